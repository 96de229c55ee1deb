"""The linear loop of a drive with a current loop of its own, through what filters its speed.

The very kernels of the tick against the exact sampled plant x = (w, i, filter), without limits and rounding;
i in the unit of the command. S is that of the reported speed: from a step that nobody filtered to what the
observer gets; Ms and margins follow as in :mod:`hil.tuning.measure`. Of a drive that measures in each m-th
tick S is that of its samples, which is the loop's own at their rate; what lies between them the law predicts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hil.control.jit import jit
from hil.control.law import MotorModel, ask, between, new_law_state, observe, reset
from hil.control.linalg import Array
from hil.control.registry import InnerLoop, SpeedFilter
from hil.control.speed import COMMANDS, flowed, latched
from hil.control.speedfilter import MOST_AVERAGE
from hil.tuning.loop import (
    LOAD,
    NO_LIMIT,
    PULSE_I,
    PULSE_TH,
    PULSE_U,
    PULSE_W,
    Plant,
    Record,
    one_mass,
    sampled,
    step,
    two_masses,
)
from hil.tuning.sensitivity import Margins, margins_of, peak_of

RESPONSE_S: Final = 1.0
"""Length of the responses; a loop that has not come to rest by then counts as unstable."""
QUIET: Final = 2 * MOST_AVERAGE
"""Ticks at rest before the disturbance: the observer has its samples and its memory by then."""
RESTLESS: Final = 0.02
"""Share of a response's peak that may be left in its last tenth."""


@dataclass(frozen=True, slots=True)
class Regulator:
    """A drive's sampled current loop as far as it is known: PI at ``period`` [s], ``bandwidth`` [rad/s]."""

    period: float
    bandwidth: float


def shaft_of(
    motor: MotorModel,
    inner: InnerLoop,
    given: SpeedFilter | None,
    T_s: float,
    masses: tuple[Array, Array] | None = None,
    regulator: Regulator | None = None,
) -> Plant:
    """The plant behind a current loop, exact for u and T_L held over a tick; x = (w, i, ..., filter).

    ``given`` filters the speed, whatever the observer knows of it; ``masses``: one inertia, or
    :func:`hil.tuning.loop.two_masses`; without them the shaft that the observer knows, or none. The current
    loop is a lag, or with ``regulator`` the drive's own samples (:func:`_regulated`).
    """
    given = given or SpeedFilter()
    if masses is None:
        masses = one_mass(motor) if inner.shaft is None else two_masses(motor, *inner.shaft.elastic)
    own, load = masses
    m, f = len(own), 2 if len(given.poles) == 2 else int(bool(given.poles or given.ticks))
    n = m + (regulator is not None)
    A, B = np.zeros((n + f, n + f)), np.zeros((n + f, 2))
    A[:m, :m], B[:m, 1] = own, load
    amperes = inner.k_u / motor.k_t  # of a unit of the command
    A[0, 1] *= amperes
    if regulator:
        A[1, 0] /= amperes
        A[1, m] = B[1, 0] = 1.0 / motor.L_q
    else:
        lag = inner.lag or 1e-4 * T_s
        A[1], B[1, 0] = 0.0, 1.0 / lag
        A[1, 1] = -1.0 / lag
    if given.ticks:
        A[n, 0] = 1.0
    elif f == 1:
        A[n, 0], A[n, n] = given.poles[0], -given.poles[0]
    elif f == 2:
        p, q = given.poles
        A[n, n + 1], A[n + 1, 0], A[n + 1, n], A[n + 1, n + 1] = 1.0, p * q, -p * q, -p - q
    C = np.eye(n + f)[n if f else 0]
    shaft = _regulated(A, B, T_s, C, m, motor, regulator) if regulator else sampled(A, B, T_s, C)
    return _mean(shaft, n, given.ticks, T_s) if given.ticks else shaft


def _regulated(
    A: Array, B: Array, T_s: float, C: Array, at: int, motor: MotorModel, regulator: Regulator
) -> Plant:
    """A tick of whole samples of a PI whose zero cancels the winding's pole; x[at] is its integral, as held.

        u = k (i* - i) + I + n_p psi_f w,  I+ = I + k (1 - a) (i* - i),  k (1 - a) = (1 - l) R
    with a = e^{-R T / L}, l = e^{-b T}: the current follows as by a lag of bandwidth b, but the voltage
    against the back-EMF is held over each sample, which feeds the acceleration back.
    """
    reset = -math.expm1(-motor.R_s * regulator.period / motor.L_q)
    gain = -math.expm1(-regulator.bandwidth * regulator.period) * motor.R_s / reset
    one, n, count = sampled(A, B, regulator.period), len(A), round(T_s / regulator.period)
    step = np.eye(n + 2)
    step[:n, :n], step[:n, n], step[:n, n + 1] = one.A, one.b * gain, one.e
    step[:n, 0] -= one.b * A[1, 0] / B[1, 0]
    step[:n, 1] -= one.b * gain
    step[at, 1] -= gain * reset
    step[at, n] += gain * reset
    whole = np.linalg.matrix_power(step, count)
    return Plant(*(np.ascontiguousarray(part) for part in (whole[:n, :n], whole[:n, n], whole[:n, n + 1], C)))


