"""A substep of a shaft that rubs or of a drive whose DC link moves: the series, cut where something changes.

Sliding ends where w reaches 0, which is found on the series; there the shaft sticks when what drives it stays
within T_s, else it slides on. Sticking ends where the drive exceeds T_s, found on the series of that torque.
So friction is exact at standstill: w is 0, not small.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.coupling import coupling_torque
from firmware_model.friction import dry_above, level
from firmware_model.jit import jit
from firmware_model.link import advance_held_link, advance_link
from firmware_model.load import held_load, load_torque, turned_load
from firmware_model.motor import arrive, plain_series, rubbed_series, series
from firmware_model.plant import ANGLE, DRIVE, LOAD_SPEED, POWER, SLIDE, TWIST
from firmware_model.saturation import flux_of
from firmware_model.series import ORDER, evaluate, first_crossing, integral, stays_clear, within

W_ERROR = 1e-10
"""Last term of the series of w [rad/s] that a step may have."""
BREAKS = 1.0 - 1e-12
"""Share of T_s at which the shaft breaks away: where a series was cut there, rounding may be short of it."""
PIECES = 1000
"""Pieces that one substep may have; beyond, it takes what is left in one."""


@jit
def drive_torque(p: Any, s: Any, t: float) -> float:
    """Torque on the shaft without friction [N m], at t [s]."""
    x, c = s["x"], s["series"]
    electric = 1.5 * p["n_p"] * (p["psi_f"] + (p["L_d"] - p["L_q"]) * x[2]) * x[1]
    if p["L_q_saturation"] > 0.0:
        electric += 1.5 * p["n_p"] * p["L_q"] * (x[1] - flux_of(p, x[1])) * x[2]
    if p["J_load"] > 0.0:
        load = coupling_torque(p, c[TWIST, 0], x[0] - c[LOAD_SPEED, 0]) + turned_load(p, c[ANGLE, 0])
    else:
        load = load_torque(p, t, x[0], c[ANGLE, 0]) + s["T_commanded"]
    return float(electric - p["B_f"] * x[0] - load + p["J"] * p["phi_w"])


@jit
def friction_torque(p: Any, s: Any, t: float) -> float:
    """Torque of friction and brakes [N m], positive against positive speed; what holds it at 0."""
    if not p["rubs"]:
        return 0.0
    w, coulomb, extra = s["x"][0], level(p, t), p["static"] - p["coulomb"]
    if w == 0.0:
        most = coulomb + extra
        return float(min(max(drive_torque(p, s, t), -most), most))
    size = coulomb  # to the bit
    if abs(w) <= dry_above(p, coulomb):
        size += extra * math.exp(-abs(w) / p["stribeck"])
    return float(size if w > 0.0 else -size)


@jit
def slide(p: Any, s: Any, t: float, h: float, most: float, on: bool) -> None:
    """Compute the series for the way that the shaft slides, or for a shaft that sticks."""
    w, c = s["x"][0], s["series"]
    way = c[SLIDE, 0] = 0.0 if w == 0.0 else (1.0 if w > 0.0 else -1.0)
    far = dry_above(p, level(p, t + 0.5 * h))
    c[SLIDE, 1] = 0.0 if way * w > far else 1.0
    series(p, s["x"], c, t, h, s["u_q"], s["u_d"], s["T_commanded"], on)
    if not p["rubs"]:
        return
    if c[SLIDE, 1] == 0.0 and not stays_clear(c[0], way * far, within(c[0], h, W_ERROR)):
        c[SLIDE, 1] = 1.0
        series(p, s["x"], c, t, h, s["u_q"], s["u_d"], s["T_commanded"], on)
    if w == 0.0 and abs(c[DRIVE, 0]) >= most * BREAKS:
        c[SLIDE, 0] = 1.0 if c[DRIVE, 0] > 0.0 else -1.0
        series(p, s["x"], c, t, h, s["u_q"], s["u_d"], s["T_commanded"], on)


@jit
def piece(w: Any, drive: Any, way: float, most: float, left: float) -> float:
    """How far the series holds: to its accuracy, to where w reaches 0, or to where the drive exceeds T_s."""
    if way == 0.0:
        return min(left, first_crossing(drive, most, left), first_crossing(drive, -most, left))
    step = within(w, left, W_ERROR)
    return min(step, first_crossing(w, 0.0, step))


@jit
def slid(p: Any, s: Any, T_held: float, T_coulomb: float, most: float, on: bool) -> Any:
    """:func:`slide` near rest, without loads that vary: w, i_q, i_d, what drives, and the way it slides."""
    w = s["x"][0]
    way = 0.0 if w == 0.0 else (1.0 if w > 0.0 else -1.0)
    while True:
        T, friction = T_held + way * T_coulomb, (way, -way / p["stribeck"])
        a, q, d, drive = rubbed_series(p, s["x"], T, s["u_q"], s["u_d"], on, friction)
        if way != 0.0 or not abs(drive[0]) >= most * BREAKS:
            return a, q, d, drive, way
        way = 1.0 if drive[0] > 0.0 else -1.0


@jit
def power_of(u_q: float, u_d: float, q: Any, d: Any, on: bool) -> Any:
    """Coefficients of the motor's power, as a tuple."""
    if not on:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return (
        1.5 * (u_q * q[0] + u_d * d[0]),
        1.5 * (u_q * q[1] + u_d * d[1]),
        1.5 * (u_q * q[2] + u_d * d[2]),
        1.5 * (u_q * q[3] + u_d * d[3]),
        1.5 * (u_q * q[4] + u_d * d[4]),
        1.5 * (u_q * q[5] + u_d * d[5]),
        1.5 * (u_q * q[6] + u_d * d[6]),
        1.5 * (u_q * q[7] + u_d * d[7]),
        1.5 * (u_q * q[8] + u_d * d[8]),
    )


