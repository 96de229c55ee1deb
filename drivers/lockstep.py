"""The end of a tick in lockstep: a frame of its own tells it, so that a lost answer costs no waiting.

An emulator with faults sends it after all that it answers to a SYNC. It names the SYNC by its data, is seen
by no drive client, and is never sent in real time. An emulator without faults need not send it.
"""

from __future__ import annotations

from collections import deque
from typing import Final
from zlib import crc32

from drivers.bus import Frame, Link
from drivers.local import EFF_FLAG

TICK_OVER: Final = 0x1FFFFFFE | EFF_FLAG
CLASSIC_MOST: Final = 8
WAIT_NS: Final = 2_000_000_000
OPEN_MOST: Final = 8
"""SYNCs of which the end may still be on its way: an answer is behind the ends of all earlier ones."""


def tick_over(sync: bytes) -> tuple[int, bytes]:
    """Identifier and data of the frame that ends the tick of a SYNC with that data, or of a longer frame."""
    return TICK_OVER, sync if len(sync) <= CLASSIC_MOST else crc32(sync).to_bytes(4, "little")


class LockstepLink:
    """A link that ends a wait when the tick is over, and reads all of a tick before the next SYNC."""

    def __init__(self, link: Link, sync_id: int | None) -> None:
        self._link, self._sync_id = link, sync_id
        self._open: deque[bytes] = deque(maxlen=OPEN_MOST)  # what ends each SYNC sent; two may be alike
        self._told = False

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        self._link.send(can_id, data, fd)
        if can_id == self._sync_id:
            self._open.append(tick_over(data)[1])

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None when time or the tick is over; then only what is there."""
        while True:
            rest = WAIT_NS if self._told and self._open else 0
            over = self._told and not self._open
            frame = self._link.receive(0 if over else timeout_ns or rest)
            if frame is None or frame.can_id | frame.flags != TICK_OVER:
                return frame
            self._told = True
            if self._end(frame.data):
                return None

    def _end(self, data: bytes) -> bool:
        """Take the oldest SYNC that ``data`` names, and those before it; True when none is open any more."""
        if data not in self._open:
            return False
        while self._open.popleft() != data:
            pass
        return not self._open

    def discard(self) -> int:
        """Throw away everything received and not read; return how many frames."""
        count = 0
        while (frame := self._link.receive(0)) is not None:
            if frame.can_id | frame.flags == TICK_OVER:
                self._end(frame.data)
            count += 1
        return count

    def close(self) -> None:
        """Close the bus."""
        self._link.close()
