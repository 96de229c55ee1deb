"""Listens to the commands that another controller sends, so that a shadow run knows what is applied."""

from __future__ import annotations

from collections.abc import Callable

from drivers.codec import Database

OnFrame = Callable[[bool, int, int, bytes], None]


class CommandWatch:
    """Remembers the voltages [V] of each valid COMMAND seen, by its counter."""

    def __init__(self, database: Database) -> None:
        self._command = database.message("COMMAND", "Counter", "VoltageQ", "VoltageD")
        self._read = self._command.reader("Counter", "VoltageQ", "VoltageD")
        self._by_counter = [(0.0, 0.0)] * self._command.counter_modulus

    def chained(self, after: OnFrame) -> OnFrame:
        """Return what takes note of a frame and hands it on to ``after``."""

        def on_frame(received: bool, t_ns: int, can_id: int, data: bytes) -> None:
            if can_id == self._command.can_id:
                self.take(data)
            after(received, t_ns, can_id, data)

        return on_frame

    def take(self, data: bytes) -> None:
        """Take note of a command, whole and valid or not at all."""
        if len(data) == self._command.length and self._command.valid(data):
            counter, u_q, u_d = self._read(data)
            self._by_counter[int(counter)] = (u_q, u_d)

    def applied(self, echo: int) -> tuple[float, float]:
        """Voltages of the newest command with that counter; zeros when none was seen."""
        return self._by_counter[echo % len(self._by_counter)]
