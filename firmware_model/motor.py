"""The motor: the full dq model (32) of a PMSM, advanced by its own Taylor series.

Amplitude-invariant dq, mechanical speed w; torque accelerates:
    J dw/dt     = 1.5 n_p (psi_f i_q + (L_d - L_q) i_d i_q) - T_L - B_f w
    L_q di_q/dt = u_q - R_s i_q - n_p w (L_d i_d + psi_f)
    L_d di_d/dt = u_d - R_s i_d + n_p w L_q i_q
``phi_w`` [rad/s2] and ``phi_q`` [A/s] are the paper's unknown constants of (33), added to dw and di_q.

Between two commands the voltage is constant and the right side is quadratic, so the coefficients of
x(t + h) = sum_k x_k h^k follow from one another: (k + 1) x_{k+1} = f_k(x_0 .. x_k), a product becoming
(ab)_k = sum_j a_j b_{k-j} (E. Hairer, S. P. Norsett, G. Wanner, "Solving Ordinary Differential Equations I",
section I.8). A substep h leaves a relative error of about (r h)^9 / 9!, r = n_p |w| + R_s / L.
"""

from __future__ import annotations

from typing import Any

from firmware_model.coupling import far_end, twisted
from firmware_model.friction import exponential, level, stribeck, stribeck_coefficient
from firmware_model.jit import jit
from firmware_model.load import held_load, varying_load
from firmware_model.plant import ANGLE, DRIVE, SLIDE
from firmware_model.saturation import begin_flux, bend, current_of
from firmware_model.series import ORDER, evaluate, inner, integral, product


@jit
def constants(p: Any) -> Any:
    """What :func:`slopes` multiplies by, of dw/dt, di_q/dt and di_d/dt; 1/J, 1/L_q and 1/L_d last."""
    n_p, L_d, L_q, k_t = p["n_p"], p["L_d"], p["L_q"], 1.5 * p["n_p"] * p["psi_f"]
    J, q, d = 1.0 / p["J"], 1.0 / L_q, 1.0 / L_d
    of_w = k_t * J, 1.5 * n_p * (L_d - L_q) * J, p["B_f"] * J
    of_q = p["R_s"] * q, n_p * p["psi_f"] * q, n_p * L_d * q
    return *of_w, *of_q, p["R_s"] * d, n_p * L_q * d, J, q, d


@jit
def slopes(m: Any, w: Any, q: Any, d: Any, k: int) -> tuple[float, float, float]:
    """Coefficient k of dw/dt, di_q/dt, di_d/dt as far as they follow from w, i_q and i_d.

    What is of order k is linear in the newest coefficients, with slopes that all orders share.
    """
    torque, reluctance, drag, fall_q, emf, cross_q, fall_d, cross_d = m[:8]
    dw = torque * q[k] - drag * w[k]
    if reluctance != 0.0:
        dw += reluctance * product(q, d, k)
    if k == 0:
        dq = -fall_q * q[0] - (emf + cross_q * d[0]) * w[0]
        return dw, dq, cross_d * w[0] * q[0] - fall_d * d[0]
    old_q, old_d = -cross_q * inner(w, d, k), cross_d * inner(w, q, k)
    dq = (old_q - fall_q * q[k]) - ((emf + cross_q * d[0]) * w[k] + (cross_q * w[0]) * d[k])
    dd = (old_d - fall_d * d[k]) + ((cross_d * w[0]) * q[k] + (cross_d * q[0]) * w[k])
    return dw, dq, dd


@jit
def held(p: Any, m: Any, T_held: float, u_q: float, u_d: float) -> tuple[float, float, float]:
    """What is added to dw/dt, di_q/dt, di_d/dt and constant over a step: load, voltage, phi."""
    inverse_J, inverse_q, inverse_d = m[-3], m[-2], m[-1]
    return p["phi_w"] - T_held * inverse_J, p["phi_q"] + u_q * inverse_q, u_d * inverse_d


@jit
def series(
    p: Any, x: Any, c: Any, t: float, h: float, u_q: float, u_d: float, T_commanded: float, on: bool
) -> None:
    """Coefficients of w, i_q, i_d [unit / s^k] about t [s] in rows 0 to 2 of ``c``, for a step of h [s].

    With the gates off no current flows and only the shaft moves. With friction the shaft slides the way that
    row SLIDE says, with or without Stribeck's part, or sticks; what drives it then goes to row DRIVE. A soft
    coupling has its own two rows.
    """
    m = constants(p)
    inverse_J = m[-3]
    w, q, d = c[0], c[1], c[2]
    w[0], q[0], d[0] = x[0], x[1], x[2]
    soft, T_held = p["J_load"] > 0.0, held_load(p, t + 0.5 * h) + T_commanded
    slide, T_coulomb = (c[SLIDE, 0], level(p, t + 0.5 * h)) if p["rubs"] else (1.0, 0.0)
    added = held(p, m, (0.0 if soft else T_held) + slide * T_coulomb, u_q, u_d)
    saturates = p["L_q_saturation"] > 0.0
    if saturates:
        begin_flux(p, c)
    for k in range(ORDER):
        share = 1.0 / (k + 1)
        dw, dq, dd = slopes(m, w, q, d, k)
        if saturates:
            bent_w, bent_d = bend(p, m, c, k)
            dw, dd = dw + bent_w, dd + bent_d
        if p["varying"]:
            T_L, T_angle = varying_load(p, c, t, k)
            if soft:
                behind = T_L - T_angle + (T_held if k == 0 else 0.0)
                T_L = T_angle + twisted(p, c, behind, k)
            dw -= T_L * inverse_J
        if k == 0:
            dw, dq, dd = dw + added[0], dq + added[1], dd + added[2]
        if slide == 0.0:
            c[DRIVE, k], dw = dw / inverse_J, 0.0
        elif p["rubs"] and c[SLIDE, 1] != 0.0:
            dw -= stribeck_coefficient(p, c, slide, k)
        w[k + 1] = dw * share
        q[k + 1], d[k + 1] = (dq * share, dd * share) if on else (0.0, 0.0)
        if saturates:
            q[k + 1] = current_of(p, c, q[k + 1], k + 1)


