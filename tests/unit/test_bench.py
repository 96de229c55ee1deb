"""What `hil bench` computes of what it measured; the measuring itself is tested on real processes."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.bench.cyclictest import MISSING, cyclictest, parse
from hil.bench.histogram import TOP_US, Histogram
from hil.bench.machine import machine_facts, resident_kib
from hil.bench.measure import LOOPS, TRIES, at_rates, highest, phases, rates_that_hold
from hil.bench.meter import by_phase, reading_ns
from hil.bench.processes import awake, seconds_in_time, share_in_time
from hil.bench.view import ratios, read_result
from hil.errors import HilError
from hil.runtime.fused import LAST, LOOP, PHASES, SEND, mark, new_marks
from hil.signals import new_ticks

CYCLICTEST = """\
# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000003 000007
000010 000090
000015 000002
# Total: 000000099
# Min Latencies: 00003
# Avg Latencies: 00009
# Max Latencies: 25000
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 77
"""


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99, 0.999, 1.0])
def test_percentiles_are_the_sorted_values_to_a_microsecond(share: float) -> None:
    late_ns = np.random.default_rng(7).integers(1000, 90_000, 5000)
    exact_us = np.sort(late_ns)[int(np.ceil(share * len(late_ns))) - 1] * 1e-3
    assert exact_us <= Histogram.of(late_ns).percentile(share) <= exact_us + 1.0, "seed 7"


def test_what_is_later_than_the_histogram_is_counted_in_its_last_place() -> None:
    histogram = Histogram.of(np.array([5_000, 10**9, 2 * 10**9]))
    assert histogram.counts[5] == 1 and histogram.counts[TOP_US - 1] == 2
    assert histogram.max == 2e6


def test_octaves_hold_every_sample_once() -> None:
    late_ns = np.random.default_rng(3).integers(0, 50_000_000, 999)
    octaves = Histogram.of(late_ns).as_dict()["histogram"]
    assert sum(count for _, _, count in octaves) == 999, "seed 3"
    assert all(a[1] == b[0] for a, b in pairwise(octaves))


def test_no_samples_are_no_error() -> None:
    assert Histogram.of(np.zeros(0, np.int64)).as_dict()["p999"] == 0.0


def test_cyclictests_output_is_read() -> None:
    histogram = parse(CYCLICTEST)
    assert (histogram.counts[3], histogram.counts[10], histogram.counts[15]) == (7, 90, 2)
    assert histogram.counts[-1] == 1 and histogram.counts.sum() == 100
    assert histogram.max == 25000.0
    assert histogram.percentile(0.5) == 11.0


def test_without_cyclictest_there_is_a_line_that_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr("hil.bench.cyclictest.OTHER_FOLDERS", ())
    anchor = cyclictest(1_000_000, 1.0, 50)
    assert anchor.lateness is None and anchor.note == MISSING


@pytest.mark.parametrize("limit", [0, 1, 2, 3, 4, 5, 9])
def test_the_highest_rate_is_found_with_few_tries(limit: int) -> None:
    asked: list[int] = []

    def holds(rate: int) -> bool:
        asked.append(rate)
        return rate <= limit

    assert highest([1, 2, 3, 4, 5], holds) == (limit if limit <= 5 else 5)
    assert len(asked) <= 3


def test_a_stall_that_spoils_a_probe_does_not_decide_on_a_rate() -> None:
    """Each rate has three probes of each loop, by turns, in one of which a second must hold."""
    top, spoiled, asked = {"hil": 4000, "bare": 5000}, {("hil", 4000): 2, ("bare", 5000): 3}, Counter[Any]()
    turns: list[str] = []

    def probe(loop: str, rate_hz: int) -> list[float]:
        asked[loop, rate_hz] += 1
        turns.append(loop)
        quiet = asked[loop, rate_hz] > spoiled.get((loop, rate_hz), 0)
        return [0.99, 0.9995 if quiet and rate_hz <= top[loop] else 0.98]

    found, tried = rates_that_hold([2000, 3000, 4000, 5000, 6000], probe)
    assert found == {"hil": 4000, "bare": 4000}
    assert (
        all(asked[loop, rate] == TRIES for loop in LOOPS for rate in (4000, 5000)) and turns == [*LOOPS] * 6
    )
    assert len(tried) == asked.total() and {max(one["in_time"]) for one in tried} == {0.9995, 0.99}
    assert at_rates(tried) == {
        "4000": {"hil": 0.99, "bare": pytest.approx(0.99475)},
        "5000": {"hil": pytest.approx(0.985), "bare": pytest.approx(0.985)},
    }
    found, tried = rates_that_hold(
        [2000, 3000, 4000, 5000, 6000], lambda loop, rate_hz: [float(rate_hz <= top[loop])]
    )
    assert found == top and len(tried) == 2 * (1 + TRIES + TRIES)


def test_seconds_in_time_count_skipped_periods_and_leave_out_a_part() -> None:
    ticks = new_ticks(2300)
    ticks["k"] = np.concatenate([np.arange(990), np.arange(1000, 2310)])  # ten periods skipped in the first
    ticks["rx_flags"], ticks["sent_ns"] = 1, 900_000
    ticks["sent_ns"][1500:1520] = 1_000_000
    ticks["rx_flags"][1600] = 0
    assert seconds_in_time(ticks, 1000) == [0.99, 0.979]
    assert share_in_time(ticks, 1000) == pytest.approx((2300 - 21) / 2310)
    assert seconds_in_time(new_ticks(0), 1000) == [] and share_in_time(new_ticks(0), 1000) == 0.0


def children() -> set[int]:
    lists = Path("/proc/self/task").glob("*/children")
    return {int(pid) for one in lists for pid in one.read_text().split()}


def test_cores_are_kept_awake_by_what_gives_way_to_all_others() -> None:
    before = children()
    with awake(False):
        assert children() == before
    with awake(True):
        spinning = children() - before
        assert {os.sched_getscheduler(pid) for pid in spinning} == {os.SCHED_IDLE}
        assert {frozenset(os.sched_getaffinity(pid)) for pid in spinning} == {
            frozenset({core}) for core in os.sched_getaffinity(0)
        }
    assert children() == before


def test_phases_are_differences_of_the_stamps() -> None:
    ticks = new_ticks(3)
    for name, value in (("lateness", 10), ("received", 110), ("computed", 118), ("sent", 150)):
        ticks[f"{name}_ns"] = value * 1000
    ticks["recorded_ns"] = 153_000
    assert phases(ticks) == pytest.approx({"exchange": 100.0, "control": 8.0, "send": 32.0, "record": 3.0})


def test_ratios_are_now_over_then_where_both_have_a_figure() -> None:
    now: dict[str, Any] = {"rate_hz": 4000, "tick_us": {"control": 6.0}, "cyclictest_us": None}
    then = {"rate_hz": 2000, "tick_us": {"control": 12.0}, "cyclictest_us": {"p999": 80.0}}
    found = ratios(now, then)
    assert {key: one["ratio"] for key, one in found.items()} == {"rate_hz": 2.0, "tick_us.control": 0.5}


@pytest.mark.parametrize("text", ["", "[1]", '{"a": 1}', "{"])
def test_a_file_that_is_no_bench_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "earlier.json"
    path.write_text(text)
    with pytest.raises(HilError, match="is no output of hil bench"):
        read_result(path)


def test_the_machine_is_described_in_json() -> None:
    facts = machine_facts()
    assert facts["cores"] >= 1 and facts["kernel"]
    assert json.loads(json.dumps(facts)) == facts


def test_memory_of_a_process_that_has_gone_is_zero() -> None:
    assert resident_kib(2**22 + 1) == 0


@pytest.mark.compiled
def test_a_border_gives_its_phase_what_the_thread_took_since_the_last() -> None:
    marks, times = new_marks(), np.zeros(4, np.int64)
    mark(marks, LOOP, times)
    marks[LOOP] = 0
    end = time.thread_time_ns() + 2_000_000
    while time.thread_time_ns() < end:
        pass
    mark(marks, SEND, times)
    assert 1_900_000 < marks[SEND] < 20_000_000
    assert marks[LAST] <= time.thread_time_ns()
    assert marks.sum() == marks[SEND] + marks[LAST]
    mark(np.zeros(0, np.int64), SEND, times)  # without a meter
    assert 0 < reading_ns() < 1e6


def test_phases_are_a_ticks_share_without_the_readings() -> None:
    marks = new_marks()
    marks[:LAST] = np.arange(1, LAST + 1) * 1000
    found = by_phase(marks, 10, 30.0)
    assert list(found) == list(PHASES) and found["loop"] == 70.0 and found["record"] == 100.0 * LAST - 30.0


def test_a_run_without_a_compiled_tick_has_no_phases() -> None:
    with pytest.raises(HilError, match="no phases"):
        by_phase(new_marks(), 10, 0.0)
