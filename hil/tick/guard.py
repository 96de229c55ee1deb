"""The guard: what stands between any control law and the bus. Pure, small, knows no control law.

It judges measurements (:func:`judge_measurement`) and changes commands (:func:`guard_command`). A single
excess is saturated and marked in ``guard_flags``; one that persists trips. Its state and limits are two
fixed-shape records, so that loop, replay and simulation run the same compiled code.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from hil.control.cogging import MOST_ANGLE
from hil.control.jit import jit
from hil.signals import DriveState, GuardFlag, Reason, RxFlag

SAFETY_PARAMS: Final = np.dtype(
    [
        ("T_s", "f8"),
        ("w_max", "f8"),
        ("i_trip", "f8"),
        ("u_max", "f8"),
        ("du_max", "f8"),
        ("T_L_max", "f8"),
        ("v_dc_min", "f8"),
        ("v_dc_max", "f8"),
        ("temperature_max", "f8"),
        ("i_continuous", "f8"),
        ("i2t_max", "f8"),
        ("power_window", "f8"),
        ("energy_max", "f8"),
        ("deviation_max", "f8"),
        ("soft_start_ticks", "i8"),
        ("trip_ticks", "i8"),
        ("guard_trip_ticks", "i8"),
        ("hold_ticks", "i8"),
        ("quick_stop_ticks", "i8"),
        ("error_budget", "i8"),
        ("enable_ticks", "i8"),
        ("max_gap", "i8"),
        ("echo_lag", "i8"),
        ("frozen_ticks", "i8"),
        ("repeat_ticks", "i8"),
        ("frozen_du", "f8"),
        ("w_error_max", "f8"),
        ("w_error_ticks", "i8"),
        ("i_d_max", "f8"),
        ("open_phase_min", "f8"),
        ("counter_modulus", "i8"),
        ("shadow", "i8"),
        ("u_lsb", "f8"),
        ("T_L_lsb", "f8"),
        ("J", "f8"),
        ("rules", "i8"),
        ("messages", "i8"),
        ("age_max", "i8", 8),
        ("carried_by", "i8", 3),
        ("k_u", "f8"),
        ("u_i", "f8"),
        ("absent", "i8"),
        ("scheduled", "i8"),
        ("theta_error_max", "f8"),
        ("theta_jump", "f8"),
    ],
    align=True,
)
"""Limits, times in ticks, and the resolution of the command on the wire. Units as in the config.

``rules``: 1 for those of this version, 0 for those of a log that lacks the field. ``messages``: slow messages
of the drive's map, whose age may be ``age_max`` periods; ``carried_by``: what v_dc, motor and inverter
temperature come with, as bits of ``came``, 0 for what the drive does not send. ``k_u``: torque per unit of
the command of a drive that takes a current or a torque, ``u_i`` that unit per ampere; 0 for voltages.
``absent``: what the drive does not report, NO_I_Q, NO_I_D and NO_ANGLE. ``scheduled``: ticks from one
measurement to the next that have none, as planned; hold times begin after them. ``theta_error_max`` [rad] and
``theta_jump`` [rad] are of a law that follows an angle, ``theta_jump`` 0 of all others.
"""
NO_I_Q: Final = 1
NO_I_D: Final = 2
NO_ANGLE: Final = 4
MEASURED: Final = 1 << 16
"""Bit of ``came`` for the messages that measure."""
MOST_MESSAGES: Final = 8
MOST_PERIODS: Final = 1024
"""Periods since the last measurement that are still counted; no run in operation waits so long."""

SAFETY_NEUTRAL: Final[dict[str, float]] = dict.fromkeys(
    (
        "rules",
        "messages",
        "age_max",
        "carried_by",
        "k_u",
        "u_i",
        "absent",
        "scheduled",
        "theta_error_max",
        "theta_jump",
    ),
    0,
)
"""Parameters newer than log format 1, each with the value that means "as before it was there".

