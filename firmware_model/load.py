"""Load torque on the shaft [N m], positive against positive speed: the sum of what the registry's loads give.

Each kernel here chooses the load's own by the code in its record (:func:`firmware_model.plant.code_of`). The
caller adds the commanded load machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from firmware_model.jit import inlined, jit
from firmware_model.plant import ANGLE, LOAD_SPEED, QUADRATURE, code_of
from firmware_model.registry import Kernel, Load, loads


@inlined
def _none(load: Any, *more: Any) -> float:
    """A load that has no such kernel."""
    return 0.0


@inlined
def _never(load: Any, *more: Any) -> float:
    """A load without an edge."""
    return math.inf


def _branch(code: int, kernel: Kernel, rest: Kernel) -> Kernel:
    """``kernel`` for the loads of that code, else ``rest``."""

    @inlined
    def chosen(load: Any, *more: Any) -> float:
        if load["kind"] == code:
            return kernel(load, *more)
        return rest(load, *more)

    return chosen


def _chosen(kernel_of: Callable[[Load], Kernel | None], otherwise: Kernel) -> Kernel:
    """One kernel for all loads: that of the load at hand."""
    for member in loads().values():
        if (kernel := kernel_of(member)) is not None:
            otherwise = _branch(code_of(member.kind), kernel, otherwise)
    return otherwise


torque_of = _chosen(lambda member: member.torque, _none)
"""``(load, t, w)``: the torque of any load but dry friction."""
held_torque_of = _chosen(lambda member: None if member.coefficient else member.torque, _none)
"""The same of the loads that are constant between their edges."""
coefficient_of = _chosen(lambda member: member.coefficient, _none)
"""``(load, T, w, t, k)``: Taylor coefficient of a load that varies."""
turned_of = _chosen(lambda member: member.turned, _none)
"""``(load, theta)``: torque of a load that goes by the shaft's angle."""
angular_of = _chosen(lambda member: member.angular, _none)
"""``(load, T, Q, theta, k)``: its Taylor coefficient."""
level_of = _chosen(lambda member: member.level, _none)
"""``(load, t)``: dry friction."""
edge_of = _chosen(lambda member: member.edge, _never)
"""``(load, t_ns)``: next edge [ns]."""


@jit
def load_torque(p: Any, t: float, w: float, theta: float = 0.0) -> float:
    """Sum of all loads at plant time t [s], which begins with the first SYNC, and shaft angle theta [rad]."""
    total = 0.0
    for j in range(p["loads"]):
        total += torque_of(p["load"][j], t, w) + turned_of(p["load"][j], theta)
    return total


@jit
def turned_load(p: Any, theta: float) -> float:
    """The part of it that goes by the shaft's angle."""
    total = 0.0
    for j in range(p["loads"]):
        total += turned_of(p["load"][j], theta)
    return total


@jit
def held_load(p: Any, t: float) -> float:
    """Sum of the loads that are constant over the substep about its middle t [s]."""
    total = 0.0
    for j in range(p["loads"]):
        total += held_torque_of(p["load"][j], t, 0.0)
    return total


@jit
def varying_load(p: Any, c: Any, t: float, k: int) -> tuple[float, float]:
    """Coefficient k of the sum of the loads that vary, and the part of it that goes by the shaft's angle.

    Each load's own goes to its row of ``c``: w, i_q, i_d, loads. Behind a soft coupling they have its speed.
    """
    total, by_angle = 0.0, 0.0
    turning = LOAD_SPEED if p["J_load"] > 0.0 else 0
    if p["turns"] and k > 0:
        c[ANGLE, k] = c[0, k - 1] / k
    for j in range(p["loads"]):
        c[3 + j, k] = coefficient_of(p["load"][j], c[3 + j], c[turning], t, k)
        angular = angular_of(p["load"][j], c[3 + j], c[QUADRATURE + j], c[ANGLE], k)
        c[3 + j, k] += angular
        total += c[3 + j, k]
        by_angle += angular
    return total, by_angle


@jit
def edge_after(p: Any, t_ns: int) -> float:
    """Time [ns] of the next edge of any load, infinite if there is none: no series must cross it."""
    nearest = math.inf
    for j in range(p["loads"]):
        nearest = min(nearest, edge_of(p["load"][j], t_ns))
    return float(nearest)
