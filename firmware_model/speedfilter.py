"""What the drive does to the speed before it reports it: a first-order lag, a PLL by its poles, a mean.

Closed forms over a substep, in which the shaft's speed runs straight from w_0 to w_1, m = (w_1 - w_0) / h.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import Filter


@jit
def track(p: Any, s: Any, before: float, w: float, h: float) -> None:
    """Move the filter on by h [s], over which the shaft went from ``before`` to w [rad/s]."""
    if p["filter"] == Filter.MEAN:
        s["angle"] += 0.5 * (before + w) * h
        if s["t_ns"] % p["slot_ns"] == 0:
            turn(p, s)
    elif p["filter"] == Filter.PLL:
        two_poles(p, s, before, w, h)
    else:
        lag = (w - before) / h / p["pole_1"]
        s["seen_w"] = w - lag + (s["seen_w"] - before + lag) * math.exp(-p["pole_1"] * h)


@jit
def two_poles(p: Any, s: Any, before: float, w: float, h: float) -> None:
    """y'' + (p + q) y' + p q y = p q w: y - w + m (p + q) / (p q) = e and y' - m = e' die away by p <= q.

    e(h) = e^{-p h} (e + c f),  e'(h) = -p e(h) + c e^{-q h},
    c = e' + p e,  f = (1 - e^{-(q - p) h}) / (q - p)
    """
    low, high, slope = p["pole_1"], p["pole_2"], (w - before) / h
    lag = slope * (low + high) / (low * high)
    e = s["seen_w"] - before + lag
    c = s["seen_rate"] - slope + low * e
    f = h if high == low else -math.expm1((low - high) * h) / (high - low)
    e = math.exp(-low * h) * (e + c * f)
    s["seen_w"] = w - lag + e
    s["seen_rate"] = slope - low * e + c * math.exp(-high * h)


@jit
def turn(p: Any, s: Any) -> None:
    """The mean over the window: the angle turned since the sample that is as old as it."""
    slots = p["slots"]
    s["seen_w"] = (s["angle"] - s["angles"][s["slot"]]) / (slots * p["slot_ns"] * 1e-9)
    s["angles"][s["slot"]] = s["angle"]
    s["slot"] = (s["slot"] + 1) % slots
