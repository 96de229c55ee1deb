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
from firmware_model.series import product


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


@jit
def edge_after(p: Any, t_ns: int) -> float:
    """Time [ns] of the next edge of a step or brake, infinite if there is none: no series must cross it."""
    nearest = math.inf
    for j in range(MAX_LOADS):
        if p["load_kind"][j] == LoadKind.STEP or p["load_kind"][j] == LoadKind.BRAKE:
            for edge in (p["load_b"][j] * 1e9, p["load_c"][j] * 1e9):
                if t_ns + 0.5 < edge < nearest:
                    nearest = edge
    return float(nearest)


@jit
def sine_coefficient(a: float, rate: float, angle: float, k: int) -> float:
    """Coefficient k of a sin(angle + rate t): a rate^k / k! sin(angle + k pi / 2)."""
    scale = a if k % 4 < 2 else -a
    for j in range(1, k + 1):
        scale *= rate / j
    return scale * (math.sin(angle) if k % 2 == 0 else math.cos(angle))


@jit
def coupler_coefficient(T: Any, w: Any, a: float, b: float, c: float, k: int) -> float:
    """Coefficient k of T = 2 a s / (1 + s^2), s = (w - c) / b, from T (1 + s^2) = 2 a s.

    T_0 .. T_{k-1} are known: sum_j over 1..k of (1 + s^2)_j T_{k-j} goes to the right side.
    """
    s_0 = (w[0] - c) / b
    total = 2.0 * a * (s_0 if k == 0 else w[k] / b)
    for j in range(1, k + 1):
        square = product(w, w, j) / (b * b) - 2.0 * c * w[j] / (b * b)
        total -= square * T[k - j]
    return float(total / (1.0 + s_0 * s_0))


@jit
def load_coefficient(p: Any, series: Any, j: int, t: float, k: int) -> float:
    """Taylor coefficient k of the varying load j about t [s]; rows of ``series``: w, i_q, i_d, loads.

    The drag of a fan keeps the sign of w(t).
    """
    kind, a, b, c = p["load_kind"][j], p["load_a"][j], p["load_b"][j], p["load_c"][j]
    w = series[0]
    if kind == LoadKind.SINE:
        rate = 2.0 * math.pi * b
        return sine_coefficient(a, rate, rate * t + c, k)
    if kind == LoadKind.FAN:
        return float(a * product(w, w, k) if w[0] >= 0.0 else -a * product(w, w, k))
    return coupler_coefficient(series[3 + j], w, a, b, c, k)
