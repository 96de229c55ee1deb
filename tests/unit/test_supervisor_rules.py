"""Every rule of the supervisor at its last allowed and its first refused value, function by function."""

from __future__ import annotations

import math
from typing import Any

import pytest

from hil.signals import Controlword, DriveState, Reason, Request, RxFlag
from hil.tick.guard import FOLLOWING_ANGLE
from hil.tick.supervisor import (
    STOP_TICKS,
    arming,
    begin_stop,
    first,
    handshake,
    is_fault,
    judge,
    judge_arming,
    judge_bus,
    judge_drive,
    judge_echo,
    judge_following,
    judge_request,
    judge_timing,
    leaky,
    operate,
    stopping,
    supervise,
)
from tests.safety import Guard

FRESH = int(RxFlag.FRESH)
ON = DriveState.OPERATION_ENABLED


def bench(**changed: float) -> Guard:
    """Fresh feedback of an enabled drive that obeys, all values good."""
    guard = Guard(**{"echo_lag": 0, **changed})
    t = guard.t
    t["gap"], t["drive_state"], t["v_dc"] = 1, int(ON), 500.0
    t["temperature_motor"] = t["temperature_inverter"] = 25.0
    guard.s["echo"] = 9
    return guard


def ask(rule: Any, guard: Guard) -> int:
    return int(rule(guard.p[0], guard.s[0], guard.t))


def test_errors_weigh_four_good_ticks() -> None:
    assert [leaky(level, True) for level in (0, 3)] == [4, 7]
    assert [leaky(level, False) for level in (0, 1, 5)] == [0, 0, 4]


@pytest.mark.parametrize(
    ("flag", "reason"),
    [
        (RxFlag.GUARDIAN, Reason.GUARDIAN),
        (RxFlag.BUS_DOWN, Reason.BUS_DOWN),
        (RxFlag.SEND_FAILED, Reason.SEND_FAILED),
        (RxFlag.GUARDIAN_LOST, Reason.GUARDIAN_LOST),
        (RxFlag.FOREIGN_COMMAND, Reason.FOREIGN_COMMAND),
        (RxFlag.STATUS, Reason.NONE),
        (RxFlag.EMERGENCY, Reason.NONE),
        (RxFlag.FRESH, Reason.NONE),
    ],
    ids=lambda value: value.name,
)
def test_flags_that_stop_at_once(flag: RxFlag, reason: Reason) -> None:
    guard = bench()
    guard.t["rx_flags"] = int(flag)
    assert ask(judge_bus, guard) == reason
    assert guard.s["crc_level"][0] == guard.s["counter_level"][0] == 0


def test_of_several_flags_the_gravest_counts() -> None:
    guard, order = bench(), []
    grave = [
        RxFlag.GUARDIAN,
        RxFlag.BUS_DOWN,
        RxFlag.SEND_FAILED,
        RxFlag.GUARDIAN_LOST,
        RxFlag.FOREIGN_COMMAND,
    ]
    guard.s["crc_level"] = guard.s["counter_level"] = 1000
    for k in range(len(grave) + 1):
        guard.t["rx_flags"] = sum(grave[k:])
        order.append(ask(judge_bus, guard))
    assert order == [
        Reason.GUARDIAN,
        Reason.BUS_DOWN,
        Reason.SEND_FAILED,
        Reason.GUARDIAN_LOST,
        Reason.FOREIGN_COMMAND,
        Reason.CRC_ERRORS,
    ]


