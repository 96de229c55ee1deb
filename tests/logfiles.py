"""Made-up runs for the tests of the log: ticks with content, a file with every kind of record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.log.mcapfile import RunFile
from hil.log.schema import FRAME, Records
from hil.signals import FIELDS, TickArray, new_ticks

PERIOD_NS = 1_000_000
HEADER: dict[str, Any] = {
    "metadata": {"kind": "test", "clock": "lockstep", "seed": 7},
    "attachments": {"config.toml": "[loop]\nrate_hz = 1000\n", "drive.dbc": 'VERSION ""\n' * 40},
}


def some_ticks(count: int, first: int = 0, seed: int = 1) -> TickArray:
    """Consecutive ticks with random values in every field."""
    rng, ticks = np.random.default_rng(seed + first), new_ticks(count)
    for field in FIELDS:
        if field.kind == "f8":
            ticks[field.name] = rng.normal(size=count)
        else:
            ticks[field.name] = rng.integers(0, 1000, count)
    ticks["k"] = np.arange(first, first + count)
    ticks["t_ns"] = ticks["k"] * PERIOD_NS
    ticks["gap"] = 1
    ticks["check"] += 1  # 0 says that there is none, and the log sets it
    return ticks


def some_frames(count: int, seed: int = 1) -> Records:
    """Frames of every length up to 64 bytes, both ways."""
    rng, frames = np.random.default_rng(seed), np.zeros(count, FRAME)
    frames["t_ns"] = np.arange(count) * PERIOD_NS // 4
    frames["can_id"] = rng.integers(0, 0x800, count)
    frames["received"] = rng.integers(0, 2, count)
    frames["size"] = rng.integers(0, 65, count)
    inside = np.arange(64)[None, :] < frames["size"][:, None]
    frames["data"] = np.where(inside, rng.integers(0, 256, (count, 64)), 0)
    return frames


def write_log(path: Path, ticks: TickArray, frames: Records, *, block: int = 50) -> None:
    """A complete log, its chunks closed every ``block`` ticks as a slow run's would be."""
    with RunFile(path, HEADER, chunk_bytes=64 * 1024) as file:
        share = len(frames) * block // max(1, len(ticks))
        for number, at in enumerate(range(0, len(ticks), block)):
            file.add_ticks(ticks[at : at + block])
            file.add_frames(frames[number * share : (number + 1) * share])
            file.add_event(at * PERIOD_NS, at, "block", f"ticks from {at} on")
            file.add_stats(at * PERIOD_NS, {"ticks": at})
            file.flush()
        file.finish({"ended": "stop_requested", "ticks": len(ticks)})
