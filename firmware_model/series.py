"""Truncated power series as arrays or tuples of coefficients: product and value.

A sum begins with its first term and not with 0: the same but for the sign of a zero, and an addition sooner.
"""

from __future__ import annotations

import math
from typing import Any, Final

from firmware_model.jit import jit

ORDER: Final = 8
"""Order of the motor's Taylor series."""


@jit
def product(a: Any, b: Any, k: int) -> float:
    """Coefficient k of a b: sum_j a_j b_{k-j}."""
    total = a[0] * b[k]
    for j in range(1, k + 1):
        total += a[j] * b[k - j]
    return float(total)


@jit
def products(a: Any, b: Any, c: Any, k: int) -> tuple[float, float, float]:
    """Coefficients k of a b, a c and b c, in one pass."""
    ab, ac, bc = a[0] * b[k], a[0] * c[k], b[0] * c[k]
    for j in range(1, k + 1):
        ab += a[j] * b[k - j]
        ac += a[j] * c[k - j]
        bc += b[j] * c[k - j]
    return ab, ac, bc


@jit
def evaluate(a: Any, h: float) -> float:
    """sum_k a_k h^k up to ORDER, by Horner's rule."""
    value = a[ORDER]
    for k in range(ORDER - 1, -1, -1):
        value = value * h + a[k]
    return float(value)


@jit
def integral(a: Any, h: float) -> float:
    """sum_k a_k h^{k+1} / (k + 1), the integral of the series from 0 to h."""
    value = a[ORDER] / (ORDER + 1)
    for k in range(ORDER - 1, -1, -1):
        value = value * h + a[k] / (k + 1)
    return float(value * h)


LOOKS = 8
"""Places at which a series is looked at for a change of sign."""


@jit
def within(a: Any, h: float, error: float) -> float:
    """Largest step up to h whose last term |a_ORDER| h^ORDER is below ``error`` (A. Jorba, M. Zou, 2005)."""
    last = abs(a[ORDER])
    if last * h**ORDER <= error:
        return h
    return float(max((error / last) ** (1.0 / ORDER), 1e-3 * h))


@jit
def stays_clear(a: Any, value: float, h: float) -> bool:
    """True when |a_0 - value| > sum_{k>0} |a_k| h^k, with room for rounding: no time in [0, h] crosses."""
    reach = abs(a[ORDER])
    for k in range(ORDER - 1, 0, -1):
        reach = reach * h + abs(a[k])
    return bool(abs(a[0] - value) > 1.001 * reach * h + 1e-12 * (abs(a[0]) + abs(value)))


@jit
def first_crossing(a: Any, value: float, h: float) -> float:
    """First time in (0, h] at which the series has passed ``value``, to rounding; infinite if it does not.

    What begins at ``value`` has passed it once it is on the other side of where it first went.
    """
    if stays_clear(a, value, h):
        return math.inf
    side, before = a[0] - value, 0.0
    for n in range(1, LOOKS + 1):
        now = h * n / LOOKS
        here = evaluate(a, now) - value
        if side == 0.0:
            side = here
        if (side > 0.0 and here < 0.0) or (side < 0.0 and here > 0.0):
            return bisected(a, value, before, now, side > 0.0)
        before = now
    return math.inf


@jit
def bisected(a: Any, value: float, low: float, high: float, above: bool) -> float:
    """The crossing between ``low``, before it, and ``high``, after it."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (evaluate(a, middle) > value) == above:
            low = middle
        else:
            high = middle
    return high


@jit
def shifted(a: Any, h: float) -> None:
    """The series about h instead of 0, in place: repeated synthetic division."""
    for i in range(ORDER):
        for k in range(ORDER - 1, i - 1, -1):
            a[k] += h * a[k + 1]
