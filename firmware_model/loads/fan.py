"""T = k w |w|, as a fan or a pump takes it."""

from __future__ import annotations

from typing import Any, Literal

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.series import product
from firmware_model.tables import Positive, Table


class FanLoad(Table):
    """T = k w |w|."""

    kind: Literal["fan"]
    k_n_m_s2: Positive
    """Coefficient k of w |w|."""


@jit
def torque(load: Any, t: float, w: float) -> float:
    """The drag at w."""
    return float(load["k_n_m_s2"] * w * abs(w))


@jit
def coefficient(load: Any, T: Any, w: Any, t: float, k: int) -> float:
    """Coefficient k of +-k w^2: the drag keeps the sign of w(t)."""
    drag = load["k_n_m_s2"]
    return float(drag * product(w, w, k) if w[0] >= 0.0 else -drag * product(w, w, k))


MEMBER = Load(FanLoad, torque, coefficient)
