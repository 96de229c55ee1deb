"""What `hil design --verify` holds a run against: dip and noise of the command with each plant.

A frame that resolves i_d coarsely is no linear part of the loop. For a search its linearisation
(:mod:`hil.tuning.rounding`) is near enough, but that knows one state: where the noise now stays within a step
of the frame and now swings out of it, there are two. So here the loop runs under noise, and the frame rounds.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.tuning.loop import Record, run_noisy
from hil.tuning.measure import (
    RINGING_S,
    UNQUIET,
    Bench,
    Elastic,
    free,
    loops,
    noise,
    quiet,
    ringing,
    state,
    turning_of,
)

PART_S: Final = 0.5
"""Length of what a run's noise is read from; slower changes are none, as in :func:`bench.seen_in`."""
PARTS: Final = 256
SEED: Final = 20261128


def foretold(law: Record, bench: Bench) -> list[tuple[float, float]]:
    """Dip [rad/s] and noise of the command [bench.unit] with each plant, on its elastic shaft if it has one.

    Infinite where the loop is unstable.
    """
    motors = (bench.motor, *bench.corners())
    if not bench.shafts:
        dips = [loop.dip for loop in loops(law, bench, bench.plants())]
        return [(dip, _noise(law, bench, motor, None)) for dip, motor in zip(dips, motors, strict=True)]
    each = list(zip(motors, bench.turns(), strict=True))
    calm = quiet(law, bench, each, RINGING_S, (bench.w_0,))
    return [_ringing(law, bench, *one) if rests else UNQUIET for one, rests in zip(each, calm, strict=True)]


def _ringing(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None) -> tuple[float, float]:
    """Of :func:`foretold`, where the vibration outlasts the response that a dip is read from."""
    return float(np.abs(ringing(law, bench, motor, at)).max()), _noise(law, bench, motor, at)


def _noise(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None) -> float:
    """Noise of the command, rms; that of a drive by voltage through the frame's rounding."""
    at = at or bench.known
    ticks = round(RINGING_S / bench.T_s) if at else None
    linear = noise(law, bench, motor, at, ticks)[0]
    if bench.inner is not None or not bench.i_d_lsb or not np.isfinite(linear):
        return linear
    return rounded_noise(law, bench, motor, at)


def rounded_noise(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None) -> float:
    """The same from a run of PARTS parts under Gaussian noise at the bench's speed."""
    length = round(PART_S / bench.T_s)
    sigma = np.array([bench.w_noise, bench.i_noise, bench.i_noise, bench.u_noise, bench.u_noise])
    draws = np.random.default_rng(SEED).standard_normal((round(RINGING_S / bench.T_s) + PARTS * length, 5))
    out = np.empty(PARTS * length)
    A, B = turning_of(motor, bench.T_s, bench.w_0, at)
    run_noisy(free(law)[0], state()[0], A, B, bench.w_0, draws * sigma, bench.i_d_lsb, out)
    return float(np.sqrt(np.mean(_about_lines(out.reshape(PARTS, length)) ** 2)))


def _about_lines(rows: Array) -> Array:
    """Each row less the line that fits it best."""
    t = np.linspace(-1.0, 1.0, rows.shape[1])
    level = rows - rows.mean(axis=1, keepdims=True)
    about: Array = level - np.outer(level @ t, t) / (t @ t)
    return about
