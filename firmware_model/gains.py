"""Gains of the drive's own current loop (:mod:`firmware_model.current`), from its bandwidth."""

from __future__ import annotations

import math


def gains(R_s: float, L: float, bandwidth: float, T: float) -> tuple[float, float]:
    """(k [V/A], 1 - a) of one axis."""
    reset = -math.expm1(-R_s * T / L)
    return -math.expm1(-bandwidth * T) * R_s / reset, reset
