"""Virtual time for a process: what it waits for comes at its time on an agenda, whatever the host does.

The C library's clock, sleep, poll and stamps are replaced for the compiled kernels, and Python's clock and
sleep likewise. Time goes on only where somebody waits. It must begin before the first kernel is loaded, and
lasts for the process's life: :func:`begin` is for processes of a test's own.
"""

from __future__ import annotations

import ctypes
import heapq
import itertools
import select
import time
from collections import deque
from collections.abc import Callable
from typing import Any

SECOND = 1_000_000_000
CONTROL, STAMP = 4, 2
"""Of a message header and of its control data: the word that points to it, the first one of the stamp."""
Words = ctypes.POINTER(ctypes.c_int64)
Ints = ctypes.POINTER(ctypes.c_int32)


def never() -> bool:
    """Nothing to wait for but the time."""
    return False


class Time:
    """The time [ns], and what is to come: the order is that of the times, then that of asking."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin again, with nothing to come."""
        self.now_ns, self._order = SECOND, itertools.count()
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self.listen: Callable[[], None] = lambda: None
        self.stamps: deque[int] = deque()
        """When each message was sent that recvmsg will give."""
        self.trouble: list[BaseException] = []

    def after(self, ns: int, act: Callable[[], None]) -> None:
        """Do that so much later."""
        heapq.heappush(self._agenda, (self.now_ns + ns, next(self._order), act))

    def pass_until(self, until_ns: int, ready: Callable[[], bool] = never) -> bool:
        """Let time pass, and what is on the agenda happen, until that time, or until ``ready`` first."""
        while True:
            self.listen()
            if ready():
                return True
            if not self._agenda or self._agenda[0][0] > until_ns:
                self.now_ns = max(self.now_ns, until_ns)
                return False
            due_ns, _, act = heapq.heappop(self._agenda)
            self.now_ns = max(self.now_ns, due_ns)
            act()


TIME = Time()
_kept: list[Any] = []
"""What the kernels call must live as long as they do."""


def _put_in_place(name: str, function: Callable[..., int], *arguments: Any) -> None:
    """Let the kernels call this in the place of the C library's; what it raises is kept for the test."""
    from llvmlite.binding import add_symbol

    def called(*values: Any) -> int:
        try:
            return function(*values)
        except BaseException as error:  # noqa: BLE001 - no exception passes through C
            TIME.trouble.append(error)
            return 0

    pointer = ctypes.CFUNCTYPE(ctypes.c_ssize_t, *arguments)(called)
    _kept.append(pointer)
    add_symbol(name, ctypes.cast(pointer, ctypes.c_void_p).value)


def _clock_gettime(_clock: int, into: Any) -> int:
    into[0], into[1] = divmod(TIME.now_ns, SECOND)
    return 0


def _clock_nanosleep(_clock: int, _flags: int, deadline: Any, _left: Any) -> int:
    TIME.pass_until(deadline[0] * SECOND + deadline[1])
    return 0


def _ppoll(fds: Any, _count: int, left: Any, _mask: Any) -> int:
    poll = select.poll()
    poll.register(fds[0], select.POLLIN)
    return int(TIME.pass_until(TIME.now_ns + left[0] * SECOND + left[1], lambda: bool(poll.poll(0))))


def _recvmsg_of(libc: Any) -> Callable[[int, Any, int], int]:
    def recvmsg(fd: int, message: Any, flags: int) -> int:
        size = int(libc.recvmsg(fd, message, flags))
        if size > 0:
            stamp = ctypes.cast(message[CONTROL], Words)
            stamp[STAMP], stamp[STAMP + 1] = divmod(TIME.stamps.popleft(), SECOND)
        return size

    return recvmsg


def begin() -> None:
    """From now on this process lives in :data:`TIME`."""
    word, number, words = ctypes.c_int, ctypes.c_size_t, Words
    _put_in_place("clock_gettime", _clock_gettime, word, words)
    _put_in_place("clock_nanosleep", _clock_nanosleep, word, word, words, ctypes.c_void_p)
    _put_in_place("ppoll", _ppoll, Ints, number, words, ctypes.c_void_p)
    _put_in_place("recvmsg", _recvmsg_of(ctypes.CDLL(None)), word, words, word)
    time.monotonic_ns = lambda: TIME.now_ns
    time.sleep = lambda seconds: TIME.pass_until(TIME.now_ns + round(seconds * SECOND)) and None
