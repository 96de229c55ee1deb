"""Dip and recovery where nobody tells the true load: deviations from a reference that rests.

On a real drive no frame says when the load stepped. What a log has is the reference, the speed, and the load
that the observer estimates: an excursion is a time in which |w - w*| leaves the band although the reference
has rested for a while; how far the estimate moved says what load it was.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from hil.report.curves import F8, since
from hil.report.metrics import RECOVERED_RAD_S
from hil.report.segments import largest
from hil.signals import DriveState, TickArray

SETTLED_S: Final = 0.3
"""A reference, or an operation, that is younger may still be settling."""
JOINED_S: Final = 0.05
"""Times outside the band that are nearer to each other are one excursion."""

LONG_AGO_S: Final = -1e12


class Excursions:
    """Gathers them block by block: largest |w - w*| [rad/s], longest excursion [s], span of T_L_hat [N m]."""

    def __init__(self) -> None:
        self.truth = False
        self.dip: float | None = None
        self.recovery_s: float | None = None
        self.unfinished = False
        self._load: tuple[float, float] = (np.inf, -np.inf)
        self._moved_s = self._begun_s = self._last_s = LONG_AGO_S
        self._w_ref = np.nan

    def feed(self, t: F8, ticks: TickArray) -> None:
        """Take the next ticks, at times ``t`` [s]."""
        self.truth = self.truth or bool(np.isfinite(ticks["T_L_true"]).any())
        on = (ticks["state"] == int(DriveState.OPERATION_ENABLED)) & (ticks["reason"] == 0)
        moving = (since(ticks["w_ref"], self._w_ref) != 0) | ~on
        moved_s = np.maximum.accumulate(np.where(moving, t, self._moved_s))
        self._w_ref, self._moved_s = float(ticks["w_ref"][-1]), float(moved_s[-1])
        resting = t - moved_s >= SETTLED_S
        if not resting.any():
            self.unfinished = False
            return
        error = np.abs(ticks["w"] - ticks["w_ref"])
        self.dip = max(self.dip or 0.0, largest(error[resting]))
        load = ticks["T_L_hat"][resting]
        self._load = (min(self._load[0], float(load.min())), max(self._load[1], float(load.max())))
        self._take(t[resting & ~(error <= RECOVERED_RAD_S)])
        self.unfinished = bool(resting[-1] and not error[-1] <= RECOVERED_RAD_S)

    def _take(self, outside: F8) -> None:
        """Join times outside the band to excursions; the longest counts."""
        self.recovery_s = self.recovery_s or 0.0
        if not len(outside):
            return
        joined = np.concatenate([[self._last_s], outside])
        begins = np.nonzero(np.diff(joined) > JOINED_S)[0]
        starts = np.concatenate([[self._begun_s], outside[begins]])
        ends = np.concatenate([joined[begins], outside[-1:]])
        self.recovery_s = max(self.recovery_s, float((ends - starts).max()))
        self._begun_s, self._last_s = float(starts[-1]), float(outside[-1])

    @property
    def load_span(self) -> float | None:
        """How far T_L_hat moved while the reference rested [N m]."""
        return self._load[1] - self._load[0] if self._load[0] <= self._load[1] else None
