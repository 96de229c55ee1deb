"""What loads share that are there from ``at_s`` until ``until_s`` [plant time]."""

from __future__ import annotations

import math
from typing import Any, TypeVar

from firmware_model.jit import jit

Windowed = TypeVar("Windowed")


def in_order(table: Windowed) -> Windowed:
    """The table. Raises ValueError for one that ends before it begins."""
    at_s, until_s = table.at_s, table.until_s  # type: ignore[attr-defined] # a validator of such a table
    if until_s is not None and until_s <= at_s:
        raise ValueError(f"until_s = {until_s} is not after at_s = {at_s}")
    return table


@jit
def inside(load: Any, t: float) -> bool:
    """True from ``at_s`` on, before ``until_s``."""
    return bool(load["at_s"] <= t < load["until_s"])


@jit
def window_edge(load: Any, t_ns: int) -> float:
    """Time [ns] of the next of both ends, infinite if there is none."""
    nearest = math.inf
    for edge in (load["at_s"] * 1e9, load["until_s"] * 1e9):
        if t_ns + 0.5 < edge < nearest:
            nearest = edge
    return float(nearest)
