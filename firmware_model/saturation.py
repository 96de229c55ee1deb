"""Saturation of the q axis: a flux linkage psi_q that grows slower than the current.

    i_q = phi + phi^3 / phi_s^2,  phi = psi_q / L_q,  phi_s = L_q_saturation / 2
so L_q is the inductance of small currents and psi_q / i_q has fallen to half of it at L_q_saturation [A]; 0
is none. phi has the slope that i_q has without saturation, and stands for i_q wherever the flux does: in the
torque and in the back-EMF of the d axis. Current over flux is a polynomial (the form of Z. Qu, M. Ranta,
M. Hinkkanen, J. Luomi, "Loss-Minimizing Flux Level Control", 2012, eq. 7, with its exponent 2), so the
Taylor coefficients follow from one another as the motor's do.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import EXCESS, FLUX, SQUARE
from firmware_model.series import product


@jit
def flux_of(p: Any, i_q: float) -> float:
    """phi [A]: the real root of the cubic, in closed form and once by Newton, to rounding."""
    if p["L_q_saturation"] == 0.0:
        return float(i_q)
    phi_s = 0.5 * p["L_q_saturation"]
    y = i_q / phi_s
    r = 2.0 / math.sqrt(3.0) * math.sinh(math.asinh(1.5 * math.sqrt(3.0) * y) / 3.0)
    return float(phi_s * (r - (r + r * r * r - y) / (1.0 + 3.0 * r * r)))


@jit
def begin_flux(p: Any, c: Any) -> None:
    """Coefficients 0 of phi, phi^2 and of i_q - phi, from that of i_q."""
    c[FLUX, 0] = flux_of(p, c[1, 0])
    c[SQUARE, 0] = c[FLUX, 0] * c[FLUX, 0]
    c[EXCESS, 0] = c[1, 0] - c[FLUX, 0]


@jit
def bend(p: Any, m: Any, c: Any, k: int) -> tuple[float, float]:
    """What saturation adds to coefficient k of dw/dt and di_d/dt."""
    reach, inverse_J, inverse_d = p["n_p"] * p["L_q"], m[-3], m[-1]
    torque, emf = product(c[EXCESS], c[2], k), product(c[0], c[EXCESS], k)
    return 1.5 * reach * torque * inverse_J, -reach * emf * inverse_d


@jit
def current_of(p: Any, c: Any, flux: float, k: int) -> float:
    """Coefficient k of i_q, from that of phi."""
    share = 4.0 / (p["L_q_saturation"] * p["L_q_saturation"])
    c[FLUX, k] = flux
    c[SQUARE, k] = product(c[FLUX], c[FLUX], k)
    c[EXCESS, k] = share * product(c[SQUARE], c[FLUX], k)
    return float(flux + c[EXCESS, k])