@pytest.mark.parametrize(
    ("flag", "level", "reason"),
    [
        (RxFlag.CRC_ERROR, "crc_level", Reason.CRC_ERRORS),
        (RxFlag.LENGTH_ERROR, "crc_level", Reason.CRC_ERRORS),
        (RxFlag.ERROR_FRAME, "crc_level", Reason.CRC_ERRORS),
        (RxFlag.COUNTER_REPEATED, "counter_level", Reason.COUNTER_ERRORS),
        (RxFlag.COUNTER_JUMP, "counter_level", Reason.COUNTER_ERRORS),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_damaged_frames_stop_past_their_budget(flag: RxFlag, level: str, reason: Reason) -> None:
    guard = bench(error_budget=3)
    guard.t["rx_flags"] = FRESH | int(flag)
    assert [ask(judge_bus, guard) for _ in range(5)] == [0, 0, 0, reason, reason]
    other = {"crc_level": "counter_level", "counter_level": "crc_level"}[level]
    assert guard.s[level][0] == 20 and guard.s[other][0] == 0
    guard.t["rx_flags"] = FRESH
    assert [ask(judge_bus, guard) for _ in range(9)] == [reason] * 7 + [0, 0]


@pytest.mark.parametrize("state", list(DriveState), ids=lambda state: state.name)
def test_what_the_drives_state_says(state: DriveState) -> None:
    guard = bench()
    guard.t["drive_state"] = int(state)
    faults = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
    expected = Reason.DRIVE_FAULT if state in faults else Reason.DRIVE_LEFT_OPERATION
    assert judge_drive(guard.s[0], guard.t) == (Reason.NONE if state == ON else expected)
    guard.t["rx_flags"] = int(RxFlag.STATUS | RxFlag.CRC_ERROR)
    assert judge_drive(guard.s[0], guard.t) == Reason.NONE


def test_staleness_counts_periods_and_fresh_feedback_ends_it() -> None:
    guard = bench(hold_ticks=5, max_gap=3)
    guard.t["rx_flags"], guard.t["gap"] = int(RxFlag.CRC_ERROR), 2
    assert [ask(judge_timing, guard) for _ in range(3)] == [0, 0, Reason.STALE_FEEDBACK]
    assert guard.s["stale"][0] == 6
    guard.t["rx_flags"] = FRESH
    assert ask(judge_timing, guard) == Reason.NONE and guard.s["stale"][0] == 0
    guard.t["rx_flags"], guard.t["gap"] = 0, 1
    assert [ask(judge_timing, guard) for _ in range(6)] == [0] * 5 + [Reason.STALE_FEEDBACK]


def test_the_hold_time_begins_when_feedback_is_due() -> None:
    guard = bench(hold_ticks=2, scheduled=4)
    guard.t["rx_flags"] = 0
    assert [ask(judge_timing, guard) for _ in range(7)] == [0] * 6 + [Reason.STALE_FEEDBACK]


def test_a_gap_longer_than_allowed() -> None:
    guard = bench(max_gap=3)
    for gap, reason in ((3, Reason.NONE), (4, Reason.LOOP_OVERRUN)):
        guard.t["gap"] = gap
        assert ask(judge_timing, guard) == reason


def echo(guard: Guard, counter: int, echoed: int) -> tuple[int, int]:
    guard.s["counter"], guard.t["echo"] = counter, echoed
    return ask(judge_echo, guard), int(guard.s["lagging"][0])


def test_an_echo_is_right_within_its_lag() -> None:
    guard = bench(hold_ticks=2, echo_lag=1)
    assert echo(guard, 3, 3) == (0, 0) and guard.s["echo"][0] == 3
    assert echo(guard, 5, 4) == (0, 0)
    assert echo(guard, 7, 5) == (0, 1)
    assert echo(guard, 8, 6) == (0, 2)
    assert echo(guard, 9, 7) == (Reason.COMMAND_LOST, 3)
    assert echo(guard, 0, 15) == (0, 0), "the counter came round"
    assert echo(guard, 15, 15) == (0, 1), "the same echo again"
    assert echo(guard, 1, 2) == (0, 2), "ahead of the command"


def test_an_echo_that_is_wrong_is_held_for_from_when_feedback_is_due() -> None:
    guard = bench(hold_ticks=2, scheduled=4)
    guard.s["elapsed"] = 5
    assert [echo(guard, 5, 1) for _ in range(3)] == [(0, 1), (0, 6), (Reason.COMMAND_LOST, 11)]


@pytest.mark.parametrize(
    ("scheduled", "modulus", "right"),
    [(15, 16, True), (31, 16, True), (1, 2, True), (14, 16, False), (0, 16, False)],
)
def test_an_echo_may_stand_still_where_the_counter_comes_round(
    scheduled: int, modulus: int, right: bool
) -> None:
    guard = bench(hold_ticks=2, scheduled=scheduled, counter_modulus=modulus)
    assert echo(guard, 1, 1) == (0, 0)
    assert echo(guard, 1, 1) == (0, 0 if right else 1)


def test_an_echo_may_not_stand_still_because_each_counter_has_one_number() -> None:
    guard = bench(hold_ticks=2, counter_modulus=1)
    guard.s["echo"] = 0
    assert echo(guard, 0, 0) == (0, 1)


def test_echoes_are_judged_when_fresh_and_not_in_a_shadow_run() -> None:
    guard = bench(hold_ticks=2)
    guard.t["rx_flags"] = int(RxFlag.STATUS)
    assert echo(guard, 5, 1) == (0, 0) and guard.s["echo"][0] == 9
    guard.t["rx_flags"], guard.p["shadow"] = FRESH, 1
    assert echo(guard, 5, 1) == (0, 0)
    guard.t["rx_flags"] = 0
    guard.p["shadow"] = 0
    assert [echo(guard, 5, 1) for _ in range(4)] == [(0, 0)] * 4


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_angle_may_be_so_far_from_its_reference(sign: float) -> None:
    guard = bench(theta_jump=0.5, theta_error_max=1.0, w_error_max=5.0, w_error_ticks=2)
    guard.t["theta_error"], guard.t["w"] = sign, 5.0
    assert [ask(judge_following, guard) for _ in range(4)] == [0] * 4
    guard.t["theta_error"] = 1.1 * sign
    assert [ask(judge_following, guard) for _ in range(2)] == [0, Reason.ANGLE_ERROR]
    assert guard.s["over"][0, FOLLOWING_ANGLE] == 2 and guard.s["over"].sum() == 2
    guard.t["w"] = 5.1
    assert [ask(judge_following, guard) for _ in range(2)] == [Reason.ANGLE_ERROR] * 2
    guard.t["theta_error"] = 0.0
    assert ask(judge_following, guard) == Reason.FOLLOWING_ERROR


def test_a_law_without_an_angle_is_judged_by_none() -> None:
    guard = bench(theta_error_max=1.0, w_error_ticks=1)
    guard.t["theta_error"] = 9.0
    assert ask(judge_following, guard) == Reason.NONE


@pytest.mark.parametrize("w", [10.0, -10.0])
def test_the_speed_may_be_so_far_from_its_reference(w: float) -> None:
    guard = bench(w_error_max=5.0, w_error_ticks=2)
    guard.t["w"], guard.t["w_ref"] = w, w + 5.0
    assert [ask(judge_following, guard) for _ in range(4)] == [0] * 4
    guard.t["w_ref"] = w - 5.1
    assert [ask(judge_following, guard) for _ in range(2)] == [0, Reason.FOLLOWING_ERROR]
    guard.t["rx_flags"] = int(RxFlag.STATUS)
    assert ask(judge_following, guard) == Reason.NONE
    guard.t["rx_flags"], guard.t["w_ref"] = FRESH, w
    assert ask(judge_following, guard) == Reason.NONE and not guard.s["over"].any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_d_current_counts_up_and_down(sign: float) -> None:
    guard = bench(i_d_max=2.0, w_error_ticks=3)
    got = []
    for i_d in (2.0, 2.1, 2.1, 1.0, 2.1, 2.1, 1.0, 1.0, 1.0, 1.0):
        guard.t["i_d"] = sign * i_d
        got.append((ask(judge_following, guard), int(guard.s["uncontrolled"][0])))
    counts = [0, 1, 2, 1, 2, 3, 2, 1, 0, 0]
    assert got == [(Reason.CURRENT_UNCONTROLLED if n >= 3 else 0, n) for n in counts]


@pytest.mark.parametrize(
    ("ticks", "elapsed", "counts"),
    [(1, 5, 1), (2, 5, 1), (3, 5, 1), (4, 5, 2), (9, 5, 4), (9, 3, 3), (9, 0, 1)],
)
def test_one_measurement_after_a_gap_fills_at_most_half_the_count(
    ticks: int, elapsed: int, counts: int
) -> None:
    guard = bench(i_d_max=2.0, w_error_ticks=ticks)
    guard.s["elapsed"], guard.t["i_d"] = elapsed, 3.0
    ask(judge_following, guard)
    assert guard.s["uncontrolled"][0] == counts


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("i_q", "i_d", "counts"),
    [(0.0, 1.0, 0), (0.0, 1.1, 1), (4.5, 1.5, 0), (4.4, 1.5, 1), (-4.5, 1.5, 0), (-4.4, 1.5, 1)],
)
def test_a_d_current_beside_the_q_current(i_q: float, i_d: float, counts: int, sign: float) -> None:
    guard = bench(open_phase_min=1.0, w_error_ticks=3)
    guard.t["i_q"], guard.t["i_d"] = i_q, sign * i_d
    assert ask(judge_following, guard) == Reason.NONE and guard.s["uncontrolled"][0] == counts


@pytest.mark.parametrize(("i_d", "counts"), [(-7.0, 0), (-7.1, 1), (-3.0, 0), (-2.9, 1), (0.0, 1)])
def test_the_d_current_is_judged_by_its_reference(i_d: float, counts: int) -> None:
    guard = bench(i_d_max=2.0, w_error_ticks=3)
    guard.s["i_d_ref"], guard.t["i_d"] = -5.0, i_d
    assert ask(judge_following, guard) == Reason.NONE and guard.s["uncontrolled"][0] == counts


def test_the_uncontrolled_current_goes_before_the_speed() -> None:
    guard = bench(i_d_max=2.0, w_error_max=1.0, w_error_ticks=1)
    guard.t["i_d"], guard.t["w"] = 3.0, 9.0
    assert ask(judge_following, guard) == Reason.CURRENT_UNCONTROLLED


def test_the_first_of_two_reasons() -> None:
    assert [first(a, b) for a, b in ((0, 0), (0, 7), (5, 0), (5, 7), (1, 7))] == [0, 7, 5, 5, 1]


ASKED = {
    Request.STOP: Reason.STOP_REQUESTED,
    Request.QUICK_STOP: Reason.QUICK_STOP_REQUESTED,
    Request.NODE_STOPPED: Reason.NODE_STOPPED,
}


@pytest.mark.parametrize("request_", list(Request), ids=lambda request: request.name)
def test_what_the_operator_asks(request_: Request) -> None:
    guard = bench()
    guard.t["request"] = int(request_)
    assert judge_request(guard.t) == ASKED.get(request_, Reason.NONE)


CAUSES = (
    # reason, how it comes, how it goes; the most telling first
    (Reason.FOREIGN_COMMAND, {"rx_flags": FRESH | int(RxFlag.FOREIGN_COMMAND)}, {"rx_flags": FRESH}),
    (Reason.OVER_SPEED, {"w": 151.0}, {"w": 0.0}),
    (Reason.DRIVE_LEFT_OPERATION, {"drive_state": int(DriveState.SWITCHED_ON)}, {"drive_state": int(ON)}),
    (Reason.COMMAND_LOST, {"echo": 5}, {}),
    (Reason.FOLLOWING_ERROR, {"w_ref": 50.0}, {"w_ref": 0.0}),
    (Reason.LOOP_OVERRUN, {"gap": 21}, {"gap": 1}),
    (Reason.LOG_FAILED, {"log_failed": 1}, {"log_failed": 0}),
    (Reason.STOP_REQUESTED, {"request": int(Request.STOP)}, {"request": 0}),
)


def put(guard: Guard, fields: dict[str, float]) -> None:
    for name, value in fields.items():
        guard.t[name] = value


def strict() -> Guard:
    """Every cause trips at its first tick."""
    return bench(trip_ticks=1, hold_ticks=0, w_error_max=30.0, w_error_ticks=1)


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause[0].name)
def test_each_cause_alone(cause: tuple[Reason, dict[str, float], dict[str, float]]) -> None:
    guard = strict()
    put(guard, cause[1])
    assert ask(judge, guard) == cause[0]


