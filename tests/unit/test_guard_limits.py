"""Every limit of the guard at its last allowed and its first refused value, function by function."""

from __future__ import annotations

import math

import pytest

import hil.tick.guard
from hil.signals import DriveState, GuardFlag, Reason, RxFlag
from hil.tick.guard import (
    deviates,
    guard_command,
    is_denormal,
    is_frozen,
    judge_measurement,
    limit_step,
    persistent_excess,
    persists,
    step_share,
    to_wire,
    voltage_limit,
    windows_trip,
    write_command,
)
from tests.safety import Guard

LEAST_NORMAL = 2.2250738585072014e-308


def test_an_excess_persists_after_so_many_ticks_in_a_row() -> None:
    s = Guard().s[0]
    held = [persists(s, 2, exceeded, 3) for exceeded in (True, True, False, True, True, True, True)]
    assert held == [False] * 5 + [True] * 2
    assert s["over"].tolist() == [0, 0, 4, 0, 0, 0, 0, 0]


def windows(i2t_max: float = math.inf, energy_max: float = math.inf, sign: float = 1.0) -> Guard:
    """A tick that adds (25 - 9) 0.5 = 8 A2 s, and 1.5 * 10 * 0.5 - 4 * 0.5 / 2 = 6.5 J to 4 J."""
    guard = Guard(T_s=0.5, i_continuous=3.0, power_window=2.0, i2t_max=i2t_max, energy_max=energy_max)
    guard.t["i_q"], guard.t["i_d"] = 3.0 * sign, 4.0 * sign
    guard.s["ua_q"], guard.s["ua_d"], guard.s["energy"] = 2.0, 1.0, 4.0 * sign
    return guard


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_windows_add_what_their_equations_say(sign: float) -> None:
    guard = windows(sign=sign)
    assert windows_trip(guard.p[0], guard.s[0], guard.t) == Reason.NONE
    assert (guard.s["i2t"][0], guard.s["energy"][0]) == (8.0, 10.5 * sign)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("i2t_max", "energy_max", "reason"),
    [
        (8.0, 10.5, Reason.NONE),
        (7.9, 10.5, Reason.I2T),
        (8.0, 10.4, Reason.ENERGY),
        (7.9, 10.4, Reason.I2T),
    ],
)
def test_windows_trip_above_their_limits(
    sign: float, i2t_max: float, energy_max: float, reason: Reason
) -> None:
    guard = windows(i2t_max, energy_max, sign)
    assert windows_trip(guard.p[0], guard.s[0], guard.t) == reason


def test_i2t_does_not_fall_below_zero() -> None:
    guard = windows()
    guard.p["i_continuous"] = 5.5
    assert windows_trip(guard.p[0], guard.s[0], guard.t) == Reason.NONE and guard.s["i2t"][0] == 0.0


def seen(guard: Guard) -> tuple[list[float], float, float, int, int]:
    s = guard.s[0]
    return s["seen"].tolist(), s["seen_q"], s["seen_d"], int(s["frozen"]), int(s["repeats"])


def frozen(guard: Guard) -> bool:
    return bool(is_frozen(guard.p[0], guard.s[0], guard.t))


def standing(w: float = 1.0, **changed: float) -> Guard:
    """A guard that has seen the same reading twice, with a voltage that has not moved."""
    guard = Guard(frozen_ticks=2, frozen_du=5.0, **changed)
    guard.t["w"], guard.t["i_q"], guard.t["i_d"] = w, 2.0, 3.0
    guard.s["ua_q"], guard.s["ua_d"] = 10.0, 20.0
    assert not frozen(guard) and seen(guard) == ([w, 2.0, 3.0], 10.0, 20.0, 0, 0)
    assert not frozen(guard) and seen(guard) == ([w, 2.0, 3.0], 10.0, 20.0, 0, int(w != 0.0))
    return guard


@pytest.mark.parametrize(
    ("u_q", "u_d", "moved"),
    [(13.0, 24.0, 0), (13.1, 24.0, 1), (13.0, 24.1, 1), (7.0, 16.0, 0), (6.9, 16.0, 1), (7.0, 15.9, 1)],
)
def test_a_reading_stands_still_when_the_voltage_moved_further_than_its_limit(
    u_q: float, u_d: float, moved: int
) -> None:
    guard = standing()
    guard.s["ua_q"], guard.s["ua_d"] = u_q, u_d
    assert not frozen(guard) and guard.s["frozen"][0] == moved
    assert frozen(guard) is bool(moved) and guard.s["frozen"][0] == 2 * moved
    guard.s["ua_q"], guard.s["ua_d"] = 10.0, 20.0
    assert not frozen(guard) and guard.s["frozen"][0] == 0


