"""The rules of a tick, each said once: the loop calls them as they stand, compiled ticks contain them.

``t`` is a tick's record: one of numpy's in a compiled tick, :class:`Fields` in the loop. ``pace`` is what is
remembered from one tick to the next.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from hil.runtime.trouble import TROUBLE
from hil.signals import ALL_MISSING, Request, RxFlag, TickArray, cell

Pacing = Literal["sync", "feedback", "timer"]
Pace = npt.NDArray[np.int64]
"""ARRIVED: when the newest cyclic feedback came, or was due [ns]; HEARD: how many were taken of a queue whose
rest is left to the loop; SINCE: periods from the last tick with feedback to the one before. Of the
last compiled call: RAN: ticks that it recorded; LOST: periods that it skipped; NEXT: number of the tick to go
on with; DID: of several nodes' exchange or commands, how many steps are done."""
ARRIVED, HEARD, SINCE, RAN, LOST, NEXT, DID = range(7)
NOT_BEGUN, BEGUN, DECIDED, SENT, RECORDED = range(5)
"""Stages of a tick: SYNC is not out; SYNC is out, the drive has feedback to conclude; the law has run; the
command is out, where there is one; the record is stored. What is left is the loop's."""
MAX_NS: Final = 2**31 - 1
NEVER: Final = 2**63 - 1
NO_WAIT: Final = 1
"""A deadline that has long passed: one feedback if it is there already."""
QUEUE_MOST: Final = 4096
"""Queued feedback that one tick takes; a flood can't hold it longer."""
STEER_EVERY: Final = 64
"""Periods between two looks at the phase of a SYNC that the kernel times."""
STOP: Final = int(Request.STOP)
FRESH, COUNTER_JUMP = int(RxFlag.FRESH), int(RxFlag.COUNTER_JUMP)


class Fields:
    """The integer fields of the first record, by their names: read and set in a fifth of numpy's time.

    All are looked up when it is made: the first ticks of a run would have no time for it.
    """

    def __init__(self, ticks: TickArray) -> None:
        names = [name for name in ticks.dtype.names or () if ticks.dtype[name].kind in "iu"]
        self._cells: dict[str, Any] = {name: cell(ticks, name) for name in names if name[0] != "_"}

    def __getitem__(self, name: str) -> int:
        value: int = self._cells[name][0]
        return value

    def __setitem__(self, name: str, value: int) -> None:
        self._cells[name][0] = value


def new_pace() -> Pace:
    """All zero."""
    return np.zeros(DID + 1, np.int64)


@register_jitable
def bounded(ns: int) -> int:
    """A stamp as the record holds it."""
    return min(max(ns, -MAX_NS), MAX_NS)


@register_jitable
def asked_in(k: int, end: int, request: int) -> int:
    """What is asked of the supervisor in tick k; at the end of the run a stop, at least."""
    return max(request, STOP) if k >= end else request


@register_jitable
def stamp(t: Any, k: int, deadline_ns: int, gap: int, late_ns: int) -> None:
    """Which tick it is, how many periods after the last one, and how late it begins."""
    t["k"], t["t_ns"], t["gap"], t["skipped"] = k, deadline_ns, gap, gap - 1
    t["lateness_ns"] = bounded(late_ns)


@register_jitable
def begin(t: Any, asked: int, log_failed: int) -> None:
    """Nothing has come yet; what is asked and known in this tick."""
    t["rx_flags"], t["missing"], t["request"], t["log_failed"] = 0, ALL_MISSING, asked, log_failed


@register_jitable
def is_due(pace: Any, every: int) -> bool:
    """Whether this tick is to have feedback; once it has not come when it was due, each tick is to."""
    return bool(pace[SINCE] + 1 >= every)


@register_jitable
def count(pace: Any, t: Any) -> None:
    """Count a tick that is over, for :func:`is_due` of the next."""
    pace[SINCE] = 0 if t["rx_flags"] & FRESH else pace[SINCE] + t["gap"]


@register_jitable
def newest(receive: Any, x: Any, t: Any, pace: Any, until_ns: int) -> int:
    """Wait for feedback, then take what else is there: the newest counts. How many came; -1: some are left.

    ``receive(x, t, deadline)`` takes one; False when what it has begun is left to the loop, which goes on.
    """
    heard, pace[HEARD] = int(pace[HEARD]), 0
    while heard < QUEUE_MOST:
        if not receive(x, t, NO_WAIT if heard else until_ns):
            pace[HEARD] = heard
            return -1
        if not t["rx_flags"] & FRESH:
            break
        heard += 1
        t["rx_flags"] &= ~FRESH
    if heard:
        t["rx_flags"] |= FRESH
    return heard


@register_jitable
def missed(heard: int, jumped: int, late_ns: int, period_ns: int) -> int:
    """Periods that had no tick: those queued; where frames are missing, those that the clock counts.

    ``heard``: measurements taken; ``jumped``: not 0 when a counter says that frames are missing; ``late_ns``:
    since the next measurement was due.
    """
    queued = max(heard - 1, 0)
    if heard and not jumped:
        return queued
    return max(queued, (late_ns + (period_ns // 2 if heard else 0)) // period_ns)


@register_jitable
def wake(t: Any, pace: Any, period_ns: int, heard: int, jumped: int, now_ns: int) -> None:
    """Stamp anew a tick that feedback woke, now or late: k and deadline follow the time.

    Each feedback is one period of the drive's clock, and so is each that is missing; of several that queued
    up the others than the newest count as skipped. Lateness is how much later it came than it was due. A run
    begins with its first tick, however much has come before.
    """
    k, deadline_ns = int(t["k"]), int(t["t_ns"])
    if k == 0:
        heard, jumped, pace[ARRIVED] = min(heard, 1), 0, now_ns - period_ns
    skipped = missed(heard, jumped, now_ns - pace[ARRIVED] - period_ns, period_ns)
    expected_ns = pace[ARRIVED] + (1 + skipped) * period_ns
    pace[ARRIVED] = now_ns if heard else expected_ns
    stamp(t, k + skipped, deadline_ns + skipped * period_ns, 1 + skipped, now_ns - expected_ns)


@register_jitable
def is_news(t: Any, state: int, request: int) -> bool:
    """Whether a tick has more to be logged than its record; ``state``, ``request``: of the one before."""
    return bool(
        t["rx_flags"] & TROUBLE != 0 or t["reason"] != 0 or t["state"] != state or t["request"] != request
    )
