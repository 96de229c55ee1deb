"""Truncated power series as arrays of coefficients: product and value."""

from __future__ import annotations

from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import ORDER


@jit
def product(a: Any, b: Any, k: int) -> float:
    """Coefficient k of a b: sum_j a_j b_{k-j}."""
    total = 0.0
    for j in range(k + 1):
        total += a[j] * b[k - j]
    return total


@jit
def products(a: Any, b: Any, c: Any, k: int) -> tuple[float, float, float]:
    """Coefficients k of a b, a c and b c, in one pass."""
    ab, ac, bc = 0.0, 0.0, 0.0
    for j in range(k + 1):
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