@pytest.mark.parametrize("name", ["w", "i_q", "i_d"])
def test_any_change_of_a_reading_begins_anew(name: str) -> None:
    guard = standing()
    guard.s["ua_q"] = 30.0
    assert not frozen(guard) and guard.s["frozen"][0] == 1
    guard.t[name] += 0.01
    assert not frozen(guard)
    assert seen(guard) == ([float(guard.t[n]) for n in ("w", "i_q", "i_d")], 30.0, 20.0, 0, 0)


def test_a_limiting_drive_begins_anew() -> None:
    guard = standing()
    guard.s["ua_q"], guard.t["limited"] = 30.0, 1
    assert not frozen(guard) and seen(guard) == ([1.0, 2.0, 3.0], 30.0, 20.0, 0, 0)


def test_equal_readings_of_a_turning_motor_count_and_of_a_standing_one_do_not() -> None:
    guard = standing(repeat_ticks=3)
    assert [frozen(guard) for _ in range(3)] == [False, True, True]
    guard.t["w"] = 0.0
    assert [frozen(guard) for _ in range(9)] == [False] * 9 and guard.s["repeats"][0] == 0


def good() -> Guard:
    """A measurement exactly at all limits: allowed. Currents of 9 and 12 A make exactly 15 A."""
    guard = Guard(i_trip=15.0, v_dc_min=450.0, v_dc_max=650.0, trip_ticks=2)
    for name, value in {
        "w": 150.0,
        "i_q": 9.0,
        "i_d": 12.0,
        "temperature_motor": 110.0,
        "temperature_inverter": 110.0,
        "v_dc": 450.0,
    }.items():
        guard.t[name] = value
    return guard


def judged(guard: Guard) -> int:
    guard.t["i_q"] -= 1e-9  # moves, so that it is not frozen
    return int(judge_measurement(guard.p[0], guard.s[0], guard.t))


def at_the_limits(guard: Guard, ticks: int = 6) -> list[int]:
    return [int(judge_measurement(guard.p[0], guard.s[0], guard.t)) for _ in range(ticks)]


def test_at_all_limits_nothing_trips() -> None:
    guard = good()
    assert at_the_limits(guard) == [0] * 6
    guard.t["w"], guard.t["v_dc"] = -150.0, 650.0
    assert at_the_limits(guard) == [0] * 6
    assert not guard.s["over"].any()


EXCESS = {
    Reason.OVER_SPEED: ("w", 150.1),
    Reason.OVER_CURRENT: ("i_d", 12.1),
    Reason.OVER_TEMPERATURE: ("temperature_motor", 110.1),
    Reason.DC_LINK_UNDER_VOLTAGE: ("v_dc", 449.9),
    Reason.DC_LINK_OVER_VOLTAGE: ("v_dc", 650.1),
}


@pytest.mark.parametrize("reason", EXCESS, ids=lambda reason: reason.name)
def test_beyond_one_limit_its_reason_trips_after_the_time(reason: Reason) -> None:
    guard = good()
    name, value = EXCESS[reason]
    guard.t[name] = value
    assert [judged(guard) for _ in range(3)] == [0, reason, reason]
    guard.t[name] = {"v_dc": 500.0}.get(name, 0.0)
    assert judged(guard) == 0 and not guard.s["over"].any()


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("w", -150.1, Reason.OVER_SPEED),
        ("i_q", -9.1, Reason.OVER_CURRENT),
        ("i_q", 9.1, Reason.OVER_CURRENT),
        ("i_d", -12.1, Reason.OVER_CURRENT),
        ("temperature_inverter", 110.1, Reason.OVER_TEMPERATURE),
    ],
)
def test_the_other_side_and_the_other_sensor_trip_too(name: str, value: float, reason: Reason) -> None:
    guard = good()
    guard.t[name] = value
    assert [judged(guard) for _ in range(2)] == [0, reason]


