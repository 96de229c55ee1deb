"""What the loop needs of the world, as protocols: a drive, a clock, a recorder.

The loop knows these and nothing behind them; the composition root hands in what implements them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from hil.signals import TickArray


class Drive(Protocol):
    """A drive on a bus. ``tick`` is one record of :data:`hil.signals.TICK`, filled in place."""

    def prepare(self, tick: Any) -> None:
        """Get ready for this very record, which every tick fills; sends nothing. Once, before the first."""

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """Send SYNC, then :meth:`receive`: the drive latches the newest command, samples and answers.

        What arrived since the last tick is taken first; feedback among it is late and not applied. Raises
        OSError when SYNC can't be sent.
        """

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until this tick's feedback came or ``deadline_ns`` (monotonic) passed.

        Fills ``rx_flags`` and, for what arrived whole and valid, the measurement fields. A field that
        did not arrive keeps its previous value.
        """

    def send(self, tick: Any) -> None:
        """Encode and send the tick's command. Raises on what can't be encoded."""

    def stop(self) -> None:
        """Send zero voltage and disable, best effort, repeated; never raises."""

    def close(self) -> None:
        """Release the bus."""


class Clock(Protocol):
    """Monotonic integer nanoseconds, and the only way to wait."""

    def now_ns(self) -> int:
        """Return the time of this clock in nanoseconds."""

    def sleep_until(self, deadline_ns: int) -> int:
        """Wait until the deadline and return the time of waking."""

    def receive_deadline(self, deadline_ns: int, timeout_ns: int) -> int:
        """Latest monotonic time at which the feedback of a tick may come."""


class Timed(Protocol):
    """What sends SYNC in the loop's place, by a timer of its own."""

    def start(self) -> None:
        """Send the first SYNC now. Raises OSError."""

    def taken(self) -> tuple[int, int]:
        """How many SYNCs were heard since the last look, and when the newest was sent [ns]."""

    def steer(self, k: int, due_ns: int) -> None:
        """Keep the newest SYNC, of period k, on the loop's grid, by which it was due at ``due_ns``."""

    def stop(self) -> None:
        """No SYNC after this; never raises."""


class Recorder(Protocol):
    """Takes records without ever blocking; drops are counted."""

    @property
    def failed(self) -> bool:
        """True once the writer has reported that it can't write (disk full, killed)."""

    def tick(self, tick: TickArray) -> None:
        """Store one tick record."""

    def event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Store one event."""


class Inbox(Protocol):
    """Where another process leaves set-points. The loop looks at ``number`` alone until it is another one."""

    number: Any

    def take(self, states: Sequence[int], asked: int) -> str:
        """Judge what waits, for the state of each node's supervisor; the event's text, or nothing yet."""
