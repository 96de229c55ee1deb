"""The motor: the full dq model (32) of a PMSM, integrated by RK4 at a substep far below the tick.

Amplitude-invariant dq, mechanical speed w; torque accelerates:
    J dw/dt     = 1.5 n_p (psi_f i_q + (L_d - L_q) i_d i_q) - T_L - B_f w
    L_q di_q/dt = u_q - R_s i_q - n_p w (L_d i_d + psi_f)
    L_d di_d/dt = u_d - R_s i_d + n_p w L_q i_q
``phi_w`` [rad/s2] and ``phi_q`` [A/s] are the paper's unknown constants of (33), added to dw and di_q.
"""

from __future__ import annotations

from typing import Any

from firmware_model.jit import jit
from firmware_model.load import load_torque


@jit
def torque(p: Any, i_q: float, i_d: float) -> float:
    """Electromagnetic torque [N m]."""
    return float(1.5 * p["n_p"] * (p["psi_f"] * i_q + (p["L_d"] - p["L_q"]) * i_d * i_q))


@jit
def slopes(
    p: Any, t: float, w: float, i_q: float, i_d: float, u_q: float, u_d: float, T_commanded: float, on: bool
) -> tuple[float, float, float]:
    """(dw/dt, di_q/dt, di_d/dt); with the gates off no current flows and only the shaft moves."""
    load = load_torque(p, t, w) + T_commanded
    dw = (torque(p, i_q, i_d) - load - p["B_f"] * w) / p["J"] + p["phi_w"]
    if not on:
        return dw, 0.0, 0.0
    e = p["n_p"] * w
    di_q = (u_q - p["R_s"] * i_q - e * (p["L_d"] * i_d + p["psi_f"])) / p["L_q"] + p["phi_q"]
    di_d = (u_d - p["R_s"] * i_d + e * p["L_q"] * i_q) / p["L_d"]
    return dw, di_q, di_d


@jit
def rk4(p: Any, x: Any, t: float, h: float, u_q: float, u_d: float, T_commanded: float, on: bool) -> None:
    """One classical Runge-Kutta step of x = (w, i_q, i_d) over h [s], in place."""
    w, q, d = x[0], x[1], x[2]
    g = 0.5 * h
    w1, q1, d1 = slopes(p, t, w, q, d, u_q, u_d, T_commanded, on)
    w2, q2, d2 = slopes(p, t + g, w + g * w1, q + g * q1, d + g * d1, u_q, u_d, T_commanded, on)
    w3, q3, d3 = slopes(p, t + g, w + g * w2, q + g * q2, d + g * d2, u_q, u_d, T_commanded, on)
    w4, q4, d4 = slopes(p, t + h, w + h * w3, q + h * q3, d + h * d3, u_q, u_d, T_commanded, on)
    x[0] = w + h / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
    x[1] = q + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)
    x[2] = d + h / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
