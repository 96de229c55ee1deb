"""The order of a tick and its rules, each said once: the loop calls them, compiled ticks contain them.

``t`` is a tick's record: one of numpy's in a compiled tick, :class:`Fields` in the loop. ``pace`` is what is
remembered from one tick to the next, ``plan`` a :data:`Timing`.
"""

from __future__ import annotations

from typing import Any, Final, Literal, Protocol

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from hil.runtime.trouble import TROUBLE
from hil.signals import ALL_MISSING, Request, RxFlag, TickArray, cell

Pacing = Literal["sync", "feedback", "timer"]
Pace = npt.NDArray[np.int64]
"""ARRIVED: when the newest cyclic feedback came, or was due [ns]; HEARD: how many were taken of a queue whose
rest is left to the loop; SINCE: periods from the last tick with feedback to the one before. Of the last
compiled call: RAN: ticks that it recorded; LOST: periods that it skipped; NEXT: number of the tick to go on
with. Of several nodes: DID: steps of the exchange or the commands that are done; NEWS: one has something to
log."""
ARRIVED, HEARD, SINCE, RAN, LOST, NEXT, DID, NEWS = range(8)
Timing = npt.NDArray[np.int64]
"""A run's plan: period and feedback timeout [ns]; the last tick; how long after the last feedback, or SYNC of
the kernel's, the next is waited for [ns]; ticks from one feedback to the next; ticks of one compiled call;
place of the pacing in :data:`PACINGS`; size of SYNC's frame."""
PERIOD_NS, TIMEOUT_NS, END, WAIT_NS, EVERY, TOGETHER, PACED, SYNC_BYTES, PLANNED = range(9)
PACINGS: Final[tuple[Pacing, ...]] = ("sync", "feedback", "timer")
BY_SYNC, BY_FEEDBACK, BY_TIMER = range(3)
NOT_BEGUN, BEGUN, READ, DECIDED, SENT, RECORDED = range(6)
"""Stages of a tick: it is not stamped; it is, and SYNC may be out; feedback is in; the law has run; the
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


rule = register_jitable(forceinline=True)
"""A function of the loop's that goes into compiled ticks."""


def new_pace() -> Pace:
    """All zero."""
    return np.zeros(NEWS + 1, np.int64)


class Parts(Protocol):
    """What :func:`run_tick` calls: functions over a compiled tick's table, or a loop's methods.

    One that returns False has left the tick to the loop, which goes on with it.
    """

    def sleep(self, deadline_ns: int) -> int:
        """Wait until then; the time of waking [ns], before it when a signal came."""

    def now(self) -> int:
        """The time [ns]."""

    def until(self, ns: int, wait_ns: int) -> int:
        """The deadline of what is waited for from then on."""

    def asked(self, k: int) -> int:
        """What is asked of the supervisor in tick k."""

    def begun(self, t: Any) -> None:
        """The tick is stamped; further nodes' ticks are as the first."""

    def sync(self, t: Any, deadline_ns: int) -> bool:
        """SYNC out and what answers it in."""

    def receive(self, t: Any, deadline_ns: int) -> bool:
        """The bus until then, or until feedback; 0: what is there."""

    def synced(self) -> tuple[int, int]:
        """SYNCs of the kernel's since the last look, -1 where it sends none; stamp of the newest [ns]."""

    def law(self, t: Any) -> bool:
        """Law, supervisor and guard."""

    def answer(self, t: Any) -> bool:
        """The command, where there is one, and ``sent_ns``."""

    def tell(self, t: Any, state: int, request: int) -> bool:
        """What is new is logged; ``state`` and ``request`` are of the tick before."""

    def store(self, t: Any) -> None:
        """The record into its ring, and ``recorded_ns``."""


@rule
def bounded(ns: int) -> int:
    """A stamp as the record holds it."""
    return min(max(ns, -MAX_NS), MAX_NS)


@rule
def asked_in(k: int, end: int, request: int) -> int:
    """What is asked of the supervisor in tick k; at the end of the run a stop, at least."""
    return max(request, STOP) if k >= end else request


@rule
def stamp(t: Any, k: int, deadline_ns: int, gap: int, late_ns: int) -> None:
    """Which tick it is, how many periods after the last one, and how late it begins."""
    t["k"], t["t_ns"], t["gap"], t["skipped"] = k, deadline_ns, gap, gap - 1
    t["lateness_ns"] = bounded(late_ns)


@rule
def begin(t: Any, asked: int, log_failed: int) -> None:
    """Nothing has come yet; what is asked and known in this tick."""
    t["rx_flags"], t["missing"], t["request"], t["log_failed"] = 0, ALL_MISSING, asked, log_failed


@rule
def is_due(pace: Any, every: int) -> bool:
    """Whether this tick is to have feedback; once it has not come when it was due, each tick is to."""
    return bool(pace[SINCE] + 1 >= every)


@rule
def count(pace: Any, t: Any) -> None:
    """Count a tick that is over, for :func:`is_due` of the next."""
    pace[SINCE] = 0 if t["rx_flags"] & FRESH else pace[SINCE] + t["gap"]