A log that lacks one replays with that value; a test refuses a new parameter without one (docs/log-format.md).
"""

SAFETY_STATE: Final = np.dtype(
    [
        ("state", "i8"),
        ("reason", "i8"),
        ("armed_ticks", "i8"),
        ("word", "i8"),
        ("run_ticks", "i8"),
        ("stop_ticks", "i8"),
        ("stale", "i8"),
        ("crc_level", "i8"),
        ("counter_level", "i8"),
        ("over", "i8", 8),
        ("clamped", "i8"),
        ("deviating", "i8"),
        ("lagging", "i8"),
        ("echo", "i8"),
        ("frozen", "i8"),
        ("repeats", "i8"),
        ("uncontrolled", "i8"),
        ("seen", "f8", 3),
        ("seen_q", "f8"),
        ("seen_d", "f8"),
        ("i2t", "f8"),
        ("energy", "f8"),
        ("u_q", "f8"),
        ("u_d", "f8"),
        ("T_L", "f8"),
        ("counter", "i8"),
        ("sent_q", "f8", 256),
        ("sent_d", "f8", 256),
        ("sent_T", "f8", 256),
        ("ua_q", "f8"),
        ("ua_d", "f8"),
        ("ua_T", "f8"),
        ("elapsed", "i8"),
        ("gap", "i8"),
        ("armed_gaps", "i8"),
        ("came", "i8"),
        ("age", "i8", 8),
        ("stale_at", "i8"),
        ("i_d_ref", "f8"),
        ("slip", "f8"),
    ],
    align=True,
)
"""State of supervisor and guard: CiA 402 state, latched reason, counters, window sums, sent commands.

