"""The window of least noise that is exact for a constant d: g = Q^-1 1 / (1' Q^-1 1), sum g = 1.

In closed form, for p.q > 0:  g_j ~ 1 - cosh(kappa (j - m)) / cosh(kappa (N + 1) / 2), m = (N - 1) / 2,
cosh kappa = (p.p + q.q) / (2 p.q); kappa -> 0 gives the parabola 6 (j + 1)(N - j) / (N (N + 1)(N + 2)) with
    sigma(d_hat) = sigma_x / T_s sqrt(12 / (N (N + 1)(N + 2)))  ~  3.46 sigma_x / (D sqrt(N)),  lag D / 2.
The parabola is the slope of the least-squares line through N + 1 samples (Fliess and Join 2013).
"""

from __future__ import annotations

import math

import numpy as np

from hil.control.linalg import Array
from hil.control.noise import DELAY, NOISE, least_noise, ticks_of, weights_of_noise
from hil.control.observer import Window, fir
from hil.control.registry import Channel, Observer, Values


def closed_form(N: int, kappa: float) -> Array:
    """The same weights in closed form, kappa >= 0."""
    j, m = np.arange(N), (N - 1) / 2
    if kappa < 1e-6:
        g: Array = 6.0 * (j + 1) * (N - j) / (N * (N + 1.0) * (N + 2))
        return g
    g = 1 - np.cosh(kappa * (j - m)) / math.cosh(kappa * (N + 1) / 2)
    g /= g.sum()
    return g


def design(values: Values, channel: Channel) -> Window:
    """Solve Q g = 1, normalise. Raises ControlDesignError."""
    N = ticks_of(values, channel.T_s)
    return fir(least_noise(np.ones((1, N)), np.ones(1), *weights_of_noise(channel, values)))


MEMBER = Observer("least-noise", "the exact window of least noise", {"delay_ms": DELAY, **NOISE}, design)
