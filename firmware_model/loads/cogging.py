"""T = T_1 sin(n theta + phase): a harmonic of the torque over the shaft's angle."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field

from firmware_model.jit import jit
from firmware_model.registry import Load
from firmware_model.tables import Finite, Table


class CoggingLoad(Table):
    """A torque that is periodic over the shaft's angle, as cogging: one harmonic; several add up."""

    kind: Literal["cogging"]
    torque_n_m: Finite
    """Amplitude."""
    order: Annotated[int, Field(ge=1, le=1000)]
    """Periods in a turn of the shaft."""
    phase_rad: Finite = 0.0
    """Phase at angle 0."""


@jit
def turned(load: Any, theta: float) -> float:
    """The torque at the angle theta."""
    return float(load["torque_n_m"] * math.sin(load["order"] * theta + load["phase_rad"]))


@jit
def angular(load: Any, T: Any, Q: Any, theta: Any, k: int) -> float:
    """Coefficient k of T = a sin(n theta(t)); Q = a cos: k T_k = sum_j j n theta_j Q_{k-j}, Q with -T."""
    n = load["order"]
    if k == 0:
        Q[0] = load["torque_n_m"] * math.cos(n * theta[0] + load["phase_rad"])
        return float(load["torque_n_m"] * math.sin(n * theta[0] + load["phase_rad"]))
    sine, cosine = 0.0, 0.0
    for j in range(1, k + 1):
        sine += j * theta[j] * Q[k - j]
        cosine -= j * theta[j] * T[k - j]
    Q[k] = n * cosine / k
    return float(n * sine / k)


MEMBER = Load(CoggingLoad, turned=turned, angular=angular)
