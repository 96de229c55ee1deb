"""A brake: adds to the dry friction of the shaft (:mod:`firmware_model.friction`) while it is closed."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import model_validator

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.tables import NonNegative, Positive, Table
from firmware_model.window import in_order, inside, window_edge


class BrakeLoad(Table):
    """A brake: dry friction from one time until another; it holds the shaft and never drives it."""

    kind: Literal["brake"]
    torque_n_m: NonNegative
    """Torque of the brake while it slides; it holds up to this."""
    at_s: NonNegative = 0.0
    """When it closes [plant time]."""
    until_s: Positive | None = None
    """When it opens; left out: never."""

    @model_validator(mode="after")
    def _in_order(self) -> BrakeLoad:
        return in_order(self)


@jit
def level(load: Any, t: float) -> float:
    """T while it is closed."""
    return float(load["torque_n_m"]) if inside(load, t) else 0.0


MEMBER = Load(BrakeLoad, level=level, edge=window_edge)
