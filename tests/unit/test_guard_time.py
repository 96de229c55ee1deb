"""Counts are of time, whatever the gaps and however few measurements come; slow messages have an age."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import hil.tick.guard
from hil.control.jit import jit
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import ALL_MISSING, Controlword, DriveState, GuardFlag, Reason, Request, RxFlag, new_ticks
from hil.tick.guard import SAFETY_PARAMS
from hil.tick.supervisor import judge_arming, note_ages
from tests.conftest import ROOT
from tests.safety import Guard

FRESH, ON = int(RxFlag.FRESH), int(DriveState.OPERATION_ENABLED)
QUIET = (
    "limits.guard_trip_ticks=1000000", "limits.following_error_rad_s=1e5", "limits.i_d_max_a=10.0",
    "limits.open_phase_min_a=5.0",
)  # fmt: skip
Feed = Callable[[int, Any], None]


def setup(*settings: str) -> Setup:
    return load_setup(ROOT / "configs/demo.toml", Overrides(settings=settings))


def ended(own: Setup, feed: Feed, gap: int = 1, fresh_every: int = 1, periods: int = 6000) -> tuple[int, str]:
    """Periods from the enabling to the stop, and its reason; ``feed`` writes each tick in operation."""
    machine, ticks = own.machine.fresh(), new_ticks()
    t, drive, k, begun, random = ticks[0], 1, 0, 0, np.random.default_rng(1)
    for n in range(periods):
        on = drive == ON
        step = gap if on else 1
        k += step
        fresh = not on or n % fresh_every == 0
        t["k"], t["t_ns"], t["gap"], t["request"] = k, k * 1_000_000, step, int(Request.ARM)
        t["rx_flags"], t["drive_state"], t["echo"] = FRESH if fresh else 0, drive, t["counter"]
        t["v_dc"], t["temperature_motor"], t["temperature_inverter"] = 540.0, 30.0, 30.0
        t["w"], t["i_q"], t["i_d"] = 0.01 * random.integers(0, 9), 0.001 * random.integers(0, 9), 0.0
        machine.prepare(ticks)
        if on:
            feed(k, t)
        else:
            begun = k
        machine.step(ticks)
        drive = {6: 2, 7: 3, 15: ON}.get(int(t["controlword"]), drive)
        if t["reason"]:
            return k - begun, Reason(int(t["reason"])).name
    return k - begun, "NONE"


def noisy(name: str, value: float) -> Feed:
    """Nearly constant, so that nothing looks frozen."""
    return lambda k, t: t.__setitem__(name, value + 1e-3 * (k % 7))


COUNTS = (
    # reason, settings, what is fed, periods to the stop with a measurement in every period
    ("I2T", (*QUIET, "limits.i2t_max_a2s=100.0"), noisy("i_q", 14.0), 757),
    ("FOLLOWING_ERROR", (*QUIET[:1], "limits.following_error_s=0.5"), noisy("w", -100.0), 501),
    ("CURRENT_UNCONTROLLED", (*QUIET[:2], "limits.following_error_s=0.5"), noisy("i_d", 4.0), 500),
    ("OVER_SPEED", (*QUIET, "limits.trip_ticks=200"), noisy("w", 160.0), 200),
    ("DC_LINK_UNDER_VOLTAGE", (*QUIET, "limits.trip_ticks=200"), noisy("v_dc", 300.0), 200),
    ("COMMAND_LOST", (*QUIET, "feedback.hold_ticks=100"), lambda k, t: t.__setitem__("echo", 3), None),
)  # fmt: skip


@functools.cache
def in_every_period(reason: str) -> tuple[int, str]:
    """:func:`ended` of a row of :data:`COUNTS` with a measurement in every period."""
    settings, feed = next((settings, feed) for name, settings, feed, _ in COUNTS if name == reason)
    return ended(setup(*settings), feed)


@pytest.mark.parametrize(("gap", "fresh_every"), [(2, 1), (5, 1), (20, 1), (1, 2), (1, 20), (1, 60), (5, 10)])
@pytest.mark.parametrize("count", COUNTS, ids=lambda count: count[0])
def test_every_count_is_of_time(count: Any, gap: int, fresh_every: int) -> None:
    reason, settings, feed, expected = count
    every, found = in_every_period(reason)
    assert found == reason
    assert expected is None or abs(every - expected) <= 2
    took, found = ended(setup(*settings), feed, gap, fresh_every)
    assert found == reason
    assert every - 2 <= took <= every + 3 * gap * fresh_every, f"{took} periods, {every} without gaps"


def test_equal_readings_are_frozen_by_time() -> None:
    own = setup("feedback.frozen_ticks=100", "limits.guard_trip_ticks=100000", *QUIET)

    def equal(k: int, t: Any) -> None:
        t["w"], t["i_q"], t["i_d"] = 20.0, 1.0, 0.0

    times = [ended(own, equal, gap) for gap in (1, 5, 20)]
    assert {reason for _, reason in times} == {"FROZEN_FEEDBACK"}
    assert times[1][0] <= times[0][0] + 20 and times[2][0] <= times[0][0] + 60
    turning = setup("feedback.repeat_ticks=200", "feedback.frozen_ticks=10000", *QUIET)
    times = [ended(turning, equal, gap) for gap in (1, 5, 20)]
    assert {reason for _, reason in times} == {"FROZEN_FEEDBACK"}
    assert [abs(took - 201) <= 2 * gap for (took, _), gap in zip(times, (1, 5, 20), strict=True)] == [
        True
    ] * 3


def test_one_measurement_after_a_long_wait_is_no_trip() -> None:
    own = setup(*QUIET[:1], "limits.following_error_s=0.05", "limits.trip_ticks=3")

    def once(k: int, t: Any) -> None:
        if k % 1000 < 120:
            t["w"] = -140.0

    took, reason = ended(own, once, fresh_every=59, periods=700)
    assert (reason, took) != ("FOLLOWING_ERROR", 59)


def test_the_enable_timeout_counts_time() -> None:
    machine, ticks = setup("feedback.enable_timeout_s=0.5").machine.fresh(), new_ticks()
    t = ticks[0]
    reasons = []
    while not t["reason"] and len(reasons) < 600:
        t["gap"], t["request"] = 5, int(Request.ARM)
        machine.step(ticks)
        reasons.append(Reason(int(t["reason"])).name)
    assert (reasons[-1], len(reasons)) == ("ENABLE_TIMEOUT", 101)


@pytest.mark.parametrize(("gap", "fresh_every"), [(5, 1), (1, 5), (20, 1), (2, 10)])
def test_sums_over_gaps_are_those_of_their_periods_to_the_bit(gap: int, fresh_every: int) -> None:
    sums = []
    for step, every in ((1, 1), (gap, fresh_every)):
        guard = Guard(rules=1, power_window=0.3, i2t_max=1e9, energy_max=1e9, hold_ticks=1000)
        guard.s["ua_q"], guard.s["ua_d"] = 70.0, -11.0
        for n in range(1, 1000 // step + 1):
            guard.t["gap"], guard.t["i_q"], guard.t["i_d"] = step, 14.0, 0.3
            guard.t["rx_flags"] = FRESH if n % every == 0 else 0
            judge_arming(guard.p[0], guard.s[0], guard.t)
        sums.append((float(guard.s["i2t"][0]), float(guard.s["energy"][0])))
    assert sums[0] == sums[1] and sums[0][0] > 100.0 and sums[0][1] > 100.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["w", "i_q", "i_d", "v_dc", "temperature_motor", "temperature_inverter"])
def test_what_is_no_number_stops_at_once(name: str, value: float) -> None:
    bad = []

    def feed(k: int, t: Any) -> None:
        if k > 40:
            t[name] = value
            bad.append(k)

    assert ended(setup(), feed)[1] == "NOT_A_NUMBER" and len(bad) == 1


def test_a_temperature_that_is_not_sent_hides_no_other() -> None:
    own = setup()
    for absent, other in ((1, "temperature_inverter"), (2, "temperature_motor")):
        own.machine.safety["carried_by"][0, absent] = 0
        name = ("v_dc", "temperature_motor", "temperature_inverter")[absent]

        def feed(k: int, t: Any, name: str = name, other: str = other) -> None:
            t[name], t[other] = math.nan, 130.0

        assert ended(own, feed) == (3, "OVER_TEMPERATURE")
        own.machine.safety["carried_by"][0, absent] = 1


def test_a_status_that_stops_is_noticed_by_its_age() -> None:
    own = setup()
    limit = int(own.machine.safety["age_max"][0, 0])
    assert limit == 5 * 10 + 60 + 20, "five cycles, hold_ticks and max_gap_ticks"
    for gap in (1, 5, 20):

        def stops(k: int, t: Any) -> None:
            t["missing"] = ALL_MISSING

        took, reason = ended(own, stops, gap)
        assert reason == "STALE_STATUS" and limit < took <= limit + gap

    def every_tenth(k: int, t: Any) -> None:
        t["missing"] = ALL_MISSING - (k % 10 == 0)

    assert ended(own, every_tenth, periods=500)[1] == "NONE"


def test_a_drive_is_not_enabled_before_its_status_has_come() -> None:
    machine, ticks = setup().machine.fresh(), new_ticks()
    t, drive, words = ticks[0], 1, []
    for _ in range(200):
        t["gap"], t["request"], t["rx_flags"], t["drive_state"] = 1, int(Request.ARM), FRESH, drive
        t["missing"] = ALL_MISSING
        machine.prepare(ticks)
        machine.step(ticks)
        words.append(int(t["controlword"]))
        drive = {6: 2, 7: 3, 15: ON}.get(words[-1], drive)
        if t["reason"]:
            break
    assert int(Controlword.ENABLE_OPERATION) not in words and drive == DriveState.SWITCHED_ON
    assert Reason(int(t["reason"])).name == "STALE_STATUS" and len(words) == 131


def test_a_drive_that_is_enabled_already_is_switched_back_until_its_status_comes() -> None:
    machine, ticks = setup().machine.fresh(), new_ticks()
    t = ticks[0]
    for missing, word in (
        (ALL_MISSING, Controlword.SWITCH_ON),
        (ALL_MISSING - 1, Controlword.ENABLE_OPERATION),
    ):
        t["gap"], t["request"], t["rx_flags"], t["drive_state"] = 1, int(Request.ARM), FRESH, ON
        t["missing"] = missing
        t["v_dc"], t["temperature_motor"], t["temperature_inverter"] = 540.0, 30.0, 30.0
        machine.prepare(ticks)
        machine.step(ticks)
        assert t["controlword"] == word


def test_a_law_at_its_limit_says_so_and_asks_for_what_it_wants() -> None:
    own = setup(*QUIET, 'reference={kind="step", w_rad_s=140.0}', "limits.du_max_v=400.0")
    seen = []

    def still(k: int, t: Any) -> None:
        seen.append((int(t["guard_flags"]), float(t["u_q_law"]), float(t["u_q"]), float(t["i_q_ref"])))

    ended(own, still, periods=60)
    flagged = [row for row in seen if row[0] & int(GuardFlag.SATURATED)]
    assert flagged and all(abs(row[3]) == 15.0 or math.hypot(row[1]) >= 300.0 for row in flagged)
    assert any(abs(row[1]) > 300.0 and abs(row[2]) <= 300.0 for row in flagged), "asked is before the circle"


def test_what_is_counted_is_bounded() -> None:
    """A gap of an hour counts as 1024 periods, which a tick can work off; slow messages have eight places."""
    guard = Guard()
    guard.t["gap"] = 3_600_000
    for _ in range(2):
        hil.tick.guard.elapse(guard.p[0], guard.s[0], guard.t)
        assert (guard.s["elapsed"][0], guard.s["gap"][0]) == (1024, 1024)
    assert SAFETY_PARAMS["age_max"].shape == (hil.tick.guard.MOST_MESSAGES,)


def test_logs_of_before_count_ticks() -> None:
    guard = Guard(rules=0)
    guard.t["gap"] = 5
    hil.tick.guard.elapse(guard.p[0], guard.s[0], guard.t)
    assert (guard.s["elapsed"][0], guard.s["gap"][0]) == (0, 0)


@pytest.mark.parametrize("name", ["u_q_seen", "u_d_seen"])
def test_what_another_controller_asks_for_must_be_a_number_where_it_is_read(name: str) -> None:
    """In a shadow run; a log of before, and a run that sends itself, know nothing of it."""
    guard = Guard(shadow=1)
    assert hil.tick.guard.all_numbers(guard.p[0], guard.s[0], guard.t)
    guard.t[name] = math.nan
    assert not hil.tick.guard.all_numbers(guard.p[0], guard.s[0], guard.t)
    for changed in ({"shadow": 0}, {"rules": 0}):
        for key, value in changed.items():
            guard.p[key] = value
        assert hil.tick.guard.all_numbers(guard.p[0], guard.s[0], guard.t)
        guard.p["shadow"] = guard.p["rules"] = 1


@pytest.mark.parametrize(
    ("place", "name"), list(enumerate(("v_dc", "temperature_motor", "temperature_inverter")))
)
def test_what_has_come_must_be_a_number_and_what_has_not_is_absent(place: int, name: str) -> None:
    guard = Guard()
    guard.p["carried_by"][0] = 1, 2, 4
    guard.t["v_dc"], guard.t["temperature_motor"], guard.t["temperature_inverter"] = 500.0, 25.0, 25.0
    guard.t[name] = math.nan
    for came in range(8):
        guard.s["came"] = came
        numbers = hil.tick.guard.all_numbers(guard.p[0], guard.s[0], guard.t)
        assert numbers is not bool(came & 1 << place), came


@jit
def larger(a: float, b: float) -> float:
    """What the compiler, or the interpreter, makes of max: with NaN each something else."""
    return max(a, b)


@pytest.mark.parametrize("rules", [0, 1])
def test_the_hotter_of_what_is_there(rules: int) -> None:
    guard = Guard(rules=rules)
    found = []
    for motor, inverter in ((40.0, 50.0), (60.0, 50.0), (math.nan, 50.0), (60.0, math.nan)):
        guard.t["temperature_motor"], guard.t["temperature_inverter"] = motor, inverter
        found.append(hil.tick.guard.hottest(guard.p[0], guard.t))
    assert found[:2] == [50.0, 60.0]
    of_before = [larger(math.nan, 50.0), larger(60.0, math.nan)]
    np.testing.assert_equal(found[2:], [50.0, 60.0] if rules else of_before)


@pytest.mark.parametrize("rules", [0, 1])
@pytest.mark.parametrize("flags", [0, FRESH])
def test_a_measurement_has_come_once_it_was_fresh(rules: int, flags: int) -> None:
    guard = Guard(rules=rules)
    guard.t["rx_flags"] = flags
    note_ages(guard.p[0], guard.s[0], guard.t)
    assert guard.s["came"][0] == (hil.tick.guard.MEASURED if rules and flags else 0)


def test_the_first_sight_counts_one_however_long_nothing_was_seen() -> None:
    """Whether it held in between is not known; afterwards time counts, and a tick at least one period."""
    assert [hil.tick.guard.grown(0, True, periods) for periods in (0, 1, 5)] == [1, 1, 1]
    assert [hil.tick.guard.grown(3, True, periods) for periods in (0, 1, 5)] == [4, 4, 8]
    assert hil.tick.guard.grown(3, False, 5) == 0


@pytest.mark.parametrize("shadow", [0, 1])
def test_a_shadow_run_waits_for_a_slow_message_that_does_not_come(shadow: int) -> None:
    guard = Guard(shadow=shadow, messages=1, age_max=3)
    guard.t["rx_flags"], guard.t["request"] = FRESH, int(Request.ARM)
    guard.s["age"] = 4
    found = judge_arming(guard.p[0], guard.s[0], guard.t)
    assert found == (Reason.NONE if shadow else Reason.STALE_STATUS)
