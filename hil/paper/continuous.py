"""The paper's continuous form, eqs. (5) to (7) with control (19) to (24), integrated exactly.

The loop with its delay is linear and the disturbance comes from a linear generator, so one matrix
exponential a grid step is exact: h(t - D) and d(t - D) travel along as states that are loaded from the grid
(D is a whole number of steps). The conventional DOB (31) watches the same plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm

from hil.control.linalg import Array
from hil.paper.examples import Case, Example, basis, basis_rate


def theta(gamma: Array, D: float) -> Array:
    """Theta = [I 0][G, e^{-Gamma D} G]^-1 of Theorem 1, as printed; gamma (2, n); shape (n, 2n)."""
    n = gamma.shape[1]
    G = np.vstack([np.eye(n), np.eye(n)])
    delayed = np.exp(-gamma.ravel() * D)[:, None] * G
    gain: Array = np.linalg.inv(np.hstack([G, delayed]))[:n]
    return gain


def channel_theta(gamma: Array, D: float) -> Array:
    """The entries of Theta per channel; shape (2, n)."""
    full, n = theta(gamma, D), gamma.shape[1]
    return np.array([np.diag(full[:, :n]), np.diag(full[:, n:])])


def window(gamma: Array, D: float, s: Array) -> Array:
    """w(s) = sum_i Theta_i gamma_i e^{-gamma_i s}, with which d_hat averages d over the past D; (k, n)."""
    weights, rows = channel_theta(gamma, D), np.asarray(s)[:, None]
    values: Array = sum(weights[i] * gamma[i] * np.exp(-gamma[i] * rows) for i in range(2))
    return values


def lag(gamma: Array, D: float) -> Array:
    """int_0^D phi, phi(s) = sum_i Theta_i e^{-gamma_i s}: ramp error per slope [s]; shape (n,)."""
    weights = channel_theta(gamma, D)
    value: Array = (weights * (1.0 - np.exp(-gamma * D)) / gamma).sum(axis=0)
    return value


@dataclass(frozen=True, slots=True)
class Trace:
    """A run on the grid t (k,): x, u, d, FTDOB's and conventional DOB's d_hat, each (k, n)."""

    t: Array
    x: Array
    u: Array
    d: Array
    d_hat: Array
    d_hat_c: Array

    @property
    def error(self) -> Array:
        """FTDOB's error, theta = d_hat - d."""
        return self.d_hat - self.d

    @property
    def error_c(self) -> Array:
        """Conventional DOB's error."""
        return self.d_hat_c - self.d


def initial_h(case: Case) -> Array:
    """h(t0) = z0 + Gamma x'(t0), eq. (6); shape (2n,)."""
    h: Array = case.z0 + case.example.gamma.ravel() * np.tile(case.x0, 2)
    return h


def _loop(e: Example) -> tuple[Array, Array, Array]:
    """Law u = K (x, z, h_D) and the closed loop of (x, z, z_c), driven by h_D; K is (n, 5n).

    u = Pi x - B^-1 Theta (z + Gamma x' - e^{-Gamma D} h_D), eqs. (6), (7), (19) to (21).
    """
    n, g = e.n, e.gamma.ravel()
    B_inv, Th = np.linalg.inv(e.B), theta(e.gamma, e.D)
    x_gain = e.Pi - B_inv @ Th @ np.vstack([np.diag(e.gamma[0]), np.diag(e.gamma[1])])
    z_gain, hD_gain = -B_inv @ Th, B_inv @ Th @ np.diag(np.exp(-g * e.D))
    K = np.hstack([x_gain, z_gain, np.zeros((n, n)), hD_gain])
    rate = np.hstack([e.A, np.zeros((n, 5 * n))]) + e.B @ K  # A x + B u
    rows = [rate]
    for i, gamma in enumerate((*e.gamma, e.gamma_c)):  # z_i' = -Gamma (z + Gamma x) - Gamma (A x + B u)
        row = -gamma[:, None] * rate
        row[:, :n] -= np.diag(gamma**2)
        row[:, n * (1 + i) : n * (2 + i)] -= np.diag(gamma)
        rows.append(row)
    return K, np.vstack(rows), rate


def _step_matrix(e: Example, C: Array, C_delayed: Array, started: bool, dt: float) -> Array:
    """Exact step of (x, z, z_c, h_D, basis, delayed basis); before D, h_D is the constant fill."""
    n, S = e.n, basis_rate()
    _, closed, _ = _loop(e)
    M = block_diag(np.zeros((6 * n, 6 * n)), S, S)
    M[: 4 * n, : 6 * n] = closed
    M[:n, 6 * n : 6 * n + S.shape[0]] = C
    if started:  # h_D' = -Gamma h_D + Gamma G d(t - D), from (9)
        g = e.gamma.ravel()
        M[4 * n : 6 * n, 4 * n : 6 * n] = -np.diag(g)
        M[4 * n : 6 * n, 6 * n + S.shape[0] :] = g[:, None] * np.vstack([C_delayed, C_delayed])
    step: Array = expm(M * dt)
    return step


def simulate(case: Case, dt: float = 0.01, fill: Array | None = None) -> Trace:
    """Run a case. ``fill`` (2n,): h before t0, default h(t0) held (the paper leaves it open, eq. (10)).

    Raises ValueError when D is not a whole number of steps.
    """
    e, n = case.example, case.example.n
    N, count = round(e.D / dt), round(case.end / dt) + 1
    if abs(N * dt - e.D) > 1e-9:
        raise ValueError(f"D = {e.D} s is not a whole number of steps of {dt} s")
    t = np.arange(count) * dt
    g, piece = basis(t), case.d.piece(t)
    y, hD = np.zeros((count, 4 * n)), np.zeros((count, 2 * n))
    y[0] = np.concatenate([case.x0, case.z0, case.z_c0])
    hD[: N + 1] = initial_h(case) if fill is None else fill
    matrices: dict[tuple[int, int], Array] = {}
    for k in range(count - 1):
        if k >= N:
            hD[k] = _h(e, y[k - N])
        back = k - N
        key = (int(piece[k]), int(piece[back]) if back >= 0 else -1)
        if key not in matrices:
            matrices[key] = _step_matrix(e, case.d.C[key[0]], case.d.C[max(key[1], 0)], key[1] >= 0, dt)
        full = np.concatenate([y[k], hD[k], g[k], g[max(back, 0)]])
        y[k + 1] = (matrices[key] @ full)[: 4 * n]
    hD[-1] = _h(e, y[count - 1 - N])
    return _trace(case, t, y, hD)


def _h(e: Example, y: Array) -> Array:
    """h = z + Gamma x' of states y (..., 4n), eq. (6)."""
    h: Array = y[..., e.n : 3 * e.n] + e.gamma.ravel() * np.concatenate([y[..., : e.n]] * 2, axis=-1)
    return h


def _trace(case: Case, t: Array, y: Array, hD: Array) -> Trace:
    """Outputs from the states, eqs. (7), (19), (31)."""
    e, n = case.example, case.example.n
    d_hat = (_h(e, y) - np.exp(-e.gamma.ravel() * e.D) * hD) @ theta(e.gamma, e.D).T
    x = y[:, :n]
    u = x @ e.Pi.T - d_hat @ np.linalg.inv(e.B).T
    return Trace(t, x, u, case.d(t), d_hat, y[:, 3 * n :] + e.gamma_c * x)