@jit
def rub_held(p: Any, s: Any, t: float, h: float, on: bool) -> None:
    """:func:`rub` without loads that vary: as tuples, as :func:`firmware_model.motor.plain_series` is.

    A shaft that is free, or so fast that friction is T_c to the bit, has the series of one under a load.
    """
    x, left = s["x"], h
    T_held, T_coulomb = held_load(p, t + 0.5 * h) + s["T_commanded"], level(p, t + 0.5 * h)
    most, far = T_coulomb + p["static"] - p["coulomb"], dry_above(p, T_coulomb)
    for n in range(PIECES):
        way, step, done = (1.0 if x[0] > 0.0 else -1.0), left, False
        if not p["rubs"] or way * x[0] > far:
            w, q, d = plain_series(p, x, T_held + way * T_coulomb, s["u_q"], s["u_d"], on)
            if p["rubs"]:
                step = within(w, left, W_ERROR)
            done = not p["rubs"] or stays_clear(w, way * far, step)
        if not done:
            w, q, d, drive, way = slid(p, s, T_held, T_coulomb, most, on)
            step = piece(w, drive, way, most, left)
        if n == PIECES - 1:
            step = left
        x[0], x[1], x[2] = evaluate(w, step), evaluate(q, step), evaluate(d, step)
        if p["rubs"] and way * x[0] <= 0.0:
            x[0] = 0.0
        if p["turns"]:
            s["series"][ANGLE, 0] += integral(w, step)
        if p["capacitance"] > 0.0:
            advance_held_link(p, s, s["series"], power_of(s["u_q"], s["u_d"], q, d, on), step)
        left -= step
        if left <= 0.0:
            return


@jit
def rub(p: Any, s: Any, t: float, h: float, on: bool) -> None:
    """Advance motor and DC link from t [s] by h [s]."""
    if not p["varying"]:
        rub_held(p, s, t, h, on)
        return
    x, c, left = s["x"], s["series"], h
    most = level(p, t + 0.5 * h) + p["static"] - p["coulomb"]
    for n in range(PIECES):
        slide(p, s, t, left, most, on)
        step = left
        if p["rubs"] and n < PIECES - 1:
            c[DRIVE, ORDER] = 0.0
            step = piece(c[0], c[DRIVE], c[SLIDE, 0], most, left)
        for k in range(ORDER + 1):
            c[POWER, k] = 1.5 * (s["u_q"] * c[1, k] + s["u_d"] * c[2, k]) if on else 0.0
        arrive(p, x, c, step)
        if p["rubs"] and c[SLIDE, 0] * x[0] <= 0.0:
            x[0] = 0.0
        if p["capacitance"] > 0.0:
            advance_link(p, s, c, step)
        t, left = t + step, left - step
        if left <= 0.0:
            return
