"""The supervisor: one pure transition function by CiA 402 names, with the reason of each stop.

A stop latches: no path leads from a stop back to operation; a new arming is a new run. What may be sent in
a state is decided here, how large it may be in :mod:`hil.tick.guard`.
"""

from __future__ import annotations

from typing import Any

from hil.control.jit import jit
from hil.signals import Controlword, DriveState, Reason, Request, RxFlag
from hil.tick.guard import FOLLOWING, FOLLOWING_ANGLE, MEASURED, elapse, grown, judge_measurement, persists

STOP_TICKS = 20
"""Ticks for which the stop frames are repeated before the run ends."""


@jit
def leaky(level: int, error: bool) -> int:
    """Error level: +4 for an error, -1 for a good tick, not below 0."""
    return level + 4 if error else max(0, level - 1)


@jit
def note_ages(p: Any, s: Any, t: Any) -> None:
    """Count the age of each slow message [periods], and note which have come once."""
    for index in range(p["messages"]):
        if int(t["missing"]) & (1 << index):
            s["age"][index] += t["gap"]
        else:
            s["age"][index] = 0
            s["came"] |= 1 << index
    if p["rules"] > 0 and t["rx_flags"] & RxFlag.FRESH:
        s["came"] |= MEASURED


@jit
def all_came(p: Any, s: Any) -> bool:
    """True once each slow message has come: before that nobody knows DC link and temperatures."""
    every = (1 << int(p["messages"])) - 1
    return bool(s["came"] & every == every)


@jit
def judge_ages(p: Any, s: Any) -> int:
    """Return the Reason once a slow message has not come for longer than its limit."""
    for index in range(p["messages"]):
        if s["age"][index] > p["age_max"][index]:
            return Reason.STALE_STATUS.value
    return Reason.NONE.value


@jit
def judge_bus(p: Any, s: Any, t: Any) -> int:
    """Return the Reason to stop that this tick's traffic gives, 0 for none."""
    flags = t["rx_flags"]
    damaged = flags & (RxFlag.CRC_ERROR | RxFlag.LENGTH_ERROR | RxFlag.ERROR_FRAME)
    s["crc_level"] = leaky(s["crc_level"], damaged != 0)
    s["counter_level"] = leaky(
        s["counter_level"], (flags & (RxFlag.COUNTER_REPEATED | RxFlag.COUNTER_JUMP)) != 0
    )
    if flags & RxFlag.GUARDIAN:
        return Reason.GUARDIAN.value
    if flags & RxFlag.BUS_DOWN:
        return Reason.BUS_DOWN.value
    if flags & RxFlag.SEND_FAILED:
        return Reason.SEND_FAILED.value
    if flags & RxFlag.GUARDIAN_LOST:
        return Reason.GUARDIAN_LOST.value
    if flags & RxFlag.FOREIGN_COMMAND:
        return Reason.FOREIGN_COMMAND.value
    if s["crc_level"] > 4 * p["error_budget"]:
        return Reason.CRC_ERRORS.value
    if s["counter_level"] > 4 * p["error_budget"]:
        return Reason.COUNTER_ERRORS.value
    return Reason.NONE.value


@jit
def judge_drive(s: Any, t: Any) -> int:
    """Return the Reason to stop that the drive's own state gives, 0 for none."""
    if not t["rx_flags"] & RxFlag.FRESH:
        return Reason.NONE.value
    if t["drive_state"] == DriveState.FAULT or t["drive_state"] == DriveState.FAULT_REACTION_ACTIVE:
        return Reason.DRIVE_FAULT.value
    if t["drive_state"] != DriveState.OPERATION_ENABLED:
        return Reason.DRIVE_LEFT_OPERATION.value
    return Reason.NONE.value


