"""A torque that is always there."""

from __future__ import annotations

from typing import Any, Literal

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.tables import Finite, Table


class ConstantLoad(Table):
    """A constant torque."""

    kind: Literal["constant"]
    torque_n_m: Finite
    """Torque, positive against positive speed."""


@jit
def torque(load: Any, t: float, w: float) -> float:
    """T."""
    return float(load["torque_n_m"])


MEMBER = Load(ConstantLoad, torque)