def test_the_most_telling_of_all_causes() -> None:
    guard, got = strict(), []
    for _, comes, _ in CAUSES:
        put(guard, comes)
    guard.s["counter"] = 9
    for cause, _, goes in CAUSES:
        got.append(ask(judge, guard))
        put(guard, goes)
        if cause == Reason.DRIVE_LEFT_OPERATION:
            guard.t["w_ref"] = 50.0
        if cause == Reason.COMMAND_LOST:
            guard.p["hold_ticks"] = 1000
    assert got == [cause for cause, _, _ in CAUSES]


def test_without_fresh_feedback_no_measurement_is_judged() -> None:
    guard = bench(trip_ticks=1)
    guard.t["w"], guard.t["rx_flags"] = 151.0, int(RxFlag.STATUS)
    assert ask(judge, guard) == Reason.NONE and ask(judge_arming, guard) == Reason.NONE
    guard.t["rx_flags"] = FRESH
    assert ask(judge_arming, guard) == Reason.OVER_SPEED and ask(judge, guard) == Reason.OVER_SPEED


def test_the_drive_is_judged_in_operation_alone() -> None:
    guard = bench(hold_ticks=0, w_error_max=1.0, w_error_ticks=1)
    guard.t["w_ref"], guard.t["drive_state"], guard.t["echo"] = 50.0, int(DriveState.FAULT), 4
    for state in set(DriveState) - {ON}:
        guard.s["state"] = int(state)
        assert ask(judge, guard) == Reason.NONE


