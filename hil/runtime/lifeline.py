"""Who ends when who ends: a robust mutex in shared memory that one process's thread holds while it lives.

The kernel gives it up (EOWNERDEAD) as the thread ends, before the process's memory is torn down. A pidfd or
the end of a pipe tells after that: with 500 MB locked, 20 to 40 ms later, and a drive's watchdog trips in 20.
"""

from __future__ import annotations

import ctypes
import errno
import os
import signal
from typing import Any, Final

from hil.errors import HilError

BYTES: Final = 64
"""Room for a pthread_mutex_t of every 64-bit Linux (40 on x86-64, 48 on arm64)."""
PR_SET_PDEATHSIG: Final = 1
CLOCK_MONOTONIC, PROCESS_SHARED, ROBUST = 1, 1, 1
SECOND_NS: Final = 1_000_000_000

_KEPT: Final[list[Any]] = []
"""The C library links what a thread holds into a list: memory that went while it was held would be written to
by the next lock that the thread takes. So it never goes: a page for each run."""


def end_with(parent: int) -> None:
    """From now on this process is killed when its parent ends, or the parent's thread that started it."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before
        raise SystemExit(128 + signal.SIGKILL)


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("ns", ctypes.c_long))


class Lifeline:
    """The mutex in the first :data:`BYTES` of ``memory``. Raises HilError where the C library has none."""

    def __init__(self, memory: Any) -> None:
        self._libc, self._until = ctypes.CDLL(None), _Timespec()
        _KEPT.append(memory)
        self._mutex = ctypes.byref((ctypes.c_char * BYTES).from_buffer(memory))
        if not hasattr(self._libc, "pthread_mutex_clocklock"):
            raise HilError("the guardian needs pthread_mutex_clocklock: glibc 2.30 or newer")
        kind = ctypes.byref((ctypes.c_char * BYTES)())
        self._call("mutexattr_init", kind)
        self._call("mutexattr_setpshared", kind, PROCESS_SHARED)
        self._call("mutexattr_setrobust", kind, ROBUST)
        self._call("mutex_init", self._mutex, kind)

    def _call(self, name: str, *args: Any) -> None:
        """A function of pthreads. Raises OSError."""
        if code := self._libc[f"pthread_{name}"](*args):
            raise OSError(code, os.strerror(code))

    def hold(self) -> None:
        """Take it: from now on it tells of the life of this very thread."""
        self._call("mutex_lock", self._mutex)

    def hand_on(self) -> None:
        """Give it up, so that who waits goes on at once. Raises OSError for a thread without it."""
        self._call("mutex_unlock", self._mutex)

    def given_up_by(self, t_ns: int) -> bool:
        """Wait until ``t_ns`` (CLOCK_MONOTONIC): True once the holder has ended or has handed it on."""
        until = self._until
        until.seconds, until.ns = divmod(t_ns, SECOND_NS)
        lock = self._libc.pthread_mutex_clocklock
        code: int = lock(self._mutex, CLOCK_MONOTONIC, ctypes.byref(until))
        if code not in (0, errno.EOWNERDEAD, errno.ETIMEDOUT):
            raise OSError(code, os.strerror(code))
        return code != errno.ETIMEDOUT
