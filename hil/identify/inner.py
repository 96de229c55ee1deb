"""A drive that takes a current or a torque: what the shaft and the drive's own loop are, by output errors.

State z = (w, i, filter of the reported speed), a command u [A] that was sent ``delay`` + 1 ticks before:
    dw/dt = g i - b w - c sgn(w) - l,   tau di/dt = u - i
g = k_t / J, b = B_f / J, c = T_c / J, l = T_0 / J. The outputs are the reported speed and, where the drive
reports one, i. A segment is linear in where it starts, and its start is eliminated in closed form; where the
shaft may stick only the current is compared. As in :mod:`hil.identify.fit` nothing noisy is a regressor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.stats import t as student

from hil.control.linalg import Array
from hil.control.registry import SpeedFilter
from hil.identify.data import Samples
from hil.identify.fit import LEVEL, WIDE, covariance, whiteness
from hil.identify.model import Flags

G, TAU, B, C, L = range(5)
"""Places of the parameters: k_t / J [rad/s2/A], lag [s], B_f / J [1/s], T_c / J and T_0 / J [rad/s2]."""
COUNT: Final = 5
LOGS: Final = np.array([True, True, False, False, False])
"""Which parameters are searched for by their logarithms."""
LEAST_LAG: Final = 1e-6
RIDGE: Final = 1e-12
SEARCHED: Final = 30
"""Segments of each kind in the search for the delay."""


@dataclass(frozen=True, slots=True)
class Drive:
    """What is known of the drive: the filter of its speed, whether it reports i_q."""

    filter: SpeedFilter
    told: bool


@dataclass(frozen=True, slots=True)
class InnerFit:
    """Parameters (5,), half-widths; residuals (N, 2) of w and i, deviations (2,), outputs, p-values (2,)."""

    value: Array
    half: Array
    residual: Array
    sigma: Array
    output: Array
    white: Array


def matrices(x: Array, drive: Drive, T_s: float) -> tuple[Array, Array, Array, Array]:
    """E (n, n), G (n,) for u, S (n,) for what brakes, C (n,) of the speed's output, of a mean the angle's."""
    n = 2 + (1 if drive.filter.ticks else len(drive.filter.poles))
    A = np.zeros((n + 2, n + 2))
    A[0, 0], A[0, 1], A[0, n + 1] = -x[B], x[G], -1.0
    A[1, 1], A[1, n] = -1.0 / x[TAU], 1.0 / x[TAU]
    if drive.filter.ticks:
        A[2, 0] = 1.0
    for row, pole in enumerate(drive.filter.poles, 2):
        A[row, row - 1 if row > 2 else 0], A[row, row] = pole, -pole
    step = expm(A * T_s)
    out = np.zeros(n)
    out[n - 1 if n > 2 else 0] = 1.0
    return step[:n, :n], step[:n, n], step[:n, n + 1], out


@dataclass(frozen=True, slots=True)
class Problem:
    """Segments side by side: y (S, K, 2), u (S, K), which samples there are, which way each segment turns."""

    samples: Samples
    drive: Drive
    y: Array
    u: Array
    weight: Array
    way: Array
    unit: Array

    def parameters(self, x: Array) -> Array:
        """From the search's numbers."""
        out: Array = np.where(LOGS, np.exp(np.where(LOGS, x, 0.0)), x * self.unit)
        out[TAU] = max(out[TAU], LEAST_LAG)
        return out

    def _seen(self, z: Array, out: Array) -> Array:
        """(..., K, 2) of states (..., K, n): the speed as reported, and the current."""
        w, m = z @ out, self.drive.filter.ticks
        if m:
            before = np.zeros_like(w)
            before[..., m:] = w[..., :-m]
            w = (w - before) / (m * self.samples.T_s)
        return np.stack([w, z[..., 1]], axis=-1)

    def _responses(self, p: Array) -> tuple[Array, Array, Array]:
        """From each start (n, K, 2), to a unit command in one period (K, 2), to a unit of drag (K, 2)."""
        E, by_u, by_drag, out = matrices(p, self.drive, self.samples.T_s)
        z = np.empty((self.u.shape[1], len(E), len(E) + 2))
        z[0] = np.column_stack([np.eye(len(E)), by_u, by_drag])
        for k in range(1, len(z)):
            z[k] = E @ z[k - 1]
        seen = self._seen(z.transpose(2, 0, 1), out)
        drag = np.zeros_like(seen[-1])
        drag[1:] = np.cumsum(seen[-1], axis=0)[:-1]
        return seen[:-2], seen[-2], drag

    def output(self, x: Array, sigma: Array) -> Array:
        """(S, K, 2) from the best starts."""
        p = self.parameters(x)
        basis, pulse, drag = self._responses(p)
        K = self.u.shape[1]
        late = np.arange(K)[None, :] - np.arange(K)[:, None]  # a command of row j seen at column k
        whole: Array = (p[C] * self.way + p[L])[:, None, None] * drag
        for c in range(2):
            whole[:, :, c] += self.u @ np.where(late >= 0, pulse[late, c], 0.0)
        start = self._start(basis, whole, sigma)
        for c in range(2):
            whole[:, :, c] += start @ basis[:, :, c]
        return whole

    def _start(self, basis: Array, forced: Array, sigma: Array) -> Array:
        """(S, n): where each segment starts, by least squares."""
        n, size = len(basis), np.bincount(self.samples.segment)
        a, b = np.zeros((len(size), n, n)), np.zeros((len(size), n))
        for c in range(2):
            own = self.weight[:, :, c].any(axis=1) / sigma[c] ** 2
            first = self.drive.filter.ticks if c == 0 else 0
            sums = np.zeros((basis.shape[1] + 1, n, n))
            sums[first + 1 :] = np.cumsum(np.einsum("nk,mk->knm", *[basis[:, first:, c]] * 2), axis=0)
            a += own[:, None, None] * sums[size]
            b += (self.weight * (self.y - forced))[:, :, c] @ basis[:, :, c].T / sigma[c] ** 2
        scale = np.sqrt(np.einsum("snn->sn", a)) + 1e-30
        scaled = a / (scale[:, :, None] * scale[:, None, :]) + RIDGE * np.eye(n)
        out: Array = np.linalg.solve(scaled, (b / scale)[..., None])[..., 0] / scale
        return out

    def residual(self, x: Array, sigma: Array) -> Array:
        """(N, 2) over ``sigma``, 0 where nothing is compared; in the order of the samples."""
        found = (self.y - self.output(x, sigma)) * self.weight / sigma
        out: Array = np.nan_to_num(found[self.there], nan=1e6, posinf=1e6, neginf=-1e6)
        return out

    @property
    def there(self) -> Flags:
        """(S, K): the samples that there are, in their order."""
        size = np.bincount(self.samples.segment)
        out: Flags = np.arange(self.u.shape[1]) < size[:, None]
        return out

    def jacobian(self, x: Array, sigma: Array) -> Array:
        """(N, 2, 5), starts eliminated, by differences."""
        here, out = self.residual(x, sigma), np.empty((len(self.samples), 2, COUNT))
        for j in range(COUNT):
            step = np.zeros(COUNT)
            step[j] = 1e-6
            out[:, :, j] = (self.residual(x + step, sigma) - here) / 1e-6
        return out

    @property
    def used(self) -> int:
        """Degrees of freedom: samples that count, less starts and parameters."""
        states = 2 + (1 if self.drive.filter.ticks else len(self.drive.filter.poles))
        return int(self.weight.sum()) - states * len(self.u) - COUNT


