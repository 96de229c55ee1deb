"""A drive port that only listens: for a run that computes what it would send, beside another controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hil.ports import Drive
from hil.runtime.rules import NO_WAIT
from hil.signals import RxFlag

Applied = Callable[[int], tuple[float, float]]


class ShadowDrive:
    """Wraps a drive: feedback passes, nothing is sent, not even SYNC or the stop frames.

    ``applied`` gives the voltages (u_q, u_d) [V] that another controller sent with a counter; the drive's
    echo names that counter. Commands of others are what a shadow expects, so they are no reason to stop.
    """

    def __init__(self, drive: Drive, applied: Applied) -> None:
        self._drive, self._applied = drive, applied

    def prepare(self, tick: Any) -> None:
        """Get ready for the record."""
        self._drive.prepare(tick)

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """Send nothing, another controller sends SYNC; only receive."""
        self.receive(tick, deadline_ns)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Wait for feedback; note what the other controller has applied from now on."""
        self._drive.receive(tick, deadline_ns)
        flags = tick["rx_flags"] = int(tick["rx_flags"]) & ~int(RxFlag.FOREIGN_COMMAND)
        # a look for more feedback that finds none may find the command that answers this one: not applied yet
        if flags & RxFlag.FRESH or deadline_ns != NO_WAIT:
            tick["u_q_seen"], tick["u_d_seen"] = self._applied(int(tick["echo"]))

    def send(self, tick: Any) -> None:
        """Send nothing, and say so in the tick."""
        tick["send"] = 0

    def stop(self) -> None:
        """Send nothing: the drive is not ours to stop."""

    def close(self) -> None:
        """Release the bus."""
        self._drive.close()
