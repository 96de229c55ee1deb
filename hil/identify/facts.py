"""Facts of bus and sensors as figures: resolution of each measured signal, when its frame arrives.

They need no motion and no model, only runs; how the echo of the commands lags stands with the delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from hil.control.linalg import Array
from hil.identify.estimate import UNITS, Estimate, Parameter
from hil.log.reader import Log
from hil.signals import RxFlag, TickArray

FEW: Final = 50
"""Measurements below which nothing is told."""
SIGNALS: Final = ("w", "i_q", "i_d")


def note_facts(out: Estimate, runs: Sequence[TickArray]) -> None:
    """Add ``w_lsb``, ``i_q_lsb``, ``i_d_lsb``; ``arrival``, ``arrival_jitter`` of the newest measurement.

    The resolution is the least difference of two measured values; arrival is after the tick's deadline, its
    jitter the standard deviation.
    """
    fresh = [run[(run["rx_flags"] & int(RxFlag.FRESH)) != 0] for run in runs]
    for name in SIGNALS:
        step = resolution(np.concatenate([run[name] for run in fresh]))
        if step is not None:
            out.put(f"{name}_lsb", step, 0.0)
    after = np.concatenate([run["received_ns"] for run in fresh]) * 1e-9
    if len(after) < FEW:
        return
    mean, spread = float(np.mean(after)), float(np.std(after))
    half = 1.96 * spread / math.sqrt(2 * len(after))
    out.put("arrival", mean, math.sqrt(2.0) * half)
    out.parameters["arrival_jitter"] = Parameter(
        spread, spread - half, spread + half, UNITS["arrival_jitter"]
    )


def resolution(values: Array) -> float | None:
    """Least difference of two values (N,), rounding aside; None where they are few or all the same."""
    told = np.unique(values[np.isfinite(values)])
    steps = np.diff(told)
    steps = steps[steps > 1e-9 * float(np.abs(told).max(initial=0.0))]
    return float(np.median(steps[steps < 1.5 * steps.min()])) if len(values) >= FEW and len(steps) else None


def offsets(log: Log) -> dict[int, Array]:
    """By identifier of a received frame: when each came [s] after its tick's deadline (N,)."""
    at, out = log.ticks["t_ns"].astype(np.int64), {}
    for can_id in sorted({frame.can_id for frame in log.frames if frame.received}):
        came = np.array([f.t_ns for f in log.frames if f.received and f.can_id == can_id], np.int64)
        tick = np.searchsorted(at, came, "right") - 1
        out[can_id] = (came - at[tick])[tick >= 0] * 1e-9
    return out


def arrivals(steps: Sequence[dict[int, Array]]) -> list[dict[str, Any]]:
    """A row a received frame over several runs: median, standard deviation and 99th percentile [ms]."""
    rows = []
    for can_id in sorted({key for step in steps for key in step}):
        after = 1e3 * np.concatenate([step[can_id] for step in steps if can_id in step])
        if len(after):
            row: dict[str, Any] = {"can_id": f"0x{can_id:X}", "frames": len(after)}
            row |= {"median_ms": float(np.median(after)), "jitter_ms": float(np.std(after))}
            rows.append(row | {"p99_ms": float(np.quantile(after, 0.99))})
    return rows
