"""Noise of a window, and the window that has least of it under linear conditions.

A window is d_hat_k = sum_{j<N} g_j v_{k-j}. With sigma the noise of the states x, and for channel c
    p = row c of Ed^-1 diag(sigma),   q = row c of Ed^-1 Ad diag(sigma),
    var(d_hat_c) = g' Q g,   Q = tridiag(-p.q, p.p + q.q, -p.q)   (N x N, positive definite).
It is exact for d = const when sum g = 1; further conditions C g = b make it exact for more, and
    g = Q^-1 C' (C Q^-1 C')^-1 b
is the one with least noise. v_{k-j} is the mean of d over the tick that ended j ticks ago.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.jit import jit
from hil.control.linalg import Array, condition, dot, product, solve
from hil.control.observer import FIR_MAX
from hil.control.registry import Channel, Key, Values

DELAY = Key("length D of the window: exact D after the last change")
MOST_CONDITION: Final = 1e13
"""Of the conditions on a window's weights."""
NOISE = {
    "w_noise_rad_s": Key("noise of the measured speed, resolution included; default: own state only", None),
    "i_noise_a": Key("noise of the measured currents, resolution included", None),
}


def ticks_of(values: Values, T_s: float, conditions: int = 1) -> int:
    """N = D / T_s, rounded. Raises ControlDesignError below the number of conditions and over FIR_MAX."""
    N: int = round(values["delay_ms"] * 1e-3 / T_s)
    if not conditions <= N <= FIR_MAX:
        raise ControlDesignError(
            f"D = {values['delay_ms']:g} ms is {N} ticks; this window takes {conditions} to {FIR_MAX} "
            "(for longer ones take kind exponentials)"
        )
    return N


def weights_of_noise(channel: Channel, values: Values) -> tuple[float, float]:
    """(p.p + q.q, p.q) of the channel; without given noise only the channel's own state is noisy."""
    w, i = values.get("w_noise_rad_s"), values.get("i_noise_a")
    sigma = np.eye(3)[channel.index] if w is None or i is None else np.array([w, i, i])
    inverse = channel.model.gap_inverse[0]
    p, q = inverse[channel.index] * sigma, product(inverse, channel.model.Ad)[channel.index] * sigma
    return dot(p, p) + dot(q, q), dot(p, q)


def noise_matrix(N: int, diagonal: float, neighbour: float) -> Array:
    """Q as a full matrix (N, N); for tests and short windows."""
    off = np.full(N - 1, -neighbour)
    Q: Array = np.diag(np.full(N, diagonal)) + np.diag(off, 1) + np.diag(off, -1)
    return Q


@jit
def by_noise(diagonal: float, neighbour: float, b: Array) -> Array:
    """Q^-1 b for b (N, m), by elimination from the first row on; Q is positive definite."""
    N, m = b.shape
    x, share = b.copy(), np.zeros(N)
    for i in range(N):
        pivot = diagonal - (neighbour * share[i - 1] if i else 0.0)
        share[i] = neighbour / pivot
        for c in range(m):
            x[i, c] = (x[i, c] + (neighbour * x[i - 1, c] if i else 0.0)) / pivot
    for i in range(N - 2, -1, -1):
        for c in range(m):
            x[i, c] += share[i] * x[i + 1, c]
    return x


def times_noise(diagonal: float, neighbour: float, x: Array) -> Array:
    """Q x for x (N, m)."""
    out: Array = diagonal * x
    out[1:] -= neighbour * x[:-1]
    out[:-1] -= neighbour * x[1:]
    return out


def least_noise(C: Array, b: Array, diagonal: float, neighbour: float) -> Array:
    """g (N,) with C g = b (C (m, N), b (m,)) and least g' Q g. Raises ControlDesignError."""
    X = by_noise(diagonal, neighbour, np.ascontiguousarray(C.T))
    inner = product(C, X)
    if not condition(inner) <= MOST_CONDITION:
        raise ControlDesignError("the conditions of the window depend on each other; lengthen D")
    g: Array = product(X, solve(inner, b[:, None]))[:, 0]
    return g
