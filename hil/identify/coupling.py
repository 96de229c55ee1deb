"""A soft coupling: whether the speed rings after the torque, where, and up to where that would have shown.

The torque T of the measured currents moves both inertias and a mode between them, w_r its resonance:
    w = w_0 + a t + (1/J) int T - (B_f/J) int w + (r/J) y + free ringing,  r = J_l / J_m
    dy/dt = T - 2 z w_r y - w_r q,  dq/dt = w_r y
T goes straight between its samples. That is linear in 1/J, B_f/J, r/J and in where each segment starts, so
it is solved for each resonance and damping ratio z of a grid. A free ringing by itself tells nothing: cogging
and loads leave one, too. So r must be many of its deviations off 0, which bear errors that correlate within a
segment. What is seen starts the exact fit (:mod:`hil.identify.fit`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from hil.control.jit import jit
from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.identify.data import Samples

SURE: Final = 6.0
"""Deviations by which J_l / J_m must be off 0."""
LEAST: Final = 0.02
"""Least J_l / J_m that is looked for: less moves no design."""
REACH: Final = 0.45
"""Highest resonance that is tried, as a share of the rate of the samples."""
PERIODS: Final = 1.5
"""Periods of the lowest one in a segment."""
DAMPINGS: Final = (0.01, 0.06)
"""Damping ratios that are tried."""
SHORT: Final = 40
"""Samples below which a segment tells nothing."""
FEW: Final = 3
"""Segments below which nothing is told."""


@dataclass(frozen=True, slots=True)
class Seen:
    """``masses``: resonance [rad/s], damping ratio, J_l / J_m; empty where none is seen.

    ``up_to`` [Hz]: up to where a load as heavy as the motor would have been seen; 0: nowhere.
    """

    masses: tuple[float, ...]
    up_to: float


@jit
def orthonormal(Q: Array) -> None:
    """Gram and Schmidt on the columns of Q (K, n), in place."""
    K, n = Q.shape
    for c in range(n):
        for b in range(c):
            dot = 0.0
            for k in range(K):
                dot += Q[k, b] * Q[k, c]
            for k in range(K):
                Q[k, c] -= dot * Q[k, b]
        size = 0.0
        for k in range(K):
            size += Q[k, c] * Q[k, c]
        for k in range(K):
            Q[k, c] /= math.sqrt(size)


@jit
def grams(
    w: Array, T: Array, first: npt.NDArray[np.int64], T_s: float, mode: tuple[float, float], step: Array,
    out: Array,
) -> None:  # fmt: skip
    """out (S, 4, 4): of each segment the products of (int T, int w, y, w), starts and ringing taken off.

    ``first`` (S + 1,): where segments begin; ``mode``: w_r and z; ``step`` (4, 4) advances (y, q, T, rise).
    """
    w_r, damping = mode
    for s in range(len(first) - 1):
        begin, K = first[s], first[s + 1] - first[s]
        X, Q, v = np.zeros((K, 4)), np.empty((K, 4)), np.zeros(2)
        for k in range(K):
            t, at = k * T_s, begin + k
            fades = math.exp(-damping * w_r * t)
            Q[k, 0], Q[k, 1] = 1.0, k - 0.5 * (K - 1)
            Q[k, 2], Q[k, 3] = fades * math.cos(w_r * t), fades * math.sin(w_r * t)
            X[k, 3] = w[at]
            if k > 0:
                rise = T[at] - T[at - 1]
                y = step[0, 0] * v[0] + step[0, 1] * v[1] + step[0, 2] * T[at - 1] + step[0, 3] * rise
                v[1] = step[1, 0] * v[0] + step[1, 1] * v[1] + step[1, 2] * T[at - 1] + step[1, 3] * rise
                v[0] = y
                X[k, 0] = X[k - 1, 0] + 0.5 * T_s * (T[at] + T[at - 1])
                X[k, 1] = X[k - 1, 1] + 0.5 * T_s * (w[at] + w[at - 1])
                X[k, 2] = y
        orthonormal(Q)
        for n in range(4):
            for c in range(4):
                dot = 0.0
                for k in range(K):
                    dot += Q[k, c] * X[k, n]
                for k in range(K):
                    X[k, n] -= dot * Q[k, c]
        for n in range(4):
            for m in range(4):
                total = 0.0
                for k in range(K):
                    total += X[k, n] * X[k, m]
                out[s, n, m] = total


@dataclass(frozen=True, slots=True)
class Turning:
    """The turning segments one after the other: speed, torque (N,), where they begin (S + 1,)."""

    T_s: float
    w: Array
    T: Array
    first: npt.NDArray[np.int64]


def turning_of(samples: Samples, motor: MotorModel) -> Turning:
    """The segments in which the shaft turns, the torque in units of what it is on average."""
    begins = np.flatnonzero(samples.begins)
    size = np.diff(begins, append=len(samples))
    kept = samples.segments(samples.free[begins] & (size >= SHORT))
    w, i_q, i_d = kept.y.T
    T = (motor.psi_f + (motor.L_d - motor.L_q) * i_d) * i_q
    usual = float(np.sqrt(np.mean(T**2))) if len(T) else 1.0
    return Turning(kept.T_s, w.copy(), T / (usual or 1.0), np.append(np.flatnonzero(kept.begins), len(kept)))


@dataclass(frozen=True, slots=True)
class Trial:
    """One resonance that was tried: its masses, what is left of the square of w, the deviation of r."""

    masses: tuple[float, float, float]
    left: float
    deviation: float


def tried(data: Turning, w_r: float, damping: float) -> Trial:
    """Least squares with that mode."""
    A = np.zeros((4, 4))
    A[0, :3], A[1, 0], A[2, 3] = (-2.0 * damping * w_r, -w_r, 1.0), w_r, 1.0 / data.T_s
    parts = np.empty((len(data.first) - 1, 4, 4))
    grams(data.w, data.T, data.first, data.T_s, (w_r, damping), expm(A * data.T_s), parts)
    whole = parts.sum(axis=0)
    size = np.sqrt(np.diag(whole)) + 1e-300
    parts, whole = parts / np.outer(size, size), whole / np.outer(size, size)
    bread = np.linalg.pinv(whole[:3, :3])
    x = bread @ whole[:3, 3]
    left = float(max(whole[3, 3] - x @ whole[:3, 3], 1e-12))
    scores = parts[:, :3, 3] - parts[:, :3, :3] @ x
    robust = bread @ (scores.T @ scores) @ bread * len(parts) / (len(parts) - 1)
    plain = bread * left / len(data.w)
    x, deviation = x / size[:3], np.sqrt(np.maximum(np.diag(robust), np.diag(plain))) / size[:3]
    inverse_J = x[0] if x[0] != 0.0 else 1e-300
    ratio, off = float(x[2] / inverse_J), float(deviation[2] / abs(inverse_J))
    return Trial((w_r, damping, ratio), left * float(size[3]) ** 2, off)


def seen(samples: Samples, motor: MotorModel) -> Seen:
    """Whether a resonance shows; ``motor`` gives how i_d adds to the torque."""
    data = turning_of(samples, motor)
    size = np.diff(data.first)
    if len(size) < FEW:
        return Seen((), 0.0)
    low, step = PERIODS / (float(size.max()) * data.T_s), 0.8 / (float(size.max()) * data.T_s)
    grid = 2.0 * np.pi * np.arange(low, REACH / data.T_s, step)
    rows = [[tried(data, w_r, damping) for damping in DAMPINGS] for w_r in grid]
    sure = [one for row in rows for one in row if one.masses[2] > max(LEAST, SURE * one.deviation)]
    hidden = [w_r for w_r, row in zip(grid, rows, strict=True) if SURE * row[-1].deviation > 1.0]
    up_to = min([*hidden, 2.0 * np.pi * REACH / data.T_s]) / (2.0 * np.pi)
    best = min(sure, key=lambda one: one.left, default=None)
    return Seen(best.masses if best else (), float(up_to) if up_to > low else 0.0)
