"""A torque that comes and goes at its times, met to the nanosecond."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import model_validator

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.tables import Finite, Since, Table
from firmware_model.window import in_order, inside, window_edge


class StepLoad(Table):
    """A torque from one time until another."""

    kind: Literal["step"]
    torque_n_m: Finite
    """Torque, positive against positive speed."""
    at_s: Since
    """When it comes [plant time]."""
    until_s: Since | None = None
    """When it goes; left out: never."""

    @model_validator(mode="after")
    def _in_order(self) -> StepLoad:
        return in_order(self)


@jit
def torque(load: Any, t: float, w: float) -> float:
    """T while it is there."""
    return float(load["torque_n_m"]) if inside(load, t) else 0.0


MEMBER = Load(StepLoad, torque, edge=window_edge)