@rule
def newest(io: Any, x: Any, t: Any, pace: Any, until_ns: int) -> int:
    """Wait for feedback, then take what else is there: the newest counts. How many; -1: some are left."""
    heard, pace[HEARD] = int(pace[HEARD]), 0
    while heard < QUEUE_MOST:
        if not io.receive(x, t, NO_WAIT if heard else until_ns):
            pace[HEARD] = heard
            return -1
        if not t["rx_flags"] & FRESH:
            break
        heard += 1
        t["rx_flags"] &= ~FRESH
    if heard:
        t["rx_flags"] |= FRESH
    return heard


@rule
def since(now: Any, x: Any, t: Any) -> int:
    """Time after the tick's deadline by :class:`Parts`' ``now``, as the record holds it [ns]."""
    return bounded(now(x) - t["t_ns"])


@rule
def run_tick(
    io: Any, x: Any, t: Any, pace: Any, plan: Any, stage: int, k: int, deadline_ns: int, log_failed: int
) -> int:
    """Read, judge, compute, write, record: what is left of a tick that got to ``stage``.

    ``io``, a module or a class, has the :class:`Parts`, which go over ``x``. One that has not begun is tick
    k, due at its deadline. Returns the stage at which it is left to the loop.
    """
    state, request = t["state"], t["request"]
    if stage == NOT_BEGUN and not wait(io, x, t, pace, plan, k, deadline_ns, log_failed):
        return NOT_BEGUN
    if stage <= BEGUN:
        if not read(io, x, t, pace, plan):
            return BEGUN
        t["received_ns"] = since(io.now, x, t)
        if plan[PACED] == BY_TIMER:
            note_age(t, pace)
    if stage <= READ:
        if not io.law(x, t):
            return READ
        t["computed_ns"] = since(io.now, x, t)
    if stage <= DECIDED and not io.answer(x, t):
        return DECIDED
    if not io.tell(x, t, state, request):
        return SENT
    count(pace, t)
    io.store(x, t)
    return RECORDED


@rule
def wait(io: Any, x: Any, t: Any, pace: Any, plan: Any, k: int, deadline_ns: int, log_failed: int) -> bool:
    """Wait for a tick's time and stamp it; whole periods late it is the one whose time it is then.

    One that feedback wakes begins by waiting for that. False when a signal came first.
    """
    late_ns = 0
    if plan[PACED] != BY_FEEDBACK:
        late_ns = io.sleep(x, deadline_ns) - deadline_ns
    elif k == 0:
        pace[ARRIVED] = io.now(x)
    if late_ns < 0:
        return False
    skipped, period_ns = 0, plan[PERIOD_NS]
    if late_ns >= period_ns and k > 0:
        skipped = late_ns // period_ns
        k, deadline_ns, late_ns = k + skipped, deadline_ns + skipped * period_ns, late_ns % period_ns
    stamp(t, k, deadline_ns, 1 + skipped, late_ns)
    begin(t, io.asked(x, k), log_failed)
    io.begun(x, t)
    return True


@rule
def read(io: Any, x: Any, t: Any, pace: Any, plan: Any) -> bool:
    """Feedback, as the pacing has it; where none is due, what is there."""
    due = is_due(pace, plan[EVERY])
    if plan[PACED] == BY_SYNC:
        return bool(io.sync(x, t, io.until(x, t["t_ns"], plan[TIMEOUT_NS] if due else 0)))
    if plan[PACED] == BY_TIMER:
        return bool(io.receive(x, t, 0))
    return follow(io, x, t, pace, plan[PERIOD_NS], plan[WAIT_NS if due else PERIOD_NS])


@rule
def note_age(t: Any, pace: Any) -> None:
    """Paced by the timer: the newest feedback may be of an earlier tick, and ``received_ns`` says so."""
    if t["rx_flags"] & FRESH:
        pace[ARRIVED] = t["t_ns"] + t["received_ns"]
    t["received_ns"] = bounded(pace[ARRIVED] - t["t_ns"])


@rule
def follow(io: Any, x: Any, t: Any, pace: Any, period_ns: int, wait_ns: int) -> bool:
    """Feedback that wakes a tick: :func:`newest`, :func:`wake`.

    Where the kernel sends SYNC, each SYNC is one period, and its stamp is when it came.
    """
    heard = newest(io, x, t, pace, io.until(x, pace[ARRIVED], wait_ns))
    if heard < 0:
        return False
    now_ns, jumped = io.now(x), t["rx_flags"] & COUNTER_JUMP
    syncs, sent_ns = io.synced(x)
    if syncs >= 0:
        heard, jumped = syncs, 0
        now_ns = sent_ns if syncs > 0 else now_ns
    wake(t, pace, period_ns, heard, jumped, now_ns)
    t["request"] = io.asked(x, t["k"])
    return True


@rule
def missed(heard: int, jumped: int, late_ns: int, period_ns: int) -> int:
    """Periods that had no tick: those queued; where frames are missing, those that the clock counts.

    ``heard``: measurements taken; ``jumped``: not 0 when a counter says that frames are missing; ``late_ns``:
    since the next measurement was due.
    """
    queued = max(heard - 1, 0)
    if heard and not jumped:
        return queued
    return max(queued, (late_ns + (period_ns // 2 if heard else 0)) // period_ns)


@rule
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


@rule
def is_news(t: Any, state: int, request: int) -> bool:
    """Whether a tick has more to be logged than its record; ``state``, ``request``: of the one before."""
    return bool(
        t["rx_flags"] & TROUBLE != 0 or t["reason"] != 0 or t["state"] != state or t["request"] != request
    )