``elapsed``: periods since the last measurement that was judged; ``gap``: of this tick; ``came``: slow
messages that have come once, and MEASURED; ``age``: of each [periods]; ``stale_at``: ``stale`` when the stop
began; ``i_d_ref``: what i_d was last to follow, which a stop leaves; ``slip`` [rad]: what the measured angle
lately moved by and the speed did not tell.
"""

OVER_SPEED: Final = 0
OVER_CURRENT: Final = 1
OVER_TEMPERATURE: Final = 2
UNDER_VOLTAGE: Final = 3
OVER_VOLTAGE: Final = 4
FOLLOWING: Final = 5
FOLLOWING_ANGLE: Final = 6


@jit
def elapse(p: Any, s: Any, t: Any) -> None:
    """Count the periods up to this tick, whether they had a measurement or not. Version 0 counts none."""
    if p["rules"] > 0:
        s["elapsed"] = min(s["elapsed"] + t["gap"], MOST_PERIODS)
        s["gap"] = min(int(t["gap"]), MOST_PERIODS)


@jit
def grown(count: int, exceeded: bool, periods: int) -> int:
    """Periods for which ``exceeded`` has held: its first sight counts 1, the next the time since the last."""
    if not exceeded:
        return 0
    return count + max(1, periods) if count > 0 else 1


@jit
def persists(s: Any, index: int, exceeded: bool, ticks: int) -> bool:
    """True once ``exceeded`` has held for ``ticks`` periods; the count is ``s['over'][index]``."""
    over = s["over"]
    over[index] = grown(over[index], exceeded, s["elapsed"])
    return bool(over[index] >= ticks)


@jit
def currents(p: Any, s: Any, t: Any) -> tuple[float, float]:
    """(i_q, i_d) as they are judged: where the drive reports none, what it is asked for, and no i_d."""
    i_q = s["ua_q"] / p["u_i"] if p["absent"] & NO_I_Q else t["i_q"]
    i_d = 0.0 if p["absent"] & NO_I_D else t["i_d"]
    return i_q, i_d


@jit
def power_in(p: Any, s: Any, t: Any, i_q: float, i_d: float) -> float:
    """1.5 (u_q i_q + u_d i_d), or of a drive with a current loop the torque times the speed [W]."""
    if p["k_u"] > 0.0:
        return float(p["k_u"] * s["ua_q"] * t["w"])
    return float(1.5 * (s["ua_q"] * i_q + s["ua_d"] * i_d))


@jit
def windows_trip(p: Any, s: Any, t: Any) -> int:
    """Advance i2t [A2 s] and the leaky energy window [J]; return the Reason that they trip with.

    i2t:    s += (i^2 - i_continuous^2) T_s, not below 0
    energy: e += P T_s - e T_s / window

    for every period since the last measurement: what was not measured counts as what is.
    """
    i_q, i_d = currents(p, s, t)
    i_squared = i_q * i_q + i_d * i_d
    power = power_in(p, s, t, i_q, i_d)
    for _ in range(max(1, s["elapsed"])):
        s["i2t"] = max(0.0, s["i2t"] + (i_squared - p["i_continuous"] * p["i_continuous"]) * p["T_s"])
        s["energy"] = s["energy"] + power * p["T_s"] - s["energy"] * p["T_s"] / p["power_window"]
    if s["i2t"] > p["i2t_max"]:
        return Reason.I2T.value
    if abs(s["energy"]) > p["energy_max"]:
        return Reason.ENERGY.value
    return Reason.NONE.value


@jit
def is_frozen(p: Any, s: Any, t: Any) -> bool:
    """True once speed and currents have stood still for ``frozen_ticks`` periods although the voltage moved.

    The voltage must have moved by ``frozen_du`` since they began to stand still: so much moves the current
    by many steps of the wire within a tick. A drive that limits the voltage is left out. Where the sensors
    are known to be noisy, ``repeat_ticks`` periods of equal readings of a turning motor tell it at constant
    voltage too.
    """
    seen = s["seen"]
    i_q = 0.0 if p["absent"] & NO_I_Q else t["i_q"]
    i_d = 0.0 if p["absent"] & NO_I_D else t["i_d"]
    same = t["w"] == seen[0] and i_q == seen[1] and i_d == seen[2]
    if not same or t["limited"]:
        seen[0], seen[1], seen[2] = t["w"], i_q, i_d
        s["seen_q"], s["seen_d"], s["frozen"], s["repeats"] = s["ua_q"], s["ua_d"], 0, 0
        return False
    dq, dd = s["ua_q"] - s["seen_q"], s["ua_d"] - s["seen_d"]
    moved = dq * dq + dd * dd > p["frozen_du"] * p["frozen_du"]
    s["frozen"] = grown(s["frozen"], moved, s["elapsed"])
    s["repeats"] = grown(s["repeats"], t["w"] != 0.0, s["elapsed"])
    return bool(s["frozen"] >= p["frozen_ticks"] or s["repeats"] >= p["repeat_ticks"])


@jit
def sent(p: Any, s: Any, part: int) -> bool:
    """True once the message that carries v_dc (0), motor (1) or inverter temperature (2) has come."""
    bit = p["carried_by"][part]
    return bool(bit != 0 and s["came"] & bit == bit)


@jit
def all_numbers(p: Any, s: Any, t: Any) -> bool:
    """False when any measured signal is NaN or infinite. What the drive does not send is absent, no fault."""
    i_q, i_d = currents(p, s, t)
    if not (math.isfinite(t["w"]) and math.isfinite(i_q) and math.isfinite(i_d)):
        return False
    if sent(p, s, 0) and not math.isfinite(t["v_dc"]):
        return False
    if sent(p, s, 1) and not math.isfinite(t["temperature_motor"]):
        return False
    if sent(p, s, 2) and not math.isfinite(t["temperature_inverter"]):
        return False
    if p["theta_jump"] > 0.0 and not abs(t["theta"]) < MOST_ANGLE:
        return False
    if p["rules"] == 0 or not p["shadow"]:
        return True
    return bool(math.isfinite(t["u_q_seen"]) and math.isfinite(t["u_d_seen"]))


@jit
def hottest(p: Any, t: Any) -> float:
    """The higher of the temperatures that there are, NaN for none: one that is absent hides no other."""
    motor, inverter = t["temperature_motor"], t["temperature_inverter"]
    if p["rules"] > 0 and math.isnan(motor):
        return float(inverter)
    if p["rules"] > 0 and math.isnan(inverter):
        return float(motor)
    return float(max(motor, inverter))


@jit
def judge_measurement(p: Any, s: Any, t: Any) -> int:
    """Return the Reason to stop that a fresh measurement gives, 0 for none.

    NaN and infinity stop at once; speed, current, temperature and DC link after ``trip_ticks`` periods.
    """
    if not all_numbers(p, s, t):
        return Reason.NOT_A_NUMBER.value
    if p["theta_jump"] > 0.0 and abs(s["slip"]) > p["theta_jump"]:
        return Reason.ANGLE_JUMP.value
    ticks = p["trip_ticks"]
    i_q, i_d = currents(p, s, t)
    i_squared = i_q * i_q + i_d * i_d
    temperature = hottest(p, t)
    speed = persists(s, OVER_SPEED, abs(t["w"]) > p["w_max"], ticks)
    current = persists(s, OVER_CURRENT, i_squared > p["i_trip"] * p["i_trip"], ticks)
    hot = persists(s, OVER_TEMPERATURE, temperature > p["temperature_max"], ticks)
    low = persists(s, UNDER_VOLTAGE, t["v_dc"] < p["v_dc_min"], ticks)
    high = persists(s, OVER_VOLTAGE, t["v_dc"] > p["v_dc_max"], ticks)
    frozen = is_frozen(p, s, t)
    if speed:
        return Reason.OVER_SPEED.value
    if current:
        return Reason.OVER_CURRENT.value
    if hot:
        return Reason.OVER_TEMPERATURE.value
    if low:
        return Reason.DC_LINK_UNDER_VOLTAGE.value
    if high:
        return Reason.DC_LINK_OVER_VOLTAGE.value
    if frozen:
        return Reason.FROZEN_FEEDBACK.value
    return int(windows_trip(p, s, t))


@jit
def limit_step(value: float, previous: float, step: float) -> float:
    """Limit the change from ``previous`` to ``step`` per tick."""
    return min(max(value, previous - step), previous + step)


@jit
def step_share(p: Any, s: Any, u_q: float, u_d: float) -> float:
    """Share of the way from the last voltage to (u_q, u_d) that keeps each axis to du_max per tick.

    Both ends lie in the voltage circle, so what lies between them does; limiting each axis by itself would
    leave the straight way and reach out of the circle.
    """
    most = max(abs(u_q - s["u_q"]), abs(u_d - s["u_d"]))
    return float(p["du_max"] / most) if most > p["du_max"] else 1.0


@jit
def to_wire(value: float, lsb: float) -> float:
    """Round as encoder and decoder do: rint(value / lsb) lsb; + 0.0 since the wire has no negative zero."""
    return float(np.rint(value / lsb) * lsb + 0.0)


@jit
def inward(value: float, lsb: float) -> float:
    """Round toward zero to a step of the wire; what is a step up to float64's rounding stays that step."""
    return float(np.trunc(value / lsb * (1.0 + 1e-12)) * lsb + 0.0)


