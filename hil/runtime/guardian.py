"""The guardian: a process beside the loop that sends the stop frames when the loop no longer can.

It watches the controller's death (SIGKILL, a crash: a mutex that its thread holds, and a pidfd as the second
sign) and its heartbeat (SIGSTOP, a deadlock), each tick's time in a word of shared memory that costs the loop
one store. When either fails while the drive is armed it latches ``FIRED`` and sends zero voltage and disable,
repeated, through a link of its own. A controller that wakes up again finds the latch before its next frame
and never sends again; should one frame have been between its last look and the socket, the guardian sees the
sign of life and sends the stop frames once more.

Not seen by it: a controller that ticks on but computes nonsense (the guard's part), and a host that is
dead as a whole (the drive's own watchdog's part).
"""

from __future__ import annotations

import contextlib
import errno
import gc
import mmap
import os
import select
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

from numba.extending import register_jitable

from hil.errors import HilError
from hil.ports import Drive, Timed
from hil.runtime import realtime
from hil.runtime.clock import RealClock
from hil.runtime.lifeline import BYTES, Lifeline
from hil.signals import DriveState, RxFlag, cell

GUARDIAN_LOST_NS = 500_000_000
"""Age of the guardian's own heartbeat, at the controller's newest, at which the controller stops the run."""
LOOK_NS = 100_000_000
"""The guardian beats at least that often, whatever its timeout."""
START_S = 5.0
END_S = 5.0
"""How long a guardian that was relieved may take to end."""
STOPS = 3
"""How often the drive client's sequence of stop frames is sent when the guardian fires."""


class Word(IntEnum):
    """Places of the shared words (int64 each)."""

    ARMED = 0
    BEAT_NS = 1
    COUNTER = 2
    FIRED = 3
    GUARD_NS = 4


# plain numbers for the tick: a member of an enumeration costs more to look up than the word to store
ARMED, BEAT_NS, COUNTER, FIRED, GUARD_NS = map(int, Word)
DISARMED = int(DriveState.SWITCH_ON_DISABLED)
GUARDIAN, GUARDIAN_LOST = int(RxFlag.GUARDIAN), int(RxFlag.GUARDIAN_LOST)


@register_jitable
def guardian_flags(words: Any) -> int:
    """RxFlag bits of what the guardian did; it is lost when its own heartbeat is old."""
    if words[FIRED] != 0:
        return GUARDIAN
    return GUARDIAN_LOST if words[BEAT_NS] - words[GUARD_NS] > GUARDIAN_LOST_NS else 0


@register_jitable
def beats(words: Any, now_ns: int) -> bool:
    """Tell it of a tick; True once it has stopped the drive and nothing may be sent."""
    words[BEAT_NS] = now_ns
    return bool(words[FIRED] != 0)


@register_jitable
def commands(words: Any, now_ns: int, state: int, counter: int) -> bool:
    """:func:`beats` before a tick's command: what the guardian stops, and after which counter."""
    beats(words, now_ns)
    words[ARMED], words[COUNTER] = int(state != DISARMED), counter
    return bool(words[FIRED] != 0)


class Stopper(Protocol):
    """What can send the stop frames."""

    def stop_from(self, counter: int) -> None:
        """Send zero voltage and disable, with counters after ``counter``; never raises."""


class Words:
    """Shared words of controller and guardian; a store or load of one is atomic on every 64-bit machine.

    Behind them lies the mutex that the controller's loop holds while it lives.
    """

    def __init__(self) -> None:
        memory = memoryview(mmap.mmap(-1, mmap.PAGESIZE))
        self.lifeline = Lifeline(memory[-BYTES:])
        self.cells: Any = memory.cast("q")


class GuardedDrive:
    """A drive port that tells the guardian of each tick; nothing is sent once the guardian has fired."""

    def __init__(
        self, drive: Drive, words: Words, now: Callable[[], int], timed: Timed | None = None
    ) -> None:
        self._drive, self._words, self._now, self._timed = drive, words.cells, now, timed

    def prepare(self, tick: Any) -> None:
        """Reach the fields of the record."""
        self._flags, self._state, self._counter = (
            cell(tick.base, name) for name in ("rx_flags", "state", "counter")
        )
        self._drive.prepare(tick)

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """SYNC, unless the guardian has stopped the drive; feedback, and what the guardian did."""
        if beats(self._words, self._now()):
            self.receive(tick, deadline_ns)
            return
        self._drive.exchange(tick, deadline_ns)
        self._note_guardian()

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Feedback, and what the guardian did; once it has fired, the kernel sends no SYNC for us either."""
        if self._timed is not None and self._words[FIRED]:
            self._timed.stop()
        self._drive.receive(tick, deadline_ns)
        self._note_guardian()

    def _note_guardian(self) -> None:
        self._flags[0] |= guardian_flags(self._words)

    def send(self, tick: Any) -> None:
        """The command. Raises OSError once the guardian has stopped the drive; the record stays as it is."""
        if commands(self._words, self._now(), self._state[0], self._counter[0]):
            raise OSError(errno.ECANCELED, "the guardian has stopped the drive")
        self._drive.send(tick)

    def stop(self) -> None:
        """The controller's own stop frames; the guardian watches until they are out."""
        if not self._words[FIRED]:
            self._drive.stop()
        self._words[ARMED] = 0

    def close(self) -> None:
        """Release the bus."""
        self._drive.close()


