"""Floods of a bus: seeded datagrams as a faulty node or program may send them, and what sends and listens.

A datagram is laid out as SocketCAN's can_frame or canfd_frame. Most are frames that a bus could carry; the
kind ``broken`` are such as only another program of this machine can put on ``hil-local``.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice

from drivers.bus import Frame, unpack_frame
from drivers.local import CLASSIC, EFF_FLAG, ERR_FLAG, FD, RTR_FLAG, open_sockets, pack_frame
from tests.fuzz.client import DATABASE

OURS = {message.can_id: message for message in DATABASE.messages.values()}
ANSWERS = ("FEEDBACK", "STATUS", "EMCY", "HEARTBEAT")
ORDERS = ("COMMAND", "SYNC", "LOAD_COMMAND")
BURST, BURST_S = 50, 0.02


def foreign(rng: random.Random) -> bytes:
    """A frame of an identifier that nobody has: any, or one bit beside one of ours."""
    can_id = rng.choice(sorted(OURS)) ^ 1 << rng.randrange(11) if rng.random() < 0.5 else rng.randrange(0x800)
    while can_id in OURS:
        can_id = rng.randrange(0x800)
    if rng.random() < 0.3:
        can_id = EFF_FLAG | rng.randrange(0x20000000)
    return any_frame(rng, can_id)


def twin(rng: random.Random) -> bytes:
    """One of our identifiers, but in the extended format or as a remote frame, so it is not ours."""
    can_id = rng.choice(sorted(OURS)) | rng.choice((EFF_FLAG, RTR_FLAG, EFF_FLAG | RTR_FLAG))
    return pack_frame(can_id, rng.randbytes(rng.randrange(9)))


def damaged(rng: random.Random) -> bytes:
    """What the drive sends, with random bytes, of any length, classic or FD."""
    return any_frame(rng, DATABASE.message(rng.choice(ANSWERS)).can_id)


def forged(rng: random.Random) -> bytes:
    """What the drive sends, whole and with a valid CRC where there is one, but of random content."""
    return valid(rng, rng.choice(ANSWERS))


def orders(rng: random.Random) -> bytes:
    """What the controller sends: whole with random content, or damaged."""
    name = rng.choice(ORDERS)
    return valid(rng, name) if rng.random() < 0.7 else any_frame(rng, DATABASE.message(name).can_id)


def errors(rng: random.Random) -> bytes:
    """An error frame: any class, any content."""
    return pack_frame(ERR_FLAG | rng.randrange(0x20000000), rng.randbytes(8))


def broken(rng: random.Random) -> bytes:
    """A datagram that is no frame: of another size, or with a length that the frame can't hold."""
    if rng.random() < 0.5:
        raw = bytearray(any_frame(rng, rng.choice(sorted(OURS))))
        raw[4] = rng.randrange(65, 256)
        return bytes(raw)
    size = rng.choice((0, 1, CLASSIC.size - 1, CLASSIC.size + 1, FD.size - 1, FD.size + 1, 128, 129, 1400))
    return rng.randbytes(size)


def any_frame(rng: random.Random, can_id: int) -> bytes:
    fd = rng.random() < 0.2
    return pack_frame(can_id, rng.randbytes(rng.randrange(65 if fd else 9)), fd)


def valid(rng: random.Random, name: str) -> bytes:
    message = DATABASE.message(name)
    data = bytearray(rng.randbytes(message.length))
    message.protect(data)
    return pack_frame(message.send_id, bytes(data))


Kind = Callable[[random.Random], bytes]
KINDS: tuple[Kind, ...] = (foreign, twin, damaged, forged, orders, errors, broken)


def datagrams(seed: int, *kinds: Kind) -> Iterator[bytes]:
    """Yield datagrams of these kinds for ever, the same ones for the same seed."""
    rng = random.Random(seed)
    while True:
        yield rng.choice(kinds)(rng)


class Flooder:
    """One node of ``hil-local`` that floods it and keeps every frame of the others, none of its own."""

    def __init__(self, channel: str) -> None:
        self._receiving, self._sending = open_sockets(channel, own=False)
        self.sent = 0
        self.heard: list[Frame] = []

    def flood(
        self, source: Iterator[bytes], seconds: float, *, bursts: bool, goes_on: Callable[[], bool]
    ) -> None:
        """Send for so many seconds while ``goes_on()``: as fast as it goes, or 50 frames every 20 ms."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and goes_on():
            for raw in islice(source, BURST):
                self.send(raw)
            self.listen(BURST_S if bursts else 0.0)

    def send(self, raw: bytes) -> None:
        with suppress(BlockingIOError):  # no room for it just now
            self._sending.send(raw)
            self.sent += 1

    def listen(self, seconds: float) -> None:
        """Keep what the others send within so many seconds, at least all that waits."""
        end = time.monotonic() + seconds
        while True:
            try:
                raw = self._receiving.recv(256)
            except BlockingIOError:
                if time.monotonic() >= end:
                    return
                time.sleep(0.001)
                continue
            if (frame := unpack_frame(raw)) is not None:
                self.heard.append(frame)

    def close(self) -> None:
        self._receiving.close()
        self._sending.close()


@contextmanager
def flooder(channel: str) -> Iterator[Flooder]:
    made = Flooder(channel)
    try:
        yield made
    finally:
        made.close()
