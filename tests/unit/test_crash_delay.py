"""How `make crash` judges the time from SIGKILL to the stop frame, and whether its control notices a stop."""

from __future__ import annotations

import os
import signal
import time

import pytest

from tests.crash.delay import BOUND_MS, MOST_MS, OWN_MS, WATCHDOG_MS, Heard, Stop, stop_of, verdict
from tests.crash.witness import PERIOD_NS, within_ms, witness

COUNTS = [1, 40, 99, 100, 200]
FAULT = "emulator stopped: state FAULT, error 0x8130, ignored frames: none"
REST = "emulator stopped: state SWITCH_ON_DISABLED, error 0x0000, ignored frames: none"
GOOD = Stop(0.4, 600.0, True, REST, silent_ms=0.9)


def judged(count: int, *odd: Stop) -> tuple[bool, str]:
    return verdict([GOOD] * (count - len(odd)) + list(odd), count)


@pytest.mark.parametrize("count", COUNTS)
def test_all_in_time_is_good(count: int) -> None:
    good, said = judged(count)
    assert good and f"of {count} kills with 600 MB locked; control late by p50 0.00" in said
    assert "over 2 ms: 0" in said and "watchdog fault: 0" in said and "\n" not in said


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("control_ms", [0.0, OWN_MS - 0.01])
def test_the_99th_percentile_is_judged_and_every_single_stop(count: int, control_ms: float) -> None:
    """A delay of the control that the loop's own end can make is no excuse."""
    late, later = (
        Stop(ms, 600.0, True, REST, control_ms=control_ms, around_ms=50.0) for ms in (BOUND_MS, MOST_MS)
    )
    spared = {1: 0, 40: 1, 99: 1, 100: 1, 200: 2}[count]
    assert judged(count, *[late] * spared)[0] and not judged(count, *[late] * (spared + 1))[0]
    good, said = judged(count, later)
    assert not good and "over 2 ms: 1, the host stood still in 0" in said and "5.00 ms after SIGKILL" in said


@pytest.mark.parametrize("count", COUNTS)
def test_one_tripped_drive_fails_at_every_count(count: int) -> None:
    good, said = judged(count, Stop(0.4, 600.0, True, FAULT, silent_ms=21.0, around_ms=WATCHDOG_MS - 0.01))
    assert not good and "watchdog fault: 1, the host stood still in 0" in said
    assert "21.00 ms after the last command" in said and "0x8130" in said


@pytest.mark.parametrize("count", COUNTS)
def test_a_host_that_stood_still_is_said_and_excused(count: int) -> None:
    late = Stop(22.0, 600.0, True, FAULT, control_ms=20.5, around_ms=WATCHDOG_MS)
    good, said = judged(count, late)
    assert good and "over 2 ms: 1, the host stood still in 1; drive in watchdog fault: 1, the host" in said
    assert "still in 1\n" in said and "control late by 20.50 ms meanwhile, 20.00 around" in said


@pytest.mark.parametrize(("after_ms", "late"), [(4.99, False), (5.0, True)])
def test_the_host_excuses_only_as_long_as_it_stood_still(after_ms: float, late: bool) -> None:
    assert judged(1, Stop(after_ms, 600.0, True, REST, control_ms=3.0))[0] != late


@pytest.mark.parametrize("without", [{"fifo": False}, {"locked_mb": 0.0}])
def test_without_rights_the_time_is_said_not_judged_and_nothing_is_excused(without: dict[str, float]) -> None:
    kept = {"locked_mb": 600.0, "fifo": True, "control_ms": 90.0, "around_ms": 90.0} | without
    good, said = judged(40, Stop(after_ms=30.0, drive=REST, **kept))  # type: ignore[arg-type]
    assert good and "not granted" in said and "over 2 ms: 1, the host stood still in 0" in said
    assert not judged(40, Stop(after_ms=30.0, drive=FAULT, **kept))[0]  # type: ignore[arg-type]


def test_kills_that_did_not_happen_fail() -> None:
    assert not verdict([], 1)[0] and not verdict([GOOD] * 39, 40)[0]


def test_a_kill_stands_beside_what_the_control_noted() -> None:
    """Meanwhile: what overlaps the time from kill to stop. Around: until the drive must have read it."""
    ms = 1_000_000
    delays = [(0, 0), (940 * ms, 951 * ms), (1001 * ms, 1004 * ms), (1090 * ms, 1200 * ms)]
    stop = stop_of(Heard(1000 * ms, 999 * ms, 1003 * ms), delays, 600.0, True, REST)
    assert (stop.after_ms, stop.silent_ms, stop.control_ms, stop.around_ms) == (3.0, 4.0, 2.0, 13.0)


@pytest.mark.parametrize(
    ("delay", "found_ms"), [((0, 9), 0.0), ((5, 12), 2.0), ((12, 15), 3.0), ((0, 90), 10.0), ((20, 30), 0.0)]
)
def test_only_what_lies_in_the_span_counts(delay: tuple[int, int], found_ms: float) -> None:
    ms = 1_000_000
    assert within_ms([(delay[0] * ms, delay[1] * ms)], 10 * ms, 20 * ms) == pytest.approx(found_ms)
    assert within_ms([], 0, 1) == 0.0


@pytest.mark.alone
def test_a_sleeper_that_was_kept_from_its_core_notes_how_long() -> None:
    with witness() as control:
        for sleeper in control.sleepers:
            os.kill(sleeper.pid, signal.SIGSTOP)
            os.waitid(os.P_PID, sleeper.pid, os.WSTOPPED)
        begun = time.time_ns()
        time.sleep(0.05)
        ended = time.time_ns()
        for sleeper in control.sleepers:
            os.kill(sleeper.pid, signal.SIGCONT)
        while sum(due < ended < woke for due, woke in control.delays()) < len(control.sleepers):
            time.sleep(0.01)
        delays = control.delays()
    whole_ms = (ended - begun) * 1e-6
    assert len(control.sleepers) == len(os.sched_getaffinity(0))
    assert whole_ms - PERIOD_NS * 1e-6 <= within_ms(delays, begun, ended) <= whole_ms
