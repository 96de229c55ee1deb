"""From logged ticks to segments that a predictor can run through: no gap, gates on, not limited."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from hil.control.linalg import Array
from hil.identify.model import Flags
from hil.signals import DriveState, RxFlag, TickArray

LONGEST: Final = 200
"""Samples of a segment: long enough for the slowest electrical time constant, short for a wandering load."""
SHORTEST: Final = 8


@dataclass(frozen=True, slots=True)
class Samples:
    """y (N, 3): w, i_q, i_d at the ends of periods; u (N, 2): (u_q, u_d) applied over the past period.

    ``begins``: a sample whose past period is unknown; ``free``: the shaft turns one way and does not stick;
    t [s] is the run's time, ``run`` the number of its log.
    """

    T_s: float
    t: Array
    y: Array
    u: Array
    begins: Flags
    free: Flags
    run: Array

    def __len__(self) -> int:
        return len(self.y)

    @property
    def segment(self) -> npt.NDArray[np.int64]:
        """Number of each sample's segment."""
        out: npt.NDArray[np.int64] = np.cumsum(self.begins) - 1
        return out

    def rows(self, keep: Flags) -> Samples:
        """Those samples; the segments stay as they are, so only whole ones may be left out."""
        names = [f.name for f in fields(self) if f.name != "T_s"]
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def segments(self, keep: Flags) -> Samples:
        """Those segments."""
        return self.rows(keep[self.segment])

    def where(self, keep: Flags) -> Samples:
        """The samples that are kept; one whose predecessor is not begins a segment."""
        begins = self.begins.copy()
        begins[1:] |= ~keep[:-1]
        return replace(self, begins=begins).rows(keep).tidy()

    def tidy(self) -> Samples:
        """Long segments cut, too short ones left out."""
        if len(self) == 0:
            return self
        begins = self.begins.copy()
        begins[0] = True
        first = np.flatnonzero(begins)
        length = np.repeat(np.diff([*first, len(begins)]), np.diff([*first, len(begins)]))
        since = np.arange(len(begins)) - first[np.cumsum(begins) - 1]
        begins |= (since % LONGEST == 0) & (length - since >= SHORTEST)
        size = np.diff([*np.flatnonzero(begins), len(begins)])
        return replace(self, begins=begins).rows(np.repeat(size >= SHORTEST, size))

    def with_free(self, free: Flags) -> Samples:
        """Cut where the shaft begins to turn or comes to rest."""
        begins = self.begins.copy()
        begins[1:] |= free[1:] != free[:-1]
        return replace(self, begins=begins, free=free).tidy()


def joined(parts: list[Samples]) -> Samples:
    """Several runs as one. All have the same period."""
    numbered = [replace(part, run=np.full(len(part), float(j))) for j, part in enumerate(parts)]
    names = [f.name for f in fields(Samples) if f.name != "T_s"]
    return Samples(parts[0].T_s, *(np.concatenate([getattr(p, name) for p in numbered]) for name in names))


def usable(ticks: TickArray) -> tuple[Flags, Flags]:
    """Ticks with a measurement while the gates are on, and those whose past period is known too."""
    fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
    on = ticks["drive_state"] == int(DriveState.OPERATION_ENABLED)
    good: Flags = fresh & on & np.isfinite(ticks["w"]) & np.isfinite(ticks["i_q"]) & np.isfinite(ticks["i_d"])
    known: Flags = good & (ticks["gap"] == 1)
    known[1:] &= good[:-1] & (ticks["limited"][:-1] == 0)
    known[:1] = False
    return good, known


def samples_of(ticks: TickArray, T_s: float, delay: int | None = None) -> Samples:
    """The samples of a run; ``delay``: take what was sent so many ticks before it acts, not the echoed."""
    good, known = usable(ticks)
    u = np.stack([ticks["ua_q"], ticks["ua_d"]], axis=1)
    if delay is not None:
        u = np.roll(np.stack([ticks["u_q"], ticks["u_d"]], axis=1), delay + 1, axis=0)
        known[: delay + 1] = False
    y = np.stack([ticks["w"], ticks["i_q"], ticks["i_d"]], axis=1)
    t = (ticks["t_ns"] - ticks["t_ns"][:1]) * 1e-9
    none = np.zeros(len(ticks))
    return Samples(T_s, t, y, u, ~known, none > 0, none).where(good)


def turning(samples: Samples) -> Flags:
    """A shaft that turns faster than where it sticks or is in the Stribeck range, as far as one can say."""
    speed = np.abs(samples.y[:, 0])
    noise = float(np.median(np.abs(np.diff(samples.y[:, 0])))) if len(samples) > 1 else 0.0
    slow = 0.12 * float(np.quantile(speed, 0.98)) if len(speed) else 0.0
    fast = speed > max(slow, 60.0 * noise, 1e-9)
    return fast if fast.sum() >= 50 else np.zeros(len(samples), bool)
