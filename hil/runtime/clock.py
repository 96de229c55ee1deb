"""The only place of the controller that reads a clock or sleeps: real, lockstep and fake."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

Cell = npt.NDArray[np.int64]
LOCKSTEP_TIMEOUT_NS = 2_000_000_000


class RealClock:
    """CLOCK_MONOTONIC in integer nanoseconds."""

    name = "monotonic"
    cell = np.zeros(0, np.int64)
    """As of :class:`LockstepClock`; none, where the time is the system's."""

    now_ns = staticmethod(time.monotonic_ns)  # no frame of Python's between a stamp and the clock

    def sleep_until(self, deadline_ns: int) -> int:
        """Sleep to the absolute deadline; return the time of waking, at once when it has passed."""
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        return time.monotonic_ns()

    def receive_deadline(self, deadline_ns: int, timeout_ns: int) -> int:
        """Latest monotonic time at which this tick's feedback may come."""
        return deadline_ns + timeout_ns


class LockstepClock:
    """Time is the tick's deadline: nothing sleeps, and what is logged is the same in every run.

    ``cell`` holds it [ns], for compiled ticks, too.
    """

    name = "lockstep"

    def __init__(self) -> None:
        self.cell = np.zeros(1, np.int64)
        self._cell: Any = self.cell.data

    def now_ns(self) -> int:
        """Return the last deadline waited for."""
        now_ns: int = self._cell[0]
        return now_ns

    def sleep_until(self, deadline_ns: int) -> int:
        """Go to the deadline without waiting."""
        self._cell[0] = deadline_ns
        return deadline_ns

    def receive_deadline(self, deadline_ns: int, timeout_ns: int) -> int:
        """Wait in real time, generously: the drive answers when it has computed."""
        return time.monotonic_ns() + LOCKSTEP_TIMEOUT_NS


class FakeClock:
    """A clock for tests: each sleep wakes ``lateness`` after its deadline, taken from a script."""

    name = "fake"

    def __init__(
        self, lateness_ns: Iterable[int] = (), on_sleep: Callable[[int], None] | None = None
    ) -> None:
        self._now_ns = 0
        self._lateness = iter(lateness_ns)
        self._on_sleep = on_sleep

    def now_ns(self) -> int:
        """Return the fake time."""
        return self._now_ns

    def advance(self, by_ns: int) -> None:
        """Let time pass."""
        self._now_ns += by_ns

    def sleep_until(self, deadline_ns: int) -> int:
        """Jump to the deadline plus the next scripted lateness."""
        if self._on_sleep:
            self._on_sleep(deadline_ns)
        self._now_ns = max(self._now_ns, deadline_ns) + next(self._lateness, 0)
        return self._now_ns

    def receive_deadline(self, deadline_ns: int, timeout_ns: int) -> int:
        """Return the plain deadline."""
        return deadline_ns + timeout_ns
