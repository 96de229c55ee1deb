"""The guard alone under drawn states and commands, judged by rules that share nothing with its code.

Read from the issue's words: what leaves is finite, no denormal, on the wire's grid, zero outside operation,
within circle, step and load limit; what is within all limits leaves as asked; each change has its mark; an
excess that persists trips, and one that does not does not.
"""

from __future__ import annotations

import math
from typing import Any

from hil.signals import DriveState, GuardFlag, Reason, RxFlag
from tests.fuzz.draw import LEAST_NORMAL, Draw
from tests.safety import Guard

PLANNED = GuardFlag.SOFT_START | GuardFlag.DENORMAL
LSB = 0.01
SLACK = 1e-9
Command = tuple[float, float, float]


def take(data: bytes) -> None:
    """Set up a guard from the input, then ask it for commands until the input is used up (or 40 of them)."""
    draw = Draw(data)
    guard = drawn_guard(draw)
    state, row = (0.0, 0.0, 0.0), 0
    for _ in range(40):
        scramble(guard, draw)
        p = guard.p[0]
        asked = (
            draw.number(float(p["u_max"]), float(p["du_max"]), 1.0),
            draw.number(float(p["u_max"]), float(p["du_max"]), 1.0),
            draw.number(float(p["T_L_max"]), 1.0),
        )
        off = deviation(guard, state)
        *sent, flags, reason = guard.ask(*asked)
        row = judge(guard, asked, state, (sent[0], sent[1], sent[2]), flags, reason, row, off)
        state = (sent[0], sent[1], sent[2])
        if not draw.rest():
            return


def drawn_guard(draw: Draw) -> Guard:
    return Guard(
        u_max=draw.pick((300.0, 48.0, 5.0)),
        du_max=draw.pick((50.0, 1000.0, 0.5)),
        T_L_max=draw.pick((10.0, 0.5)),
        deviation_max=draw.pick((math.inf, 5.0)),
        soft_start_ticks=draw.pick((0, 100)),
        guard_trip_ticks=draw.pick((5, 2, 1000)),
    )


def scramble(guard: Guard, draw: Draw) -> None:
    """What the guard reads beside the command: state, time in operation, applied voltage, freshness."""
    on = not draw.one_in(6)
    guard.t["state"] = int(DriveState.OPERATION_ENABLED) if on else draw.below(8)
    guard.t["rx_flags"] = int(RxFlag.FRESH) if not draw.one_in(4) else draw.below(1 << 13)
    guard.t["limited"] = draw.one_in(8)
    guard.s["run_ticks"] = draw.pick((10_000, 0, 1, 50, 99, 100))
    if draw.one_in(4):
        guard.s["ua_q"], guard.s["ua_d"] = draw.number(5.0, 50.0), draw.number(5.0, 50.0)
    else:
        guard.s["ua_q"], guard.s["ua_d"] = guard.s["u_q"], guard.s["u_d"]


def deviation(guard: Guard, before: Command) -> float:
    """Distance of the applied voltage from the last one sent, 0 when nothing fresh tells it.

    A drive that limits the voltage is off by more than any limit.
    """
    if not int(guard.t["rx_flags"]) & RxFlag.FRESH:
        return 0.0
    if guard.t["limited"] and math.isfinite(guard.p["deviation_max"][0]):
        return 1e9
    return math.hypot(guard.s["ua_q"][0] - before[0], guard.s["ua_d"][0] - before[1])


