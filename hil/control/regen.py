"""Regeneration limits: how much braking current a DC link can take, from the balance of powers.

What goes into the motor in steady state, w the electrical speed, f = psi_f + (L_d - L_q) i_d, and the
voltages e_q = -L_q d_hat_q, e_d = -L_d d_hat_d by which the observers correct the model's:

    P = 1.5 (u_d i_d + u_q i_q) = 1.5 (R_s (i_d^2 + i_q^2) + (w f + e_q) i_q + e_d i_d)

P >= -P_max is a quadratic inequality in i_q, the copper loss its square. Braking by less than the smaller
root gives back less; with no root there is no current that gives back too much. Above the larger root the
copper would take it all again, but the way there leads through what must not be: it is not used.
A change of current moves 0.75 (L_q i_q^2 + L_d i_d^2) of magnetic energy besides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from hil.control.jit import jit


@dataclass(frozen=True, slots=True)
class RegenLimit:
    """Power P_max [W] that may go back to the DC link, falling to 0 from v_from to v_end [V] of it."""

    power: float
    v_from: float = math.inf
    v_end: float = math.inf


def regen_params(given: RegenLimit | None, R_s: float) -> dict[str, float]:
    """Parameters of these kernels; none of them without a limit."""
    if given is None:
        return {}
    own = {"regen": 1, "p_regen": given.power, "R_s": R_s}
    if given.v_end == math.inf:
        return own
    return own | {"v_regen": given.v_end, "g_regen": given.power / (given.v_end - given.v_from)}


@jit
def allowed_power(p: Any, v_dc: float) -> float:
    """P_max [W], less where the DC link [V] nears its end; a link that is not known (0, NaN) takes P_max."""
    most = p["p_regen"]
    if p["g_regen"] > 0.0 and v_dc > 0.0:
        most = min(most, p["g_regen"] * max(p["v_regen"] - v_dc, 0.0))
    return float(most)


@jit
def braked(p: Any, s: Any, w: float, i_d: float, i_q: float) -> float:
    """i_q [A], or the smaller one that gives back P_max at i_d and w; ``capped`` says which.

    With g = w f + e_q, c = R_s i_d^2 + e_d i_d + P_max / 1.5:  R_s i^2 - |g| i + c >= 0 for braking by i,
        i <= 2 c / (|g| + (g^2 - 4 R_s c)^1/2)
    """
    on, R_s = float(p["coupling"]), p["R_s"]
    psi_f = p["k_t"] / (1.5 * p["n_p"])
    g = w * (psi_f + (p["L_d"] - p["L_q"]) * i_d) - on * p["L_q"] * s["d_hat"][1]
    c = R_s * i_d * i_d - on * p["L_d"] * s["d_hat"][2] * i_d + allowed_power(p, s["v_dc"]) / 1.5
    c = max(c, 0.0)
    inside = g * g - 4.0 * R_s * c
    if g * i_q >= 0.0 or inside <= 0.0:
        return i_q
    most = 2.0 * c / (abs(g) + math.sqrt(inside))
    if abs(i_q) <= most:
        return i_q
    s["capped"] = 1
    return float(most if i_q > 0.0 else -most)