class Judge:
    """What the guardian makes of the shared words: how long to wait, and when to send the stop frames."""

    def __init__(self, words: Words, timeout_ns: int, stopper: Stopper) -> None:
        self._cells, self._timeout_ns, self._stopper = words.cells, timeout_ns, stopper
        self._answered = 0

    def next_look(self, now_ns: int) -> int:
        """Beat, and answer a sign of life after the latch; return the time of the next look [ns]."""
        cells = self._cells
        beat = cells[BEAT_NS]
        if cells[FIRED] and beat != self._answered:  # once more: a frame may have been on its way
            self._answered = beat
            self._stopper.stop_from(cells[COUNTER])
        cells[GUARD_NS] = now_ns
        latest = now_ns + min(LOOK_NS, self._timeout_ns)
        return min(latest, beat + self._timeout_ns + 1) if self._watching() else latest

    def judge(self, now_ns: int, gone: bool) -> None:
        """Fire, once, when the controller is gone or was silent for longer than the timeout while armed."""
        cells = self._cells
        if self._watching() and (gone or now_ns - cells[BEAT_NS] > self._timeout_ns):
            cells[FIRED] = 1
            self._answered = cells[BEAT_NS]
            for _ in range(STOPS):
                self._stopper.stop_from(cells[COUNTER])

    def _watching(self) -> bool:
        return bool(self._cells[ARMED] and not self._cells[FIRED])


def watch(words: Words, parent_fd: int, timeout_ns: int, stopper: Stopper) -> None:
    """Watch until the controller has gone; fire when it dies or is silent for ``timeout_ns`` while armed."""
    now, poll, judge = RealClock().now_ns, select.poll(), Judge(words, timeout_ns, stopper)
    poll.register(parent_fd, select.POLLIN)
    gone = False
    while not gone:
        gone = words.lifeline.given_up_by(judge.next_look(now())) or bool(poll.poll(0))
        judge.judge(now(), gone)


@dataclass(frozen=True, slots=True)
class Rights:
    """What the guardian asks of the system for itself: FIFO above the loop's, locked memory, another core."""

    priority: int = 0
    lock_memory: bool = False
    loop_cpu: int | None = None

    def acquire(self) -> None:
        """Take what is granted. The collector would touch every page that is shared with the controller."""
        gc.disable()
        gc.freeze()
        if self.lock_memory:
            realtime.lock_as_touched()
            realtime.keep_pages()
        if self.priority > 0:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(min(self.priority + 1, 99)))
        realtime.keep_off(0, self.loop_cpu)


def _serve(
    words: Words,
    timeout_ns: int,
    parent: int,
    rights: Rights,
    open_stopper: Callable[[], Stopper],
    report: int,
) -> None:
    """The guardian's whole life, in the forked child; never returns to the caller's code."""
    try:
        os.setsid()
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        parent_fd = os.pidfd_open(parent)
        stopper = open_stopper()
        rights.acquire()
        words.cells[Word.GUARD_NS] = RealClock().now_ns()
        os.write(report, b"ready")
        os.close(report)
        watch(words, parent_fd, timeout_ns, stopper)
        for late in (parent, 0):  # the end of two large processes with FIFO would take two cores for 30 ms
            with contextlib.suppress(OSError):
                realtime.release(late)
        os._exit(0)
    except BaseException as error:  # noqa: BLE001 - a forked child must not run the parent's handlers
        with contextlib.suppress(OSError):
            os.write(report, f"{type(error).__name__}: {error}".encode()[:500])
        os._exit(1)


@contextlib.contextmanager
def guardian(
    timeout_ns: int, rights: Rights, open_stopper: Callable[[], Stopper], words: Words | None = None
) -> Iterator[Words]:
    """A guardian while the block runs, which must be in the thread that runs the loop.

    ``open_stopper`` runs in the guardian and opens a link of its own; it lets go of what a fork must not keep
    open, the recorder's pipes. Raises HilError when it can't start.
    """
    words, parent = words or Words(), os.getpid()
    words.lifeline.hold()
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(ours)
        _serve(words, timeout_ns, parent, rights, open_stopper, theirs)
    os.close(theirs)
    try:
        _await_ready(ours)
        yield words
    finally:
        os.close(ours)
        words.lifeline.hand_on()  # it ends; if the drive is still armed, not without the stop frames
        _await_end(pid)


def _await_end(pid: int) -> None:
    """Wait for the guardian, which was relieved; one that hangs is ended."""
    fd = os.pidfd_open(pid)
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    if not poll.poll(END_S * 1000):
        os.kill(pid, signal.SIGKILL)
    os.close(fd)
    os.waitpid(pid, 0)


def _await_ready(ours: int) -> None:
    """Wait until the guardian says that it watches. Raises HilError with what it says instead."""
    poll = select.poll()
    poll.register(ours, select.POLLIN)
    said = os.read(ours, 1000).decode(errors="replace") if poll.poll(START_S * 1000) else "no answer"
    if said != "ready":
        raise HilError(f"the guardian can't start: {said or 'it has ended'}; nothing was sent")