def judge(
    guard: Guard,
    asked: Command,
    before: Command,
    sent: Command,
    flags: int,
    reason: int,
    row: int,
    off: float,
) -> int:
    """Check one command; return the count of ticks in a row in which the guard had to act."""
    p: Any = guard.p[0]
    seen = f"asked {asked} after {before}: sent {sent} flags {flags:#x} reason {reason}"
    assert sent == (guard.s["u_q"][0], guard.s["u_d"][0], guard.s["T_L"][0]), f"{seen}: not remembered"
    assert all(clean(value) for value in sent), seen
    if not all(map(math.isfinite, asked)):
        assert sent == (0.0, 0.0, 0.0) and flags == GuardFlag.NOT_A_NUMBER, seen
        assert reason == Reason.CONTROLLER_ERROR, seen
        return row
    assert bool(flags & GuardFlag.DENORMAL) == any(0.0 < abs(v) < LEAST_NORMAL for v in asked), seen
    wanted = tuple(0.0 if abs(v) < LEAST_NORMAL else v for v in asked)
    if guard.t["state"] != DriveState.OPERATION_ENABLED:
        assert sent == (0.0, 0.0, 0.0) and reason == Reason.NONE, seen
        assert bool(flags & GuardFlag.STATE_FORCES_ZERO) == any(wanted), seen
        return row
    check_size(guard, before, sent, seen)
    check_marks(guard, (wanted[0], wanted[1], wanted[2]), before, sent, flags, seen)
    if math.isfinite(off) and abs(off - p["deviation_max"]) > SLACK:
        assert bool(flags & GuardFlag.APPLIED_DEVIATES) == (off > p["deviation_max"]), seen
    row = row + 1 if flags & ~PLANNED else 0
    assert reason == (Reason.GUARD_PERSISTENT if row >= p["guard_trip_ticks"] else Reason.NONE), (
        f"{seen} {row}"
    )
    return row


def clean(value: float) -> bool:
    """Finite, no denormal, no negative zero, on the grid of the wire."""
    on_grid = math.isfinite(value) and value == round(value / LSB) * LSB
    return on_grid and (abs(value) >= LEAST_NORMAL or math.copysign(1.0, value) > 0.0)


def radius(guard: Guard) -> float:
    """Of the voltage circle: grows over the soft start."""
    p, ran = guard.p[0], int(guard.s["run_ticks"][0])
    whole = ran >= p["soft_start_ticks"]
    return float(p["u_max"] if whole else p["u_max"] * ran / p["soft_start_ticks"])


def check_size(guard: Guard, before: Command, sent: Command, seen: str) -> None:
    """Circle, step and load limit; in the circle rounding to the wire may add half a step to each axis."""
    p = guard.p[0]
    shrinks = math.hypot(before[0], before[1]) > radius(guard)
    assert shrinks or math.hypot(sent[0], sent[1]) <= radius(guard) + SLACK, seen
    assert abs(sent[0] - before[0]) <= p["du_max"] + LSB / 2 + SLACK, seen
    assert abs(sent[1] - before[1]) <= p["du_max"] + LSB / 2 + SLACK, seen
    assert abs(sent[2]) <= p["T_L_max"] + LSB / 2 + SLACK, seen


def check_marks(guard: Guard, asked: Command, before: Command, sent: Command, flags: int, seen: str) -> None:
    """Each limit that is passed is marked and no other is; what is within all leaves as asked."""
    p, size = guard.p[0], math.hypot(asked[0], asked[1])
    limit = GuardFlag.VOLTAGE if radius(guard) == p["u_max"] else GuardFlag.SOFT_START
    if abs(size - radius(guard)) > SLACK:
        assert flags & (GuardFlag.VOLTAGE | GuardFlag.SOFT_START) == (limit if size > radius(guard) else 0), (
            seen
        )
    share = radius(guard) / size if size > radius(guard) else 1.0
    if math.isinf(asked[0] * asked[0] + asked[1] * asked[1]):
        share = 0.0  # no direction is left: zero
    way = [asked[axis] * share - before[axis] for axis in (0, 1)]
    far = max(map(abs, way))
    if abs(far - p["du_max"]) > SLACK:
        assert bool(flags & GuardFlag.VOLTAGE_STEP) == (far > p["du_max"]), seen
    assert bool(flags & GuardFlag.LOAD_TORQUE) == (abs(asked[2]) > p["T_L_max"]), seen
    part = p["du_max"] / far if far > p["du_max"] else 1.0
    for axis in (0, 1):
        assert abs(sent[axis] - before[axis] - part * way[axis]) < LSB + SLACK, (
            seen
        )  # toward zero at the circle
    assert abs(sent[2] - min(max(asked[2], -p["T_L_max"]), p["T_L_max"])) <= LSB / 2 + SLACK, seen
