"""Noise through a coarse frame in the loop: rounding by its statistical linearisation.

A frame that rounds to multiples of q a Gaussian signal of deviation s about a multiple passes it on with the
gain K, and adds what is not correlated with it, of variance R (Booton 1954; Gelb and Vander Velde,
"Multiple-input describing functions", 1968, ch. 7):
    K = (2 q / s) sum_j phi(t_j),   R = 2 q^2 sum_j (2 j + 1) Q(t_j) - K^2 s^2,   t_j = (j + 1/2) q / s
with phi and Q density and tail of the normal distribution. For s >= q that is K = 1 and R = q^2 / 12.
For smaller s K falls, and with it the loop's gain: so s, K and the loop's noise are found together.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from hil.control.linalg import Array

STEPS: Final = 8
"""Thresholds that matter for s < q: the last is 7.5 deviations out and more."""
NEAR: Final = 1e-4
"""Difference of K at which it is found."""
ROUNDS: Final = 60


def linearised(s: float, q: float) -> tuple[float, float]:
    """K and R of rounding to multiples of q, for a Gaussian signal of deviation s about one of them."""
    if s >= q:
        return 1.0, q * q / 12.0
    t = [(j + 0.5) * q / s for j in range(STEPS)] if s > 0.0 else [math.inf]
    density = math.fsum(math.exp(-0.5 * a * a) for a in t) / math.sqrt(2.0 * math.pi)
    tail = math.fsum((2 * j + 1) * 0.5 * math.erfc(a / math.sqrt(2.0)) for j, a in enumerate(t))
    K = 2.0 * q / s * density if s > 0.0 else 0.0
    return K, max(0.0, 2.0 * q * q * tail - (K * s) ** 2)


def through_rounding(responses: Array, sigma: Array, c: int, measured: int, q: float) -> Array:
    """Deviations (m,) of m signals of a loop in which a measurement is rounded to multiples of q.

    ``responses`` (n, m, ticks): without rounding, of each signal to a pulse of each of n disturbances with
    the deviations ``sigma`` (n,), that of row ``c`` being on the measurement of the signal ``measured``. With
    D its transform, and n that disturbance, the measurement is D + n; rounded K (D + n) + r. So
        D_j(K) = D_j / (1 + (1 - K) D_c),   Y_j(K) = Y_j - (1 - K) Y_c D_j(K)
    and row c has the variance K^2 sigma_c^2 + R, whatever K: one pass of the loop is enough.
    """
    if q <= 0.0:
        fine: Array = np.sqrt(np.einsum("n,nmk->m", sigma**2, responses**2))
        return fine
    size = 1 << (2 * responses.shape[2] - 1).bit_length()
    Y = np.fft.rfft(responses, size)
    share = np.full(Y.shape[2], 2.0 / size)
    share[[0, -1]] = 1.0 / size
    D, K, R = Y[:, measured], 1.0, q * q / 12.0
    power = (D.real**2 + D.imag**2) * share
    others, own = np.delete(sigma, c) ** 2 @ np.delete(power, c, axis=0), power[c]
    for _ in range(ROUNDS):
        back = 1.0 + (1.0 - K) * D[c]
        found = (others + ((K * sigma[c]) ** 2 + R) * own) @ (1.0 / (back.real**2 + back.imag**2))
        K_new, R_new = linearised(math.sqrt(found + sigma[c] ** 2), q)
        if abs(K_new - K) < NEAR:
            break
        K, R = 0.5 * (K + K_new), 0.5 * (R + R_new)
    whole = Y - (1.0 - K) * Y[c][None] * (D / back)[:, None]
    variance = sigma**2
    variance[c] = (K * sigma[c]) ** 2 + R
    coarse: Array = np.sqrt(variance @ ((whole.real**2 + whole.imag**2) @ share))
    return coarse