@pytest.mark.parametrize("reason", [r for r in Reason if r], ids=lambda reason: reason.name)
def test_which_stops_are_faults(reason: Reason) -> None:
    planned = {Reason.STOP_REQUESTED, Reason.QUICK_STOP_REQUESTED, Reason.STALE_FEEDBACK, Reason.LOG_FAILED}
    planned |= {Reason.NODE_STOPPED}
    assert is_fault(int(reason)) is (reason not in planned)
    guard = bench()
    guard.s["stop_ticks"], guard.s["stale"], guard.s["stale_at"] = 7, 5, 2
    begin_stop(guard.s[0], int(reason))
    state = DriveState.QUICK_STOP_ACTIVE if reason in planned else DriveState.FAULT_REACTION_ACTIVE
    assert (guard.s["state"][0], guard.s["reason"][0], guard.s["stop_ticks"][0]) == (state, reason, 0)
    assert (guard.s["stale"][0], guard.s["stale_at"][0]) == (5, 5), "how old the feedback was is told later"


def shake(drive: DriveState, armed: int = 1, flags: int = FRESH, **changed: float) -> tuple[int, int, int]:
    """Controlword, state and run ticks after one tick of the handshake."""
    guard = bench(**changed)
    guard.s["state"], guard.s["armed_ticks"] = int(DriveState.READY_TO_SWITCH_ON), armed
    guard.s["word"], guard.s["run_ticks"] = 0x55, 77
    guard.t["drive_state"], guard.t["rx_flags"] = int(drive), flags
    word = ask(handshake, guard)
    return word, int(guard.s["state"][0]), int(guard.s["run_ticks"][0])


