"""The control of a timed kill: whether the host itself stood still.

On each core a small process, locked in memory and above the guardian under FIFO, only sleeps and notes how
late it wakes up. What delays it delays everything: a hypervisor that runs something else, or a kernel that
does not preempt what it does for another program.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PRIORITY = 60
PERIOD_NS, NOTED_NS = 500_000, 100_000
PATIENCE_S = 60.0
DELAY, ROOM = struct.Struct("=qq"), 1 << 14
Delay = tuple[int, int]
"""When a sleeper should have woken up and when it did [ns, CLOCK_REALTIME, as the kernel stamps frames]."""


class Witness:
    """The sleepers, and what they have noted, each in a ring of its own."""

    def __init__(self) -> None:
        self.sleepers: list[subprocess.Popen[bytes]] = []
        self._notes: list[mmap.mmap] = []

    def begin(self, core: int, note: Path) -> None:
        """Start a sleeper on a core."""
        note.write_bytes(bytes(ROOM * DELAY.size))
        with note.open("r+b") as file:
            self._notes.append(mmap.mmap(file.fileno(), 0))
        self.sleepers.append(subprocess.Popen([sys.executable, "-IS", __file__, str(note), str(core)]))

    def await_all(self) -> None:
        """Wait until each sleeps, which its first note says. Raises TimeoutError."""
        end = time.monotonic() + PATIENCE_S
        while not all(DELAY.unpack_from(note)[1] for note in self._notes):
            if time.monotonic() > end:
                raise TimeoutError("a sleeper of the control did not start")
            time.sleep(0.01)

    def end(self) -> None:
        """End all."""
        for sleeper in self.sleepers:
            sleeper.kill()
            sleeper.wait()

    def delays(self) -> list[Delay]:
        """Of all cores, in no order."""
        return [delay for note in self._notes for delay in DELAY.iter_unpack(note)]


def within_ms(delays: list[Delay], begin_ns: int, end_ns: int) -> float:
    """The longest delay, as far as it lies in a span of time [ms]."""
    return max(0, max((min(woke, end_ns) - max(due, begin_ns) for due, woke in delays), default=0)) * 1e-6


@contextmanager
def witness() -> Iterator[Witness]:
    """A sleeper on each core while the block runs. Raises TimeoutError."""
    control = Witness()
    with tempfile.TemporaryDirectory() as folder:
        try:
            for core in sorted(os.sched_getaffinity(0)):
                control.begin(core, Path(folder) / str(core))
            control.await_all()
            yield control
        finally:
            control.end()


@contextmanager
def above_all() -> Iterator[None]:
    """FIFO above all that is timed, where it is granted; what is forked meanwhile does not have it."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def sleep_on(note: str, core: int) -> None:
    """A sleeper's life."""
    with Path(note).open("r+b") as file:
        ring, place = mmap.mmap(file.fileno(), 0), 0
    os.sched_setaffinity(0, {core})
    ctypes.CDLL(None).mlockall(3)
    with above_all():
        woke = time.time_ns()
        while True:
            time.sleep(PERIOD_NS * 1e-9)
            due, woke = woke + PERIOD_NS, time.time_ns()
            if woke - due > NOTED_NS or place == 0:
                DELAY.pack_into(ring, place % ROOM * DELAY.size, due, woke)
                place += 1


if __name__ == "__main__":
    sleep_on(sys.argv[1], int(sys.argv[2]))
