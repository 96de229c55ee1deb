"""Dry friction of the shaft by Coulomb and Stribeck, with sticking: its torque and its Taylor coefficients.

    T = sgn(w) (T_c + (T_s - T_c) e^{-|w| / w_s}) for w != 0;  |T| <= T_s at w = 0, where it holds the shaft
(B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and compensation
methods for the control of machines with friction", Automatica 30(7), 1994). Brakes add to T_c and to T_s.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.load import level_of
from firmware_model.plant import SLIDE, STRIBECK


@jit
def level(p: Any, t: float) -> float:
    """T_c with the brakes that are on at t [s]."""
    total = p["coulomb"]
    for j in range(p["loads"]):
        total += level_of(p["load"][j], t)
    return float(total)


@jit
def stribeck_coefficient(p: Any, c: Any, k: int) -> float:
    """Coefficient k of (T_s - T_c) e^{-|w| / w_s} while the shaft slides the way of row SLIDE.

    e = e^{g}, g = -|w| / w_s, from e' = g' e: k e_k = sum_{j=1..k} j g_j e_{k-j}.
    """
    extra = p["static"] - p["coulomb"]
    if extra == 0.0 or c[SLIDE, 0] == 0.0:
        return 0.0
    e = c[STRIBECK]
    e[k] = exponential(-c[SLIDE, 0] / p["stribeck"], c[0], e, k)
    return float(extra * e[k])


@jit
def exponential(rate: float, w: Any, e: Any, k: int) -> float:
    """Coefficient k of e^{rate w} from those of w and its own before."""
    if k == 0:
        return math.exp(rate * w[0])
    total = 0.0
    for j in range(1, k + 1):
        total += j * rate * w[j] * e[k - j]
    return total / k