@jit
def longer(m: Any, added: Any, on: bool, w: Any, q: Any, d: Any) -> Any:
    """The series w, i_q, i_d, here tuples, with one coefficient more."""
    k = len(w) - 1
    dw, dq, dd = slopes(m, w, q, d, k)
    if k == 0:
        dw, dq, dd = dw + added[0], dq + added[1], dd + added[2]
    share = 1.0 / (k + 1)
    dq, dd = (dq * share, dd * share) if on else (0.0, 0.0)
    return (*w, dw * share), (*q, dq), (*d, dd)


@jit
def plain_series(p: Any, x: Any, T_held: float, u_q: float, u_d: float, on: bool) -> Any:
    """:func:`series` without friction and loads that vary, as tuples, whose length the compiler knows.

    So each sum is unrolled and the coefficients stay in registers: three quarters of the time.
    """
    m = constants(p)
    added = held(p, m, T_held, u_q, u_d)
    w, q, d = longer(m, added, on, (x[0],), (x[1],), (x[2],))
    w, q, d = longer(m, added, on, w, q, d)
    w, q, d = longer(m, added, on, w, q, d)
    w, q, d = longer(m, added, on, w, q, d)
    w, q, d = longer(m, added, on, w, q, d)
    w, q, d = longer(m, added, on, w, q, d)
    w, q, d = longer(m, added, on, w, q, d)
    return longer(m, added, on, w, q, d)


@jit
def rubbed(m: Any, added: Any, friction: Any, on: bool, w: Any, q: Any, d: Any, e: Any) -> Any:
    """:func:`longer` for a shaft with ``friction``: (way that it slides or 0, -way / w_s).

    So does ``e``, what Stribeck's part takes from dw/dt; last comes coefficient k of what drives a shaft that
    sticks.
    """
    k, inverse_J = len(w) - 1, m[-3]
    slide, rate = friction
    dw, dq, dd = slopes(m, w, q, d, k)
    if k == 0:
        dw, dq, dd = dw + added[0], dq + added[1], dd + added[2]
    drive = 0.0
    if slide == 0.0:
        drive, dw = dw / inverse_J, 0.0
    else:
        dw -= e[k]
    share = 1.0 / (k + 1)
    dq, dd = (dq * share, dd * share) if on else (0.0, 0.0)
    w = (*w, dw * share)
    return w, (*q, dq), (*d, dd), (*e, exponential(rate, w, e, k + 1)), drive


@jit
def rubbed_series(p: Any, x: Any, T_held: float, u_q: float, u_d: float, on: bool, friction: Any) -> Any:
    """:func:`series` with friction and without loads that vary, as tuples: w, i_q, i_d and what drives.

    ``T_held`` has Coulomb's part of it.
    """
    m = constants(p)
    added = held(p, m, T_held, u_q, u_d)
    e = (stribeck(p, friction[0], x[0]),)
    w, q, d, e, drive_0 = rubbed(m, added, friction, on, (x[0],), (x[1],), (x[2],), e)
    w, q, d, e, drive_1 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_2 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_3 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_4 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_5 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_6 = rubbed(m, added, friction, on, w, q, d, e)
    w, q, d, e, drive_7 = rubbed(m, added, friction, on, w, q, d, e)
    return w, q, d, (drive_0, drive_1, drive_2, drive_3, drive_4, drive_5, drive_6, drive_7, 0.0)


@jit
def arrive(p: Any, x: Any, c: Any, h: float) -> None:
    """The states at the end of h [s], from the series in ``c``: x, the angle, what a coupling has."""
    for i in range(3):
        x[i] = evaluate(c[i], h)
    if p["turns"]:
        c[ANGLE, 0] += integral(c[0], h)
    far_end(p, c, h)


@jit
def move(
    p: Any, x: Any, c: Any, t: float, h: float, u_q: float, u_d: float, T_commanded: float, on: bool
) -> None:
    """Advance x = (w, i_q, i_d) by h [s] in place; ``c`` is room for the coefficients."""
    if p["varying"]:
        series(p, x, c, t, h, u_q, u_d, T_commanded, on)
        arrive(p, x, c, h)
        return
    w, q, d = plain_series(p, x, held_load(p, t + 0.5 * h) + T_commanded, u_q, u_d, on)
    x[0], x[1], x[2] = evaluate(w, h), evaluate(q, h), evaluate(d, h)
    if p["turns"]:
        c[ANGLE, 0] += integral(w, h)
