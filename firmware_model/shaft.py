"""Two motors on one rigid shaft, as on a dyno bench: torques, inertias and friction B_f add, w is one.

Both drives keep their own firmware, currents and loads; the shaft is advanced by one Taylor series of the
joint right side (:mod:`firmware_model.motor`), of which both torques are part coefficient by coefficient:
    (J_1 + J_2) dw/dt = T_1 + T_2 - T_L1 - T_L2 - (B_1 + B_2) w
A positive torque of either accelerates: a load machine that brakes a positive speed is commanded a negative
one. Dry friction, an open phase and a DC link that moves are left to a shaft of one motor.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from firmware_model.config import PlantConfig, Record
from firmware_model.current import regulate
from firmware_model.drive import heat, protect, watch
from firmware_model.jit import array_at, entry, jit, places_of
from firmware_model.load import edge_after, held_load, varying_load
from firmware_model.motor import constants, held, slopes
from firmware_model.plant import ANGLE, PARAMS, STATE, State
from firmware_model.registry import PlantError
from firmware_model.series import ORDER, evaluate, integral
from firmware_model.speedfilter import track

_ARRAYS = {"p": PARAMS, "s": STATE, "q": PARAMS, "r": STATE}


def refuse_uncoupled(plants: dict[str, PlantConfig]) -> None:
    """Raise PlantError for what only a shaft of one motor can have."""
    for name, plant in plants.items():
        has = {
            "coupling": plant.coupling is not None,
            "friction": plant.friction.most_n_m > 0.0,
            "motor.L_q_saturation_a": plant.motor.L_q_saturation_a is not None,
            "a load that only holds (brake)": any(load.kind == "brake" for load in plant.load),
            "inverter.capacitance_f": bool(plant.inverter.capacitance_f),
            "fault: phase-loss": any(fault.kind == "phase-loss" for fault in plant.fault),
            'pacing = "cyclic"': plant.pacing != "sync",
        }
        for what in (what for what, there in has.items() if there):
            raise PlantError(f"plant of {name}: {what}: not on a shaft of two motors; remove it")


def couple(p: Record, q: Record) -> None:
    """Give both records the inertia of the whole shaft, in place."""
    p["J"] = q["J"] = p["J"] + q["J"]


class Shaft:
    """``advance(dt_ns)`` moves both drives' records on together, in place."""

    def __init__(self, p: Record, s: Record, q: Record, r: Record) -> None:
        self._alive = {"p": p, "s": s, "q": q, "r": r}
        trial = self._alive | {"s": s.copy(), "r": r.copy()}
        places = places_of(self._alive, _ARRAYS)
        self.advance: Any = partial(entry(advance_at, places_of(trial, _ARRAYS), 0), places)


@jit
def advance_at(places: Any, dt_ns: int) -> None:
    """:func:`advance_both`."""
    p, s = array_at(places, 0, PARAMS)[0], array_at(places, 1, STATE)[0]
    advance_both(p, s, array_at(places, 2, PARAMS)[0], array_at(places, 3, STATE)[0], dt_ns)


@jit
def share(p: Any, s: Any, m: Any, t: float, k: int, on: bool) -> Any:
    """Coefficients k of one motor's part of dw/dt, of di_q/dt and of di_d/dt about t [s]."""
    c = s["series"]
    dw, dq, dd = slopes(m, c[0], c[1], c[2], k)
    if p["varying"]:
        dw -= varying_load(p, c, t, k)[0] * m[-3]
    return (dw, dq, dd) if on else (dw, 0.0, 0.0)


@jit
def begin(p: Any, s: Any, m: Any, t: float, on: bool) -> Any:
    """Coefficients 0, and what is added to the slopes over the step."""
    for i in range(3):
        s["series"][i, 0] = s["x"][i]
    w, q, d = held(p, m, held_load(p, t) + s["T_commanded"], s["u_q"], s["u_d"])
    return (w, q, d) if on else (w, 0.0, 0.0)


@jit
def turn(p: Any, s: Any, q: Any, r: Any, t: float, h: float) -> None:
    """Advance w and both motors' currents by h [s] from t [s], in place."""
    on_p, on_q = s["state"] == State.OPERATION_ENABLED, r["state"] == State.OPERATION_ENABLED
    m, n = constants(p), constants(q)
    a, b = begin(p, s, m, t + 0.5 * h, on_p), begin(q, r, n, t + 0.5 * h, on_q)
    c, e = s["series"], r["series"]
    for k in range(ORDER):
        one, other = share(p, s, m, t, k, on_p), share(q, r, n, t, k, on_q)
        first = 1.0 if k == 0 else 0.0
        part = 1.0 / (k + 1)
        c[0, k + 1] = e[0, k + 1] = (one[0] + other[0] + first * (a[0] + b[0])) * part
        c[1, k + 1], c[2, k + 1] = (one[1] + first * a[1]) * part, (one[2] + first * a[2]) * part
        e[1, k + 1], e[2, k + 1] = (other[1] + first * b[1]) * part, (other[2] + first * b[2]) * part
    for i in range(3):
        s["x"][i], r["x"][i] = evaluate(c[i], h), evaluate(e[i], h)
    if p["turns"]:
        c[ANGLE, 0] += integral(c[0], h)
    if q["turns"]:
        e[ANGLE, 0] += integral(e[0], h)


@jit
def limited(p: Any, s: Any, step: int) -> int:
    """``step`` [ns], at most up to the drive's next sample of current or speed; that of now is taken."""
    step = min(step, p["substep_ns"])
    if p["takes"] > 0:
        step = min(step, p["current_ns"] - s["t_ns"] % p["current_ns"])
        if s["state"] == State.OPERATION_ENABLED and s["t_ns"] % p["current_ns"] == 0:
            regulate(p, s)
    if p["slot_ns"] > 0:
        step = min(step, p["slot_ns"] - s["t_ns"] % p["slot_ns"])
    return int(step)


@jit
def look(p: Any, s: Any, before: float, step: int) -> None:
    """What a drive does after a step: filter, protection, heat, watchdog."""
    h = step * 1e-9
    s["t_ns"] += step
    if p["filter"] > 0:
        track(p, s, before, s["x"][0], h)
    protect(p, s)
    heat(p, s, h)
    watch(p, s)


@jit
def advance_both(p: Any, s: Any, q: Any, r: Any, dt_ns: int) -> None:
    """Move both on by dt_ns, in steps that end at the edges and samples of either."""
    left = dt_ns
    while left > 0:
        step = limited(q, r, limited(p, s, left))
        t_ns = s["t_ns"]
        edge = min(edge_after(p, t_ns), edge_after(q, t_ns))
        if edge < t_ns + step:
            step = max(int(edge + 0.5) - t_ns, 1)
        before = s["x"][0]
        turn(p, s, q, r, t_ns * 1e-9, step * 1e-9)
        look(p, s, before, step)
        look(q, r, before, step)
        r["x"][0] = s["x"][0]
        left -= step
