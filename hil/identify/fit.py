"""Maximum likelihood over the exact sampled model: output errors, starts of segments eliminated, error bars.

Voltages are known and speed and currents are measured with noise, so the error is taken of simulated against
measured outputs: what is noisy is no regressor, and nothing is biased as in ordinary least squares (L. Ljung,
"System Identification", 2nd ed., sections 7.3 and 10.6). The covariance is the larger of sigma^2 (J'J)^-1 and
its form for errors that correlate within a segment (H. White, "Asymptotic Theory for Econometricians", 1984).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2
from scipy.stats import t as student

from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.identify.data import Samples
from hil.identify.model import (
    B_F,
    COULOMB,
    DAMPING,
    LOAD,
    N_P,
    PSI_F,
    RATIO,
    RESONANCE,
    RIGID,
    SATURATION,
    Flags,
    J,
    outputs,
    responses,
)

WIDE: Final = 3.0
"""Deviation of ln(parameter) before the data: a factor of 20; keeps what they do not tell finite."""
LEVEL: Final = 0.95
COUNT: Final = LOAD + 1
MASSES: Final = (RESONANCE, DAMPING, RATIO)
LINEAR: Final = (PSI_F, B_F, COULOMB, LOAD)
"""Parameters that are not searched for by their logarithms."""
SURE: Final = 6.0
"""Deviations by which L_q must seem to saturate before that is a parameter."""
BENDS: Final = 0.02
"""Share by which it must seem to fall up to the largest current for that."""


@dataclass(frozen=True, slots=True)
class Shaft:
    """What starts the search besides the motor: Coulomb friction and constant load [N m].

    ``saturation`` [1/A2]: that of L_q (:mod:`hil.identify.model`); 0: there is none. ``masses``: of a soft
    coupling its resonance [rad/s], damping ratio and J_l / J_m; empty: the shaft is rigid.
    """

    coulomb: float = 0.0
    load: float = 0.0
    saturation: float = 0.0
    masses: tuple[float, ...] = ()

    @property
    def places(self) -> tuple[int, ...]:
        """Places in the model's vector of what is searched for."""
        bends = (SATURATION,) if self.saturation > 0.0 else ()
        return (*range(COUNT), *bends, *(MASSES if self.masses else ()))


@dataclass(frozen=True, slots=True)
class Fit:
    """Parameters (8,) at their ``places`` of the model, 95 % half-widths; residuals (N, 3), deviations (3,).

    With saturation one more, on a soft coupling three. ``told``: share of what was open before that the data
    closed; 0 nothing, 1 all. ``white``: p-values of the three residuals' whiteness. ``cov``: of the search's
    numbers, times the squared quantile that makes half-widths of its roots.
    """

    value: Array
    half: Array
    told: Array
    residual: Array
    sigma: Array
    output: Array
    white: Array
    cov: Array
    places: tuple[int, ...]

    @property
    def saturation(self) -> float:
        """That of L_q [1/A2]; 0: none."""
        return float(self.value[SATURATION]) if SATURATION in self.places else 0.0

    @property
    def masses(self) -> tuple[float, ...]:
        """Of a soft coupling resonance [rad/s], damping ratio and J_l / J_m; empty for a rigid shaft."""
        return tuple(float(x) for x in self.value[-len(MASSES) :]) if RATIO in self.places else ()

    @property
    def shaft(self) -> Shaft:
        """Friction, load, saturation and masses."""
        return Shaft(float(self.value[COULOMB]), float(self.value[LOAD]), self.saturation, self.masses)


