"""Normal and logarithmic draws of the same bits on every processor: no libm, LAPACK or BLAS.

The C library's logarithm and exponential choose their code, and the last bit with it, by the processor;
those of :mod:`decimal` are whole numbers' work, rounded right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Context, Decimal
from typing import Final

_DIGITS: Final = Context(prec=40)
_CENTRE, _MIDDLE, _TAIL = (
    (
        (2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4,
         1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0),
        (5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4,
         5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0),
    ),
    (
        (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1,
         1.27045825245236838258e0, 3.64784832476320460504e0, 5.76949722146069140550e0,
         4.63033784615654529590e0, 1.42343711074968357734e0),
        (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2,
         1.48103976427480074590e-1, 6.89767334985100004550e-1, 1.67638483018380384940e0,
         2.05319162663775882187e0, 1.0),
    ),
    (
        (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3,
         2.65321895265761230930e-2, 2.96560571828504891230e-1, 1.78482653991729133580e0,
         5.46378491116411436990e0, 6.65790464350110377720e0),
        (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5,
         7.86869131145613259100e-4, 1.48753612908506148525e-2, 1.36929880922735805310e-1,
         5.99832206555887937690e-1, 1.0),
    ),
)  # fmt: skip
"""Numerators and denominators of AS241."""


def log(x: float) -> float:
    """The natural logarithm of x > 0, rounded once."""
    return float(Decimal(x).ln(_DIGITS))


def between(low: float, high: float, u: float) -> float:
    """low^(1 - u) high^u, rounded once; the share u of the way on a logarithmic scale."""
    first, last = (Decimal(x).ln(_DIGITS) for x in (low, high))
    return float(_DIGITS.exp(_DIGITS.fma(Decimal(u), _DIGITS.subtract(last, first), first)))


def normal(u: float) -> float:
    """The standard normal below which a share u of all lies, to 1e-16 (M. J. Wichura, AS241, 1988)."""
    q = u - 0.5
    if abs(q) <= 0.425:
        return q * _ratio(_CENTRE, 0.180625 - q * q)
    r = math.sqrt(-log(min(u, 1.0 - u)))
    size = _ratio(_MIDDLE, r - 1.6) if r <= 5.0 else _ratio(_TAIL, r - 5.0)
    return math.copysign(size, q)


def _ratio(polynomials: Sequence[Sequence[float]], r: float) -> float:
    """Both polynomials at r by Horner's rule, the highest power first; their ratio."""
    values = []
    for coefficients in polynomials:
        value = 0.0
        for coefficient in coefficients:
            value = value * r + coefficient
        values.append(value)
    return values[0] / values[1]


def root(correlation: Sequence[Sequence[float]]) -> list[list[float]]:
    """The lower triangle L with L L' = correlation, which may be singular. Raises ValueError."""
    n = len(correlation)
    L = [[0.0] * n for _ in range(n)]
    for j in range(n):
        left = [
            correlation[i][j] - math.fsum(L[i][k] * L[j][k] for k in range(j)) for i in range(n)
        ]  # fmt: skip
        pivot = left[j] if left[j] > SINGULAR else 0.0
        if left[j] < -SINGULAR or (not pivot and any(abs(x) > math.sqrt(SINGULAR) for x in left[j + 1 :])):
            raise ValueError("no covariance can be that: a correlation beyond 1, or several that contradict")
        for i in range(j, n):
            L[i][j] = left[i] / math.sqrt(pivot) if pivot else 0.0
    return L


SINGULAR: Final = 1e-9
"""What is left of a variance of 1, given the keys before, that counts as nothing."""
