"""Listens to the commands that another controller sends, so that a shadow run knows what is applied."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drivers.binding import Binding
from drivers.drive import OnFrames
from drivers.errors import DatabaseError
from drivers.mapping import COMMANDED_D, COMMANDED_Q
from drivers.wire import FRAME


class CommandWatch:
    """Remembers each valid command seen [V, A or N m], by its counter.

    A drive without echo is taken to apply the newest. Raises DatabaseError for u_q and u_d in two messages.
    """

    def __init__(self, binding: Binding) -> None:
        bound = binding.command
        self._message, self._echo = bound.message, bool(binding.map.echo)
        parts = dict(bound.parts)
        if "u_q" in parts and "u_d" not in parts:
            raise DatabaseError("a shadow run needs u_q and u_d in one message; drop --shadow")
        axes = [parts[part] for part in (*COMMANDED_Q, *COMMANDED_D) if part in parts]
        counter = [bound.counter] if bound.counter else []
        self._axes, self._read = len(axes), self._message.reader(*axes, *counter)
        self._by_counter = [(0.0, 0.0)] * bound.counter_modulus
        self._newest = (0.0, 0.0)

    def chained(self, after: OnFrames | None) -> OnFrames:
        """Return what takes note of frames and hands them on to ``after``."""

        def on_frames(records: memoryview) -> None:
            for frame in np.frombuffer(records, FRAME):
                if frame["can_id"] == self._message.send_id:
                    self.take(frame["data"][: frame["size"]].tobytes())
            if after is not None:
                after(records)

        return on_frames

    def take(self, data: bytes) -> None:
        """Take note of a command, whole and valid or not at all."""
        if len(data) == self._message.length and self._message.valid(data):
            values = self._read(data)
            counter = values[self._axes :]
            self._newest = (values[0], values[1] if self._axes > 1 else 0.0)
            self._by_counter[int(counter[0]) % len(self._by_counter) if counter else 0] = self._newest

    def after(self, flush: Callable[[], None]) -> Callable[[int], tuple[float, float]]:
        """:meth:`applied`, once the frames that came are handed on."""

        def applied(echo: int) -> tuple[float, float]:
            flush()
            return self.applied(echo)

        return applied

    def applied(self, echo: int) -> tuple[float, float]:
        """The newest command (q, d) with that counter; zeros when none was seen."""
        return self._by_counter[echo % len(self._by_counter)] if self._echo else self._newest
