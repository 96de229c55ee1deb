"""`hil identify --steps cogging`: the load torque over the shaft's angle, from the observer's own estimate.

A run at slow constant speed, some laps forward and some back, by the configuration's own law. What the
observer says at a tick is its window over past loads, so the model is that of a window over past angles:

    -J d_hat_k = sum_j g_j T_{k-j},   T = c +- f + sum_n a_n <cos n theta> + b_n <sin n theta>

<> is the mean of both ends of tick k, as the law's kernel takes it, and g the window's impulse response: its
lag and what it takes off a fast harmonic are known, at any speed and acceleration. c +- f is what does not
depend on the angle, one number a direction. Intervals come from laps that scatter, each a sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from hil.config.design import inner_loop, law_spec
from hil.config.tables import RunConfig
from hil.control.cogging import ORDERS, SLOW, Harmonics, basis
from hil.control.law import design_law, law_window
from hil.control.linalg import Array
from hil.control.observer import ADAPTIVE, impulse_response, response_length
from hil.errors import HilError
from hil.signals import DriveState, RxFlag, TickArray

MOST: Final = 128
"""Highest order that is looked for."""
SETTLE_S: Final = 0.3
"""After a change of the reference the law may still move the shaft."""
LEAST_LAPS: Final = 4
"""Whole laps, both directions together, from which on their scatter says something."""
PLAIN: Final = 3.0
"""Amplitude over its half-width from which on a harmonic is taken: of MOST none comes there by chance."""
SHARE: Final = 0.01
"""Smallest share of the largest amplitude that is worth a harmonic."""
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rows:
    """The regression of one run: y (N,) [N m], X (N, 2 + 2 MOST), lap (N,), each direction its own."""

    y: Array
    X: Array
    lap: npt.NDArray[np.int64]
    most: int
    """Highest order that is slow enough in a period to be told."""


@dataclass(slots=True)
class Cogging:
    """What was learned: harmonics with the half-width [N m] of each coefficient's 95 % interval.

    ``residual``: rms of what no harmonic explains; ``before``: rms of the estimate's part by the angle.
    """

    known: Harmonics = field(default_factory=lambda: Harmonics((), (), ()))
    half: tuple[float, ...] = ()
    residual: float = math.nan
    before: float = math.nan
    laps: int = 0
    friction: float = math.nan
    speed: float = math.nan
    """Mean |w| of the laps [rad/s]."""

    @property
    def amplitudes(self) -> Array:
        """Of each harmonic [N m]."""
        return np.hypot(self.known.a, self.known.b)


def response(config: RunConfig, told: bool = True) -> Array:
    """g (n,): what d_hat_w is of the loads of the past ticks, the newest first. Raises HilError.

    Where the observer knows a filter of the speed, its innovation is itself a mean over some ticks: that of
    the filter's response to a load, by the weights of the samples.
    """
    inner = inner_loop(config, told)
    if inner is not None and inner.every > 1:
        raise HilError("feedback.period_ms: cogging is learned from an angle in each tick; leave it out")
    spec, T_s = law_spec(config, told), 1.0 / config.loop.rate_hz
    window = law_window(spec, T_s)
    if window.form.size and window.form[0] == ADAPTIVE:
        raise HilError(
            "observer.speed.kind adaptive: its window has no fixed length, so an estimate belongs to no "
            "angle; learn with another kind"
        )
    g = impulse_response(window, response_length(window))[:, 0]
    law = design_law(spec, T_s)[0]
    if inner is not None and law["order"]:
        n = int(law["order"]) + 1
        effect = np.diff(np.r_[0.0, law["gap_y"][:n]])
        own: Array = np.convolve(law["v_y"][:n], effect)[:n]
        g = np.convolve(g, own)
    return g


def filtered(g: Array, x: Array) -> Array:
    """sum_j g_j x_{k-j} of each column of x (N, m); what is before the first row counts as 0."""
    size = 1 << int(len(g) + len(x) - 1).bit_length()
    spectrum = np.fft.rfft(x, size, axis=0) * np.fft.rfft(g, size)[:, None]
    out: Array = np.fft.irfft(spectrum, size, axis=0)[: len(x)]
    return out


def usable(ticks: TickArray, T_s: float, length: int) -> tuple[Flags, Flags]:
    """(whole, good): ticks with a measured angle and a known past; those whose window lies among such.

    Good ones besides have a reference that has stood for a while, and no limit was at work.
    """
    fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
    on = (ticks["drive_state"] == int(DriveState.OPERATION_ENABLED)) & (
        ticks["state"] == int(DriveState.OPERATION_ENABLED)
    )
    whole = fresh & on & (ticks["gap"] == 1) & np.isfinite(ticks["theta"]) & np.isfinite(ticks["w"])
    steady = np.r_[False, np.diff(ticks["w_ref"]) == 0.0] & (ticks["limited"] == 0)
    since = _since(whole)
    settled = _since(steady) > round(SETTLE_S / T_s)
    return whole, (since > length) & settled & (ticks["w_ref"] != 0.0)


def _since(flags: Flags) -> npt.NDArray[np.int64]:
    """For how many ticks in a row the flag has held."""
    count = np.arange(1, len(flags) + 1)
    out: npt.NDArray[np.int64] = count - np.maximum.accumulate(np.where(flags, 0, count))
    return out


def rows_of(ticks: TickArray, law: Any, g: Array, T_s: float) -> Rows:
    """The regression of a run; what a table has already known is added to the estimate again."""
    whole, good = usable(ticks, T_s, len(g) + 1)
    theta = np.unwrap(np.where(whole, ticks["theta"], 0.0))
    ends = basis(theta, range(1, MOST + 1))
    mean = np.vstack([ends[:1], 0.5 * (ends[1:] + ends[:-1])]) * whole[:, None]
    windowed = filtered(g, mean)
    y = -float(law["J"]) * ticks["d_hat_w"]
    if law["cogs"]:
        places = [2 * (int(n) - 1) for n in law["cog_order"][: law["cogs"]]]
        known = np.ravel([law["cog_a"][: law["cogs"]], law["cog_b"][: law["cogs"]]], "F")
        y = y + windowed[:, [p + i for p in places for i in (0, 1)]] @ known
    forward = ticks["w_ref"] > 0.0
    X = np.column_stack([forward, ~forward, windowed])
    turn = np.floor(theta / (2.0 * math.pi)).astype(np.int64)
    lap = 2 * turn + forward
    good &= _whole_laps(lap, good)
    fastest = float(np.abs(ticks["w"][good]).max()) if good.any() else 0.0
    most = int(min(MOST, SLOW / (T_s * max(fastest, 1e-9))))
    return Rows(y[good], X[good], lap[good], most)


def _whole_laps(lap: npt.NDArray[np.int64], good: Flags) -> Flags:
    """True in laps of which nearly all ticks are good: half a lap would tell one harmonic for another."""
    keep = np.zeros(len(lap), bool)
    for one in np.unique(lap[good]):
        here = np.flatnonzero((lap == one) & good)
        keep[here] = len(here) > 0.5 * np.median([np.sum((lap == n) & good) for n in np.unique(lap[good])])
    return keep


def learned(parts: Sequence[Rows]) -> Cogging:
    """Harmonics out of the rows of runs. Raises HilError when there are too few laps."""
    y, X = np.concatenate([part.y for part in parts]), np.vstack([part.X for part in parts])
    laps = np.concatenate([part.lap + 10**6 * j for j, part in enumerate(parts)])
    count = len(np.unique(laps))
    if count < LEAST_LAPS:
        raise HilError(
            f"{count} whole laps at a steady speed with a reported angle; at least {LEAST_LAPS} tell a "
            "harmonic from a load that wanders: run longer, or name drive.signals.angle"
        )
    directions = [j for j in (0, 1) if X[:, j].any()]
    wanted = np.arange(1, min(part.most for part in parts) + 1)
    if len(wanted) == 0:
        raise HilError("the shaft turns too fast for any harmonic to be told from its samples; run slower")
    beta, half, _ = _fit(y, X[:, [*directions, *range(2, 2 + 2 * len(wanted))]], laps, len(directions))
    size, error = np.hypot(*beta.reshape(-1, 2).T), half.reshape(-1, 2).max(axis=1)
    told = (size > PLAIN * error) & (size > SHARE * size.max())
    most = sorted(wanted[told], key=lambda n: -size[n - 1])[:ORDERS]
    orders = sorted(int(n) for n in most)
    columns = [2 * n + i for n in orders for i in (0, 1)]
    beta, half, constant = _fit(y, X[:, [*directions, *columns]], laps, len(directions))
    rest = y - X[:, directions] @ constant
    found = Cogging(
        Harmonics(tuple(orders), tuple(beta[::2]), tuple(beta[1::2])), tuple(half.reshape(-1, 2).max(axis=1))
    )
    found.residual = float(np.sqrt(np.mean((rest - X[:, columns] @ beta) ** 2)))
    found.before, found.laps = float(np.sqrt(np.mean(rest**2))), count
    if len(directions) == 2:
        found.friction = 0.5 * float(constant[0] - constant[1])
    return found


def _fit(y: Array, X: Array, laps: Any, constants: int) -> tuple[Array, Array, Array]:
    """Least squares; (coefficients, half of their 95 % intervals, constants), by the scatter of whole laps.

    cov = (X'X)^-1 (sum_laps X_l' r_l r_l' X_l) (X'X)^-1 B / (B - 1), Student's t of B - 1 for B laps.
    """
    inverse = np.linalg.inv(X.T @ X)
    beta = inverse @ (X.T @ y)
    rest = X * (y - X @ beta)[:, None]
    scores = np.array([rest[laps == lap].sum(axis=0) for lap in np.unique(laps)])
    moved = scores @ inverse
    B = len(scores)
    half = stats.t.ppf(0.975, B - 1) * np.sqrt((moved**2).sum(axis=0) * B / (B - 1))
    return beta[constants:], half[constants:], beta[:constants]
