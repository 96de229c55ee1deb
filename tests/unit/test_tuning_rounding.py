"""Noise through a coarse frame: the gain and the rest of rounding, and a loop that is closed through it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hil.tuning.rounding import linearised, through_rounding

Q = 0.01


@pytest.mark.parametrize("s", [0.0005, 0.002, 0.004, 0.007, 0.0099, 0.02])
def test_gain_and_rest_of_rounding_are_those_of_samples(s: float) -> None:
    x = np.random.default_rng(7).normal(0.0, s, 2_000_000)
    y = np.round(x / Q) * Q
    gain = (x @ y) / (x @ x)
    K, R = linearised(s, Q)
    assert pytest.approx(gain, abs=4e-3) == K and np.var(y - gain * x) == pytest.approx(R, rel=0.01, abs=1e-9)


def test_rounding_of_nothing_and_of_much_noise() -> None:
    assert linearised(0.0, Q) == (0.0, 0.0) and linearised(Q, Q) == (1.0, Q * Q / 12.0)
    K, R = linearised(Q * (1.0 - 1e-9), Q)
    assert pytest.approx(1.0, abs=1e-7) == K and pytest.approx(Q * Q / 12.0, rel=1e-6) == R


def loop(a: float, g: float, ticks: int, noises: np.ndarray, q: float) -> np.ndarray:
    """x+ = a x + u, u = g y with y = x + n rounded; columns x, u."""
    x, out = 0.0, np.empty((ticks, 2))
    for k in range(ticks):
        y = x + noises[k, 0]
        y = round(y / q) * q if q else y
        out[k] = x, g * y
        x = a * x + g * y + noises[k, 1]
    return out


@pytest.mark.parametrize("q", [0.0, 0.002, Q, 0.02])
def test_a_loop_closed_through_rounding_has_the_noise_of_its_simulation(q: float) -> None:
    a, g, sigma, ticks = 0.98, -0.2, np.array([0.002, 0.0015]), 400
    pulses = [np.outer(np.arange(ticks) == 0, one) for one in np.eye(2)]
    responses = np.array([loop(a, g, ticks, one, 0.0).T for one in pulses])
    noises = np.random.default_rng(3).normal(0.0, sigma, (200_000, 2))
    seen, said = loop(a, g, len(noises), noises, q).std(axis=0), through_rounding(responses, sigma, 0, 0, q)
    assert said == pytest.approx(seen, rel=0.07)
    fine = through_rounding(
        responses, np.array([math.hypot(sigma[0], q / math.sqrt(12.0)), sigma[1]]), 0, 0, 0.0
    )
    assert (fine[1] > 1.2 * seen[1]) == (q > Q), "the white noise of a fine resolution is too much then"
