"""T = T_1 sin(2 pi f t + phase)."""

from __future__ import annotations

import math
from typing import Any, Literal

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.tables import Finite, Positive, Table


class SineLoad(Table):
    """A sinusoidal torque."""

    kind: Literal["sine"]
    torque_n_m: Finite
    """Amplitude."""
    frequency_hz: Positive
    """Frequency."""
    phase_rad: Finite = 0.0
    """Phase at plant time 0."""


@jit
def torque(load: Any, t: float, w: float) -> float:
    """The sine at t."""
    return float(load["torque_n_m"] * math.sin(2.0 * math.pi * load["frequency_hz"] * t + load["phase_rad"]))


@jit
def coefficient(load: Any, T: Any, w: Any, t: float, k: int) -> float:
    """Coefficient k of a sin(angle + rate t): a rate^k / k! sin(angle + k pi / 2)."""
    rate = 2.0 * math.pi * load["frequency_hz"]
    angle = rate * t + load["phase_rad"]
    scale = load["torque_n_m"] if k % 4 < 2 else -load["torque_n_m"]
    for j in range(1, k + 1):
        scale *= rate / j
    return float(scale * (math.sin(angle) if k % 2 == 0 else math.cos(angle)))


MEMBER = Load(SineLoad, torque, coefficient)
