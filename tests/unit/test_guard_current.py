"""The guard of a drive with a current loop: what it takes for what the drive does not report."""

from __future__ import annotations

import math

import pytest

from hil.signals import Reason
from hil.tick import guard as rules
from hil.tick.guard import (
    NO_I_D,
    NO_I_Q,
    all_numbers,
    currents,
    is_frozen,
    judge_measurement,
    power_in,
    windows_trip,
)
from tests.safety import Guard

NEITHER = NO_I_Q | NO_I_D


def test_what_is_not_reported_has_a_bit_of_its_own_as_logs_keep_it() -> None:
    assert (rules.NO_I_Q, rules.NO_I_D, rules.NO_ANGLE) == (1, 2, 4)


def guard_of(absent: int = 0, **changed: float) -> Guard:
    """A command of 6 N m at 2 N m/A is 3 A; reported, where they are, 5 A and 7 A at 4 rad/s."""
    guard = Guard(k_u=0.5, u_i=2.0, absent=absent, **changed)
    guard.s["ua_q"], guard.s["ua_d"] = 6.0, 0.0
    guard.t["i_q"], guard.t["i_d"], guard.t["w"] = 5.0, 7.0, 4.0
    return guard


@pytest.mark.parametrize(
    ("absent", "judged"),
    [(0, (5.0, 7.0)), (NO_I_Q, (3.0, 7.0)), (NO_I_D, (5.0, 0.0)), (NEITHER, (3.0, 0.0))],
)
def test_a_current_that_is_not_reported_is_the_one_asked_for(
    absent: int, judged: tuple[float, float]
) -> None:
    guard = guard_of(absent)
    assert currents(guard.p[0], guard.s[0], guard.t) == judged


def test_power_is_torque_times_speed_or_by_voltages_and_currents() -> None:
    guard = guard_of()
    assert power_in(guard.p[0], guard.s[0], guard.t, 5.0, 7.0) == 0.5 * 6.0 * 4.0
    guard.p["k_u"], guard.s["ua_d"] = 0.0, 2.0
    assert power_in(guard.p[0], guard.s[0], guard.t, 5.0, 7.0) == 1.5 * (6.0 * 5.0 + 2.0 * 7.0)


def test_windows_are_of_what_is_judged() -> None:
    """i2t adds (9 - 4) 0.5 = 2.5 A2 s by the command, energy 12 * 0.5 = 6 J by torque and speed."""
    guard = guard_of(NEITHER, T_s=0.5, i_continuous=2.0, power_window=2.0)
    assert windows_trip(guard.p[0], guard.s[0], guard.t) == Reason.NONE
    assert (guard.s["i2t"][0], guard.s["energy"][0]) == (2.5, 6.0)


@pytest.mark.parametrize("absent", [0, NO_I_Q, NO_I_D, NEITHER])
@pytest.mark.parametrize("name", ["i_q", "i_d"])
def test_only_what_is_reported_must_be_a_number_and_may_trip(absent: int, name: str) -> None:
    reported = not absent & (NO_I_Q if name == "i_q" else NO_I_D)
    guard = guard_of(absent, trip_ticks=1)
    guard.t[name] = math.nan
    assert all_numbers(guard.p[0], guard.s[0], guard.t) is not reported
    guard.t[name] = 23.0
    assert (judge_measurement(guard.p[0], guard.s[0], guard.t) == Reason.OVER_CURRENT) is reported


@pytest.mark.parametrize("absent", [0, NO_I_Q, NO_I_D, NEITHER])
@pytest.mark.parametrize("name", ["i_q", "i_d"])
def test_what_is_not_reported_can_not_show_that_readings_live(absent: int, name: str) -> None:
    """A field that the drive never sends may hold anything: speed alone tells then."""
    reported = not absent & (NO_I_Q if name == "i_q" else NO_I_D)
    guard, found = guard_of(absent), []
    for tick in range(8):
        guard.t[name] = 20.0 + tick
        guard.s["ua_q"] = 6.0 + tick
        found.append(is_frozen(guard.p[0], guard.s[0], guard.t))
    assert any(found) is not reported
    assert guard.s["seen"][0].tolist()[0] == 4.0
