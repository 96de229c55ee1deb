"""The same cases in our exact sampled form (hil.control), beside an Euler discretisation of eq. (5).

The plant is advanced exactly also for a d that varies inside a tick; the observer assumes nothing more than
what it measures. The matrices of plant and model may differ: the paper's design on the real motor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import expm

from hil.control.composite import composite_command, composite_gain
from hil.control.fac import SampledModel, sample
from hil.control.jit import jit
from hil.control.linalg import Array, Index, matvec, matvec_add
from hil.control.observer import Window, ftdob, window_step
from hil.paper.continuous import Trace, initial_h, theta
from hil.paper.examples import Case, Example, basis, basis_rate


@jit
def run_loop(
    plant: tuple[Array, Array, Array],
    model: tuple[Array, Array, Array],
    gains: tuple[Array, Array],
    window: tuple[Array, Array, Array, Index],
    memory: tuple[Array, Array],
    xs: Array,
    us: Array,
    d_hats: Array,
) -> None:
    """Closed loop over the rows of xs (k, n): u = Pi_d x - B^-1 d_hat, plant, innovation, window.

    plant: Ad, Bd, forcing (k, n); model: Ad, Bd, Ed^-1; gains: Pi_d, B^-1; window: lam, lam_N, theta, N;
    memory: h (2, n), its ring of the past. xs[0] and d_hats[0] are the start.
    """
    n, head = xs.shape[1], 0
    xi, v, free = np.zeros(n), np.zeros(n), np.zeros(n)
    h, past = memory
    for k in range(xs.shape[0] - 1):
        composite_command(gains[0], gains[1], xs[k], d_hats[k], xi, us[k])
        matvec(plant[0], xs[k], xs[k + 1])
        matvec_add(plant[1], us[k], xs[k + 1])
        matvec(model[0], xs[k], free)
        matvec_add(model[1], us[k], free)
        for c in range(n):
            xs[k + 1, c] += plant[2][k, c]
            free[c] = xs[k + 1, c] - free[c]
        matvec(model[2], free, v)
        head = window_step(window[0], window[1], window[2], window[3], v, h, past, head, d_hats[k + 1])
    composite_command(gains[0], gains[1], xs[-1], d_hats[-1], xi, us[-1])


def forcing(A: Array, case: Case, t: Array, T_s: float) -> Array:
    """int_0^{T_s} e^{A (T_s - s)} d(t_k + s) ds for each tick, exact; shape (k, n)."""
    n, S = A.shape[0], basis_rate()
    M = np.zeros((n + S.shape[0],) * 2)
    M[:n, :n], M[n:, n:] = A, S
    responses = []
    for C in case.d.C:
        M[:n, n:] = C
        responses.append(expm(M * T_s)[:n, n:])
    values: Array = np.einsum("knb,kb->kn", np.array(responses)[case.d.piece(t)], basis(t))
    return values


def simulate_sampled(case: Case, T_s: float = 0.01, plant_A: Array | None = None) -> Trace:
    """Run a case in the sampled form; ``plant_A``: the plant's real A where the model is wrong."""
    e = case.example
    model = sample(e.A, e.B, T_s, 1)
    plant = model if plant_A is None else sample(plant_A, e.B, T_s, 1)
    window = ftdob(e.gamma[0], e.gamma[1], e.D, T_s)
    gain = composite_gain(model, e.Upsilon, e.Z)
    t = np.arange(round(case.end / T_s) + 1) * T_s
    h, past = _memory(initial_h(case).reshape(2, e.n), window)
    xs, us, d_hats = (np.zeros((t.size, e.n)) for _ in range(3))
    xs[0], d_hats[0] = case.x0, (window.theta * (1 - window.lam_N) * h).sum(axis=0)
    run_loop(
        (plant.Ad, plant.Bd, forcing(plant.A, case, t, T_s)),
        (model.Ad, model.Bd, model.gap_inverse[0]),
        (gain.Pi_d, np.linalg.inv(e.B)),
        (window.lam, window.lam_N, window.theta, window.N),
        (h, past),
        xs,
        us,
        d_hats,
    )
    d = case.d(t)
    return Trace(t, xs, us, d, d_hats, np.full_like(d, np.nan))


