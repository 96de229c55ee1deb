"""Load torque on the shaft [N m], positive against positive speed; several loads add up.

The coupler is a permanent-magnet eddy-current coupler: torque over slip speed s has the form
T = T_max 2 (s / s_m) / (1 + (s / s_m)^2) of eddy-current machines, with T_max falling exponentially with the
air gap (:func:`coupler_torque_max`). The commanded load machine is added by the caller.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import MAX_LOADS, LoadKind


def coupler_torque_max(torque_at_zero_gap: float, gap_m: float, decay_length_m: float) -> float:
    """T_max(gap) = T_0 e^{-2 gap / decay}: B falls by e per decay length, T goes with B^2."""
    return torque_at_zero_gap * math.exp(-2.0 * gap_m / decay_length_m)


@jit
def one_load(kind: int, a: float, b: float, c: float, t: float, w: float) -> float:
    """Torque of one load at time t [s] and speed w [rad/s]."""
    if kind == LoadKind.CONSTANT:
        return a
    if kind == LoadKind.STEP:
        return a if b <= t < c else 0.0
    if kind == LoadKind.SINE:
        return a * math.sin(2.0 * math.pi * b * t + c)
    if kind == LoadKind.FAN:
        return a * w * abs(w)
    if kind == LoadKind.COUPLER:
        slip = (w - c) / b
        return a * 2.0 * slip / (1.0 + slip * slip)
    return 0.0


@jit
def load_torque(p: Any, t: float, w: float) -> float:
    """Sum of all loads at plant time t [s], which begins with the first SYNC."""
    total = 0.0
    for j in range(MAX_LOADS):
        kind = p["load_kind"][j]
        if kind == LoadKind.NONE:
            break
        total += one_load(kind, p["load_a"][j], p["load_b"][j], p["load_c"][j], t, w)
    return total
