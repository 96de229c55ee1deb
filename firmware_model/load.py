"""Load torque on the shaft [N m], positive against positive speed; several loads add up.

The coupler is a permanent-magnet eddy-current coupler: torque over slip speed s has the form
T = T_max 2 (s / s_m) / (1 + (s / s_m)^2) of eddy-current brakes (J. H. Wouterse, "Critical torque and speed
of eddy current brake with widely separated soft iron poles", IEE Proc. B 138(4), 1991), with T_max falling
exponentially with the air gap (:func:`coupler_torque_max`). The caller adds the commanded load machine.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import MAX_LOADS, LoadKind


def coupler_torque_max(torque_at_zero_gap: float, gap: float, decay_length: float) -> float:
    """T_max(gap) = T_0 e^{-2 gap / decay}, gap and decay in one unit.

    The field of an array of alternating poles of pitch tau falls as e^{-pi y / tau} (Laplace's equation), so
    the decay length is tau / pi; the torque goes with the square of the field.
    """
    return torque_at_zero_gap * math.exp(-2.0 * gap / decay_length)


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
