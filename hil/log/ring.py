"""A ring of fixed-size records in anonymous shared memory: one producer, one consumer, no lock.

The producer never waits: a full ring drops the record and counts it. The memory is a memfd, so it has no
name, nobody else can open it, and nothing is left behind after a SIGKILL. The consumer takes only records
that were published before its previous look, so that it needs no memory fence to see them whole.
"""

from __future__ import annotations

import mmap
import os
from typing import Final

from hil.errors import HilError

HEADER_BYTES: Final = 4096
MAGIC: Final = 0x68696C52494E4731
MAGIC_AT, SIZE_AT, CAPACITY_AT, HEAD_AT, TAIL_AT, DROPPED_AT, FAILED_AT, BEAT_AT, HIGH_AT = range(9)
MAX_BYTES: Final = 1 << 30


class RingError(HilError, RuntimeError):
    """Shared memory that is no ring of ours."""


class Ring:
    """Both ends of a ring over a file descriptor."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, 0)
        self._bytes = memoryview(self._map)
        self.header = self._bytes[:HEADER_BYTES].cast("Q")
        if self.header[MAGIC_AT] != MAGIC:
            raise RingError("not a ring")
        self.record_size, self.capacity = self.header[SIZE_AT], self.header[CAPACITY_AT]
        self._seen = self.header[TAIL_AT]

    @classmethod
    def create(cls, name: str, record_size: int, capacity: int) -> Ring:
        """Make a ring whose pages are all touched, so that no push ever faults."""
        size = HEADER_BYTES + record_size * capacity
        if size > MAX_BYTES:
            raise RingError(f"a ring of {size} bytes is too large")
        fd = os.memfd_create(f"hil-{name}")
        os.fchmod(fd, 0o600)
        os.posix_fallocate(fd, 0, size)
        with mmap.mmap(fd, size) as pages:
            pages[HEADER_BYTES:] = bytes(size - HEADER_BYTES)
            header = memoryview(pages)[:HEADER_BYTES].cast("Q")
            header[MAGIC_AT], header[SIZE_AT], header[CAPACITY_AT] = MAGIC, record_size, capacity
            header.release()
        return cls(fd)

    def push(self, record: bytes | memoryview) -> bool:
        """Store one record of exactly ``record_size`` bytes; False when it was dropped."""
        header = self.header
        head = header[HEAD_AT]
        if head - header[TAIL_AT] >= self.capacity:
            header[DROPPED_AT] += 1
            return False
        at = HEADER_BYTES + (head % self.capacity) * self.record_size
        self._bytes[at : at + self.record_size] = record
        header[HEAD_AT] = head + 1
        return True

    def take(self, *, final: bool = False) -> bytes:
        """Return the records published before the previous look, whole; with ``final`` all there are."""
        header = self.header
        head, tail = header[HEAD_AT], header[TAIL_AT]
        end, self._seen = (head if final else self._seen), head
        header[HIGH_AT] = max(header[HIGH_AT], head - tail)
        if end <= tail:
            return b""
        first, last = tail % self.capacity, end % self.capacity
        size, base = self.record_size, HEADER_BYTES
        if first < last:
            out = bytes(self._bytes[base + first * size : base + last * size])
        else:
            wrap = self._bytes[base : base + last * size]
            out = bytes(self._bytes[base + first * size : base + self.capacity * size]) + bytes(wrap)
        header[TAIL_AT] = end
        return out

    @property
    def dropped(self) -> int:
        """Records dropped since the ring was made."""
        return int(self.header[DROPPED_AT])

    def close(self) -> None:
        """Unmap and close."""
        self.header.release()
        self._bytes.release()
        self._map.close()
        os.close(self.fd)