def _mean(shaft: Plant, first: int, ticks: int, T_s: float) -> Plant:
    """(w, i, ..., angle of the last tick, of the one before, ...)."""
    n = first + ticks
    A, C = np.zeros((n, n)), np.zeros(n)
    A[: first + 1, :first], C[first:] = shaft.A[:, :first], 1.0 / (ticks * T_s)
    for row in range(first + 1, n):
        A[row, row - 1] = 1.0
    b, e = (np.r_[part, np.zeros(ticks - 1)] for part in (shaft.b, shaft.e))
    return Plant(A, b, e, C)


@jit
def respond_current(
    p: Any, s: Any, A: Array, b: Array, e: Array, C: Array, kind: int, closed: bool, out: Array
) -> None:
    """The response from rest; ``out`` (4, K): command, reported speed, w, d_hat from then on.

    The angle, which the law position follows to 0, is the trapezoids of w. It begins with a measurement. Not
    ``closed``, the observer alone: no command reaches the drive.
    """
    n, K, every = A.shape[0], out.shape[1], max(p["every"], 1)
    x, new, way = np.zeros(n), np.zeros(n), np.zeros(COMMANDS)
    reset(s)
    latched(p, s, 0.0, False)
    s["turned"] = 0.0
    for k in range(-QUIET * every, K):
        fresh = k % every == 0
        y = 1.0 if kind == PULSE_W and k == 0 else 0.0
        for c in range(n):
            y += C[c] * x[c]
        i = x[1] + (1.0 if kind == PULSE_I and k == 0 else 0.0)
        s["ua"][0] = flowed(p, s, i, fresh and p["told"] != 0, 1)
        observe(p, s, y, 0.0, 0.0, fresh, 1)
        if not fresh:
            between(p, s)
        latched(p, s, way[0], True)
        pulse = 1.0 if kind == PULSE_TH and k == 0 else 0.0
        s["turned"] += pulse
        ask(p, s, 0.0, 0.0, 0.0, NO_LIMIT)
        s["turned"] -= pulse
        acts = way[p["delay"]] + (1.0 if kind == PULSE_U and k == 0 else 0.0)
        load = 1.0 if kind == LOAD and k >= 0 else 0.0
        if k >= 0:
            out[0, k], out[1, k], out[2, k], out[3, k] = s["u"][1], y, x[0], s["d_hat"][0]
        for age in range(p["delay"], 0, -1):
            way[age] = way[age - 1]
        way[0] = s["u"][1] if closed else 0.0
        before = x[0]
        step(A, b, e, acts, load, x, new)
        s["turned"] += 0.5 * p["T_s"] * (before + x[0])


@jit
def respond_each(
    p: Any, s: Any, A: Array, b: Array, e: Array, C: Array, kinds: Any, closed: bool, out: Array
) -> None:
    """:func:`respond_current` for every plant and kind; A (m, n, n), out (m, kinds, 4, K)."""
    for m in range(A.shape[0]):
        for j in range(kinds.shape[0]):
            respond_current(p, s, A[m], b[m], e[m], C[m], kinds[j], closed, out[m, j])


NONE: Final = Margins(0.0, 0.0, 0.0)
"""Margins of a loop that is not stable."""


@dataclass(frozen=True, slots=True)
class Loop:
    """Whether the loop is stable, its margins, and d_hat [rad/s2] and u for noise of 1 rad/s rms in y."""

    stable: bool
    ms: float = math.inf
    margins: Margins = NONE
    d_noise: float = math.inf
    u_noise: float = math.inf


def loop_of(law: Record, shaft: Plant, T_s: float) -> Loop:
    """Run a law through a shaft's filter and judge it."""
    own, state = law.copy(), new_law_state()
    own["cogs"], own["k_w2"] = 0, 0.0  # a known load: no part of the linear loop
    own["i_max"] = np.inf
    step, pulse = np.empty((2, 4, min(max(round(RESPONSE_S / T_s), 500), 20_000)))
    with np.errstate(over="ignore", invalid="ignore"):
        for kind, out in ((LOAD, step), (PULSE_W, pulse)):
            respond_current(own[0], state[0], shaft.A, shaft.b, shaft.e, shaft.C, kind, True, out)
    if not all(_at_rest(row) for row in (step[2], pulse[0], pulse[1])):
        return Loop(False)
    u, seen, _, d = pulse
    every = max(int(law["every"][0]), 1)
    d_noise, u_noise = (math.sqrt(float((row**2).sum()) / every) for row in (d, u))
    return Loop(True, peak_of(seen[::every]), margins_of(seen[::every], every * T_s), d_noise, u_noise)


def _at_rest(response: Array) -> bool:
    """True when the last tenth is near nothing."""
    if not np.isfinite(response).all():
        return False
    size = np.abs(response)
    return bool(size[-len(size) // 10 :].max() <= RESTLESS * size.max())