@jit
def judge_timing(p: Any, s: Any, t: Any) -> int:
    """Count ticks without fresh feedback; return the Reason once the hold time is over.

    It begins when feedback is due.
    """
    if t["rx_flags"] & RxFlag.FRESH:
        s["stale"] = 0
    else:
        s["stale"] += t["gap"]
    if s["stale"] > p["hold_ticks"] + p["scheduled"]:
        return Reason.STALE_FEEDBACK.value
    if t["gap"] > p["max_gap"]:
        return Reason.LOOP_OVERRUN.value
    return Reason.NONE.value


@jit
def judge_echo(p: Any, s: Any, t: Any) -> int:
    """Count periods for which the echo is not the last command's; return the Reason past the hold time.

    Either the drive does not get the commands, or what comes is the answer to an older SYNC: both make
    feedback that is good frame by frame worthless. An echo that stands still does not count as right when
    the command's counter comes round to it; where it comes round from one feedback to the next it may.
    """
    if p["shadow"] or not t["rx_flags"] & RxFlag.FRESH:
        return Reason.NONE.value
    lag = (int(s["counter"]) - int(t["echo"])) % int(p["counter_modulus"])
    round_again = p["scheduled"] > 0 and (p["scheduled"] + 1) % p["counter_modulus"] == 0
    right = lag <= p["echo_lag"] and (round_again or t["echo"] != s["echo"])
    s["lagging"] = grown(s["lagging"], not right, s["elapsed"])
    s["echo"] = t["echo"]
    return Reason.COMMAND_LOST.value if s["lagging"] > p["hold_ticks"] + p["scheduled"] else Reason.NONE.value


