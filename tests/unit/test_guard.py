"""The guard alone: what it lets through, changes and trips on, without any control law."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.signals import DriveState, GuardFlag, Reason
from hil.tick.guard import (
    inward,
    is_denormal,
    is_frozen,
    limit_step,
    to_wire,
    voltage_limit,
    windows_trip,
)
from tests.safety import Guard

ANY = st.floats(allow_nan=True, allow_infinity=True)


def test_what_is_within_limits_passes_rounded_to_the_wire() -> None:
    assert Guard().ask(12.344, -3.127, 1.236) == (12.34, -3.13, 1.24, 0, 0)


def test_no_negative_zero_leaves() -> None:
    u_q, u_d, T_L, _, _ = Guard().ask(-0.001, -0.0, -0.004)
    assert [math.copysign(1.0, v) for v in (u_q, u_d, T_L)] == [1.0, 1.0, 1.0]


def test_the_circle_keeps_the_direction() -> None:
    u_q, u_d, _, flags, _ = Guard(du_max=1e9).ask(600.0, 800.0)
    assert (u_q, u_d) == (180.0, 240.0) and flags == GuardFlag.VOLTAGE


def test_the_step_limit_counts_from_the_last_command() -> None:
    guard = Guard()
    assert [guard.ask(120.0)[0] for _ in range(4)] == [50.0, 100.0, 120.0, 120.0]
    assert guard.ask(-120.0)[0] == 70.0


def test_load_torque_is_limited() -> None:
    assert Guard().ask(0.0, 0.0, -11.0)[2:4] == (-10.0, GuardFlag.LOAD_TORQUE)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", range(3))
def test_what_is_no_number_becomes_zero_and_stops(bad: float, where: int) -> None:
    asked = [1.0, 1.0, 1.0]
    asked[where] = bad
    u_q, u_d, T_L, flags, reason = Guard().ask(*asked)
    assert (u_q, u_d, T_L) == (0.0, 0.0, 0.0)
    assert flags & GuardFlag.NOT_A_NUMBER and reason == Reason.CONTROLLER_ERROR


def test_denormals_become_zero() -> None:
    u_q, _, _, flags, reason = Guard().ask(5e-324, 2.0)
    assert u_q == 0.0 and flags & GuardFlag.DENORMAL and reason == Reason.NONE
    assert not is_denormal(0.0) and not is_denormal(2.3e-308) and is_denormal(-2.2e-308)


@pytest.mark.parametrize("state", [s for s in DriveState if s != DriveState.OPERATION_ENABLED])
def test_states_in_which_only_zero_may_be_sent(state: DriveState) -> None:
    guard = Guard()
    guard.t["state"] = int(state)
    assert guard.ask(10.0, 10.0, 10.0) == (0.0, 0.0, 0.0, int(GuardFlag.STATE_FORCES_ZERO), 0)


def test_a_persistent_excess_trips_and_a_passing_one_does_not() -> None:
    guard = Guard(du_max=1e9)
    assert [guard.ask(301.0)[4] for _ in range(5)] == [0, 0, 0, 0, Reason.GUARD_PERSISTENT]
    guard = Guard(du_max=1e9)
    for _ in range(20):
        assert all(guard.ask(301.0)[4] == 0 for _ in range(4))
        assert guard.ask(299.0)[4] == 0


def test_soft_start_grows_and_never_trips() -> None:
    guard = Guard(soft_start_ticks=100, du_max=1e9)
    sent = []
    for k in range(120):
        guard.s["run_ticks"] = k
        u_q, _, _, _, reason = guard.ask(250.0)
        assert reason == Reason.NONE
        sent.append(u_q)
    assert sent[0] == 0.0 and sent[50] == 150.0 and sent[100] == 250.0
    assert all(b >= a for a, b in itertools.pairwise(sent))
    guard.s["run_ticks"] = 100
    assert voltage_limit(guard.p[0], guard.s[0]) == 300.0


def test_an_applied_voltage_that_deviates_trips_when_it_persists() -> None:
    guard = Guard(deviation_max=5.0)
    guard.s["ua_q"] = 20.0
    guard.ask(14.0)
    assert guard.t["guard_flags"] & GuardFlag.APPLIED_DEVIATES
    reasons = []
    for _ in range(6):
        guard.s["ua_q"] = 20.0
        reasons.append(guard.ask(14.0)[4])
    assert Reason.GUARD_PERSISTENT in reasons
    guard.s["ua_q"], guard.s["ua_d"] = 17.0, 4.0  # 5 V away: allowed
    guard.ask(14.0)
    assert not guard.t["guard_flags"] & GuardFlag.APPLIED_DEVIATES


@pytest.mark.parametrize(("deviation_max", "deviates"), [(5.0, True), (math.inf, False)])
def test_a_drive_that_limits_the_voltage_deviates_when_there_is_a_limit(
    deviation_max: float, deviates: bool
) -> None:
    guard = Guard(deviation_max=deviation_max)
    guard.ask(14.0)
    guard.s["ua_q"], guard.t["limited"] = 14.0, 1
    guard.ask(14.0)
    assert bool(guard.t["guard_flags"] & GuardFlag.APPLIED_DEVIATES) == deviates


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy scalars warn where compiled code does not
@given(u_q=ANY, u_d=ANY, T_L=ANY, before_q=st.floats(-300, 300), state=st.sampled_from(list(DriveState)))
@settings(max_examples=300, deadline=None)
def test_whatever_is_asked_what_leaves_is_safe(
    u_q: float, u_d: float, T_L: float, before_q: float, state: DriveState
) -> None:
    guard = Guard()
    guard.t["state"] = int(state)
    guard.s["u_q"] = before_q
    got_q, got_d, got_T, _, _ = guard.ask(u_q, u_d, T_L)
    assert all(map(math.isfinite, (got_q, got_d, got_T)))
    if state != DriveState.OPERATION_ENABLED or not all(map(math.isfinite, (u_q, u_d, T_L))):
        assert (got_q, got_d, got_T) == (0.0, 0.0, 0.0)
        return
    assert abs(got_q - before_q) <= 50.0 + 0.01 and abs(got_d) <= 50.0 + 0.01 and abs(got_T) <= 10.0
    assert math.hypot(got_q, got_d) <= 300.0 + 1e-9


def test_to_wire_is_what_a_codec_does() -> None:
    assert to_wire(0.125, 0.25) == 0.0 and to_wire(0.375, 0.25) == 0.5  # halves to even
    assert limit_step(5.0, 0.0, 2.0) == 2.0 and limit_step(-5.0, 0.0, 2.0) == -2.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_energy_window_trips_on_power_in_either_direction(sign: float) -> None:
    """300 W into a window of 1 s: e_n = 300 (1 - (1 - T_s)^n) passes 50 J at n = 183."""
    guard = Guard(energy_max=50.0)
    guard.s["ua_q"], guard.t["i_q"] = 100.0, 2.0 * sign
    tick, reason = 0, 0
    while reason == 0 and tick < 400:
        reason, tick = windows_trip(guard.p[0], guard.s[0], guard.t), tick + 1
    assert (tick, reason) == (183, Reason.ENERGY)
    assert abs(guard.s["energy"][0]) == pytest.approx(300.0 * (1.0 - 0.999**183), rel=1e-12)


def test_the_energy_window_forgets() -> None:
    guard = Guard(energy_max=50.0)
    guard.s["energy"], guard.t["i_q"] = 49.0, 0.0
    for _ in range(1000):
        assert windows_trip(guard.p[0], guard.s[0], guard.t) == Reason.NONE
    assert guard.s["energy"][0] == pytest.approx(49.0 * 0.999**1000, rel=1e-12)


def frozen_after(guard: Guard, ticks: int) -> list[bool]:
    return [is_frozen(guard.p[0], guard.s[0], guard.t) for _ in range(ticks)]


def test_equal_readings_are_frozen_once_the_voltage_has_moved_far_enough() -> None:
    guard = Guard()
    guard.t["w"], guard.t["i_q"], guard.t["i_d"] = 10.0, 1.0, 0.1
    guard.s["ua_q"] = 50.0
    assert not any(frozen_after(guard, 20))  # equal, but so is the voltage
    guard.s["ua_q"] = 50.0 + 0.65
    assert not any(frozen_after(guard, 20))
    guard.s["ua_q"] = 50.0 + 0.67
    assert frozen_after(guard, 6) == [False] * 4 + [True] * 2
    for name in ("w", "i_q", "i_d"):  # a change of any one ends it
        guard.t[name] += 0.01
        assert frozen_after(guard, 1) == [False] and guard.s["frozen"][0] == 0


def test_a_drive_that_limits_the_voltage_is_not_frozen() -> None:
    guard = Guard()
    frozen_after(guard, 1)
    guard.s["ua_d"], guard.t["limited"] = 100.0, 1
    assert not any(frozen_after(guard, 20))


def test_repeated_readings_of_a_turning_motor_are_frozen_where_sensors_are_noisy() -> None:
    guard = Guard(repeat_ticks=4)
    guard.t["w"] = 10.0
    assert frozen_after(guard, 6) == [False] * 4 + [True] * 2
    guard.t["w"] = 0.0
    assert not any(frozen_after(guard, 20))


@pytest.mark.parametrize("rules", [0, 1])
def test_rounding_to_the_wire_does_not_leave_the_circle(rules: int) -> None:
    """The nearest steps of a command on the circle, (299.3, -20.5), are 1.2 mV outside of it."""
    asked = (math.sqrt(300.0**2 - 20.496**2), -20.496)
    u_q, u_d, *_ = Guard(du_max=1e9, rules=rules).ask(*asked)
    assert (u_q, u_d) == [(29930 * 0.01, -2050 * 0.01), (29929 * 0.01, -2049 * 0.01)][rules]
    assert (math.hypot(u_q, u_d) <= 300.0) == bool(rules)


@pytest.mark.parametrize("asked", [(300.0, 0.0), (-180.0, 240.0), (0.0, -300.0), (299.29, 20.6)])
def test_a_step_of_the_wire_in_the_circle_is_sent_as_it_is(asked: tuple[float, float]) -> None:
    assert Guard(du_max=1e9).ask(*asked)[:2] == asked
    assert [inward(u, 0.01) for u in asked] == list(asked)


def test_less_than_a_step_of_the_wire_is_zero_without_a_sign() -> None:
    assert [math.copysign(1.0, inward(u, 0.01)) for u in (0.009, -0.009)] == [1.0, 1.0]


@pytest.mark.parametrize("seed", range(20))
def test_a_limited_step_stays_in_the_circle(seed: int) -> None:
    """Both axes limited by themselves reached 311 V of 300: from (212, 212) towards (300, 0)."""
    random = np.random.default_rng(seed)
    guard = Guard()
    for _ in range(40):
        angle = random.uniform(0, 2 * math.pi)
        u_q, u_d, *_ = guard.ask(900 * math.cos(angle), 900 * math.sin(angle))
        assert math.hypot(u_q, u_d) <= 300.0 + 1e-9, f"seed {seed}"
