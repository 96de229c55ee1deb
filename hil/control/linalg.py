"""Small matrices and the exponential as explicit loops: the order of every addition is fixed, no BLAS.

A design must have the same bits on every processor. BLAS, numpy's vector loops and the C library's ``exp``
choose their code, and with it the rounding, by the processor; sums and products of IEEE 754 do not.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.control.jit import jit

Array = npt.NDArray[np.floating[Any]]
Index = npt.NDArray[np.int64]
TERMS: Final = 16
"""Terms of the exponential's series: 0.5^17 / 17! = 2e-20."""
DOUBLINGS: Final = 60
"""Steps of :func:`riccati`: 2^60 ticks."""
BITS: Final = 160
"""Of the scalar exponential, and 1.5 for each unit of |x|: e^-|x| begins 1.44 |x| places below the point."""


@jit
def matvec_add(m: Array, x: Array, out: Array) -> None:
    """Add m x to out; m (r, c), x (c,), out (r,)."""
    for i in range(m.shape[0]):
        total = 0.0
        for j in range(m.shape[1]):
            total += m[i, j] * x[j]
        out[i] += total


@jit
def matvec(m: Array, x: Array, out: Array) -> None:
    """out = m x; out must not be x."""
    for i in range(m.shape[0]):
        total = 0.0
        for j in range(m.shape[1]):
            total += m[i, j] * x[j]
        out[i] = total


@jit
def copy(source: Array, out: Array) -> None:
    """out = source, vectors of one length."""
    for i in range(source.shape[0]):
        out[i] = source[i]


def exp(x: float) -> float:
    """e^x, rounded once: the series of x / 2^s in whole numbers, squared s times.

    inf and 0 where it overflows and underflows.
    """
    x = float(x)
    if not -750.0 < x < 709.78:
        return 0.0 if x < 0.0 else x * math.inf
    top, bottom = x.as_integer_ratio()
    halvings, bits = max(0, math.frexp(x)[1] + 4), BITS + int(1.5 * abs(x))
    small = (top << bits) // (bottom << halvings)
    total, term, k = 0, 1 << bits, 0
    while term not in (0, -1):
        total, k = total + term, k + 1
        term = (term * small >> bits) // k
    for _ in range(halvings):
        total = total * total >> bits
    return total / (1 << bits)


def cos_sin(x: float) -> tuple[float, float]:
    """cos x and sin x of a finite x, rounded once: the series of e^{i x / 2^s} as in :func:`exp`."""
    top, bottom = float(x).as_integer_ratio()
    halvings = max(0, math.frexp(x)[1] + 4)
    bits = BITS + 2 * halvings
    small = (top << bits) // (bottom << halvings)
    parts, term, k = [0, 0], 1 << bits, 0  # (real, imaginary); i^k goes round with k
    while term not in (0, -1):
        parts[k % 2] += -term if k % 4 >= 2 else term
        k += 1
        term = (term * small >> bits) // k
    re, im = parts
    for _ in range(halvings):
        re, im = re * re - im * im >> bits, re * im >> bits - 1
    return re / (1 << bits), im / (1 << bits)


def dot(a: Array, b: Array) -> float:
    """Sum of products of two vectors, each product rounded, then their sum."""
    return math.fsum((a * b).tolist())


def power(x: float, n: int) -> float:
    """x^n for a whole n >= 0, rounded once."""
    top, bottom = float(x).as_integer_ratio()
    return float(top ** int(n) / bottom ** int(n))


@jit
def product(a: Array, b: Array) -> Array:
    """a b; a (r, m), b (m, c)."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(b.shape[1]):
            total = 0.0
            for j in range(a.shape[1]):
                total += a[i, j] * b[j, k]
            out[i, k] = total
    return out


@jit
def solve(a: Array, b: Array) -> Array:
    """a^-1 b by Gauss and Jordan with row pivots; b (n, m); a (n, n) is regular, as the caller made sure."""
    n, m = b.shape
    left, right = a.copy(), b.copy()
    for c in range(n):
        best = c
        for i in range(c + 1, n):
            if abs(left[i, c]) > abs(left[best, c]):
                best = i
        for j in range(n):
            left[c, j], left[best, j] = left[best, j], left[c, j]
        for j in range(m):
            right[c, j], right[best, j] = right[best, j], right[c, j]
        pivot = left[c, c]
        for j in range(n):
            left[c, j] = left[c, j] / pivot
        for j in range(m):
            right[c, j] = right[c, j] / pivot
        for i in range(n):
            factor = left[i, c]
            if i != c and factor != 0.0:
                for j in range(n):
                    left[i, j] -= factor * left[c, j]
                for j in range(m):
                    right[i, j] -= factor * right[c, j]
    return right


@jit
def inverse(a: Array) -> Array:
    """a^-1; the caller has made sure that a (n, n) is regular."""
    return solve(a, np.eye(a.shape[0]))


@jit
def integral_exponential(A: Array, T: float, halvings: int) -> tuple[Array, Array]:
    """e^{A T} and E(T) = int_0^T e^{A s} ds, from h = T / 2^halvings with |A h| below a half.

    E(h) = h (I + A h / 2 (I + A h / 3 (I + ...))), e^{A h} = I + A E(h), then E(2h) = E(h) + e^{A h} E(h)
    and e^{2 A h} = (e^{A h})^2 (N. J. Higham, "Functions of Matrices", SIAM 2008, sections 10.3 and 10.7).
    """
    n, h = A.shape[0], math.ldexp(T, -halvings)
    step: Array = A * h
    E: Array = np.eye(n)
    for k in range(TERMS, 1, -1):
        E = np.eye(n) + product(step, E) / k
    E = E * h
    exponential: Array = np.eye(n) + product(A, E)
    for _ in range(halvings):
        E = E + product(exponential, E)
        exponential = product(exponential, exponential)
    return exponential, E


def halvings_of(A: Array, T: float) -> int:
    """How often T is halved until the largest row sum of |A| T / 2^s is below a half."""
    norm = max((math.fsum(abs(float(x)) for x in row) for row in A), default=0.0) * T
    return max(0, math.frexp(norm)[1] + 1) if math.isfinite(norm) else 1100


def condition(a: Array) -> float:
    """|a| |a^-1| in the norm of row sums; nan or inf for a (n, n) that is singular."""
    with np.errstate(divide="ignore", invalid="ignore"):  # compiled code divides by 0 without a word
        both = [math.fsum(abs(float(x)) for x in row) for m in (a, inverse(a)) for row in m]
    return max(both[: len(a)]) * max(both[len(a) :])


def riccati(A: Array, G: Array, Q: Array) -> Array:
    """P (n, n) of P = A' P (I + G P)^-1 A + Q, G = B R^-1 B', by doubling; not finite where there is none.

    W = I + G P;  A <- A W^-1 A,  G <- G + A W^-1 G A',  P <- P + A' P W^-1 A, from P = Q: quadratic
    (E. K. Chu, H. Y. Fan, W. W. Lin, C. S. Wang, Int. J. Control 77, 2004, the doubling algorithm).
    """
    A, G, P = (np.array(m, float, order="C") for m in (A, G, Q))
    eye = np.eye(len(P))
    for _ in range(DOUBLINGS):
        W = eye + product(G, P)
        left, right = solve(W, A), solve(W, G)
        across = np.ascontiguousarray(A.T)
        more = product(across, product(P, left))
        G = G + product(product(A, right), across)
        A = product(A, left)
        P = P + (more + more.T) / 2
        G = (G + G.T) / 2
        if np.abs(more).max() <= 1e-16 * np.abs(P).max():
            return P
    return np.full_like(P, np.nan)
