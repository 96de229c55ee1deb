"""A drive port that only listens: for a run that computes what it would send, beside another controller."""

from __future__ import annotations

from typing import Any

from hil.ports import Drive
from hil.runtime.rules import FRESH, NO_WAIT, rule


@rule
def note_applied(t: Any, seen: Any, deadline_ns: int) -> None:
    """Write to the tick what the drive applies from now on: what was ``seen`` with the counter of its echo.

    A look for more feedback that finds none may find the command that answers this one: not applied yet.
    """
    if t["rx_flags"] & FRESH or deadline_ns != NO_WAIT:
        at = 2 * (int(t["echo"]) % (len(seen) // 2))
        t["u_q_seen"], t["u_d_seen"] = seen[at], seen[at + 1]


class ShadowDrive:
    """Wraps a drive: feedback passes, nothing is sent, not even SYNC or the stop frames.

    ``seen``: what the drive's client overhears of another controller's commands.
    """

    def __init__(self, drive: Drive, seen: Any) -> None:
        self._drive, self._seen = drive, seen

    def prepare(self, tick: Any) -> None:
        """Get ready for the record."""
        self._drive.prepare(tick)

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """Send nothing, another controller sends SYNC; only receive."""
        self.receive(tick, deadline_ns)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Wait for feedback; note what the other controller has applied from now on."""
        self._drive.receive(tick, deadline_ns)
        note_applied(tick, self._seen, deadline_ns)

    def send(self, tick: Any) -> None:
        """Send nothing, and say so in the tick."""
        tick["send"] = 0

    def stop(self) -> None:
        """Send nothing: the drive is not ours to stop."""

    def close(self) -> None:
        """Release the bus."""
        self._drive.close()