READY = int(DriveState.READY_TO_SWITCH_ON)


@pytest.mark.parametrize(
    ("drive", "word", "state", "run_ticks"),
    [
        (DriveState.NOT_READY_TO_SWITCH_ON, Controlword.SHUTDOWN, READY, 77),
        (DriveState.SWITCH_ON_DISABLED, Controlword.SHUTDOWN, READY, 77),
        (DriveState.READY_TO_SWITCH_ON, Controlword.SWITCH_ON, READY, 77),
        (DriveState.SWITCHED_ON, Controlword.ENABLE_OPERATION, DriveState.SWITCHED_ON, 77),
        (DriveState.OPERATION_ENABLED, Controlword.ENABLE_OPERATION, ON, 0),
        (DriveState.QUICK_STOP_ACTIVE, Controlword.SHUTDOWN, READY, 77),
        (DriveState.FAULT_REACTION_ACTIVE, Controlword.SHUTDOWN, READY, 77),
    ],
)
def test_the_handshake_by_the_drives_state(
    drive: DriveState, word: Controlword, state: int, run_ticks: int
) -> None:
    assert shake(drive) == (word, state, run_ticks)
    assert shake(drive, armed=5) == (word, state, run_ticks)


@pytest.mark.parametrize("armed", [4, 5])
def test_a_fault_is_reset_by_words_that_alternate_from_feedback_to_feedback(armed: int) -> None:
    guard = bench(scheduled=1)
    guard.t["rx_flags"], guard.t["drive_state"] = FRESH, int(DriveState.FAULT)
    guard.s["armed_ticks"], words = armed, []
    for _ in range(3):
        guard.s["word"] = ask(handshake, guard)
        words.append(int(guard.s["word"][0]))
    assert words == [Controlword.FAULT_RESET, Controlword.DISABLE_VOLTAGE, Controlword.FAULT_RESET]


