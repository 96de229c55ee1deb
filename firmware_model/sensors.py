"""Sensors: seeded noise, then rounding to the resolution of the wire with saturation.

The generator is a 32-bit PCG-like linear congruential one kept in 63 bits of integer arithmetic that cannot
overflow; a normal number is the sum of 12 uniform ones (no libm), the same to the bit everywhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from firmware_model.jit import jit

MULTIPLIER = 1103515245
INCREMENT = 12345
MASK = 0x7FFFFFFF
DRAWS = 12
"""Uniform numbers in a normal one."""


def _leaps() -> Any:
    """(a, c) of x <- a x + c mod 2^31 for 1 to DRAWS steps at once, (2, DRAWS)."""
    steps = [(MULTIPLIER, INCREMENT)]
    for a, c in (steps[-1] for _ in range(DRAWS - 1)):
        steps.append((a * MULTIPLIER & MASK, (c * MULTIPLIER + INCREMENT) & MASK))
    return np.array(steps, np.int64).T.copy()


LEAPS = _leaps()


@jit
def shuffled(x: int) -> int:
    """A state of the generator with its low bits mixed with its high ones."""
    x = x ^ (x >> 15)
    x = (x * 0x2C1B3C6D) & MASK
    return x ^ (x >> 12)


@jit
def uniform(s: Any) -> float:
    """Next number in [0, 1); advances s['random'] (x <- a x + c mod 2^31, shuffled by its own high bits)."""
    x = (int(s["random"]) * MULTIPLIER + INCREMENT) & MASK
    s["random"] = x
    return float(shuffled(x)) / 2147483648.0


@jit
def normal(s: Any) -> float:
    """Approximately standard normal: sum of 12 of :func:`uniform` minus 6 (Irwin-Hall).

    Each leaps to its number from the first state, so that none waits for the one before. Whole numbers add
    up exactly, as the uniform ones do.
    """
    start, x, total = int(s["random"]), 0, 0
    for j in range(DRAWS):
        x = (start * LEAPS[0, j] + LEAPS[1, j]) & MASK
        total += shuffled(x)
    s["random"] = x
    return float(total) / 2147483648.0 - 6.0


@jit
def to_wire(value: float, lsb: float, top: float) -> float:
    """Round to the wire's resolution and saturate at +-top; + 0.0 since the wire has no negative zero.

    It is the raw number that saturates: raw * lsb is then what a receiver decodes, to the bit.
    """
    raw_top = np.rint(top / lsb)
    return float(min(max(np.rint(value / lsb), -raw_top), raw_top) * lsb + 0.0)


@jit
def to_angle(theta: float, lsb: float, counts: float) -> float:
    """An angle rounded to the wire's resolution, within a turn or on a signed counter of so many numbers.

    NaN where it is not reported.
    """
    if lsb <= 0.0:
        return math.nan
    if counts > 0.0:
        raw = np.rint(theta / lsb)
        return float((raw - counts * math.floor((raw + 0.5 * counts) / counts)) * lsb)
    turn = 2.0 * math.pi
    return float(np.rint((theta - math.floor(theta / turn) * turn) / lsb) * lsb)


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