def problem(samples: Samples, drive: Drive, first: Array) -> Problem:
    """The segments side by side. What runs in one direction alone can't tell a load from friction."""
    seg, first_rows = samples.segment, np.flatnonzero(samples.begins)
    size = np.bincount(seg)
    S, K = len(size), int(size.max())
    place = np.arange(len(samples)) - first_rows[seg]
    y, u, weight = np.zeros((S, K, 2)), np.zeros((S, K)), np.zeros((S, K, 2))
    y[seg, place], u[seg, place] = samples.y[:, :2], samples.u[:, 0]
    weight[seg, place, 0] = samples.free & (place >= drive.filter.ticks)
    weight[seg, place, 1] = drive.told
    u[:, 0] = 0.0  # before the first sample
    way = np.sign(samples.y[first_rows, 0])
    most = float(np.abs(samples.u[:, 0]).max()) * first[G]
    fastest = max(float(np.abs(samples.y[:, 0]).max()), 1e-3)
    return Problem(samples, drive, y, u, weight, way, np.array([1.0, 1.0, most / fastest, most, most]))


def fit(samples: Samples, drive: Drive, first: Array, sigma: Array) -> InnerFit:
    """The parameters of most likelihood from ``first``; ``sigma`` (2,): deviations to begin with."""
    one, x, sigma, wide = searched(samples, drive, first, sigma, 3, 30)
    return _judged(one, x, sigma, wide)