@jit
def judge_following(p: Any, s: Any, t: Any) -> int:
    """Return the Reason once speed, angle or i_d has been off its reference by too much for too long.

    i_d follows i_d*, 0 for most laws. With a phase open the current stays on one stator axis, so that
    tan theta = i_d/i_q while the rotor turns by theta: |i_d| > |i_q|/3 in 80 % of the ticks, at any load
    whose current the sensors can tell. So periods count up and down; one measurement alone never fills the
    count.
    """
    if not t["rx_flags"] & RxFlag.FRESH:
        return Reason.NONE.value
    off = abs(t["w_ref"] - t["w"]) > p["w_error_max"]
    lost = persists(s, FOLLOWING, off, p["w_error_ticks"])
    i_d = abs(t["i_d"] - s["i_d_ref"])
    far = i_d > p["i_d_max"] or (i_d > p["open_phase_min"] and 3.0 * i_d > abs(t["i_q"]))
    periods = min(max(1, s["elapsed"]), max(1, p["w_error_ticks"] // 2))
    s["uncontrolled"] = s["uncontrolled"] + periods if far else max(0, s["uncontrolled"] - periods)
    if s["uncontrolled"] >= p["w_error_ticks"]:
        return Reason.CURRENT_UNCONTROLLED.value
    if p["theta_jump"] > 0.0:
        astray = abs(t["theta_error"]) > p["theta_error_max"]
        if persists(s, FOLLOWING_ANGLE, astray, p["w_error_ticks"]):
            return Reason.ANGLE_ERROR.value
    return Reason.FOLLOWING_ERROR.value if lost else Reason.NONE.value


@jit
def first(a: int, b: int) -> int:
    """Return the first reason that is one."""
    return a if a != 0 else b


@jit
def judge(p: Any, s: Any, t: Any) -> int:
    """Return the most telling Reason to stop now, 0 for none. All judges run, so that all counts advance."""
    elapse(p, s, t)
    bus = judge_bus(p, s, t)
    timing = judge_timing(p, s, t)
    measured = Reason.NONE.value
    if t["rx_flags"] & RxFlag.FRESH:
        measured = judge_measurement(p, s, t)
    reason = first(bus, measured)
    if s["state"] == DriveState.OPERATION_ENABLED:
        reason = first(reason, judge_drive(s, t))
        reason = first(reason, judge_echo(p, s, t))
        reason = first(reason, judge_following(p, s, t))
    if t["rx_flags"] & RxFlag.FRESH:
        s["elapsed"] = 0
    reason = first(reason, timing)
    reason = first(reason, judge_ages(p, s))
    reason = first(reason, Reason.LOG_FAILED.value if t["log_failed"] else 0)
    return first(reason, judge_request(t))


@jit
def judge_request(t: Any) -> int:
    """Return the Reason that the request gives: the operator's, or for the sake of another node."""
    if t["request"] == Request.QUICK_STOP:
        return Reason.QUICK_STOP_REQUESTED.value
    if t["request"] == Request.STOP:
        return Reason.STOP_REQUESTED.value
    if t["request"] == Request.NODE_STOPPED:
        return Reason.NODE_STOPPED.value
    return Reason.NONE.value


@jit
def is_fault(reason: int) -> bool:
    """True for reasons that are faults; a requested stop and stale feedback begin as a quick stop."""
    return not (
        reason == Reason.STOP_REQUESTED
        or reason == Reason.QUICK_STOP_REQUESTED
        or reason == Reason.STALE_FEEDBACK
        or reason == Reason.LOG_FAILED
        or reason == Reason.NODE_STOPPED
    )


@jit
def begin_stop(s: Any, reason: int) -> None:
    """Latch the reason and enter the stop that belongs to it."""
    s["reason"] = reason
    s["stop_ticks"] = 0
    s["stale_at"] = s["stale"]
    fault = is_fault(reason)
    s["state"] = DriveState.FAULT_REACTION_ACTIVE.value if fault else DriveState.QUICK_STOP_ACTIVE.value


@jit
def handshake(p: Any, s: Any, t: Any) -> int:
    """Follow the drive through its enable handshake; return the controlword for its state.

    A drive that stands in FAULT is reset by a rising edge of bit 7, made of two alternating words, by the
    tick's number, or from one feedback to the next where these are several ticks apart. Without
    fresh feedback the last word stands: another would undo the step that the drive may just have made. It is
    switched on, but not enabled before each slow message has come.
    """
    if not t["rx_flags"] & RxFlag.FRESH and s["armed_ticks"] > 1:
        return int(s["word"])
    if t["rx_flags"] & RxFlag.FRESH:
        on = t["drive_state"] == DriveState.OPERATION_ENABLED or t["drive_state"] == DriveState.SWITCHED_ON
        if on and not all_came(p, s):
            return Controlword.SWITCH_ON.value
        if t["drive_state"] == DriveState.OPERATION_ENABLED:
            s["state"] = DriveState.OPERATION_ENABLED.value
            s["run_ticks"] = 0
            return Controlword.ENABLE_OPERATION.value
        if t["drive_state"] == DriveState.SWITCHED_ON:
            s["state"] = DriveState.SWITCHED_ON.value
            return Controlword.ENABLE_OPERATION.value
        if t["drive_state"] == DriveState.READY_TO_SWITCH_ON:
            return Controlword.SWITCH_ON.value
        if t["drive_state"] == DriveState.FAULT:
            odd = s["armed_ticks"] % 2 == 1
            if p["scheduled"] > 0:
                odd = s["word"] != Controlword.FAULT_RESET
            return Controlword.FAULT_RESET.value if odd else Controlword.DISABLE_VOLTAGE.value
    return Controlword.SHUTDOWN.value


@jit
def arming(p: Any, s: Any, t: Any) -> int:
    """One tick of READY_TO_SWITCH_ON or SWITCHED_ON: handshake, or the Reason to give up."""
    s["armed_ticks"] += 1
    if p["rules"] > 0:
        s["armed_gaps"] += max(0, int(t["gap"]) - 1)
    reason = judge_arming(p, s, t)
    if reason != 0:
        begin_stop(s, reason)
        return Controlword.DISABLE_VOLTAGE.value
    s["word"] = handshake(p, s, t)
    return int(s["word"])


@jit
def judge_arming(p: Any, s: Any, t: Any) -> int:
    """While the drive is being enabled, missing feedback is covered by the enable timeout.

    A shadow run waits for its drive, and so for the drive's slow messages.
    """
    elapse(p, s, t)
    reason = judge_bus(p, s, t)
    if t["rx_flags"] & RxFlag.FRESH:
        reason = first(reason, judge_measurement(p, s, t))
        s["elapsed"] = 0
        if not p["shadow"]:
            reason = first(reason, judge_ages(p, s))
    reason = first(reason, Reason.LOG_FAILED.value if t["log_failed"] else 0)
    reason = first(reason, judge_request(t))
    timed_out = s["armed_ticks"] + s["armed_gaps"] > p["enable_ticks"]
    return first(reason, Reason.ENABLE_TIMEOUT.value if timed_out else 0)


@jit
def operate(p: Any, s: Any, t: Any) -> int:
    """One tick of OPERATION_ENABLED."""
    reason = judge(p, s, t)
    if reason != 0:
        begin_stop(s, reason)
        return Controlword.QUICK_STOP.value
    s["run_ticks"] += 1
    return Controlword.ENABLE_OPERATION.value


@jit
def stopping(p: Any, s: Any, t: Any) -> int:
    """One tick of a stop: zero voltage and quick stop until the drive has left operation, then disable."""
    s["stop_ticks"] += 1
    judge_timing(p, s, t)
    if s["state"] == DriveState.QUICK_STOP_ACTIVE and s["stale"] > p["quick_stop_ticks"] + p["scheduled"]:
        s["state"] = DriveState.FAULT_REACTION_ACTIVE.value
    fresh = (t["rx_flags"] & RxFlag.FRESH) != 0
    left = fresh and t["drive_state"] != DriveState.OPERATION_ENABLED
    most = STOP_TICKS + p["quick_stop_ticks"] + p["scheduled"]
    if (left and s["stop_ticks"] >= 3) or s["stop_ticks"] >= most:
        quick = s["state"] == DriveState.QUICK_STOP_ACTIVE
        s["state"] = DriveState.SWITCH_ON_DISABLED.value if quick else DriveState.FAULT.value
        return Controlword.DISABLE_VOLTAGE.value
    return Controlword.QUICK_STOP.value


@jit
def supervise(p: Any, s: Any, t: Any) -> None:
    """Advance the supervisor by one tick; writes ``state``, ``reason``, ``controlword`` and ``send``.

    SWITCH_ON_DISABLED (disarmed) --ARM--> READY_TO_SWITCH_ON -> SWITCHED_ON -> OPERATION_ENABLED
    -> QUICK_STOP_ACTIVE -> SWITCH_ON_DISABLED, or -> FAULT_REACTION_ACTIVE -> FAULT. Disarmed and after a
    stop, ``send`` is 0 but for the one frame that disables the drive; with the bus down, once the guardian
    has stopped the drive, and in a shadow run, nothing is sent. A stop that is asked for before arming ends
    the run there.
    """
    state = s["state"]
    controlword = Controlword.DISABLE_VOLTAGE.value
    send = 1
    note_ages(p, s, t)
    if state == DriveState.SWITCH_ON_DISABLED and s["reason"] == 0 and t["request"] == Request.ARM:
        s["state"] = DriveState.READY_TO_SWITCH_ON.value
        controlword = arming(p, s, t)
    elif state == DriveState.READY_TO_SWITCH_ON or state == DriveState.SWITCHED_ON:
        controlword = arming(p, s, t)
    elif state == DriveState.OPERATION_ENABLED:
        controlword = operate(p, s, t)
    elif state == DriveState.QUICK_STOP_ACTIVE or state == DriveState.FAULT_REACTION_ACTIVE:
        controlword = stopping(p, s, t)
    else:
        if s["reason"] == 0:
            s["reason"] = judge_request(t)
        send = 0
    t["state"] = s["state"]
    t["reason"] = s["reason"]
    t["controlword"] = controlword
    down = (t["rx_flags"] & RxFlag.BUS_DOWN) != 0 or s["reason"] == Reason.BUS_DOWN
    down = down or (t["rx_flags"] & RxFlag.GUARDIAN) != 0 or s["reason"] == Reason.GUARDIAN
    t["send"] = 0 if down or p["shadow"] else send