def _memory(h: Array, window: Window) -> tuple[Array, Array]:
    """h and a past in which it was held."""
    past = np.empty((int(window.N.max()) + 1, 2, h.shape[1]))
    past[:] = h
    return h.copy(), past


@dataclass(frozen=True, slots=True)
class Convergence:
    """Largest error of a channel over t (k,), for each initial error (e,); shape of the curves (e, k)."""

    t: Array
    initial: Array
    ftdob: Array
    euler: Array
    dob: Array
    N: int


def convergence(e: Example, T_s: float = 0.01, ticks: int = 100) -> Convergence:
    """Estimates of a constant d from ten initial errors 1e-3 .. 1e3, by three observers on one plant.

    The plant is open loop with u = 0 from x0 = 0, d = 0.2 in each channel; the observers differ in nothing
    but their form. Errors are absolute.
    """
    initial = np.logspace(-3, 3, 10)
    model = sample(e.A, e.B, T_s, 1)
    d = np.full(e.n, 0.2)
    xs = np.zeros((ticks + 1, e.n))
    for k in range(ticks):
        xs[k + 1] = model.Ad @ xs[k] + model.Ed @ d
    exact, euler, dob = (
        np.array([np.abs(run(e, model, xs, d + error) - d).max(axis=1) for error in initial])
        for run in (_ftdob_estimates, _euler_estimates, _dob_estimates)
    )
    return Convergence(np.arange(ticks + 1) * T_s, initial, exact, euler, dob, round(e.D / T_s))


def _innovations(model: SampledModel, xs: Array) -> Array:
    """v of the measured xs with u = 0; shape (k, n)."""
    v: Array = (xs[1:] - xs[:-1] @ model.Ad.T) @ model.gap_inverse[0].T
    return v


def _ftdob_estimates(e: Example, model: SampledModel, xs: Array, start: Array) -> Array:
    """d_hat of the exact sampled FTDOB that starts with h = start, held in the past; shape (k, n)."""
    window = ftdob(e.gamma[0], e.gamma[1], e.D, model.T_s)
    h, past = _memory(np.tile(start, (2, 1)), window)
    d_hats, head = np.zeros_like(xs), 0
    d_hats[0] = start
    step = partial(window_step, window.lam, window.lam_N, window.theta, window.N)
    for k, v in enumerate(_innovations(model, xs)):
        head = step(v, h, past, head, d_hats[k + 1])
    return d_hats


def _euler_estimates(e: Example, model: SampledModel, xs: Array, start: Array) -> Array:
    """d_hat of (5) to (7) with z advanced by Euler and Theta from e^{-Gamma D}; shape (k, n)."""
    g, N, T_s = e.gamma.ravel(), round(e.D / model.T_s), model.T_s
    h = np.empty((xs.shape[0], g.size))
    h[0] = np.tile(start, 2)
    z = h[0] - g * np.tile(xs[0], 2)
    for k, x in enumerate(xs[:-1]):
        z = z + T_s * (-g * (z + g * np.tile(x, 2)) - g * np.tile(e.A @ x, 2))
        h[k + 1] = z + g * np.tile(xs[k + 1], 2)
    delayed = np.vstack([np.repeat(h[:1], N, axis=0), h[: xs.shape[0] - N]])
    d_hats: Array = (h - np.exp(-g * e.D) * delayed) @ theta(e.gamma, e.D).T
    return d_hats


def _dob_estimates(e: Example, model: SampledModel, xs: Array, start: Array) -> Array:
    """d_hat of the conventional DOB in exact sampled form; shape (k, n)."""
    lam = np.exp(-e.gamma_c * model.T_s)
    d_hats = np.zeros_like(xs)
    d_hats[0] = start
    for k, v in enumerate(_innovations(model, xs)):
        d_hats[k + 1] = lam * d_hats[k] + (1 - lam) * v
    return d_hats
