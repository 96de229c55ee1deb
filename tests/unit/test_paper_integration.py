"""The exact continuous form against a general integrator with the delay by the method of steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

from hil.paper.continuous import Trace, initial_h, simulate, theta, window
from hil.paper.examples import Case, case_1, case_3, levels, pmsm_corrected, section_5
from hil.paper.sampled import simulate_sampled

Vector = npt.NDArray[np.floating]


def method_of_steps(case: Case, steps: int) -> tuple[Vector, Vector]:
    """x and d_hat at the ends of intervals of length D: (5) to (7), (19) to (21) as printed, DOP853."""
    e, n = case.example, case.example.n
    Gamma, Th = e.gamma.ravel(), theta(e.gamma, e.D)
    B_inv, decay = np.linalg.inv(e.B), np.exp(-Gamma * e.D)
    start = initial_h(case)
    delayed: Callable[[float], Vector] = lambda t: start  # noqa: E731
    y, xs, d_hats = np.concatenate([case.x0, case.z0]), [], []

    def h_of(y: Vector) -> Vector:
        return y[n:] + Gamma * np.tile(y[:n], 2)

    for i in range(steps):
        t0, t1 = i * e.D, (i + 1) * e.D

        def slope(
            t: float, y: Vector, delayed: Callable[[float], Vector] = delayed, t1: float = t1
        ) -> Vector:
            d = case.d(np.array([min(t, t1 - 1e-8)]))[0]
            d_hat = Th @ (h_of(y) - decay * delayed(t - e.D))
            u = e.Pi @ y[:n] - B_inv @ d_hat
            known = e.A @ y[:n] + e.B @ u
            return np.concatenate([known + d, -Gamma * h_of(y) - Gamma * np.tile(known, 2)])

        solution = solve_ivp(slope, (t0, t1), y, "DOP853", rtol=1e-12, atol=1e-13, dense_output=True)
        assert solution.success, solution.message
        dense = solution.sol
        d_hats.append(Th @ (h_of(solution.y[:, -1]) - decay * delayed(t1 - e.D)))
        delayed = lambda t, dense=dense: h_of(dense(t))  # noqa: E731
        y = solution.y[:, -1]
        xs.append(y[:n])
    return np.array(xs), np.array(d_hats)


@pytest.mark.parametrize("case", [case_1(), case_3(), pmsm_corrected()], ids=lambda c: c.name)
def test_exact_steps_equal_a_general_integrator(case: Case) -> None:
    steps = 14
    xs, d_hats = method_of_steps(case, steps)
    trace = simulate(replace(case, end=steps * case.example.D))
    rows = (np.arange(1, steps + 1) * round(case.example.D / 0.01)).astype(int)
    np.testing.assert_allclose(trace.x[rows], xs, atol=2e-9)
    np.testing.assert_allclose(trace.d_hat[rows], d_hats, atol=2e-9)


def test_the_grid_does_not_matter() -> None:
    case = replace(case_3(), end=20.0)
    coarse, fine = simulate(case, 0.1), simulate(case, 0.02)
    np.testing.assert_allclose(coarse.x, fine.x[::5], atol=1e-11)
    np.testing.assert_allclose(coarse.d_hat, fine.d_hat[::5], atol=1e-11)


def test_a_grid_that_d_is_no_multiple_of_is_refused() -> None:
    with pytest.raises(ValueError, match="not a whole number of steps"):
        simulate(case_1(), 0.03)


def test_the_estimate_is_the_moving_average_of_the_errata() -> None:
    """d_hat(t) = int_0^D w(s) d(t - s) ds, for the varying d of case 3."""
    case = case_3()
    e = case.example
    nodes, weights = np.polynomial.legendre.leggauss(40)
    s = 0.5 * e.D * (nodes + 1)
    w = 0.5 * e.D * weights[:, None] * window(e.gamma, e.D, s)
    trace = simulate(replace(case, end=20.0))
    for t in (0.5, 3.0, 17.31):
        average = (w * case.d(t - s)).sum(axis=0)
        np.testing.assert_allclose(trace.d_hat[round(t / 0.01)], average, atol=1e-12)


@pytest.mark.parametrize("case", [case_1(), pmsm_corrected()], ids=lambda c: c.name)
def test_the_sampled_form_estimates_the_same_for_a_piecewise_constant_d(case: Case) -> None:
    ours, paper = simulate_sampled(case), simulate(case)
    np.testing.assert_allclose(ours.d_hat, paper.d_hat, atol=1e-13)
    assert np.abs(ours.x - paper.x).max() < 0.05


def test_the_sampled_loop_approaches_the_continuous_one_with_the_tick() -> None:
    case = replace(case_1(), end=5.0)

    def distance(T_s: float) -> float:
        ours: Trace = simulate_sampled(case, T_s)
        return float(np.abs(ours.x - simulate(case, T_s).x).max())

    assert distance(0.01) < 0.3 * distance(0.05)


def test_a_plant_other_than_the_model_is_felt() -> None:
    case = replace(case_1(), end=5.0)
    wrong = simulate_sampled(case, plant_A=section_5().A * 1.1)
    assert np.abs(wrong.error[300:]).max() > 1e-3


def test_disturbance_pieces_are_right_continuous() -> None:
    d = levels([0, 3], [[1.0], [2.0]])
    np.testing.assert_array_equal(d(np.array([0.0, 2.999, 3.0, 9.0]))[:, 0], [1, 1, 2, 2])
