"""Truncated power series as arrays or tuples of coefficients: product and value.

The coefficients of a differential equation follow from one another, so the processor waits for the newest.
They come last into each sum, whose other terms are added up meanwhile.
"""

from __future__ import annotations

import math
from typing import Any, Final

from firmware_model.jit import jit

ORDER: Final = 8
"""Order of the motor's Taylor series."""


@jit
def inner(a: Any, b: Any, k: int) -> float:
    """sum_{0<j<k} a_j b_{k-j}: coefficient k of a b without those of order k, the middle first."""
    total = a[k // 2] * b[k // 2] if k % 2 == 0 else 0.0
    for j in range((k - 1) // 2, 0, -1):
        total += a[j] * b[k - j] + a[k - j] * b[j]
    return float(total)


@jit
def product(a: Any, b: Any, k: int) -> float:
    """Coefficient k of a b: sum_j a_j b_{k-j}."""
    if k == 0:
        return float(a[0] * b[0])
    return float(inner(a, b, k) + (a[0] * b[k] + a[k] * b[0]))


@jit
def evaluate(a: Any, h: float) -> float:
    """sum_k a_k h^k up to ORDER = 8, by pairs (G. Estrin, 1960): a third of Horner's wait."""
    h_2 = h * h
    h_4 = h_2 * h_2
    low = (a[0] + a[1] * h) + (a[2] + a[3] * h) * h_2
    high = (a[4] + a[5] * h) + (a[6] + a[7] * h) * h_2
    return float(low + (high + a[8] * h_4) * h_4)


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
