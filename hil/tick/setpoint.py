"""The reference of a tick: the config's profile, a live set-point instead of it, and the ramp before a stop.

All three end in ``w_ref``, ``dw_ref`` and ``i_q_ref_in``, which are inputs of the tick and logged, so that a
replay needs none of this. Time counts in periods (``gap``), so that skipped ones stretch neither profile nor
ramp.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.control.jit import jit
from hil.control.law import FAC
from hil.control.references import reference_at, turned_at
from hil.control.speed import FOLLOWS, LEADS
from hil.signals import DriveState, Request

SETPOINT_PARAMS: Final = np.dtype(
    [
        ("T_s", "f8"),
        ("stop_rate", "f8"),
        ("stop_ticks", "i8"),
        ("settle_ticks", "i8"),
        ("w_still", "f8"),
        ("w_min", "f8"),
        ("w_max", "f8"),
        ("w_rate", "f8"),
        ("i_q_max", "f8"),
        ("i_q_rate", "f8"),
    ],
    align=True,
)
"""Ramp of a stop [rad/s2], its longest time and that to come to rest [ticks], speed at rest [rad/s]; range
and rate of live set-points [rad/s, rad/s2, A, A/s]. ``stop_ticks`` 0: a stop is a stop at once."""

SETPOINT_STATE: Final = np.dtype(
    [
        ("w", "f8"),
        ("i_q", "f8"),
        ("live_w", "i8"),
        ("live_i_q", "i8"),
        ("w_target", "f8"),
        ("i_q_target", "f8"),
        ("ramping", "i8"),
        ("ticks", "i8"),
        ("at_zero", "i8"),
        ("w_from", "f8"),
        ("i_q_from", "f8"),
        ("theta", "f8"),
        ("theta_base", "f8"),
        ("own", "i8"),
        ("skipped", "i8"),
    ],
    align=True,
)
"""Newest references; live targets and whether there are any; of the ramp: ticks since its begin and since the
reference is 0, and the references that it began with; the reference angle, what it is ahead of the profile's
own, and whether the profile gave it; periods skipped in operation."""

Record = npt.NDArray[np.void]


@jit
def stepped(value: float, target: float, most: float) -> float:
    """``value`` moved towards ``target`` by ``most`` at most."""
    return min(max(target, value - most), value + most)


@jit
def follow(p: Any, g: Any, w: float, dw: float, i_q: float, gap: int) -> tuple[float, float, float]:
    """The profile's (w*, dw*/dt, i_q*), or what a live set-point has made of them, at its rate."""
    if g["live_w"]:
        w = stepped(g["w"], g["w_target"], p["w_rate"] * p["T_s"] * gap)
        left = g["w_target"] - w
        dw = 0.0 if left == 0.0 else (p["w_rate"] if left > 0.0 else -p["w_rate"])
    if g["live_i_q"]:
        i_q = stepped(g["i_q"], g["i_q_target"], p["i_q_rate"] * p["T_s"] * gap)
    return w, dw, i_q


@jit
def begin_ramp(g: Any, w: float, i_q: float, measured: float) -> None:
    """Ramp down from where the drive is, so that a stop never accelerates it: w* clipped to [0, w]."""
    g["ramping"], g["ticks"], g["at_zero"] = 1, 0, 0
    g["w_from"], g["i_q_from"] = w, i_q
    if math.isfinite(measured):
        g["w_from"] = min(w, max(measured, 0.0)) if w >= 0.0 else max(w, min(measured, 0.0))


@jit
def ramped(p: Any, g: Any) -> tuple[float, float, float]:
    """(w*, dw*/dt, i_q*) on the ramp: |w*| = max(|w_from| - rate t, 0); i_q* shrinks with it."""
    start = abs(g["w_from"])
    size = start - p["stop_rate"] * p["T_s"] * g["ticks"]
    if size <= 0.0:
        return 0.0, 0.0, 0.0
    sign = 1.0 if g["w_from"] > 0.0 else -1.0
    return sign * size, -sign * p["stop_rate"], g["i_q_from"] * size / start


@jit
def ramp_over(p: Any, g: Any, w_ref: float, measured: float, gap: int) -> bool:
    """True once the drive rests, has had its time to come to rest, or the ramp's time is over."""
    g["at_zero"] = g["at_zero"] + gap if w_ref == 0.0 else 0
    rests = w_ref == 0.0 and abs(measured) <= p["w_still"]
    return bool(rests or g["at_zero"] > p["settle_ticks"] or g["ticks"] >= p["stop_ticks"])


@jit
def turned(rp: Any, p: Any, g: Any, time: float, w: float, gap: int) -> float:
    """theta* [rad], the integral of w*: the profile's in closed form, elsewhere trapezoids of ``gap`` ticks.

    The profile's goes on from where the other left it, so theta* never jumps.
    """
    profile, own = not (g["ramping"] or g["live_w"]), turned_at(rp, time)
    if not (profile and g["own"]):
        g["theta_base"] = g["theta"] + 0.5 * p["T_s"] * gap * (g["w"] + w) - own
    g["own"] = int(profile)
    g["theta"] = g["theta_base"] + own
    return float(g["theta"])


@jit
def prepare(rp: Any, gp: Any, gs: Any, ss: Any, lp: Any, ticks: Any) -> None:
    """Write the reference of this tick; the profile's time begins when operation is enabled.

    A stop that is asked for in operation becomes RAMP_DOWN until the ramp is over. ``rp``: the profile; ``gp,
    gs``: parameters and state of this module; ``ss, lp``: the supervisor's state, the law's parameters.
    """
    t, s, p, g, profile, law = ticks[0], ss[0], gp[0], gs[0], rp[0], lp[0]
    if s["run_ticks"] == 0:
        g["skipped"] = 0
    elif s["state"] == DriveState.OPERATION_ENABLED:
        g["skipped"] += t["gap"] - 1
    time = (s["run_ticks"] + g["skipped"]) * law["T_s"]
    w_ref, dw_ref = reference_at(profile, time)
    pair = law["pair"]
    i_q = profile["i_q"] if law["kind"] == FAC or pair == LEADS else 0.0
    w_ref, dw_ref, i_q = follow(p, g, w_ref, dw_ref, i_q, t["gap"])
    orderly = t["request"] == Request.STOP and s["state"] == DriveState.OPERATION_ENABLED
    if g["ramping"]:
        g["ticks"] += t["gap"]
    elif orderly and p["stop_ticks"] > 0:
        begin_ramp(g, w_ref, i_q, t["w"])
    if g["ramping"]:
        w_ref, dw_ref, i_q = ramped(p, g)
        over = ramp_over(p, g, w_ref, t["w"], t["gap"])
        if orderly and not over:
            t["request"] = Request.RAMP_DOWN.value
    if law["k_th"] != 0.0:
        t["theta_ref"] = turned(profile, p, g, time, w_ref, t["gap"])
    g["w"], g["i_q"] = w_ref, i_q
    t["w_ref"], t["dw_ref"] = w_ref, dw_ref
    if pair != FOLLOWS:  # else another node's law has written it
        t["i_q_ref_in"] = i_q


def no_setpoint() -> Record:
    """No ramp and no live set-point, as for a controller whose references are logged."""
    return np.zeros(1, SETPOINT_PARAMS)


def new_setpoint_state() -> Record:
    """The profile's reference, no stop."""
    return np.zeros(1, SETPOINT_STATE)
