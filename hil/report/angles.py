"""How an angle was followed: following error, and how soon after the last move it is near the reference."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from hil.report.curves import F8
from hil.signals import DriveState, TickArray

SETTLED_RAD: Final = 0.01
LONG_AGO_S: Final = -math.inf


class Angles:
    """Gathers it block by block, in operation; None where no angle is followed."""

    def __init__(self) -> None:
        self._count, self._square, self._peak = 0, 0.0, 0.0
        self._moved_s = self._outside_s = LONG_AGO_S
        self._moving = self._outside = False

    def feed(self, t: F8, ticks: TickArray) -> None:
        """Take the next ticks, at times ``t`` [s]."""
        error, w_ref = np.abs(ticks["theta_error"]), ticks["w_ref"]
        on = (ticks["state"] == int(DriveState.OPERATION_ENABLED)) & np.isfinite(error)
        if not on.any():
            return
        t, error, moving = t[on], error[on], w_ref[on] != 0.0
        outside = error > SETTLED_RAD
        self._count += len(error)
        self._square += float(np.sum(error * error))
        self._peak = max(self._peak, float(error.max()))
        if moving.any():
            self._moved_s = float(t[moving][-1])
        if outside.any():
            self._outside_s = float(t[outside][-1])
        self._moving, self._outside = bool(moving[-1]), bool(outside[-1])

    @property
    def rms(self) -> float | None:
        """RMS of theta* - theta [rad]."""
        return math.sqrt(self._square / self._count) if self._count else None

    @property
    def peak(self) -> float | None:
        """Largest |theta* - theta| [rad]."""
        return self._peak if self._count else None

    @property
    def settling_s(self) -> float | None:
        """From the end of the last move until it stays within 0.01 rad [s]; infinite when it never does."""
        if self._moving or self._moved_s == LONG_AGO_S:
            return None
        return math.inf if self._outside else max(self._outside_s - self._moved_s, 0.0)
