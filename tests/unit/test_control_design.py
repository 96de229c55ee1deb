"""Identities with the paper, conditions of Theorems 1 and 2, and the exact sampled model."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from hil.control.composite import composite_command, composite_gain, continuous_gain, predict
from hil.control.errors import ControlDesignError
from hil.control.fac import MAX_GAP, sample
from hil.control.observer import conventional_dob, ftdob, side_by_side

A5 = np.array([[-0.8, 1.0, 1.6], [0.0, -3.0, 2.0], [0.0, 0.0, -6.0]])  # the paper's (30)
T_S = 1e-3


def rotation(omega: float) -> np.ndarray:
    return np.array([[0.0, omega], [-omega, 0.0]])


def test_printed_theta_of_section_5() -> None:
    window = ftdob(np.array([0.6, 0.7, 0.8]), np.array([1.4, 1.5, 1.6]), 0.5, T_S)
    np.testing.assert_allclose(window.theta, [[-2.0332] * 3, [3.0332] * 3], atol=5e-5)
    assert window.N.tolist() == [500] * 3


def test_printed_theta_of_section_6() -> None:
    window = ftdob(np.array([0.2, 0.5]), np.array([0.8, 0.1]), 0.5, T_S)
    np.testing.assert_allclose(window.theta, [[-2.8583, 5.5167], [3.8583, -4.5167]], atol=5e-5)


def test_theta_solves_theorem_1_for_a_delay_between_ticks() -> None:
    window = ftdob(np.array([3.0]), np.array([80.0]), 0.0505, T_S)
    (l1,), (l2,) = window.lam_N
    G = np.array([[1.0, l1], [1.0, l2]])
    np.testing.assert_allclose(np.array([1.0, 0.0]) @ np.linalg.inv(G), window.theta[:, 0], rtol=1e-12)
    assert window.N[0] == 50  # lam^N goes with the rounded window, not with e^{-g D}
    np.testing.assert_allclose(window.lam_N[:, 0], np.exp(-np.array([3.0, 80.0]) * 0.050), rtol=1e-12)


def test_printed_pi_of_section_5() -> None:
    Pi = continuous_gain(A5, np.eye(3), -np.diag([0.1, 0.2, 0.3]), np.eye(3))
    np.testing.assert_allclose(Pi, [[0.7, -1.0, -1.6], [0.0, 2.8, -2.0], [0.0, 0.0, 5.7]], atol=1e-12)


@pytest.mark.parametrize(
    ("gamma_1", "gamma_2", "delay", "condition"),
    [
        (0.0, 1.0, 0.1, "positive"),
        (1.0, -1.0, 0.1, "positive"),
        (math.nan, 1.0, 0.1, "positive"),
        (2.0, 2.0, 0.1, "equal poles"),
        (2.0, 2.0 + 1e-12, 0.1, "singular"),
        (1e5, 2e5, 0.1, "singular"),
        (1.0, 2.0, 0.9e-3, "shorter than a tick"),
        (1.0, 2.0, math.inf, "D must be finite"),
    ],
)
def test_conditions_of_theorem_1(gamma_1: float, gamma_2: float, delay: float, condition: str) -> None:
    with pytest.raises(ControlDesignError, match=condition):
        ftdob(np.array([1.0, gamma_1]), np.array([2.0, gamma_2]), np.array([0.1, delay]), T_S)


def test_well_scaled_fast_poles_are_no_singularity() -> None:
    """Both lam^N are below 1e-11 here, but Theta is as well conditioned as can be."""
    window = ftdob(np.array([300.0]), np.array([500.0]), 0.1, T_S)
    np.testing.assert_allclose(window.theta[:, 0], [0.0, 1.0], atol=1e-8)


def test_windows_need_an_entry_per_channel() -> None:
    with pytest.raises(ControlDesignError, match="one entry per channel"):
        ftdob(np.array([1.0, 2.0]), np.array([3.0]), 0.1, T_S)


def test_conventional_dob_refuses_a_pole_that_is_not_positive() -> None:
    with pytest.raises(ControlDesignError, match="Gamma_c"):
        conventional_dob(np.array([1.0, 0.0]), T_S)


def test_side_by_side_keeps_the_order() -> None:
    window = side_by_side(ftdob(1.0, 2.0, 0.1, T_S), conventional_dob(np.array([5.0]), T_S))
    assert window.n == 2
    assert window.N.tolist() == [100, 1]
    assert window.lam_N[:, 1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("Upsilon", "Z", "B", "condition"),
    [
        (np.diag([1.0, -1.0]), np.eye(2), np.eye(2), "Hurwitz"),
        (np.diag([0.0, -1.0]), np.eye(2), np.eye(2), "Hurwitz"),
        (-np.eye(2), np.ones((2, 2)), np.eye(2), "Z must be non-singular"),
        (-np.eye(2), np.eye(2), np.ones((2, 2)), "full actuation"),
        (-np.eye(2), np.eye(2), np.ones((2, 1)), "full actuation"),
        (-np.eye(3), np.eye(2), np.eye(2), "shape of B"),
    ],
)
def test_conditions_of_theorem_2(Upsilon: np.ndarray, Z: np.ndarray, B: np.ndarray, condition: str) -> None:
    with pytest.raises(ControlDesignError, match=condition):
        composite_gain(sample(np.zeros((2, 2)), B, T_S), Upsilon, Z)


def test_sampled_gain_places_the_poles_exactly() -> None:
    """One tick late: predict, then Pi_d; the loop follows Z e^{Upsilon T_s} Z^-1 with d cancelled."""
    rng = np.random.default_rng(1)
    B, Z = rng.normal(size=(3, 3)) + 3 * np.eye(3), rng.normal(size=(3, 3)) + 3 * np.eye(3)
    Upsilon, d, zero = -np.diag([3.0, 5.0, 8.0]), np.array([1.0, -2.0, 3.0]), np.zeros(3)
    model = sample(A5, B, 0.05)
    gain = composite_gain(model, Upsilon, Z)
    x, u, x_p, after = np.array([1.0, 2.0, -1.0]), np.array([0.3, 0.1, -0.2]), np.empty(3), np.empty(3)
    predict(model.Ad, model.Bd, model.Ed, x, u, d, x_p)
    late = np.empty(3)
    composite_command(gain.Pi_d, np.linalg.inv(B), x_p, d, zero, late)
    predict(model.Ad, model.Bd, model.Ed, x_p, late, d, after)
    np.testing.assert_allclose(after, Z @ expm(Upsilon * 0.05) @ np.linalg.inv(Z) @ x_p, rtol=1e-10)
    shifted = np.empty(3)
    composite_command(gain.Pi_d, np.linalg.inv(B), x_p, d, np.array([0.5, 0.0, -0.5]), shifted)
    np.testing.assert_allclose(shifted - late, [0.5, 0.0, -0.5], atol=1e-12)


@pytest.mark.parametrize("A", [A5, rotation(40.0), np.zeros((2, 2)), np.diag([5.0, -9.0])])
def test_sampled_model_is_the_integral(A: np.ndarray) -> None:
    """Ed against a fine midpoint sum of e^{A s}: independent of the augmented exponential."""
    n, T_s, steps = len(A), 0.02, 2000
    model = sample(A, np.eye(n), T_s)
    ed = sum(expm(A * (j + 0.5) * T_s / steps) for j in range(steps)) * (T_s / steps)
    np.testing.assert_allclose(model.Ed, ed, atol=1e-9)
    np.testing.assert_allclose(model.Ad, expm(A * T_s), rtol=1e-12)
    assert (model.n, len(model.gap_inverse)) == (n, MAX_GAP)
    np.testing.assert_allclose(model.gap_inverse[1] @ (model.Ed + model.Ad @ model.Ed), np.eye(n), atol=1e-11)
    with pytest.raises(ValueError, match="read-only"):
        model.Ad[0, 0] = 1.0


@pytest.mark.parametrize(
    ("A", "B", "T_s", "condition"),
    [
        (np.ones((2, 3)), np.eye(2), 0.1, "n x n"),
        (np.ones(3), np.eye(3), 0.1, "n x n"),
        (np.eye(2), np.eye(3), 0.1, "n x n"),
        (np.eye(2) * math.nan, np.eye(2), 0.1, "finite"),
        (np.eye(2), np.eye(2), 0.0, "T_s must be positive"),
        (np.eye(2), np.eye(2), math.nan, "T_s must be positive"),
        (rotation(2 * math.pi / 0.1), np.eye(2), 0.1, "Ed is singular"),
        (np.eye(2) * 2000.0, np.eye(2), 1.0, "not finite"),
    ],
)
def test_models_that_can_not_be_sampled(A: np.ndarray, B: np.ndarray, T_s: float, condition: str) -> None:
    with pytest.raises(ControlDesignError, match=condition):
        sample(A, B, T_s)


def test_gaps_end_where_their_sum_is_singular() -> None:
    """A rotation of a fifth of a turn a tick: after five ticks nothing of a constant d is left to see."""
    assert len(sample(rotation(2 * math.pi / 0.5), np.eye(2), 0.1).gap_inverse) == 4


def test_gaps_end_where_an_unstable_sum_overflows() -> None:
    assert 1 <= len(sample(np.eye(2) * 50.0, np.eye(2), 1.0).gap_inverse) < 20