def test_the_reasons_in_order_of_their_weight() -> None:
    guard = good()
    guard.p["frozen_ticks"], guard.p["i2t_max"] = 1, 0.0
    guard.t["w"], guard.t["i_q"], guard.t["i_d"], guard.t["temperature_motor"] = 160.0, 20.0, 20.0, 120.0
    guard.s["ua_q"] = 0.0
    at_the_limits(guard, 1)
    guard.s["ua_q"] = 50.0  # and now it is frozen, too
    order = []
    for name, value in (("w", 1.0), ("i_q", 9.0), ("temperature_motor", 20.0)):
        order += at_the_limits(guard, 2)[1:]
        guard.t[name] = value
        if name == "i_q":
            guard.t["i_d"] = 0.0
    assert order == [Reason.OVER_SPEED, Reason.OVER_CURRENT, Reason.OVER_TEMPERATURE]
    guard.t["v_dc"] = 449.0
    assert at_the_limits(guard, 3)[2] == Reason.DC_LINK_UNDER_VOLTAGE
    guard.t["v_dc"] = 651.0
    assert at_the_limits(guard, 3)[2] == Reason.DC_LINK_OVER_VOLTAGE
    guard.t["v_dc"], guard.s["ua_q"] = 500.0, 250.0
    assert at_the_limits(guard, 1) == [Reason.FROZEN_FEEDBACK]
    guard.p["frozen_ticks"] = 100
    assert at_the_limits(guard, 1) == [Reason.I2T]


