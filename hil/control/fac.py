"""The fully actuated model x' = A x + B u + d and its exact sampled form for an input held over a tick.

Source: the paper's eq. (1); the sampled form is exact for d constant over a tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.linalg import Array, halvings_of, integral_exponential, inverse, product

MAX_GAP = 64
"""Longest gap in the measurements [ticks] that a gap inverse is kept for."""

SINGULAR = 1e13
"""Condition number above which a matrix counts as singular."""


@dataclass(frozen=True, slots=True)
class SampledModel:
    """Exact sampled form x_{k+1} = Ad x_k + Bd u_k + Ed d_k.

    ``A`` (n, n), ``B`` (n, m), ``T_s`` [s]; ``Ad = e^{A T_s}``, ``Ed = int_0^{T_s} e^{A s} ds``,
    ``Bd = Ed B``; ``gap_inverse[m - 1] = (sum_{j<m} Ad^j Ed)^-1`` for gaps of m ticks, so
    ``gap_inverse[0] = Ed^-1``; it has as many entries as are regular one after another.
    """

    A: Array
    B: Array
    T_s: float
    Ad: Array
    Ed: Array
    Bd: Array
    gap_inverse: Array

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])


def sample(A: Array, B: Array, T_s: float, max_gap: int = MAX_GAP) -> SampledModel:
    """Sample x' = A x + B u + d exactly with e^{A T_s} and its integral, of the same bits on every machine.

    Raises ControlDesignError for shapes that do not fit, a T_s that is not positive, and a singular Ed
    (A then has an eigenvalue 2 pi j k / T_s; take another T_s). A singular gap sum only ends ``gap_inverse``.
    """
    A, B = np.array(A, float), np.array(B, float)
    n = A.shape[0] if A.ndim == 2 else 0
    if A.ndim != 2 or A.shape != (n, n) or B.ndim != 2 or B.shape[0] != n:
        raise ControlDesignError(f"A must be n x n and B n x m, not {A.shape} and {B.shape}")
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise ControlDesignError("A and B must be finite")
    if not T_s > 0:
        raise ControlDesignError(f"T_s must be positive, not {T_s}")
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable A may overflow: the checks see it
        Ad, Ed = integral_exponential(A, float(T_s), halvings_of(A, T_s))
        inverses = _gap_inverses(Ad, Ed, T_s, max_gap)
    return SampledModel(A, B, T_s, _frozen(Ad), _frozen(Ed), _frozen(product(Ed, B)), inverses)


def _gap_inverses(Ad: Array, Ed: Array, T_s: float, max_gap: int) -> Array:
    """(sum_{j<m} Ad^j Ed)^-1 for m = 1 .. max_gap or the last regular one; shape (count, n, n)."""
    n = Ad.shape[0]
    integrals: Array = np.zeros((max_gap, n, n))
    power: Array = np.eye(n)
    total: Array = np.zeros((n, n))
    for m in range(max_gap):
        total = total + product(power, Ed)
        power = product(power, Ad)
        integrals[m] = total
    count = _regular(integrals, T_s)
    if not count:
        raise ControlDesignError(
            "Ed is singular or not finite: A has an eigenvalue 2 pi j k / T_s; change T_s"
        )
    return _frozen(np.array([inverse(integral) for integral in integrals[:count]]))


def _regular(integrals: Array, T_s: float) -> int:
    """How many of int_0^{m T_s} e^{A s} ds, m = 1, 2, ... are regular one after another.

    Singular is also one where all of it cancels; e^{A 0} = I is the scale.
    """
    finite: Any = np.isfinite(integrals).all(axis=(1, 2))
    count = len(integrals) if finite.all() else int(np.argmin(finite))
    sigma = np.linalg.svd(integrals[:count], compute_uv=False)
    lengths = T_s * np.arange(1, count + 1)
    singular = sigma[:, -1] * SINGULAR < np.maximum(sigma[:, 0], lengths)
    return int(np.argmax(singular)) if singular.any() else count


def _frozen(array: Array) -> Array:
    """A contiguous array that can't be written to."""
    out = np.ascontiguousarray(array)
    out.flags.writeable = False
    return out
