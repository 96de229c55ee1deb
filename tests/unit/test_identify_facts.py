"""Facts of bus and sensors: what runs tell of resolution and arrival, against what they were made with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.identify.estimate import Estimate
from hil.identify.facts import arrivals, note_facts, offsets, resolution
from hil.log.reader import Frame, Log
from hil.signals import RxFlag, TickArray, new_ticks

COUNT = 2000


def ticks() -> TickArray:
    """Noise rounded to 0.01 rad/s and 2 mA, no i_d, taken 0.2 ms after the deadline, 30 us of jitter."""
    random, out = np.random.default_rng(3), new_ticks(COUNT)
    out["t_ns"] = 5_000_000 + 1_000_000 * np.arange(COUNT)
    out["rx_flags"] = int(RxFlag.FRESH)
    out["w"] = np.rint(random.normal(0.0, 3.0, COUNT)) * 0.01
    out["i_q"] = np.rint(random.normal(0.0, 5.0, COUNT)) * 0.002
    out["i_d"] = np.nan
    out["received_ns"] = 200_000 + random.normal(0.0, 30_000, COUNT)
    return out


def test_figures_are_those_of_the_run() -> None:
    out, run = Estimate(), ticks()
    run["rx_flags"][::7], run["received_ns"][::7], run["w"][::7] = 0, 900_000, 0.0033
    note_facts(out, [run])
    p = out.parameters
    assert p["w_lsb"].value == pytest.approx(0.01) and p["i_q_lsb"].value == pytest.approx(0.002)
    assert "i_d_lsb" not in p
    assert p["arrival"].low < 200e-6 < p["arrival"].high
    assert p["arrival_jitter"].low < 30e-6 < p["arrival_jitter"].high < 35e-6


def test_few_measurements_or_one_value_tell_nothing() -> None:
    out = Estimate()
    note_facts(out, [ticks()[:49]])
    assert out.parameters == {}
    assert resolution(np.full(100, 3.0)) is None


def test_every_frame_has_its_own_arrival() -> None:
    run = ticks()
    frames = [Frame(True, int(t) + 100_000, 0x181, b"") for t in run["t_ns"]]
    frames += [
        Frame(True, int(t) + 300_000 + 50_000 * (k % 2), 0x281, b"") for k, t in enumerate(run["t_ns"])
    ]
    frames += [Frame(False, int(run["t_ns"][0]), 0x80, b""), Frame(True, 0, 0x181, b"")]
    found = offsets(Log(Path("a.mcap"), run, frames))
    rows = arrivals([found, found])
    assert [(row["can_id"], row["frames"]) for row in rows] == [("0x181", 2 * COUNT), ("0x281", 2 * COUNT)]
    assert rows[0]["median_ms"] == pytest.approx(0.1) and rows[0]["jitter_ms"] == pytest.approx(0.0, abs=1e-9)
    assert rows[1]["jitter_ms"] == pytest.approx(0.025) and rows[1]["p99_ms"] == pytest.approx(0.35)