@pytest.mark.parametrize("name", ["w", "i_q", "i_d"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_judged_at_once_and_counts_for_nothing(name: str, value: float) -> None:
    guard = good()
    guard.t[name] = value
    assert judge_measurement(guard.p[0], guard.s[0], guard.t) == Reason.NOT_A_NUMBER
    assert not guard.s["over"].any() and guard.s["i2t"][0] == 0.0


def test_places_of_the_counts_are_apart() -> None:
    names = ("SPEED", "CURRENT", "TEMPERATURE")
    places = [getattr(hil.tick.guard, f"OVER_{name}") for name in names]
    places += [hil.tick.guard.UNDER_VOLTAGE, hil.tick.guard.OVER_VOLTAGE, hil.tick.guard.FOLLOWING]
    assert len(set(places)) == 6 and max(places) < len(Guard().s[0]["over"])


def test_the_step_from_the_last_value() -> None:
    assert [limit_step(v, 10.0, 2.0) for v in (7.0, 8.5, 10.0, 11.5, 13.0)] == [8.0, 8.5, 10.0, 11.5, 12.0]


@pytest.mark.parametrize(
    ("u_q", "u_d", "share"),
    [
        (60.0, 20.0, 1.0),
        (-40.0, 20.0, 1.0),
        (10.0, 70.0, 1.0),
        (10.0, -30.0, 1.0),
        (110.0, 20.0, 0.5),
        (-90.0, 20.0, 0.5),
        (10.0, 220.0, 0.25),
        (10.0, -180.0, 0.25),
        (110.0, 220.0, 0.25),
        (210.0, 120.0, 0.25),
    ],
)
def test_the_share_of_the_way_is_that_of_the_longer_axis(u_q: float, u_d: float, share: float) -> None:
    guard = Guard()
    guard.s["u_q"], guard.s["u_d"] = 10.0, 20.0
    assert step_share(guard.p[0], guard.s[0], u_q, u_d) == share


def test_rounded_to_the_wire_without_a_negative_zero() -> None:
    assert [to_wire(v, 0.25) for v in (0.125, 0.375, 0.3, -0.3, 7.0)] == [0.0, 0.5, 0.25, -0.25, 7.0]
    assert math.copysign(1.0, to_wire(-0.001, 0.25)) == 1.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_denormal_is_below_the_least_normal_number_and_not_zero(sign: float) -> None:
    values = (0.0, 5e-324, math.nextafter(LEAST_NORMAL, 0.0), LEAST_NORMAL, 0.5, 1.0)
    assert [is_denormal(sign * v) for v in values] == [False, True, True, False, False, False]


def test_the_circle_grows_over_the_soft_start() -> None:
    guard = Guard(soft_start_ticks=100)
    radii = []
    for ticks in (0, 25, 99, 100, 101, 400):
        guard.s["run_ticks"] = ticks
        radii.append(voltage_limit(guard.p[0], guard.s[0]))
    assert radii == [0.0, 75.0, 297.0, 300.0, 300.0, 300.0]
    guard.p["soft_start_ticks"], guard.s["run_ticks"] = 0, 0
    assert voltage_limit(guard.p[0], guard.s[0]) == 300.0


@pytest.mark.parametrize(
    ("u_q", "u_d", "far"),
    [(13.0, 24.0, False), (13.1, 24.0, True), (13.0, 24.1, True), (7.0, 16.0, False), (6.9, 16.0, True)],
)
def test_the_applied_voltage_may_be_so_far_from_the_sent_one(u_q: float, u_d: float, far: bool) -> None:
    guard = Guard(deviation_max=5.0)
    guard.s["u_q"], guard.s["u_d"], guard.s["ua_q"], guard.s["ua_d"] = 10.0, 20.0, u_q, u_d
    assert deviates(guard.p[0], guard.s[0], guard.t) is far
    guard.t["rx_flags"] = int(RxFlag.CRC_ERROR | RxFlag.STATUS)  # nothing fresh: nothing known
    assert not deviates(guard.p[0], guard.s[0], guard.t)


@pytest.mark.parametrize(
    ("deviation_max", "fresh", "far"), [(5.0, 1, True), (5.0, 2, False), (math.inf, 1, False)]
)
def test_a_drive_that_limits_deviates_where_there_is_a_limit(
    deviation_max: float, fresh: int, far: bool
) -> None:
    guard = Guard(deviation_max=deviation_max)
    guard.t["limited"], guard.t["rx_flags"] = 1, fresh
    assert deviates(guard.p[0], guard.s[0], guard.t) is far


def test_a_command_is_written_to_tick_and_state() -> None:
    guard = Guard()
    assert write_command(guard.s[0], guard.t, 1.0, 2.0, 3.0, 5) == Reason.NONE
    for record in (guard.t, guard.s[0]):
        assert (record["u_q"], record["u_d"], record["T_L"]) == (1.0, 2.0, 3.0)
    assert guard.t["guard_flags"] == 5


@pytest.mark.parametrize("flag", list(GuardFlag), ids=lambda flag: flag.name)
def test_which_changes_count_as_an_excess(flag: GuardFlag) -> None:
    guard = Guard(guard_trip_ticks=3)
    planned = flag in (GuardFlag.SOFT_START, GuardFlag.DENORMAL)
    got = [persistent_excess(guard.p[0], guard.s[0], int(flag)) for _ in range(4)]
    assert got == ([0] * 4 if planned else [0, 0, Reason.GUARD_PERSISTENT, Reason.GUARD_PERSISTENT])
    assert persistent_excess(guard.p[0], guard.s[0], 0) == Reason.NONE and guard.s["clamped"][0] == 0


def test_the_circle_is_allowed_and_past_it_the_direction_stays() -> None:
    guard = Guard(du_max=1e9)
    assert guard.ask(180.0, 240.0) == (180.0, 240.0, 0.0, 0, 0)
    assert guard.ask(180.0, -240.3)[:2] == (179.85, -240.1)
    assert guard.t["guard_flags"] == GuardFlag.VOLTAGE
    assert guard.ask(240.1, -180.0)[3] == GuardFlag.VOLTAGE


def test_in_the_soft_start_the_circle_says_so() -> None:
    guard = Guard(soft_start_ticks=100, du_max=1e9)
    guard.s["run_ticks"] = 50
    assert guard.ask(90.0, 120.0) == (90.0, 120.0, 0.0, 0, 0)
    assert guard.ask(120.0, 160.0) == (90.0, 120.0, 0.0, int(GuardFlag.SOFT_START), 0)


@pytest.mark.parametrize(
    ("u_q", "u_d", "sent"),
    [
        (60.0, 70.0, (60.0, 70.0, 0)),  # both axes a whole step away: allowed
        (110.0, 70.0, (60.0, 45.0, int(GuardFlag.VOLTAGE_STEP))),
        (10.0, 120.0, (10.0, 70.0, int(GuardFlag.VOLTAGE_STEP))),
        (-90.0, -30.0, (-40.0, -5.0, int(GuardFlag.VOLTAGE_STEP))),
    ],
)
def test_a_step_goes_straight_and_no_further_than_its_limit(
    u_q: float, u_d: float, sent: tuple[float, float, int]
) -> None:
    guard = Guard()
    guard.s["u_q"], guard.s["u_d"] = 10.0, 20.0
    got = guard.ask(u_q, u_d)
    assert (got[0], got[1], got[3]) == sent


@pytest.mark.parametrize(("asked", "sent"), [(10.0, 10.0), (-10.0, -10.0), (10.1, 10.0), (-10.1, -10.0)])
def test_load_torque_at_its_limit(asked: float, sent: float) -> None:
    assert Guard().ask(0.0, 0.0, asked)[2:] == (sent, 0 if asked == sent else GuardFlag.LOAD_TORQUE, 0)


@pytest.mark.parametrize("where", range(3))
def test_a_denormal_of_any_part_becomes_zero_and_says_so(where: int) -> None:
    asked = [5.0, 6.0, 7.0]
    asked[where] = -5e-324
    got = Guard().ask(*asked)
    assert got[:3] == tuple(0.0 if i == where else v for i, v in enumerate(asked))
    assert got[3:] == (GuardFlag.DENORMAL, Reason.NONE)
    guard = Guard()
    guard.t["state"] = int(DriveState.SWITCHED_ON)  # and is then nothing that the state had to force to zero
    assert guard.ask(*(5e-324 if i == where else 0.0 for i in range(3)))[3] == GuardFlag.DENORMAL


@pytest.mark.parametrize("where", range(3))
def test_outside_operation_any_part_is_forced_to_zero(where: int) -> None:
    guard = Guard()
    guard.t["state"] = int(DriveState.QUICK_STOP_ACTIVE)
    asked = [0.0, 0.0, 0.0]
    assert guard.ask(*asked)[3] == 0
    asked[where] = 1.0
    assert guard.ask(*asked) == (0.0, 0.0, 0.0, int(GuardFlag.STATE_FORCES_ZERO), 0)
    assert guard.ask(5e-324, 0.0, 1.0)[3] == GuardFlag.STATE_FORCES_ZERO | GuardFlag.DENORMAL


def test_deviation_is_judged_against_what_was_sent_before_and_counts() -> None:
    guard = Guard(deviation_max=5.0, guard_trip_ticks=2)
    guard.s["ua_q"] = 5.1
    assert guard.ask(3.0)[3:] == (GuardFlag.APPLIED_DEVIATES, Reason.NONE)
    guard.s["ua_q"] = -2.1
    assert guard.ask(3.0)[3:] == (GuardFlag.APPLIED_DEVIATES, Reason.GUARD_PERSISTENT)


@pytest.mark.parametrize("where", range(3))
def test_no_number_forgets_the_last_command(where: int) -> None:
    guard = Guard()
    guard.ask(20.0, 30.0, 4.0)
    asked = [1.0, 2.0, 3.0]
    asked[where] = math.nan
    reason = guard_command(guard.p[0], guard.s[0], guard.t, *asked)
    assert reason == Reason.CONTROLLER_ERROR and guard.t["guard_flags"] == GuardFlag.NOT_A_NUMBER
    assert (guard.s["u_q"][0], guard.s["u_d"][0], guard.s["T_L"][0]) == (0.0, 0.0, 0.0)


def measured(theta: float, slip: float, theta_jump: float) -> int:
    guard = Guard(theta_jump=theta_jump)
    guard.t["v_dc"], guard.t["theta"], guard.s["slip"] = 500.0, theta, slip
    guard.t["temperature_motor"] = guard.t["temperature_inverter"] = 25.0
    return int(judge_measurement(guard.p[0], guard.s[0], guard.t))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_angle_is_a_number_and_moves_by_what_the_speed_tells(sign: float) -> None:
    assert measured(sign * 0.99e9, sign * 0.5, 0.5) == Reason.NONE
    for theta in (math.nan, sign * math.inf, sign * 1e9):
        assert measured(theta, 0.0, 0.5) == Reason.NOT_A_NUMBER
    assert measured(0.0, sign * 0.51, 0.5) == Reason.ANGLE_JUMP
    assert measured(math.nan, sign * 9.0, 0.0) == Reason.NONE, "of a law without an angle"
