"""Small matrix kernels as explicit loops: the order of every addition is fixed, no BLAS."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from hil.control.jit import jit

Array = npt.NDArray[np.floating[Any]]
Index = npt.NDArray[np.int64]


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
