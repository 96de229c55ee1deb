"""The end of a tick in lockstep: a frame of its own tells it, so that a lost answer costs no waiting.

An emulator with faults sends it after all that it answers to a SYNC. It names the SYNC by its data, is seen
by no drive client, and is never sent in real time. An emulator without faults need not send it.
"""

from __future__ import annotations

from typing import Final
from zlib import crc32

from drivers.bus import Frame, Link
from drivers.local import EFF_FLAG

TICK_OVER: Final = 0x1FFFFFFE | EFF_FLAG
CLASSIC_MOST: Final = 8
WAIT_NS: Final = 2_000_000_000


def tick_over(sync: bytes) -> tuple[int, bytes]:
    """Identifier and data of the frame that ends the tick of a SYNC with that data, or of a longer frame."""
    return TICK_OVER, sync if len(sync) <= CLASSIC_MOST else crc32(sync).to_bytes(4, "little")


class LockstepLink:
    """A link that ends a wait when the tick is over, and reads all of a tick before the next SYNC."""

    def __init__(self, link: Link, sync_id: int | None) -> None:
        self._link, self._sync_id = link, sync_id
        self._sync = b""
        self._told = self._open = False

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        if can_id == self._sync_id:
            self._sync, self._open = data, True
        self._link.send(can_id, data, fd)

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None when time or the tick is over."""
        while True:
            rest = WAIT_NS if self._told and self._open else 0
            frame = self._link.receive(timeout_ns or rest)
            if frame is None or frame.can_id | frame.flags != TICK_OVER:
                return frame
            self._told = True
            if frame.data == tick_over(self._sync)[1]:
                self._open = False
                return None

    def discard(self) -> int:
        """Throw away everything received and not read; return how many frames."""
        return self._link.discard()

    def close(self) -> None:
        """Close the bus."""
        self._link.close()