@pytest.mark.parametrize(
    ("drive", "word"),
    [
        (DriveState.SWITCH_ON_DISABLED, Controlword.SHUTDOWN),
        (DriveState.FAULT, Controlword.FAULT_RESET),
        (DriveState.SWITCHED_ON, Controlword.SWITCH_ON),
        (DriveState.OPERATION_ENABLED, Controlword.SWITCH_ON),
    ],
)
def test_no_drive_is_enabled_before_each_slow_message_has_come(drive: DriveState, word: Controlword) -> None:
    assert shake(drive, messages=2) == (word, READY, 77)


def test_a_fault_is_reset_by_turns() -> None:
    words = [shake(DriveState.FAULT, armed)[0] for armed in (1, 2, 3, 4)]
    assert words == [Controlword.FAULT_RESET, Controlword.DISABLE_VOLTAGE] * 2


def test_without_feedback_the_last_word_stands_but_for_the_first() -> None:
    stale = int(RxFlag.STATUS)
    assert [shake(ON, armed, stale)[0] for armed in (1, 2, 3)] == [Controlword.SHUTDOWN, 0x55, 0x55]
    assert shake(ON, 1, stale)[1] == READY


def test_arming_counts_and_gives_up() -> None:
    guard = bench(enable_ticks=3)
    guard.s["state"], guard.t["drive_state"] = READY, int(DriveState.READY_TO_SWITCH_ON)
    guard.s["echo"], guard.t["request"] = 0, int(Request.ARM)
    words = [ask(arming, guard) for _ in range(3)]
    assert words == [Controlword.SWITCH_ON] * 3 and guard.s["armed_ticks"][0] == 3
    assert guard.s["word"][0] == Controlword.SWITCH_ON
    assert ask(arming, guard) == Controlword.DISABLE_VOLTAGE
    assert guard.s["reason"][0] == Reason.ENABLE_TIMEOUT
    assert guard.s["state"][0] == DriveState.FAULT_REACTION_ACTIVE


@pytest.mark.parametrize("rules", [0, 1])
def test_periods_that_were_skipped_while_arming_count(rules: int) -> None:
    """From this version on: a log of before replays by its ticks alone."""
    guard, found = bench(enable_ticks=7, rules=rules), []
    guard.s["state"], guard.t["drive_state"] = READY, int(DriveState.READY_TO_SWITCH_ON)
    guard.s["echo"], guard.t["request"] = 0, int(Request.ARM)
    for gap in (0, 1, 2, 3):
        guard.t["gap"] = gap
        assert ask(arming, guard) == Controlword.SWITCH_ON
        found.append(int(guard.s["armed_gaps"][0]))
    assert found == ([0, 0, 1, 3] if rules else [0, 0, 0, 0])
    assert (ask(arming, guard) == Controlword.DISABLE_VOLTAGE) == bool(rules)