@jit
def voltage_to_wire(p: Any, u_q: float, u_d: float, limit: float) -> tuple[float, float]:
    """Round a voltage in the circle of radius ``limit`` to the wire, without leaving the circle.

    The nearest steps may lie outside of it, by up to u_lsb / sqrt(2): then both go toward zero. Version 0
    takes the nearest.
    """
    lsb = p["u_lsb"]
    q, d = to_wire(u_q, lsb), to_wire(u_d, lsb)
    if p["rules"] > 0 and q * q + d * d > limit * limit * (1.0 + 1e-12):
        return inward(u_q, lsb), inward(u_d, lsb)
    return q, d


@jit
def is_denormal(value: float) -> bool:
    """True for a number other than 0 below the smallest normal float64."""
    return value != 0.0 and abs(value) < 2.2250738585072014e-308


@jit
def voltage_limit(p: Any, s: Any) -> float:
    """Radius of the voltage circle [V], ramped in over the soft start."""
    if s["run_ticks"] >= p["soft_start_ticks"]:
        return float(p["u_max"])
    return float(p["u_max"]) * float(s["run_ticks"]) / float(p["soft_start_ticks"])


@jit
def deviates(p: Any, s: Any, t: Any) -> bool:
    """True when the drive applies another voltage than the last one sent, by more than allowed.

    By how much a drive that limits the voltage itself is off is not known: with a limit given it deviates.
    """
    dq = s["ua_q"] - s["u_q"]
    dd = s["ua_d"] - s["u_d"]
    far = dq * dq + dd * dd > p["deviation_max"] * p["deviation_max"]
    far = far or (t["limited"] != 0 and p["deviation_max"] < math.inf)
    return bool(far and t["rx_flags"] & RxFlag.FRESH)


