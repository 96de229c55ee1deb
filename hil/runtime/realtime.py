"""What the operating system grants the loop: FIFO, memory that stays, a core, a frozen collector.

Nothing here fails: what is not granted is said, with what would grant it.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from dataclasses import dataclass

from hil.config.loop import RealtimeTable

_MCL_CURRENT_AND_FUTURE = 3
_MCL_ONFAULT = 4
_PR_SET_THP_DISABLE = 41


@dataclass(frozen=True, slots=True)
class Grant:
    """One thing that was asked of the operating system."""

    what: str
    granted: bool
    detail: str


def acquire(table: RealtimeTable) -> list[Grant]:
    """Ask for everything the config wants; return what came of it."""
    return [*_asked(table), freeze_collector()]


def release(pid: int = 0) -> None:
    """Give FIFO scheduling back, so that what follows the loop disturbs nobody; ``pid`` 0: here."""
    if os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO:
        # the flag stays: only a privileged process may take it back
        os.sched_setscheduler(pid, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def probe(table: RealtimeTable) -> list[Grant]:
    """Ask for everything the config wants and give it back at once; return what would be granted."""
    cores = os.sched_getaffinity(0)
    try:
        return _asked(table)
    finally:
        release()
        ctypes.CDLL(None).munlockall()
        keep_pages(False)
        os.sched_setaffinity(0, cores)


def _asked(table: RealtimeTable) -> list[Grant]:
    """FIFO last: to lock 650 MB takes half a second, which another run's loop and drive must not wait for."""
    memory = _memory(table.lock_memory)
    return [*_fifo(table.fifo_priority), *memory, *_core(table.cpu)]


def _fifo(priority: int) -> list[Grant]:
    if priority == 0:
        return []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        remedy = f"add '@{os.getlogin() if os.isatty(0) else 'user'} - rtprio 98' to /etc/security/limits.d"
        return [Grant("SCHED_FIFO", False, f"{error.strerror}; {remedy}")]
    return [Grant("SCHED_FIFO", True, f"priority {priority}")]


def _memory(wanted: bool) -> list[Grant]:
    if not wanted:
        return []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
        detail = os.strerror(ctypes.get_errno()) + "; raise memlock in /etc/security/limits.d"
        return [Grant("locked memory", False, detail), *keep_pages()]
    return [Grant("locked memory", True, "current and future pages"), *keep_pages()]


def lock_as_touched() -> bool:
    """Lock each page that this process touches from its first touch on: a fork's shared pages stay shared."""
    return bool(ctypes.CDLL(None).mlockall(_MCL_CURRENT_AND_FUTURE | _MCL_ONFAULT) == 0)


def keep_pages(wanted: bool = True) -> list[Grant]:
    """Keep khugepaged off this process's pages, and off those of the processes it starts from now on.

    It copies them together into huge ones while it may not be preempted, 0.6 ms seen, whatever its priority.
    Source: prctl(2), PR_SET_THP_DISABLE.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_THP_DISABLE, *map(ctypes.c_ulong, (wanted, 0, 0, 0))) != 0:
        return [Grant("pages left in place", False, os.strerror(ctypes.get_errno()))]
    return [Grant("pages left in place", True, "khugepaged makes no huge pages of them")]


def _core(cpu: int | None) -> list[Grant]:
    if cpu is None:
        return []
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        return [Grant("core", False, f"core {cpu}: {error.strerror}; choose another [realtime] cpu")]
    return [Grant("core", True, f"pinned to core {cpu}")]


def keep_off(pid: int, cpu: int | None) -> None:
    """Keep another process off the loop's core, where there is another core for it."""
    others = os.sched_getaffinity(0) - {cpu}
    if cpu is not None and others:
        with contextlib.suppress(OSError):  # it has gone, which the loop sees by itself
            os.sched_setaffinity(pid, others)


def freeze_collector() -> Grant:
    """Switch the collector off for the run and move everything out of its sight, so that the exit is quick.

    What is garbage by now stays: to look for it first takes longer than all else that is asked for here.
    """
    gc.disable()
    gc.freeze()
    return Grant("garbage collector", True, "frozen for the run")
