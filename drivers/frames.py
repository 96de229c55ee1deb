"""Frames of one drive in both directions: checked and applied to a tick, or encoded from one."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Final

from drivers.binding import Bound
from drivers.mapping import RECEIVED
from drivers.record import Cell

# What was seen, as bits of the tick's rx_flags; equal to hil's own by a test.
FRESH: Final = 1 << 0
CRC_ERROR: Final = 1 << 1
COUNTER_REPEATED: Final = 1 << 2
COUNTER_JUMP: Final = 1 << 3
LENGTH_ERROR: Final = 1 << 4
STATUS: Final = 1 << 5
EMERGENCY: Final = 1 << 6
ERROR_FRAME: Final = 1 << 7
BUS_DOWN: Final = 1 << 8
FOREIGN_COMMAND: Final = 1 << 9
SEND_FAILED: Final = 1 << 10

SOURCES: Final = {
    "controlword": 0,
    "u_q": 1,
    "u_d": 2,
    "load_torque": 3,
    "enable": 4,
    "reset": 5,
    "load_enable": 6,
}


class Incoming:
    """One received message: checks its frames and sets the fields of the tick it is bound to."""

    def __init__(self, bound: Bound) -> None:
        message = bound.message
        self.length, self.valid = message.length, message.valid
        self.fields = [RECEIVED[part].field for part, _ in bound.parts]
        self.parts = [part for part, _ in bound.parts]
        names = [signal for _, signal in bound.parts]
        whole = {signal for part, signal in bound.parts if not RECEIVED[part].units}
        counter = [bound.counter] if bound.counter else []
        self._counted = bool(counter)
        self._read = message.reader(*counter, *names, whole={*counter, *whole})
        self._modulus = bound.counter_modulus
        self.last = -1
        self.cells: list[Cell] = []

    def take(self, data: bytes, late: bool = False) -> int:
        """Check a frame; if it is whole, valid, new and not late set the fields and flag FRESH too."""
        if len(data) != self.length:
            return LENGTH_ERROR
        if not self.valid(data):
            return CRC_ERROR
        values: Sequence[float] = self._read(data)
        flags = FRESH
        if self._counted:
            flags = self._judge(int(values[0]))
            values = values[1:]
        if late or not flags & FRESH:
            return flags & ~FRESH
        for cell, value in zip(self.cells, values, strict=True):
            cell[0] = value
        return flags

    def _judge(self, counter: int) -> int:
        """Flags of a frame's counter against the last one's."""
        last, self.last = self.last, counter
        if counter == last:
            return COUNTER_REPEATED
        return FRESH if last < 0 or counter == (last + 1) % self._modulus else FRESH | COUNTER_JUMP


class Outgoing:
    """One sent message: picks its values of what a tick commands."""

    def __init__(self, bound: Bound) -> None:
        message = bound.message
        self.send_id, self.fd, self._counted = message.send_id, message.fd, bool(bound.counter)
        self._mask = bound.counter_modulus - 1
        names = [signal for _, signal in bound.parts] + [signal for signal, _ in bound.constants]
        self._constants = tuple(value for _, value in bound.constants)
        self._write = message.writer(*([bound.counter] if bound.counter else []), *names)
        places = [SOURCES[part] for part, _ in bound.parts]
        self._pick = itemgetter(*places) if len(places) > 1 else lambda values: (values[places[0]],)

    def encode(self, counter: int, values: tuple[float, ...]) -> bytes:
        """The frame's bytes. Raises EncodeError."""
        if self._counted:
            return self._write(counter & self._mask, *self._pick(values), *self._constants)
        return self._write(*self._pick(values), *self._constants)
