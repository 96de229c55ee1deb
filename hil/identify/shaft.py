"""Friction and inertia in the rough: which stretches of a run are like most, and which had another load."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.identify.data import SHORTEST, Samples
from hil.identify.fit import Shaft
from hil.identify.model import Flags

ROUNDS: Final = 50


def balance(samples: Samples, motor: MotorModel) -> tuple[Array, Array]:
    """A row a segment of the means of (T_e, -w, -sgn(w), -1), and dw/dt: J dw/dt = row (1, B_f, T_c, T_0).

    Another load is then an error of the response, which a robust fit bears, and not of a regressor.
    """
    seg, count = samples.segment, int(samples.segment[-1]) + 1
    first = np.flatnonzero(samples.begins)
    last = np.append(first[1:], len(samples)) - 1
    size = np.bincount(seg)
    w, i_q, i_d = samples.y.T
    torque = 1.5 * motor.n_p * (motor.psi_f + (motor.L_d - motor.L_q) * i_d) * i_q
    slope = (w[last] - w[first]) / ((size - 1) * samples.T_s)
    means = [np.bincount(seg, value) / size for value in (w, np.sign(w), torque)]
    return np.stack([means[2], -means[0], -means[1], -np.ones(count)], 1), slope


def _least_absolute(rows: Array, right: Array) -> Array:
    """Least sum of absolute errors, by weighted least squares: a load for a while does not move it."""
    size = np.abs(rows).max(axis=0).clip(1e-12)
    scaled, weight = rows / size, np.ones(len(right))
    floor = 1e-4 * float(np.abs(right).max()) + 1e-15
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        x = np.linalg.lstsq(scaled * root[:, None], right * root, rcond=1e-9)[0]
        weight = 1.0 / np.maximum(np.abs(scaled @ x - right), floor)
    out: Array = x / size
    return out


def _short(samples: Samples, longest: int = 50) -> Samples:
    """The same cut shorter, so that a load that comes for a while leaves pieces as they were."""
    since = np.arange(len(samples)) - np.flatnonzero(samples.begins)[samples.segment]
    left = np.bincount(samples.segment)[samples.segment] - since
    return replace(samples, begins=samples.begins | ((since % longest == 0) & (left >= SHORTEST)))


def _solution(samples: Samples, motor: MotorModel) -> tuple[Array, Array]:
    """What each segment's acceleration is off [N m], and (J, B_f, T_c, T_0); one way alone T_0 is in T_c."""
    rows, slope = balance(samples, motor)
    one_way = bool((rows[:, 2] > 0).all() or (rows[:, 2] < 0).all())
    count = 3 if one_way else 4
    if len(rows) < count:
        return np.zeros(len(rows)), np.array([motor.J, motor.B_f, 0.0, 0.0])
    found = np.zeros(4)
    found[:count] = _least_absolute(rows[:, :count], slope)
    J = 1.0 / found[0] if found[0] > 0.0 else motor.J
    return J * np.abs(rows @ found - slope), np.array([J, *(J * found[1:])])


def rough(samples: Samples, motor: MotorModel) -> Shaft:
    """Coulomb friction and load of most of the time."""
    found = _solution(_short(samples), motor)[1]
    return Shaft(max(float(found[2]), 0.0), float(found[3]))


def calm(samples: Samples, motor: MotorModel) -> Flags:
    """Segments whose torque balances as that of most, in each of their pieces."""
    pieces = _short(samples)
    off, _ = _solution(pieces, motor)
    torque = np.abs(balance(pieces, motor)[0][:, 0])
    bad = off > max(8.0 * float(np.median(off)), 0.06 * float(torque.max()))
    of = samples.segment[np.flatnonzero(pieces.begins)]
    out: Flags = np.bincount(of, bad) == 0
    return out


def times(samples: Samples, which: Flags) -> list[tuple[float, float]]:
    """When those segments were, neighbours as one."""
    first = np.flatnonzero(samples.begins)
    last = np.append(first[1:], len(samples)) - 1
    merged: list[tuple[float, float]] = []
    for a, b in zip(samples.t[first[which]], samples.t[last[which]], strict=True):
        if merged and merged[-1][1] <= a < merged[-1][1] + 5 * samples.T_s:
            merged[-1] = (merged[-1][0], float(b))
        else:
            merged.append((float(a), float(b)))
    return merged
