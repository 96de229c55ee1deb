"""A ring of fixed-size records in anonymous shared memory: one producer, one consumer, no lock.

The producer never waits: a full ring drops the record and counts it. The memory is a memfd, so it has no
name, only this user's processes can open it (through /proc), and nothing is left behind after a SIGKILL.
The record is written before the head that publishes it, and the consumer takes only records that were
published before its previous look, so that it needs no memory fence to see them whole. Any number of
viewers may look at the newest records without either end noticing.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
from pathlib import Path
from typing import Final

from hil.errors import HilError

HEADER_BYTES: Final = 4096
MAGIC: Final = 0x68696C52494E4731
MAGIC_AT, SIZE_AT, CAPACITY_AT, HEAD_AT, TAIL_AT, DROPPED_AT, FAILED_AT, BEAT_AT, HIGH_AT = range(9)
MAX_BYTES: Final = 1 << 30


class RingError(HilError, RuntimeError):
    """Shared memory that is no ring of ours."""


class Ring:
    """One end of a ring over a file descriptor, which it owns. All pages are mapped before it returns."""

    def __init__(self, fd: int, *, view: bool = False) -> None:
        self.fd = fd
        size = os.fstat(fd).st_size
        if size < HEADER_BYTES:
            raise RingError("not a ring: too small")
        access = mmap.PROT_READ if view else mmap.PROT_READ | mmap.PROT_WRITE
        # populated, since the first touch of a page in the loop would cost a fault in the tick that does it
        self._map = mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE, prot=access)
        self.memory = memoryview(self._map)
        self.header = self.memory[:HEADER_BYTES].cast("Q")
        self.record_size, self.capacity = self.header[SIZE_AT], self.header[CAPACITY_AT]
        if self.header[MAGIC_AT] != MAGIC or HEADER_BYTES + self.record_size * self.capacity != size:
            self.close()
            raise RingError("not a ring: its header does not fit")
        self._seen = self.header[TAIL_AT]

    @classmethod
    def create(cls, name: str, record_size: int, capacity: int) -> Ring:
        """Make a ring of ``capacity`` records of ``record_size`` bytes, all its memory really allocated."""
        size = HEADER_BYTES + record_size * capacity
        if record_size < 1 or capacity < 1 or size > MAX_BYTES:
            raise RingError(f"a ring of {capacity} records of {record_size} bytes can't be made")
        fd = os.memfd_create(f"hil-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.fchmod(fd, 0o600)
        os.posix_fallocate(fd, 0, size)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        header = b"".join(value.to_bytes(8, "little") for value in (MAGIC, record_size, capacity))
        os.pwrite(fd, header, 0)
        return cls(fd)

    def push(self, record: bytes | memoryview) -> bool:
        """Store one record of exactly ``record_size`` bytes; False when it was dropped."""
        header = self.header
        head = header[HEAD_AT]
        if head - header[TAIL_AT] >= self.capacity:
            header[DROPPED_AT] += 1
            return False
        at = HEADER_BYTES + (head % self.capacity) * self.record_size
        self.memory[at : at + self.record_size] = record
        header[HEAD_AT] = head + 1
        return True

    def push_many(self, records: memoryview) -> None:
        """Store whole records; those that there is no room for, the newest, are dropped."""
        header, size = self.header, self.record_size
        head, count = header[HEAD_AT], len(records) // size
        room = self.capacity - head + header[TAIL_AT]
        if count > room:
            header[DROPPED_AT] += count - room
            count = room
        first = head % self.capacity
        at, end = HEADER_BYTES + first * size, count * size
        cut = min(end, (self.capacity - first) * size)
        self.memory[at : at + cut] = records[:cut]
        if cut < end:
            self.memory[HEADER_BYTES : HEADER_BYTES + end - cut] = records[cut:end]
        header[HEAD_AT] = head + count

    def take(self, *, final: bool = False) -> bytes:
        """Return the records published before the previous look, whole; with ``final`` all there are."""
        header = self.header
        head, tail = header[HEAD_AT], header[TAIL_AT]
        end, self._seen = (head if final else self._seen), head
        header[HIGH_AT] = max(header[HIGH_AT], head - tail)
        if end <= tail:
            return b""
        out = self._copy(tail, end)
        header[TAIL_AT] = end
        return out

    def latest(self, count: int) -> bytes:
        """Return up to ``count`` newest records without taking them; for viewers, at any time."""
        return self.since(max(0, self.header[HEAD_AT] - count))[0]

    def since(self, start: int) -> tuple[bytes, int]:
        """Return the records from number ``start`` on that are still there, and where to go on."""
        head = self.header[HEAD_AT]
        start = min(max(start, head - self.capacity + 1, 0), head)
        out = self._copy(start, head)
        # what the producer overwrote while this copied is cut off; it may be at work on one more
        oldest_whole = self.header[HEAD_AT] + 1 - self.capacity
        return out[max(0, oldest_whole - start) * self.record_size :], head

    def _copy(self, start: int, end: int) -> bytes:
        """The bytes of records ``start`` to ``end`` (counted from the ring's beginning)."""
        size, base = self.record_size, HEADER_BYTES
        first, count = start % self.capacity, end - start
        whole = min(count, self.capacity - first)
        out = bytes(self.memory[base + first * size : base + (first + whole) * size])
        if whole < count:
            out += bytes(self.memory[base : base + (count - whole) * size])
        return out

    @property
    def dropped(self) -> int:
        """Records dropped since the ring was made."""
        return int(self.header[DROPPED_AT])

    @property
    def published(self) -> int:
        """Records stored since the ring was made."""
        return int(self.header[HEAD_AT])

    @property
    def high_water(self) -> int:
        """Most records that ever waited, as the consumer saw it."""
        return int(self.header[HIGH_AT])

    def close(self) -> None:
        """Unmap and close."""
        self.header.release()
        self.memory.release()
        self._map.close()
        os.close(self.fd)


def attach(pid: int, name: str, record_size: int) -> Ring:
    """Open another process's ring for viewing. Raises RingError when it has none of that name and size."""
    wanted = f"/memfd:hil-{name} (deleted)"
    try:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                if str(link.readlink()) == wanted:
                    ring = Ring(os.open(link, os.O_RDONLY | os.O_CLOEXEC), view=True)
                    if ring.record_size == record_size:
                        return ring
                    ring.close()
                    raise RingError(f"process {pid} is of another version of hil: use that one's commands")
    except OSError as error:
        raise RingError(f"process {pid}: can't be looked into ({error.strerror})") from error
    raise RingError(f"process {pid} has no ring {name!r}")
