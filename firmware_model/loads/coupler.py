"""A permanent-magnet eddy-current coupler between the shaft and a side that turns by itself.

Torque over slip speed s has the form T = T_max 2 (s / s_m) / (1 + (s / s_m)^2) of eddy-current brakes
(J. H. Wouterse, "Critical torque and speed of eddy current brake with widely separated soft iron poles", IEE
Proc. B 138(4), 1991), with T_max falling exponentially with the air gap (:func:`coupler_torque_max`).
"""

from __future__ import annotations

import math
from typing import Any, Literal

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.series import product
from firmware_model.tables import Finite, NonNegative, Positive, Table


class CouplerLoad(Table):
    """Permanent-magnet eddy-current coupler; the air gap sets its torque."""

    kind: Literal["coupler"]
    torque_at_zero_gap_n_m: Positive
    """Largest torque over slip speed, at no air gap."""
    gap_mm: NonNegative
    """Air gap."""
    decay_length_mm: Positive
    """Air gap over which the field falls to 1/e: pole pitch / pi."""
    slip_at_max_rad_s: Positive
    """Slip speed at which the torque is largest."""
    other_side_rad_s: Finite = 0.0
    """Speed of the coupler's other side."""


def coupler_torque_max(torque_at_zero_gap: float, gap: float, decay_length: float) -> float:
    """T_max(gap) = T_0 e^{-2 gap / decay}, gap and decay in one unit.

    The field of an array of alternating poles of pitch tau falls as e^{-pi y / tau} (Laplace's equation), so
    the decay length is tau / pi; the torque goes with the square of the field.
    """
    return torque_at_zero_gap * math.exp(-2.0 * gap / decay_length)


@jit
def torque(load: Any, t: float, w: float) -> float:
    """The torque at slip (w - other side)."""
    slip = (w - load["other_side_rad_s"]) / load["slip_at_max_rad_s"]
    return float(load["torque_max_n_m"] * 2.0 * slip / (1.0 + slip * slip))


@jit
def coefficient(load: Any, T: Any, w: Any, t: float, k: int) -> float:
    """Coefficient k of T = 2 a s / (1 + s^2), s = (w - c) / b, from T (1 + s^2) = 2 a s.

    T_0 .. T_{k-1} are known: sum_j over 1..k of (1 + s^2)_j T_{k-j} goes to the right side.
    """
    a, b, c = load["torque_max_n_m"], load["slip_at_max_rad_s"], load["other_side_rad_s"]
    s_0 = (w[0] - c) / b
    total = 2.0 * a * (s_0 if k == 0 else w[k] / b)
    for j in range(1, k + 1):
        square = product(w, w, j) / (b * b) - 2.0 * c * w[j] / (b * b)
        total -= square * T[k - j]
    return float(total / (1.0 + s_0 * s_0))


def _torque_max(table: Any) -> float:
    return coupler_torque_max(table.torque_at_zero_gap_n_m, table.gap_mm, table.decay_length_mm)


MEMBER = Load(CouplerLoad, torque, coefficient, derived={"torque_max_n_m": _torque_max})