def test_causes_while_arming_in_order() -> None:
    guard, got = bench(trip_ticks=1, enable_ticks=0), []
    guard.s["armed_ticks"] = 1
    causes = [c for c in CAUSES if c[0] in ARMING]
    for _, comes, _ in causes:
        put(guard, comes)
    for _, _, goes in causes:
        got.append(ask(judge_arming, guard))
        put(guard, goes)
    assert [*got, ask(judge_arming, guard)] == [*ARMING, Reason.ENABLE_TIMEOUT]
    guard.p["enable_ticks"] = 1
    assert ask(judge_arming, guard) == Reason.NONE


ARMING = (Reason.FOREIGN_COMMAND, Reason.OVER_SPEED, Reason.LOG_FAILED, Reason.STOP_REQUESTED)


def test_operation_counts_its_ticks_until_a_reason_comes() -> None:
    guard = bench(hold_ticks=100)
    guard.s["run_ticks"] = 5
    assert ask(operate, guard) == Controlword.ENABLE_OPERATION
    assert (guard.s["run_ticks"][0], guard.s["state"][0]) == (6, ON)
    guard.t["request"] = int(Request.STOP)
    assert ask(operate, guard) == Controlword.QUICK_STOP
    assert (guard.s["run_ticks"][0], guard.s["state"][0]) == (6, DriveState.QUICK_STOP_ACTIVE)
    assert guard.s["reason"][0] == Reason.STOP_REQUESTED


def stop_of(state: DriveState, drive: DriveState, flags: int = FRESH, **changed: float) -> Guard:
    guard = bench(**changed)
    guard.s["state"], guard.t["drive_state"], guard.t["rx_flags"] = int(state), int(drive), flags
    return guard


def ticks_to_end(guard: Guard) -> tuple[int, int]:
    """Ticks of quick stop until the last word, and the state then."""
    for k in range(1, 200):
        word = ask(stopping, guard)
        if word == Controlword.DISABLE_VOLTAGE:
            return k, int(guard.s["state"][0])
        assert word == Controlword.QUICK_STOP
    raise AssertionError("no end")


STOPPED = (
    (DriveState.QUICK_STOP_ACTIVE, DriveState.SWITCH_ON_DISABLED),
    (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT),
)


@pytest.mark.parametrize(("state", "end"), STOPPED)
def test_a_stop_ends_once_the_drive_has_left_operation(state: DriveState, end: DriveState) -> None:
    guard = stop_of(state, DriveState.QUICK_STOP_ACTIVE)
    assert ticks_to_end(guard) == (3, end)
    guard = stop_of(state, ON)
    guard.s["stop_ticks"] = 5
    assert ask(stopping, guard) == Controlword.QUICK_STOP
    guard.t["drive_state"] = int(DriveState.SWITCHED_ON)
    assert ask(stopping, guard) == Controlword.DISABLE_VOLTAGE


@pytest.mark.parametrize(("state", "end"), STOPPED)
def test_a_drive_that_does_not_leave_is_waited_for_so_long(state: DriveState, end: DriveState) -> None:
    assert ticks_to_end(stop_of(state, ON, quick_stop_ticks=4)) == (STOP_TICKS + 4, end) == (24, end)


def test_a_stop_waits_for_feedback_that_is_not_due_yet() -> None:
    state, lost = DriveState.QUICK_STOP_ACTIVE, int(RxFlag.STATUS)
    for flags, first_fault in ((FRESH, None), (lost, 8)):
        guard = stop_of(state, ON, flags, quick_stop_ticks=4, scheduled=3)
        states = []
        for _ in range(STOP_TICKS + 4 + 3 - 1):
            assert ask(stopping, guard) == Controlword.QUICK_STOP
            states.append(int(guard.s["state"][0]))
        assert ask(stopping, guard) == Controlword.DISABLE_VOLTAGE
        faults = [k for k, one in enumerate(states, 1) if one == DriveState.FAULT_REACTION_ACTIVE]
        assert (faults[0] if faults else None) == first_fault