@jit
def guard_command(p: Any, s: Any, t: Any, u_q: float, u_d: float, T_L: float) -> int:
    """Limit the law's command, write what may be sent to the tick, return the Reason of a persistent excess.

    Order: not a number -> 0; state -> 0; circle u_max (with soft start); step du_max; load torque; wire.
    """
    flags = 0
    if not (math.isfinite(u_q) and math.isfinite(u_d) and math.isfinite(T_L)):
        write_command(s, t, 0.0, 0.0, 0.0, GuardFlag.NOT_A_NUMBER.value)
        return Reason.CONTROLLER_ERROR.value
    if is_denormal(u_q) or is_denormal(u_d) or is_denormal(T_L):
        u_q = 0.0 if is_denormal(u_q) else u_q
        u_d = 0.0 if is_denormal(u_d) else u_d
        T_L = 0.0 if is_denormal(T_L) else T_L
        flags |= GuardFlag.DENORMAL.value
    if t["state"] != DriveState.OPERATION_ENABLED:
        flags |= GuardFlag.STATE_FORCES_ZERO.value if (u_q != 0.0 or u_d != 0.0 or T_L != 0.0) else 0
        return write_command(s, t, 0.0, 0.0, 0.0, flags)
    limit = voltage_limit(p, s)
    norm = math.sqrt(u_q * u_q + u_d * u_d)
    if norm > limit:
        ratio = limit / norm  # 0 for a norm that overflows
        u_q, u_d = u_q * ratio, u_d * ratio
        flags |= GuardFlag.SOFT_START.value if limit < p["u_max"] else GuardFlag.VOLTAGE.value
    share = step_share(p, s, u_q, u_d)
    step_q, step_d = u_q, u_d
    if share < 1.0:
        step_q = limit_step(s["u_q"] + share * (u_q - s["u_q"]), s["u_q"], p["du_max"])
        step_d = limit_step(s["u_d"] + share * (u_d - s["u_d"]), s["u_d"], p["du_max"])
        flags |= GuardFlag.VOLTAGE_STEP.value
    load = min(max(T_L, -p["T_L_max"]), p["T_L_max"])
    flags |= GuardFlag.LOAD_TORQUE.value if load != T_L else 0
    flags |= GuardFlag.APPLIED_DEVIATES.value if deviates(p, s, t) else 0
    q, d = voltage_to_wire(p, step_q, step_d, limit)
    write_command(s, t, q, d, to_wire(load, p["T_L_lsb"]), flags)
    return persistent_excess(p, s, flags)


@jit
def write_command(s: Any, t: Any, u_q: float, u_d: float, T_L: float, flags: int) -> int:
    """Store the guarded command in tick and state."""
    t["u_q"], t["u_d"], t["T_L"] = u_q, u_d, T_L
    s["u_q"], s["u_d"], s["T_L"] = u_q, u_d, T_L
    t["guard_flags"] = flags
    return Reason.NONE.value


@jit
def persistent_excess(p: Any, s: Any, flags: int) -> int:
    """Return GUARD_PERSISTENT once the guard has had to change the command for guard_trip_ticks periods.

    The soft start is a planned limit and does not count.
    """
    changed = flags & ~(GuardFlag.SOFT_START.value | GuardFlag.DENORMAL.value)
    s["clamped"] = grown(s["clamped"], changed != 0, s["gap"])
    return Reason.GUARD_PERSISTENT.value if s["clamped"] >= p["guard_trip_ticks"] else Reason.NONE.value