def searched(
    samples: Samples, drive: Drive, first: Array, sigma: Array, rounds: int, most: int
) -> tuple[Problem, Array, Array, Array]:
    """The search itself, of so many rounds of at most so many steps: problem, numbers, deviations, bounds."""
    one = problem(samples, drive, first)
    way = one.way[samples.free[samples.begins]]
    wide = np.array([WIDE, WIDE, 1.0, 1.0, 1.0 if len(set(way)) > 1 else 1e-9])
    start = np.where(LOGS, np.log(np.where(LOGS, first, 1.0)), first / one.unit)
    x = start
    for _ in range(rounds):
        x = _solved(one, x, start, sigma, wide, most)
        before, sigma = sigma, _spread(one, x, sigma)
        if np.abs(before / sigma - 1.0).max() < 0.05:
            break
    return one, x, sigma, wide


def _solved(one: Problem, x: Array, start: Array, sigma: Array, wide: Array, most: int) -> Array:
    def cost(x: Array) -> Array:
        return np.append(one.residual(x, sigma).ravel(), (x - start) / wide)

    def slope(x: Array) -> Array:
        out: Array = np.vstack([one.jacobian(x, sigma).reshape(-1, COUNT), np.diag(1.0 / wide)])
        return out

    scale = np.minimum(wide, 1.0)
    found: Array = least_squares(
        cost, x, slope, x_scale=scale, max_nfev=most, xtol=1e-7, ftol=1e-7, gtol=None
    ).x
    return found


def _spread(one: Problem, x: Array, sigma: Array) -> Array:
    """Deviations of the two outputs; that of one that is not compared stays."""
    counts = one.weight.sum(axis=(0, 1))
    rms = np.sqrt((one.residual(x, sigma) ** 2).sum(axis=0) / np.maximum(counts, 1.0)) * sigma
    floor = 1e-7 * np.abs(one.y).max(axis=(0, 1)) + 1e-12
    out: Array = np.where(counts > 0, np.maximum(rms, floor), sigma)
    return out


def _judged(one: Problem, x: Array, sigma: Array, wide: Array) -> InnerFit:
    """Covariance, intervals, whiteness at the optimum."""
    r, jacobian = one.residual(x, sigma), one.jacobian(x, sigma)
    cov, freedom = covariance(jacobian, r, one.samples, 1.0 / wide**2, one.used)
    value = one.parameters(x)
    scale = np.where(LOGS, value, one.unit)
    half = float(student.ppf(0.5 + LEVEL / 2, freedom)) * np.sqrt(np.diag(cov)) * scale
    residual = r * sigma
    spread = _spread(one, x, sigma)
    output = one.samples.y[:, :2] - residual
    return InnerFit(value, half, residual, spread, output, whiteness(residual, one.samples))


def residual_of(samples: Samples, drive: Drive, found: InnerFit) -> Array:
    """Residuals (N, 2) of samples that a fit was not made of."""
    one = problem(samples, drive, found.value)
    x = np.where(LOGS, np.log(np.where(LOGS, found.value, 1.0)), found.value / one.unit)
    return one.residual(x, found.sigma) * found.sigma


def at_delay(samples: Samples, delay: int) -> Samples:
    """The samples under the commands of so many ticks before, from those of all delays."""
    return replace(samples, u=samples.u[:, delay : delay + 1])


def best_delay(samples: Samples, drive: Drive, first: Array, sigma: Array) -> tuple[int, Array]:
    """The delay [ticks] that fits best, and for each what is left: the geometric mean of the deviations."""
    left = []
    few = evenly(samples, SEARCHED)
    for delay in range(samples.u.shape[1]):
        one, x, spread, _ = searched(at_delay(few, delay), drive, first, sigma, 1, 8)
        first = one.parameters(x)
        left.append(float(np.exp(np.log(spread[: 2 if drive.told else 1]).mean())))
    return int(np.argmin(left)), np.array(left)


def evenly(samples: Samples, most: int) -> Samples:
    """At most so many segments that turn, and as many that do not, evenly spread."""
    turns = samples.free[samples.begins]
    keep = np.zeros(len(turns), bool)
    for kind in (turns, ~turns):
        rows = np.flatnonzero(kind)
        keep[rows[:: max(1, -(-len(rows) // most))]] = True
    return samples.segments(keep)