def test_feedback_that_is_lost_for_too_long_makes_a_quick_stop_a_fault() -> None:
    guard = stop_of(DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT, int(RxFlag.STATUS), quick_stop_ticks=4)
    states = []
    for _ in range(6):
        ask(stopping, guard)
        states.append(int(guard.s["state"][0]))
    assert states == [DriveState.QUICK_STOP_ACTIVE] * 4 + [DriveState.FAULT_REACTION_ACTIVE] * 2
    assert ticks_to_end(guard)[1] == DriveState.FAULT


def tick(guard: Guard) -> tuple[int, int, int, int]:
    """State, reason, controlword and send of one tick."""
    supervise(guard.p[0], guard.s[0], guard.t)
    t = guard.t
    assert (t["state"], t["reason"]) == (guard.s["state"][0], guard.s["reason"][0])
    return int(t["state"]), int(t["reason"]), int(t["controlword"]), int(t["send"])


DISARMED = int(DriveState.SWITCH_ON_DISABLED)


@pytest.mark.parametrize("request_", list(Request), ids=lambda request: request.name)
def test_only_arm_arms(request_: Request) -> None:
    guard = bench()
    guard.s["state"], guard.t["request"], guard.t["drive_state"] = DISARMED, int(request_), DISARMED
    expected = (DISARMED, ASKED.get(request_, Reason.NONE), Controlword.DISABLE_VOLTAGE, 0)
    assert tick(guard) == ((READY, 0, Controlword.SHUTDOWN, 1) if request_ == Request.ARM else expected)


def test_the_reason_of_a_run_that_is_over_stays_and_nothing_arms_it_again() -> None:
    guard = bench()
    guard.s["state"], guard.s["reason"] = DISARMED, int(Reason.STOP_REQUESTED)
    for request in (Request.ARM, Request.QUICK_STOP, Request.NONE):
        guard.t["request"] = int(request)
        assert tick(guard) == (DISARMED, Reason.STOP_REQUESTED, 0, 0)


@pytest.mark.parametrize(
    ("state", "drive", "expected"),
    [
        (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON, (3, 0, 0x0F, 1)),
        (DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED, (4, 0, 0x0F, 1)),
        (DriveState.OPERATION_ENABLED, DriveState.OPERATION_ENABLED, (4, 0, 0x0F, 1)),
        (DriveState.OPERATION_ENABLED, DriveState.FAULT, (6, Reason.DRIVE_FAULT, 0x02, 1)),
        (DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED, (5, 0, 0x02, 1)),
        (DriveState.FAULT_REACTION_ACTIVE, DriveState.OPERATION_ENABLED, (6, 0, 0x02, 1)),
        (DriveState.FAULT, DriveState.OPERATION_ENABLED, (7, 0, 0x00, 0)),
        (DriveState.NOT_READY_TO_SWITCH_ON, DriveState.OPERATION_ENABLED, (0, 0, 0x00, 0)),
    ],
)
def test_one_tick_of_each_state(
    state: DriveState, drive: DriveState, expected: tuple[int, int, int, int]
) -> None:
    guard = bench()
    guard.s["state"], guard.t["drive_state"], guard.t["request"] = int(state), int(drive), int(Request.ARM)
    assert tick(guard) == expected


@pytest.mark.parametrize("cause", ["flag", "reason", "shadow"])
@pytest.mark.parametrize("which", [Reason.BUS_DOWN, Reason.GUARDIAN])
def test_with_the_bus_down_or_the_guardian_acting_nothing_goes_out(cause: str, which: Reason) -> None:
    guard = bench()
    guard.s["state"], guard.s["reason"] = int(DriveState.FAULT_REACTION_ACTIVE), int(Reason.OVER_SPEED)
    assert tick(guard)[3] == 1
    if cause == "flag":
        guard.t["rx_flags"] = FRESH | int(RxFlag[which.name])
    elif cause == "reason":
        guard.s["reason"] = int(which)
    else:
        guard.p["shadow"] = 1
    assert tick(guard)[3] == 0


def test_no_number_stops_the_arming() -> None:
    guard = bench()
    guard.s["state"], guard.t["i_d"] = READY, math.nan
    assert tick(guard)[:3] == (DriveState.FAULT_REACTION_ACTIVE, Reason.NOT_A_NUMBER, 0)