@dataclass(frozen=True, slots=True)
class Problem:
    """Samples, pole pairs and scales: from the search's numbers x to outputs and weighted residuals.

    ``places``: where the numbers stand in the model's vector.
    """

    samples: Samples
    n_p: float
    start: Array
    unit: Array
    wide: Array
    places: tuple[int, ...]

    @property
    def states(self) -> int:
        """Of the model: two more on a soft coupling."""
        return RIGID + (2 if RATIO in self.places else 0)

    @property
    def logs(self) -> Flags:
        """Which numbers are logarithms."""
        return ~np.isin(self.places, LINEAR)

    def motor(self, x: Array) -> Array:
        """The model's vector."""
        p = np.zeros(RATIO + 1)
        p[list(self.places)] = np.where(self.logs, np.exp(np.where(self.logs, x, 0.0)), x * self.unit)
        p[N_P] = self.n_p
        return p

    def output(self, x: Array, weight: Array) -> Array:
        """w, i_q, i_d (N, 3) from the best starts."""
        s = self.samples
        z, out = np.empty((len(s), self.states + 1, self.states)), np.empty((len(s), 3))
        responses(self.motor(x), s.T_s, s.y, s.u, s.begins, s.free, z)
        outputs(s.y, z, s.begins, weight, out)
        return out

    def residual(self, x: Array, weight: Array) -> Array:
        """(N, 3), weighted."""
        found = (self.samples.y - self.output(x, weight)) * weight
        return np.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)

    def jacobian(self, x: Array, weight: Array) -> Array:
        """(N, 3, len(x)), starts eliminated, by differences."""
        here, out = self.residual(x, weight), np.empty((len(self.samples), 3, len(x)))
        for j in range(len(x)):
            step = np.zeros(len(x))
            step[j] = 1e-6 * min(self.wide[j], 1.0)
            out[:, :, j] = (self.residual(x + step, weight) - here) / step[j]
        return out

    @property
    def used(self) -> int:
        """Degrees of freedom: outputs that count, less starts and parameters."""
        s = self.samples
        return 2 * len(s) + int(s.free.sum()) - self.states * int(s.begins.sum()) - len(self.start)

    def solve(self, x: Array, weight: Array) -> Array:
        """Least squares, with what was known before as one more residual each."""

        def cost(x: Array) -> Array:
            return np.append(self.residual(x, weight), (x - self.start) / self.wide)

        def slope(x: Array) -> Array:
            J = self.jacobian(x, weight).reshape(-1, len(x))
            return np.concatenate([J, np.diag(1.0 / self.wide)])

        scale = np.minimum(self.wide, 1.0)
        found: Array = least_squares(
            cost, x, slope, x_scale=scale, max_nfev=30, xtol=1e-7, ftol=1e-7, gtol=None
        ).x
        return found


def problem(samples: Samples, motor: MotorModel, shaft: Shaft) -> Problem:
    """The search around a motor. What runs in one direction alone can't tell a load from friction.

    Where no shaft turns freely J and B_f stay: there they bend the speed within a period alone, as L_q does.
    """
    way = np.sign(samples.y[samples.free, 0])
    one_way = len(way) == 0 or bool((way == way[0]).all())
    most = abs(motor.k_t) * max(float(np.abs(samples.y[:, 1]).max()), 1e-9) + shaft.coulomb
    fastest = max(float(np.abs(samples.y[:, 0]).max()), 1e-3)
    places = shaft.places
    unit = np.ones(len(places))
    unit[PSI_F], unit[B_F], unit[COULOMB], unit[LOAD] = abs(motor.psi_f), most / fastest, most, most
    first = np.array([motor.R_s, motor.L_d, motor.L_q, motor.psi_f, motor.J, motor.B_f, shaft.coulomb, 0.0])
    wide = np.array([WIDE, WIDE, WIDE, WIDE, WIDE, 1.0, 1.0, 1e-9 if one_way else 1.0])
    if len(way) == 0:
        wide[J] = wide[B_F] = 1e-9
    first[LOAD] = 0.0 if one_way else shaft.load
    more = [shaft.saturation] if shaft.saturation > 0.0 else []
    first = np.append(first, [*more, *shaft.masses])
    wide = np.append(wide, np.full(len(places) - COUNT, WIDE))
    logs = ~np.isin(places, LINEAR)
    start = np.where(logs, np.log(np.where(logs, first, 1.0)), first / unit)
    return Problem(samples, float(motor.n_p), start, unit, wide, places)


def fit(samples: Samples, motor: MotorModel, shaft: Shaft, sigma: Array | None = None) -> Fit:
    """The parameters of most likelihood; the outputs' deviations are found too, or begin at ``sigma``."""
    one = problem(samples, motor, shaft)
    x, weight = one.start, 1.0 / (first_sigma(samples) if sigma is None else sigma)
    for _ in range(3):
        x = one.solve(x, weight)
        spread = np.sqrt(np.mean((one.residual(x, weight) / weight) ** 2, axis=0))
        spread[0] *= np.sqrt(len(samples) / max(int(samples.free.sum()), 1))
        before, weight = weight, 1.0 / np.maximum(spread, _floor(samples))
        if np.abs(before / weight - 1.0).max() < 0.05:
            break
    return _judged(one, x, weight)


def _floor(samples: Samples) -> Array:
    """Deviations below which nothing is believed: noiseless outputs would get all the weight."""
    out: Array = 1e-7 * np.abs(samples.y).max(axis=0) + 1e-12
    return out


def first_sigma(samples: Samples) -> Array:
    """Noise by the second difference's median."""
    jump = np.median(np.abs(np.diff(samples.y, 2, axis=0)), axis=0) / (0.6745 * np.sqrt(6.0))
    out: Array = np.maximum(jump, 1e-4 * np.abs(samples.y).max(axis=0) + 1e-9)
    return out


