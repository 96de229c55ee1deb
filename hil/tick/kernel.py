"""The whole of a tick as one pure compiled function: observe, judge, control, guard, command.

The loop, replay and simulation all call :func:`step`, so that their outputs are the same to the bit. Inputs
and outputs are fields of one TICK record; parameters and states are the records of safety and law.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.control.cogging import MOST_ANGLE, flows, known_load, loaded
from hil.control.jit import array_at, jit
from hil.control.law import (
    LAW_PARAMS,
    LAW_STATE,
    MTPA,
    SPEED,
    apply,
    ask,
    between,
    is_saturated,
    observe,
    reset,
    to_circle,
)
from hil.control.position import locate
from hil.control.references import REFERENCE
from hil.control.speed import LEADS, flowed, latched
from hil.signals import Controlword, DriveState, GuardFlag, Reason, RxFlag
from hil.tick.guard import SAFETY_PARAMS, SAFETY_STATE, guard_command, voltage_limit
from hil.tick.setpoint import SETPOINT_PARAMS, SETPOINT_STATE, prepare
from hil.tick.supervisor import begin_stop, supervise

Record = npt.NDArray[np.void]
PLACED = (
    REFERENCE, SETPOINT_PARAMS, SETPOINT_STATE, SAFETY_PARAMS, SAFETY_STATE, LAW_PARAMS, LAW_STATE,
)  # fmt: skip
"""The records of one controller, in the order in which :func:`whole` takes them."""
SLIP_S = 0.02
"""Time constant with which it is forgotten what the angle moved by and the speed did not tell [s]."""

__all__ = ["SAFETY_PARAMS", "SAFETY_STATE", "new_safety_state", "prepare", "step"]


def new_safety_state() -> Record:
    """Disarmed, nothing sent."""
    s = np.zeros(1, SAFETY_STATE)
    s["state"] = DriveState.SWITCH_ON_DISABLED.value
    return s


@jit
def applied_now(p: Any, s: Any, t: Any) -> None:
    """Find what is applied from this tick on: by the echo when feedback is fresh, else the newest command.

    In every drive state but OPERATION_ENABLED the gates are off: zero. In a shadow run it is what another
    controller was seen to command.
    """
    if p["shadow"]:
        on = t["drive_state"] == DriveState.OPERATION_ENABLED
        s["ua_q"], s["ua_d"] = (t["u_q_seen"], t["u_d_seen"]) if on else (0.0, 0.0)
        s["ua_T"] = s["T_L"]
        return
    if not t["rx_flags"] & RxFlag.FRESH:
        s["ua_q"], s["ua_d"], s["ua_T"] = s["u_q"], s["u_d"], s["T_L"]
        return
    if t["drive_state"] == DriveState.OPERATION_ENABLED:
        echo = t["echo"] % 256
        s["ua_q"], s["ua_d"], s["ua_T"] = s["sent_q"][echo], s["sent_d"][echo], s["sent_T"][echo]
    else:
        s["ua_q"], s["ua_d"], s["ua_T"] = 0.0, 0.0, 0.0


@jit
def estimate_speed(p: Any, s: Any, lp: Any, ls: Any, t: Any) -> None:
    """:func:`estimate` of a drive with a current loop: told what flowed, or by the model of that loop.

    Of the law fac over two nodes it is what flowed of both: i_q less the load machine's torque over k_t.
    """
    fresh = (t["rx_flags"] & RxFlag.FRESH) != 0
    told, pair = lp["told"] != 0, lp["pair"] == LEADS
    heard = fresh and math.isfinite(t["w"]) and (not told or math.isfinite(t["i_q"]))
    flows_now, braking = t["i_q"] * lp["u_i"], 0.0
    if pair:
        heard = heard and math.isfinite(t["T_L_in"])
        flows_now -= t["T_L_in"] / lp["k_u"]
        braking = ls["load"]
        if heard:
            ls["load"] = t["T_L_in"]
            braking = 0.5 * (braking + ls["load"])
    periods = min(int(t["gap"]), int(lp["max_gap"]) + 1)
    ls["ua"][0] = flowed(lp, ls, flows_now, heard and told, periods)
    if loaded(lp) and lp["order"]:
        flows(lp, ls, periods)
    observe(lp, ls, t["w"], 0.0, 0.0, heard, t["gap"])
    if lp["every"] > 1 and not heard:
        between(lp, ls)
    t["ua_q"], t["ua_d"] = ls["ua"][0], 0.0
    applied_now(p, s, t)
    if pair:
        t["ua_q"] += braking / lp["k_u"]
        latched(lp, ls, s["ua_q"] - t["T_L_sent"] / lp["k_u"], True)
        return
    latched(lp, ls, s["ua_q"], not fresh or t["drive_state"] == DriveState.OPERATION_ENABLED)


@jit
def estimate_angle(p: Any, s: Any, lp: Any, ls: Any, t: Any) -> None:
    """The angle over turns and its following error; until operation its reference begins where the shaft is.

    The shaft has turned on since the last measurement: by the speed that the observer foretells.
    What is no angle is left to the guard, and so is what it jumps by, which ``slip`` forgets within SLIP_S.
    """
    ls["unseen"] += t["gap"]
    if t["rx_flags"] & RxFlag.FRESH and abs(t["theta"]) < MOST_ANGLE:
        kept = max(1.0 - ls["unseen"] * p["T_s"] / SLIP_S, 0.0)
        s["slip"] = kept * s["slip"] + locate(lp, ls, t["theta"])
    if s["reason"] == 0 and s["state"] != DriveState.OPERATION_ENABLED:
        ls["origin"] = ls["turned"] - t["theta_ref"]
    ls["theta_ref"] = t["theta_ref"]
    t["theta_turned"] = ls["turned"] - ls["origin"] + ls["unseen"] * p["T_s"] * ls["x"][0]
    t["theta_error"] = t["theta_ref"] - t["theta_turned"]


@jit
def estimate(p: Any, s: Any, lp: Any, ls: Any, t: Any) -> None:
    """Advance the observer by the past periods; a measurement that is not finite is no measurement."""
    if lp["cogs"] and t["rx_flags"] & RxFlag.FRESH:
        ls["theta"] = t["theta"]
    if lp["kind"] == SPEED:
        estimate_speed(p, s, lp, ls, t)
        if lp["k_th"] != 0.0:
            estimate_angle(p, s, lp, ls, t)
        return
    fresh = (t["rx_flags"] & RxFlag.FRESH) != 0
    finite = math.isfinite(t["w"]) and math.isfinite(t["i_q"]) and math.isfinite(t["i_d"])
    observe(lp, ls, t["w"], t["i_q"], t["i_d"], fresh and finite, t["gap"])
    t["ua_q"], t["ua_d"] = ls["ua"][1], ls["ua"][2]
    applied_now(p, s, t)
    apply(ls, s["ua_T"], s["ua_q"], s["ua_d"])


@jit
def note_asked(ls: Any, t: Any) -> None:
    """Write what the law asks for to the tick."""
    t["T_L_law"], t["u_q_law"], t["u_d_law"] = ls["u"][0], ls["u"][1], ls["u"][2]
    t["i_q_ref"], t["i_d_ref"] = ls["i_q_ref"], ls["i_d_ref"]


@jit
def circle(p: Any, s: Any, lp: Any, t: Any) -> float:
    """Radius of the law's circle [V]: the guard's, or v_dc / sqrt 3 where the law follows the DC link."""
    limit = voltage_limit(p, s)
    if lp["kind"] == MTPA and t["v_dc"] >= 0.0:
        limit = min(limit, t["v_dc"] / math.sqrt(3.0))
    return float(limit)


@jit
def control(p: Any, s: Any, lp: Any, ls: Any, t: Any) -> Any:
    """Ask the law for the next command; without feedback that was due hold the last one.

    Returns (u_q, u_d, T_L) in the voltage circle, NaN where the law asks for what is no number, and the flag
    of a law that is at a limit. Version 0 of the rules records what is asked for after the circle, without
    the flag.
    """
    if t["state"] != DriveState.OPERATION_ENABLED:
        t["u_q_law"], t["u_d_law"], t["T_L_law"] = 0.0, 0.0, 0.0
        t["i_q_ref"], t["i_d_ref"] = 0.0, 0.0
        return 0.0, 0.0, 0.0, 0
    known = t["rx_flags"] & RxFlag.FRESH or 0 < ls["gap"] < lp["every"]
    if not (known and ls["started"]):
        t["u_q_law"], t["u_d_law"], t["T_L_law"] = s["u_q"], s["u_d"], s["T_L"]
        t["i_q_ref"], t["i_d_ref"] = ls["i_q_ref"], ls["i_d_ref"]
        return s["u_q"], s["u_d"], s["T_L"], 0
    limit = circle(p, s, lp, t)
    if lp["regen"]:
        ls["v_dc"] = t["v_dc"]
    ask(lp, ls, t["w_ref"], t["dw_ref"], t["i_q_ref_in"], limit)
    note_asked(ls, t)
    s["i_d_ref"] = ls["i_d_ref"]
    number = math.isfinite(ls["u"][1]) and math.isfinite(ls["u"][2])
    saturated = is_saturated(lp, ls, limit)
    to_circle(ls, limit)
    if p["rules"] == 0:
        note_asked(ls, t)
        return ls["u"][1], ls["u"][2], ls["u"][0], 0
    u_q = ls["u"][1] if number else math.nan
    return u_q, ls["u"][2], ls["u"][0], GuardFlag.SATURATED.value if saturated else 0


@jit
def remember(p: Any, s: Any, t: Any) -> None:
    """Number the command and keep it until the drive echoes its number."""
    if t["send"]:
        s["counter"] = (s["counter"] + 1) % p["counter_modulus"]
    t["counter"] = s["counter"]
    s["sent_q"][s["counter"]], s["sent_d"][s["counter"]] = t["u_q"], t["u_d"]
    s["sent_T"][s["counter"]] = t["T_L"]


@jit
def report(p: Any, lp: Any, ls: Any, t: Any) -> None:
    """Write the estimates to the tick; what is known of the load, or told, is part of it."""
    t["d_hat_w"], t["d_hat_q"], t["d_hat_d"] = ls["d_hat"][0], ls["d_hat"][1], ls["d_hat"][2]
    t["T_L_hat"] = -p["J"] * ls["d_hat"][0] + 0.0
    if loaded(lp):
        t["T_L_hat"] += known_load(lp, ls, 0.0)
    if lp["pair"] == LEADS:
        t["T_L_hat"] += ls["load"]
    t["filled"] = ls["filled"]


@jit
def step(sp: Any, ss: Any, lp: Any, ls: Any, ticks: Any) -> None:
    """Run one tick. ``sp, ss``: safety parameters and state; ``lp, ls``: the law's; ``ticks``: one TICK."""
    p, s, q, law, t = sp[0], ss[0], lp[0], ls[0], ticks[0]
    estimate(p, s, q, law, t)
    before = s["state"]
    supervise(p, s, t)
    if t["state"] == DriveState.OPERATION_ENABLED and before != DriveState.OPERATION_ENABLED:
        reset(law)
        if q["kind"] == SPEED:
            observe(q, law, t["w"], 0.0, 0.0, True, t["gap"])
        else:
            observe(q, law, t["w"], t["i_q"], t["i_d"], True, t["gap"])
    u_q, u_d, T_L, saturated = control(p, s, q, law, t)
    reason = guard_command(p, s, t, u_q, u_d, T_L)
    t["guard_flags"] |= saturated
    if reason != Reason.NONE:
        begin_stop(s, reason)
        t["state"], t["reason"] = s["state"], s["reason"]
        t["controlword"] = Controlword.QUICK_STOP.value
        guard_command(p, s, t, 0.0, 0.0, 0.0)
    remember(p, s, t)
    report(p, q, law, t)


@jit
def whole(rp: Any, gp: Any, gs: Any, sp: Any, ss: Any, lp: Any, ls: Any, ticks: Any) -> None:
    """:func:`hil.tick.setpoint.prepare` and :func:`step`: a tick whose reference is not logged yet."""
    prepare(rp, gp, gs, ss, lp, ticks)
    step(sp, ss, lp, ls, ticks)


@jit
def whole_at(places: Any, ticks: Any) -> None:
    """:func:`whole` over the records at ``places``, in the order of :data:`PLACED`."""
    profile, limits = array_at(places, 0, REFERENCE), array_at(places, 1, SETPOINT_PARAMS)
    setpoint = array_at(places, 2, SETPOINT_STATE)
    safety, state = array_at(places, 3, SAFETY_PARAMS), array_at(places, 4, SAFETY_STATE)
    law, law_state = array_at(places, 5, LAW_PARAMS), array_at(places, 6, LAW_STATE)
    whole(profile, limits, setpoint, safety, state, law, law_state, ticks)
