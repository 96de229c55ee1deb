"""Dry friction of the shaft by Coulomb and Stribeck, with sticking: its torque and its Taylor coefficients.

    T = sgn(w) (T_c + (T_s - T_c) e^{-|w| / w_s}) for w != 0;  |T| <= T_s at w = 0, where it holds the shaft
(B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and compensation
methods for the control of machines with friction", Automatica 30(7), 1994). Brakes add to T_c and to T_s.
"""

from __future__ import annotations

import math
from typing import Any, Final

from firmware_model.jit import jit
from firmware_model.load import level_of
from firmware_model.plant import STRIBECK

FAR: Final = 38.0
"""Speed over w_s at which the exponential is e^-38 = 3.14e-17."""
LOST: Final = 1.75
"""Largest (T_s - T_c) / T_c for which that is lost: 1.75 e^-38 < 2^-54, and half an ulp of T_c is more."""


@jit
def dry_above(p: Any, coulomb: float) -> float:
    """Speed [rad/s] above which friction is T_c to the bit, here ``coulomb``; infinite if there is none."""
    extra = p["static"] - p["coulomb"]
    if extra == 0.0:
        return 0.0
    return float(FAR * p["stribeck"]) if extra <= LOST * coulomb else math.inf


@jit
def level(p: Any, t: float) -> float:
    """T_c with the brakes that are on at t [s]."""
    total = p["coulomb"]
    for j in range(p["loads"]):
        total += level_of(p["load"][j], t)
    return float(total)


@jit
def stribeck(p: Any, way: float, w: float) -> float:
    """What (T_s - T_c) e^{-|w| / w_s} takes from dw/dt of a shaft that slides that way; 0 where it sticks."""
    extra = p["static"] - p["coulomb"]
    if way * extra == 0.0:
        return 0.0
    return float(way * extra / p["J"] * math.exp(-way * w / p["stribeck"]))


@jit
def stribeck_coefficient(p: Any, c: Any, way: float, k: int) -> float:
    """Coefficient k of :func:`stribeck`, which goes to row STRIBECK, too."""
    e = c[STRIBECK]
    e[k] = stribeck(p, way, c[0, 0]) if k == 0 else exponential(-way / p["stribeck"], c[0], e, k)
    return float(e[k])


@jit
def exponential(rate: float, w: Any, e: Any, k: int) -> float:
    """Coefficient k > 0 of e = e_0 e^{rate (w - w_0)}: k e_k = rate sum_{j=1..k} j w_j e_{k-j}."""
    total = 0.0
    for j in range(2, k):
        total += j * w[j] * e[k - j]
    if k > 1:
        total += w[1] * e[k - 1]
    return float(total * (rate * (1.0 / k)) + w[k] * (rate * e[0]))
