"""A received frame straight from the socket's bytes into the tick: check and apply as one generated function.

The same rules, in the same order, as :class:`drivers.frames.Incoming`, for frames of the right length on a
socket of SocketCAN's layout; anything else takes the plain way. A tick spends most of its time here, and a
cold processor pays for every step of an interpreter. Equality with the plain way is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from drivers.binding import Bound
from drivers.compiled import build, crc_lines, value_lines
from drivers.frames import COUNTER_JUMP, COUNTER_REPEATED, CRC_ERROR, FRESH, Incoming, Outgoing
from drivers.local import CLASSIC, FD, FD_BRS, FD_FDF
from drivers.mapping import RECEIVED
from drivers.record import Cell

DATA_AT: Final = 8
"""Where a frame's data begin, classic or FD."""
Take = Callable[[bytes, bool], int]
Maker = Callable[[Incoming, Sequence[Cell]], Take]


class RawFrame(NamedTuple):
    """How a frame of one message is known and taken: its size on the socket, identifier, length."""

    take: Take
    size: int
    send_id: int
    end: int


def key_of(bound: Bound) -> bytes:
    """The first five bytes of a frame of this message: identifier and length."""
    return CLASSIC.pack(bound.message.send_id, bound.message.length, b"")[:5]


def size_of(bound: Bound) -> int:
    """Bytes of a frame of this message on the socket."""
    return FD.size if bound.message.fd else CLASSIC.size


def taker(bound: Bound, seen: int = FRESH) -> Maker:
    """A maker of ``take(raw, late)``, which returns flags; a good frame's are ``seen``.

    ``late``: the frame is checked and counted but not applied. Messages that are not measurements are given
    other flags to return and are never late.
    """
    message, names = bound.message, [signal for _, signal in bound.parts]
    whole = [not RECEIVED[part].units for part, _ in bound.parts]
    counter = [bound.counter] if bound.counter else []
    signals = [message.signals[name] for name in counter + names]
    decode, values, namespace = value_lines(
        message.length, signals, [True] * len(counter) + whole, start=DATA_AT
    )
    check, crc_names = crc_lines(message.profile, message.length, message.data_ids, start=DATA_AT)
    lines = [f"        {line}" for line in decode]
    lines += [f"        if not ({check}): return {CRC_ERROR}"] if check else []
    if counter:
        lines += _judge_lines(values[0], bound.counter_modulus)
    lines += [f"        if late: return {'flags' if counter else 0}"]
    lines += [f"        c{index}[0] = {value}" for index, value in enumerate(values[len(counter) :])]
    lines += [f"        return {f'flags | {seen}' if counter else seen}"]
    cells = ", ".join(f"c{index}" for index in range(len(names)))
    head = ["def make(incoming, cells):", f"    {cells}, = cells", "    def take(raw, late):"]
    maker: Maker = build("make", [*head, *lines, "    return take"], namespace | crc_names)
    return maker


def _judge_lines(counter: str, modulus: int) -> list[str]:
    """The counter against the last one's, which the plain way shares."""
    return [
        f"        counter = {counter}",
        "        last = incoming.last",
        "        incoming.last = counter",
        f"        if counter == last: return {COUNTER_REPEATED}",
        f"        flags = 0 if last < 0 or counter == (last + 1) % {modulus} else {COUNTER_JUMP}",
    ]


class RawOut:
    """One sent message with its frame around it, ready for the socket."""

    def __init__(self, bound: Bound, outgoing: Outgoing) -> None:
        message = bound.message
        self.encode, self.send_id = outgoing.encode, message.send_id
        room = FD.size if message.fd else CLASSIC.size
        if message.fd:
            self.head = FD.pack(message.send_id, message.length, FD_FDF | FD_BRS, b"")[:DATA_AT]
        else:
            self.head = CLASSIC.pack(message.send_id, message.length, b"")[:DATA_AT]
        self.tail = bytes(room - DATA_AT - message.length)
