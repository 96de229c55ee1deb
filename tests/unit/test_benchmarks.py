"""What the benchmarks conclude from what they measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.endurance import GROWTH_KIB, judged
from benchmarks.simulate_scaling import fit
from hil.bench.processes import LoopRun, two_cores
from hil.signals import new_ticks


def run_of(ticks: int, in_log: int, dropped: int, growth_kib: int) -> LoopRun:
    said: dict[str, Any] = {
        "ticks": ticks, "dropped": dropped, "skipped": 0, "processor_us": 90.0, "ended": "stop_requested",
    }  # fmt: skip
    records = new_ticks(in_log)
    records["k"] = range(in_log)
    return LoopRun(5000, records, said, 1.0, Path("run.mcap"), growth_kib)


@pytest.mark.parametrize(
    ("in_log", "dropped", "growth_kib", "ok"),
    [(50, 0, 0, True), (50, 0, GROWTH_KIB + 1, False), (49, 0, 0, False), (50, 1, 0, False)],
)
def test_a_minute_holds_only_with_every_record_and_no_growth(
    in_log: int, dropped: int, growth_kib: int, ok: bool
) -> None:
    assert judged(run_of(50, in_log, dropped, growth_kib))["ok"] is ok


def test_a_straight_line_is_found_with_its_slope() -> None:
    line = fit([(x, 0.5 + 0.002 * x) for x in (1.0, 2.0, 4.0, 8.0)])
    assert (line.slope, line.intercept, line.r2) == pytest.approx((0.002, 0.5, 1.0))


def test_what_grows_quadratically_is_no_straight_line() -> None:
    assert fit([(x, x * x) for x in (1.0, 2.0, 4.0, 8.0, 16.0)]).r2 < 0.95


def test_the_loop_and_the_drive_have_a_core_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 3})
    assert two_cores(None) == (0, 3)
    assert two_cores(3) == (3, 1)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {2})
    assert two_cores(None) == (None, None)
