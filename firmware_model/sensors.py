"""Sensors: seeded noise, then rounding to the resolution of the wire with saturation.

The generator is a 32-bit PCG-like linear congruential one kept in 63 bits of integer arithmetic that cannot
overflow; a normal number is the sum of 12 uniform ones (no libm), the same to the bit everywhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_model.jit import jit

MULTIPLIER = 1103515245
INCREMENT = 12345
MASK = 0x7FFFFFFF


@jit
def uniform(s: Any) -> float:
    """Next number in [0, 1); advances s['random'] (x <- a x + c mod 2^31, shuffled by its own high bits)."""
    x = (int(s["random"]) * MULTIPLIER + INCREMENT) & MASK
    s["random"] = x
    x = x ^ (x >> 15)
    x = (x * 0x2C1B3C6D) & MASK
    x = x ^ (x >> 12)
    return float(x) / 2147483648.0


@jit
def normal(s: Any) -> float:
    """Approximately standard normal: sum of 12 uniforms minus 6 (Irwin-Hall)."""
    total = 0.0
    for _ in range(12):
        total += uniform(s)
    return total - 6.0


@jit
def to_wire(value: float, lsb: float, top: float) -> float:
    """Round to the wire's resolution and saturate at +-top; + 0.0 since the wire has no negative zero.

    It is the raw number that saturates: raw * lsb is then what a receiver decodes, to the bit.
    """
    raw_top = np.rint(top / lsb)
    return float(min(max(np.rint(value / lsb), -raw_top), raw_top) * lsb + 0.0)


@jit
def whole_degrees(temperature: float) -> float:
    """Temperature on the wire: whole degrees from -40 to 215 degC."""
    return float(min(max(np.rint(temperature), -40.0), 215.0) + 0.0)


@jit
def measure(s: Any, value: float, noise: float, lsb: float, top: float) -> float:
    """One reading: noise of that standard deviation, then the wire."""
    if noise > 0.0:
        value += noise * normal(s)
    return to_wire(value, lsb, top)
