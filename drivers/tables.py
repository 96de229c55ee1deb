"""A binding as tables for the kernels of :mod:`drivers.wire`."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.binding import Binding, Bound
from drivers.codec import Message
from drivers.errors import DatabaseError
from drivers.frames import PLACES, SENT_FIELDS, SOURCES, STATUS
from drivers.local import CLASSIC, FD, FD_BRS, FD_FDF
from drivers.mapping import COMMANDED_D, COMMANDED_Q, MEASURED, RECEIVED
from drivers.signal import Signal
from drivers.wire import FD_BYTES, MESSAGE, NO_SELECTOR, OVERHEARD, SIGNAL, STATE_RAW, WATCHED

Records = npt.NDArray[np.void]
Row = tuple[Signal, int, int, int, bool]
"""A signal with offset and kind of its field of the tick, its place in a command's values, and wholeness."""
_KINDS: Final = {"<f8": 0, "<u4": 1, "<u8": 2, "<i4": 3, "<i8": 4}


class Tables:
    """Messages of one direction and their signals, each message's together, its counter first."""

    def __init__(self) -> None:
        self._messages: list[tuple[Any, ...]] = []
        self._signals: list[tuple[Any, ...]] = []

    def add(self, bound: Bound, rows: list[Row], bit: int = 0, seen: int = 0, slow: int = 0) -> None:
        """Add a message with its signals; one behind several values of a multiplexer once for each."""
        message, first = bound.message, len(self._signals)
        if bound.counter:
            rows = [(message.signals[bound.counter], 0, 0, 0, True), *rows]
        count = len(rows)
        if bound.selector:
            rows = [*rows, (message.signals[bound.selector], 0, 0, 0, True)]
        for one, at, kind, source, whole in rows:
            low, high = (one.minimum, one.maximum) if one.is_float else one.raw_range()
            self._signals.append(
                (at, kind, source, one.shift, one.length, one.big_endian, one.signed, one.is_float, whole,
                 one.scale, one.offset, float(low), float(high))
            )  # fmt: skip
        ids = np.frombuffer(message.data_ids.ljust(16, b"\0"), "u1")
        modulus = bound.counter_modulus if bound.counter else 0
        under = np.frombuffer(bound.payload.data.ljust(64, b"\0"), "u1")
        for wanted in bound.wanted or (0,):
            self._messages.append(
                (message.send_id, message.length, message.profile, ids, modulus, first, count, bit, seen,
                 message.fd, first + count if bound.selector else NO_SELECTOR, wanted, under, slow)
            )  # fmt: skip

    def watch(self, message: Message) -> None:
        """Add a message that is known by its identifier alone."""
        self._messages.append((message.send_id, 0, 0, 0, 0, 0, 0, WATCHED, 0, False, NO_SELECTOR, 0, 0, 0))

    def overhear(self, bound: Bound) -> None:
        """Add a command that another controller sends.

        Raises DatabaseError for u_q and u_d in two messages.
        """
        parts = dict(bound.parts)
        if "u_q" in parts and "u_d" not in parts:
            raise DatabaseError("a shadow run needs u_q and u_d in one message; drop --shadow")
        axes = [(part, place) for place, axis in enumerate((COMMANDED_Q, COMMANDED_D)) for part in axis]
        rows = [(bound.message.signals[parts[part]], at, 0, 0, False) for part, at in axes if part in parts]
        self.add(bound, rows, OVERHEARD)

    def records(self) -> tuple[Records, Records]:
        """(messages, signals) as the kernels take them."""
        return np.array(self._messages, MESSAGE), np.array(self._signals, SIGNAL)


def incoming_tables(
    binding: Binding, tick: np.dtype[np.void], overhears: bool = False
) -> tuple[Records, Records, int]:
    """(messages, signals, bits of all that measure) for :func:`drivers.wire.take` into records ``tick``.

    Watched besides: the drive's emergencies, and what only the controller itself may send; who ``overhears``
    takes another's command for what it is. Raises DatabaseError where that can't be.
    """
    tables, needed = Tables(), 0
    for bound in binding.incoming:
        parts = {part for part, _ in bound.parts}
        bit = sum(1 << place for place, part in enumerate(MEASURED) if part in parts)
        needed |= bit
        rows = [
            (bound.message.signals[name], *field_in(tick, RECEIVED[part].field), 0, not RECEIVED[part].units)
            for part, name in bound.parts
        ]
        seen = STATUS if not bit and "v_dc" in parts else 0
        seen |= STATE_RAW if "state" in parts and binding.map.states else 0
        slow = 1 << binding.slow.index(bound) if bound in binding.slow else 0
        tables.add(bound, rows, bit, seen, slow)
    watched = [binding.emergency]
    if overhears:
        tables.overhear(binding.command)
    else:
        watched += [*(bound.message for bound in binding.outgoing), binding.sync]
    for message in watched:
        if message is not None:
            tables.watch(message)
    return *tables.records(), needed


def field_in(tick: np.dtype[np.void], name: str) -> tuple[int, int]:
    """(offset, kind) of a field of the tick. Raises TypeError for a kind that no kernel writes."""
    kind, offset = tick.fields[name][:2]  # type: ignore[index]
    if kind.str not in _KINDS:
        raise TypeError(f"field {name} of the tick is {kind.str}; kernels write {', '.join(_KINDS)}")
    return int(offset), _KINDS[kind.str]


def outgoing_tables(binding: Binding) -> tuple[Records, Records]:
    """(messages, signals) for :func:`drivers.wire.encode`."""
    tables = Tables()
    for bound in binding.outgoing:
        signals = bound.message.signals
        tables.add(bound, [(signals[name], 0, 0, PLACES[part], False) for part, name in bound.parts])
    return tables.records()


def command_values() -> npt.NDArray[np.float64]:
    """Values of a command, in the order of :data:`drivers.frames.SOURCES`; a load is always let on."""
    values = np.zeros(len(SOURCES))
    values[SOURCES.index("load_enable")] = 1.0
    return values


def sent_offsets(tick: np.dtype[np.void]) -> npt.NDArray[np.int64]:
    """Where a tick's fields are that make its command: for :func:`drivers.posix.gather`."""
    return np.array([tick.fields[name][1] for name in SENT_FIELDS], np.int64)  # type: ignore[index]


def laid_out(send_id: int, length: int, fd: bool) -> npt.NDArray[np.uint8]:
    """A buffer with the head of a frame to send; its data are 0."""
    buffer = np.zeros(FD_BYTES, np.uint8)
    head = FD.pack(send_id, length, FD_FDF | FD_BRS, b"") if fd else CLASSIC.pack(send_id, length, b"")
    buffer[: len(head)] = np.frombuffer(head, np.uint8)
    return buffer