def _judged(one: Problem, x: Array, weight: Array) -> Fit:
    """Covariance, intervals, whiteness at the optimum."""
    r, jacobian = one.residual(x, weight), one.jacobian(x, weight)
    cov, freedom = covariance(jacobian, r, one.samples, 1.0 / one.wide**2, one.used)
    deviation = np.sqrt(np.diag(cov))
    value = one.motor(x)[list(one.places)]
    quantile = float(student.ppf(0.5 + LEVEL / 2, freedom))
    half = quantile * deviation * np.where(one.logs, value, one.unit)
    residual = r / weight
    free = one.samples.free
    sigma = np.sqrt(np.mean(residual**2, axis=0))
    sigma[0] = np.sqrt(np.mean(residual[free, 0] ** 2)) if free.any() else np.nan
    told = 1.0 - np.minimum(deviation / one.wide, 1.0)
    out, white = one.samples.y - residual, whiteness(residual, one.samples)
    return Fit(value, half, told, residual, sigma, out, white, quantile**2 * cov, one.places)


def covariance(J: Array, r: Array, samples: Samples, prior: Array, used: int) -> tuple[Array, float]:
    """Covariance (n, n) and degrees of freedom; J (N, m, n), r (N, m), both weighted; ``used``: outputs less
    starts and parameters."""
    flat = J.reshape(-1, J.shape[2])
    s2 = float((r * r).sum()) / max(used, 1)
    bread = np.linalg.inv(flat.T @ flat / max(s2, 1e-30) + np.diag(prior))
    seg = samples.segment
    scores = np.zeros((int(seg[-1]) + 1, J.shape[2]))
    np.add.at(scores, seg, np.einsum("kmn,km->kn", J, r) / max(s2, 1e-30))
    groups = len(scores)
    robust = bread @ (scores.T @ scores * groups / max(groups - 1, 1)) @ bread
    grow = np.sqrt(np.maximum(1.0, np.diag(robust) / np.diag(bread)))
    return bread * np.outer(grow, grow), float(max(groups - 1, 1))


def whiteness(residual: Array, samples: Samples, lags: int = 20) -> Array:
    """p-values (m,) of Ljung and Box over residuals (N, m) within segments: small when they correlate."""
    out = np.ones(residual.shape[1])
    seg = samples.segment
    for c, r in enumerate(residual.T):
        spread, n = float(r @ r), len(r)
        if spread == 0.0 or n <= lags:
            continue
        rho = [float(np.sum((r[j:] * r[:-j])[seg[j:] == seg[:-j]])) / spread for j in range(1, lags + 1)]
        out[c] = chi2.sf(n * (n + 2) * sum(p * p / (n - j) for j, p in enumerate(rho, 1)), lags)
    return out


def bending(samples: Samples, motor: MotorModel, shaft: Shaft, sigma: Array) -> float:
    """Saturation of L_q [1/A2] that the residuals of a fit without it ask for, in one step; 0: none.

    ``motor`` and ``shaft`` are the fit's, ``sigma`` (3,) its deviations. A score test: the slope towards
    saturation is one column more of the Jacobian, whose coefficient must be SURE of its deviations off 0.
    """
    one, weight = problem(samples, motor, shaft), 1.0 / np.maximum(np.nan_to_num(sigma, nan=1.0), 1e-12)
    peak = float(np.abs(samples.y[:, 1]).max())
    r, J = one.residual(one.start, weight), one.jacobian(one.start, weight)
    trial = problem(samples, motor, replace(shaft, saturation=1e-4 / peak**2))
    slope = (trial.residual(trial.start, weight) - r) / 1e-4
    whole = np.concatenate([J, slope[:, :, None]], axis=2)
    prior = np.append(1.0 / one.wide**2, 0.0)
    flat, s2 = whole.reshape(-1, whole.shape[2]), float((r * r).sum()) / max(one.used - 1, 1)
    inverse = np.linalg.inv(flat.T @ flat / s2 + np.diag(prior))
    step, deviation = -float((inverse @ flat.T @ r.reshape(-1))[-1]) / s2, float(np.sqrt(inverse[-1, -1]))
    return step / peak**2 if step > max(SURE * deviation, BENDS) else 0.0


def frozen(samples: Samples, motor: MotorModel, sigma: Array, saturation: float = 0.0) -> Array:
    """Residuals over ``sigma`` (N, 3) of a motor that is given, the speed as measured throughout."""
    as_measured = replace(samples, free=np.zeros(len(samples), bool))
    one = problem(as_measured, motor, Shaft(saturation=saturation))
    return one.residual(one.start, 1.0 / np.nan_to_num(sigma, nan=1.0))
