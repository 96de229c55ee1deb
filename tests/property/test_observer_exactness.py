"""d_hat is exact N ticks after d settled, whatever happened before: the point of the whole observer."""

from __future__ import annotations

import numpy as np
import pytest

from hil.control.fac import SampledModel, sample
from hil.control.observer import Window, conventional_dob, fill, ftdob, window_step

SEEDS = range(200)
RING = 64
LONGEST = 60


class Observer:
    """The kernels, in the order in which the drive law calls them; open loop over a gap with d = 0."""

    def __init__(self, model: SampledModel, window: Window, rng: np.random.Generator) -> None:
        n = model.n
        self.model, self.window = model, window
        self.h, self.past = rng.normal(size=(2, n)) * 10, rng.normal(size=(RING, 2, n)) * 10
        self.head, self.gap, self.d_hat = int(rng.integers(RING)), 0, np.zeros(n)

    def start(self, x: np.ndarray) -> None:
        self.x_open, self.gap = x.copy(), 0

    def period(self, ua: np.ndarray) -> None:
        self.x_open = self.model.Ad @ self.x_open + self.model.Bd @ ua
        self.gap += 1

    def measure(self, x: np.ndarray) -> None:
        v, w = self.model.gap_inverse[self.gap - 1] @ (x - self.x_open), self.window
        for _ in range(self.gap):
            self.head = window_step(w.lam, w.lam_N, w.theta, w.N, v, self.h, self.past, self.head, self.d_hat)
        self.start(x)


def random_system(rng: np.random.Generator) -> tuple[SampledModel, Window]:
    """Coupled, stable or unstable; poles that differ by a factor of 1.5 at least; N 1 to 60 per channel.

    A, B and d are of the order 1 / (60 ticks): so x moves by its own size within the longest window, and an
    unstable one grows up to a hundredfold in the run. (Beyond that the rounding of x itself, eps |x| / T_s,
    is all that is left to see.)
    """
    n, T_s = int(rng.integers(1, 5)), 10.0 ** rng.uniform(-4, -2)
    A = rng.normal(size=(n, n)) * rng.uniform(0.1, 1.0) / (LONGEST * T_s)
    B = rng.normal(size=(n, n)) / (LONGEST * T_s)
    N = rng.integers(1, 61, size=n)
    slow = rng.uniform(0.1, 1.0, size=n) / (N * T_s)
    fast = slow * rng.uniform(1.5, 4.0, size=n)
    return sample(A, B, T_s), ftdob(slow, fast, N * T_s, T_s)


def simulate(seed: int, broken: bool = False) -> float:
    """Error over |d|, N ticks after the step of d; with lost frames, and a late, saturated input."""
    rng = np.random.default_rng(seed)
    model, window = random_system(rng)
    if broken:
        window = conventional_dob(-np.log(window.lam[0]) / model.T_s, model.T_s)
    n = model.n
    observer = Observer(model, window, rng)
    x, ua, wanted = rng.normal(size=n), np.zeros(n), np.zeros(n)
    observer.start(x)
    d, d_after = rng.normal(size=(2, n)) / (LONGEST * model.T_s)
    for k in range(2 * LONGEST + 10):
        if k == LONGEST:
            d = d_after
        ua = np.clip(wanted, -1.0, 1.0)  # the command of the tick before, saturated
        wanted = rng.normal(size=n) * 2 - x
        x = model.Ad @ x + model.Bd @ ua + model.Ed @ d
        observer.period(ua)
        lost = rng.random() < 0.2 and k not in (LONGEST - 1, 2 * LONGEST + 9)
        if not lost:  # the step falls on a tick that is measured: a gap across it mixes both values
            observer.measure(x)
    return float(np.abs(observer.d_hat - d_after).max() / np.abs(d_after).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_after_n_ticks(seed: int) -> None:
    assert simulate(seed) < 1e-10, f"seed {seed}"


def test_the_check_can_fail() -> None:
    """A conventional DOB in the same harness is not exact."""
    assert max(simulate(seed, broken=True) for seed in range(5)) > 1e-4


@pytest.mark.parametrize("N", [1, 2, 7, 60])
def test_not_before_n_ticks_and_exactly_then(N: int) -> None:
    window = ftdob(np.array([20.0]), np.array([50.0]), N * 1e-3, 1e-3)
    h, past, head, d_hat = np.zeros((2, 1)), np.zeros((RING, 2, 1)), 0, np.zeros(1)
    for k in range(N + 3):
        head = window_step(window.lam, window.lam_N, window.theta, window.N, np.ones(1), h, past, head, d_hat)
        exact = abs(d_hat[0] - 1.0) < 1e-12 * max(1.0, float(np.abs(window.theta).max()))
        assert exact == (k + 1 >= N), f"tick {k + 1} of N = {N}: {d_hat[0]}"


def test_filled_memory_is_a_steady_state() -> None:
    rng = np.random.default_rng(8)
    _, window = random_system(rng)
    v, n = rng.normal(size=window.n), window.n
    h, past, d_hat = np.empty((2, n)), np.empty((RING, 2, n)), np.empty(n)
    fill(v, h, past)
    window_step(window.lam, window.lam_N, window.theta, window.N, v, h, past, 5, d_hat)
    np.testing.assert_allclose(d_hat, v, rtol=1e-12)
