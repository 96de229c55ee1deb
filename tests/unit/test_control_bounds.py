"""What a window's estimate can reach: each bound against an experiment with the step kernel."""

from __future__ import annotations

import numpy as np
import pytest

from hil.control.fac import SampledModel, sample
from hil.control.observer import (
    Window,
    bounds,
    conventional_dob,
    ftdob,
    impulse_response,
    response_length,
    rule_of_thumb,
    window_step,
)

T_S = 1e-3
WINDOWS = {
    "ftdob": ftdob(np.array([20.0, 60.0]), np.array([45.0, 110.0]), np.array([0.012, 0.030]), T_S),
    "dob": conventional_dob(np.array([100.0, 300.0]), T_S),
}
A = np.array([[-20.0, 300.0], [-70.0, -90.0]])


def run(window: Window, v: np.ndarray) -> np.ndarray:
    """Estimates for the innovations v (k, n), from an empty memory."""
    n = window.n
    h, past, head = np.zeros((2, n)), np.zeros((64, 2, n)), 0
    d_hat = np.zeros_like(v)
    for k in range(len(v)):
        head = window_step(window.lam, window.lam_N, window.theta, window.N, v[k], h, past, head, d_hat[k])
    return d_hat


def innovations(model: SampledModel, e: np.ndarray) -> np.ndarray:
    """What errors e (k, n) of the measured state make of v."""
    return (e[1:] - e[:-1] @ model.Ad.T) @ model.gap_inverse[0].T


@pytest.mark.parametrize("name", WINDOWS)
def test_impulse_response_is_the_kernels(name: str) -> None:
    window = WINDOWS[name]
    length = response_length(window)
    v = np.zeros((length, 2))
    v[0] = 1.0
    weights = impulse_response(window, length)
    np.testing.assert_allclose(run(window, v), weights, atol=1e-12)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-12)
    assert name == "dob" or length == 31


@pytest.mark.parametrize("name", WINDOWS)
def test_ramp_error_is_slope_times_the_integral_of_phi(name: str) -> None:
    """d = slope t seen through v, its mean over the tick; err = slope int phi (errata 1), A = 0."""
    window = WINDOWS[name]
    k = np.arange(1, 2001)[:, None]
    slope = np.array([3.0, -7.0])
    error = slope * k[-1] * T_S - run(window, slope * (k - 0.5) * T_S)[-1]
    ramp = bounds(window, np.eye(2), T_S * np.eye(2), T_S, np.zeros(2)).ramp
    np.testing.assert_allclose(error, slope * ramp, rtol=1e-9)


def test_integral_of_phi_tends_to_half_the_window() -> None:
    window = ftdob(np.array([1e-3]), np.array([2e-3]), 1.0, T_S)
    assert bounds(window, np.eye(1), T_S * np.eye(1), T_S, np.ones(1)).ramp == pytest.approx(0.5, rel=2e-3)


@pytest.mark.parametrize(("g_D", "gain"), [((0.003, 0.007), 1.41), ((0.3, 0.7), 1.6), ((1.0, 3.0), 3.3)])
def test_noise_gains_of_the_errata(g_D: tuple[float, float], gain: float) -> None:
    window = ftdob(np.array([g_D[0]]), np.array([g_D[1]]), 1.0, T_S)
    found = bounds(window, np.eye(1), T_S * np.eye(1), T_S, np.ones(1))
    assert found.noise == pytest.approx(gain, rel=0.03)


@pytest.mark.parametrize("name", WINDOWS)
def test_noise_gain_is_what_noise_gives(name: str) -> None:
    model, window, seed = sample(A, np.eye(2), T_S), WINDOWS[name], 3
    e = np.random.default_rng(seed).normal(size=(40_000, 2))
    spread = run(window, innovations(model, e))[500:].std(axis=0)
    expected = bounds(window, model.Ad, model.Ed, T_S, np.ones(2)).noise
    np.testing.assert_allclose(spread, expected, rtol=0.03, err_msg=f"seed {seed}")


@pytest.mark.parametrize("name", WINDOWS)
def test_resolution_bound_is_reached_by_the_worst_signs_and_never_passed(name: str) -> None:
    """The worst rounding is found by linear search over unit errors, not by the formula under test."""
    model, window, lsb = sample(A, np.eye(2), T_S), WINDOWS[name], np.array([0.01, 0.001])
    length = response_length(window) + 2
    worst = np.zeros(2)
    for j in range(length - 1):
        for state in range(2):
            e = np.zeros((length, 2))
            e[1 + j, state] = lsb[state] / 2
            worst += np.abs(run(window, innovations(model, e))[-1])
    resolution = bounds(window, model.Ad, model.Ed, T_S, lsb).resolution
    np.testing.assert_allclose(worst, resolution, rtol=1e-9)
    e = np.random.default_rng(5).choice([-0.5, 0.5], size=(5000, 2)) * lsb
    reached = np.abs(run(window, innovations(model, e))[200:]).max(axis=0)
    assert (reached <= resolution).all()
    assert (reached > 0.3 * resolution).all()


def test_rule_of_thumb() -> None:
    assert rule_of_thumb(0.01, 0.012) == pytest.approx(1.1667, rel=1e-3)
