"""One tick after the other: read, judge, compute, write, record. Knows ports only.

The law, the supervisor and the guard are one pure function handed in as ``step``; this module owns the
deadlines. A late tick is never caught up by a burst: whole periods are skipped and counted.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from hil.ports import Clock, Drive, Inbox, Recorder, Timed
from hil.runtime.trouble import TROUBLE, Trouble
from hil.signals import ALL_MISSING, DriveState, Reason, Request, RxFlag, TickArray, cell, ticks_from

Pacing = Literal["sync", "feedback", "timer"]
Step = Callable[[TickArray], None]
Whole = Callable[[int, int, bool], int]
"""Whole ticks in one compiled call, as far as they go: the first one's number, its deadline [ns], whether the
log failed; see :mod:`hil.runtime.fused`. It returns the stage that the last one reached."""
Pace = npt.NDArray[np.int64]
"""ARRIVED: when the newest cyclic feedback came, or was due [ns]; HEARD: how many a compiled tick has taken
of a queue that it left to the loop; SINCE: periods from the last tick with feedback to the one before. Of the
last compiled call: RAN: ticks that it recorded; LOST: periods that it skipped; NEXT: number of the tick to go
on with; DID: of several nodes' exchange or commands, how many steps are done."""
ARRIVED, HEARD, SINCE, RAN, LOST, NEXT, DID = range(7)
NOT_BEGUN, BEGUN, DECIDED, SENT, RECORDED = range(5)
"""Stages of a tick: SYNC is not out; SYNC is out, the drive has feedback to conclude; the law has run; the
command is out, where there is one; the record is stored. What is left is done here."""
MAX_NS = 2**31 - 1
NO_WAIT = 1
"""A deadline that has long passed: one feedback if it is there already."""
COUNTER_JUMP = int(RxFlag.COUNTER_JUMP)
FULL = (errno.ENOBUFS, errno.EAGAIN)
"""A bus that takes nothing more for now; what the loop sends next is still worth trying."""
QUEUE_MOST = 4096
"""Queued feedback that one tick takes; a flood can't hold it longer."""
ENDED = (int(DriveState.SWITCH_ON_DISABLED), int(DriveState.FAULT))


RAMP_DOWN, STOP = int(Request.RAMP_DOWN), int(Request.STOP)
FRESH, BUS_DOWN, SEND_FAILED = int(RxFlag.FRESH), int(RxFlag.BUS_DOWN), int(RxFlag.SEND_FAILED)
NEVER = 2**63 - 1
STEER_EVERY = 64
"""Periods between two looks at the phase of a SYNC that the kernel times."""
RAMP_EVENT = "ramp-down", "a stop was asked: the speed reference ramps to 0"


def bounded(ns: int) -> int:
    """A stamp as the record holds it."""
    return ns if -MAX_NS <= ns <= MAX_NS else (MAX_NS if ns > 0 else -MAX_NS)


def wait_ns(plan: Plan, timed: bool) -> int:
    """How long after the last feedback, or the last SYNC of the kernel's, the next is waited for.

    Where none is due a tick begins when it would have been due: :func:`is_due`.
    """
    return plan.period_ns + plan.timeout_ns if timed else plan.period_ns * 3 // 2


class StopRequest:
    """What the operator asks: nothing, a stop (first Ctrl-C, SIGTERM) or a quick stop (second).

    ``cell`` holds it for compiled ticks.
    """

    ramps = True
    """Whether a stop lets the reference ramp to 0 first, as the config says."""
    polled = False
    """Whether :attr:`value` has to be read in each tick for something to be found out."""
    STOPS = (int(Request.STOP), int(Request.QUICK_STOP))

    def __init__(self) -> None:
        self.cell = np.zeros(1, np.int64)
        self._cell: Any = self.cell.data  # an item of it costs half of one of the array's
        self._cell[0] = int(Request.ARM)

    @property
    def value(self) -> int:
        """The request of this moment."""
        return int(self._cell[0])

    @value.setter
    def value(self, new: int) -> None:
        self._cell[0] = new

    def stop(self, *_: object) -> None:
        """Ask for a stop; asked twice, for a quick stop. Safe as a signal handler."""
        again = self.value in self.STOPS
        self.value = int(Request.QUICK_STOP if again else Request.STOP)


@dataclass(frozen=True, slots=True)
class Plan:
    """Timing of a run: period and feedback timeout [ns], pacing, length in ticks (None: until stopped).

    ``every``: ticks from one feedback to the next. ``together``: ticks that one compiled call may run; a
    signal that comes while none of them waits is late by so much.
    """

    period_ns: int
    timeout_ns: int
    pacing: Pacing
    ticks: int | None
    every: int = 1
    together: int = 1


@dataclass(slots=True)
class Outcome:
    """What a run was: ticks, skipped periods, why it ended."""

    ticks: int = 0
    skipped: int = 0
    reason: int = 0
    state: int = 0
    stop: TickArray | None = None
    """The first tick with a reason."""


def new_pace() -> Pace:
    """All zero."""
    return np.zeros(DID + 1, np.int64)


def none_compiled(_k: int, _deadline_ns: int, _log_failed: bool) -> int:
    """Every tick is left to the loop."""
    return NOT_BEGUN


def no_whole(_pace: Pace) -> Whole:
    """No tick is compiled."""
    return none_compiled


def transition_event(state: int, reason: int) -> tuple[str, str]:
    """Kind and text of the event that a change of the supervisor's state is logged as."""
    name = DriveState(state).name
    return ("stop", f"{name}: {Reason(reason).name}") if reason else ("state", name)


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
def is_due(pace: Any, fresh: int, gap: int, every: int) -> bool:
    """Whether this tick is to have feedback; ``fresh``, ``gap``: of the tick before.

    Once it has not come when it was due, each tick is to.
    """
    pace[SINCE] = 0 if fresh else pace[SINCE] + gap
    return bool(pace[SINCE] + 1 >= every)


class Cells:
    """The fields of the tick that the loop itself writes and reads."""

    __slots__ = (
        "computed_ns", "gap", "k", "lateness_ns", "log_failed", "missing", "reason", "received_ns",
        "recorded_ns", "request", "rx_flags", "send", "sent_ns", "skipped", "state", "t_ns",
    )  # fmt: skip

    def __init__(self, ticks: TickArray) -> None:
        for name in self.__slots__:
            setattr(self, name, cell(ticks, name))


class Loop:
    """A closed loop over a drive port. :meth:`run` returns after a safe stop, whatever happened.

    It is prepared when it is made: that sends nothing and takes longer than many ticks.

    ``whole`` makes, for the prepared drive and the loop's pace, the ticks in which nothing is unusual; what
    they leave is done by the rules here, which are its own.
    """

    def __init__(
        self,
        drive: Drive,
        clock: Clock,
        recorder: Recorder,
        step: Step,
        ticks: TickArray,
        plan: Plan,
        request: StopRequest,
        whole: Callable[[Pace], Whole] = no_whole,
        inbox: Inbox | None = None,
        timed: Timed | None = None,
    ) -> None:
        self._timed = timed
        self._drive, self._clock, self._recorder = drive, clock, recorder
        self._step, self._ticks, self._plan, self._request = step, ticks, plan, request
        self._end = NEVER if plan.ticks is None else plan.ticks
        self._sends_sync = plan.pacing == "sync"
        self._cells: Any = Cells(ticks)
        self._outcome, self._trouble = Outcome(), Trouble(recorder.event)
        pace = new_pace()
        self._pace: Any = pace.data
        self._start_ns = 0
        self._inbox, self._taken = inbox, 0
        self._number: Any = inbox.number if inbox else [0]
        self._state = int(DriveState.SWITCH_ON_DISABLED)
        self._requested = int(Request.ARM)
        self._tick: Any = ticks[0]
        drive.prepare(self._tick)
        self._whole = whole(pace)
        self._ended = False  # True once the supervisor has left every state in which it drives

    def run(self) -> Outcome:
        """Run until the supervisor has ended the run. The drive is stopped on every way out."""
        try:
            self._run()
        finally:
            if self._timed is not None:
                self._timed.stop()
            self._drive.stop()
        return self._outcome

    def _run(self) -> None:
        period_ns, tick, whole, pace = self._plan.period_ns, self._tick, self._whole, self._pace
        compiled = whole is not none_compiled
        start_ns = self._start_ns = self._clock.now_ns()
        if self._timed is not None:
            self._timed.start()
        k = 0
        while True:
            stage = NOT_BEGUN
            if compiled:
                self._asked(k)  # a set-point that waits, and what has to be polled
                pace[RAN], pace[LOST], pace[NEXT] = 0, 0, k
                stage = whole(k, start_ns + k * period_ns, self._recorder.failed)
                self._outcome.ticks += pace[RAN]
                self._outcome.skipped += pace[LOST]
                k = pace[NEXT]
            if stage != RECORDED:
                k = self._rest(stage, tick, k, start_ns + k * period_ns) + 1
                self._outcome.ticks += 1
            if self._ended:
                return
            if self._timed is not None and not (k - 1) % STEER_EVERY:
                self._timed.steer(k - 1, start_ns + (k - 1) * period_ns)

    def _asked(self, k: int) -> int:
        """What is asked of the supervisor; at the end of the run a stop, at least."""
        asked = self._request.value
        if k >= self._end:
            asked = max(STOP, asked)
        if self._number[0] != self._taken:
            self._take(k, asked)
        return asked

    def _take(self, k: int, asked: int) -> None:
        """A set-point of another process, into the reference of this tick or refused."""
        assert self._inbox is not None  # noqa: S101 - without one the number stays 0
        if text := self._inbox.take(self._states(), asked):
            self._taken = self._number[0]
            self._recorder.event(self._start_ns + k * self._plan.period_ns, k, "set-point", text)

    def _states(self) -> tuple[int, ...]:
        """Of each node's supervisor."""
        return (self._cells.state[0],)

    def _rest(self, stage: int, tick: Any, k: int, deadline_ns: int) -> int:
        """What is left of a tick that got to ``stage``; return k, which may have moved on."""
        if stage == NOT_BEGUN:
            k = self._on_time(tick, k, deadline_ns)
        elif stage == BEGUN:
            k = self._one(tick, k, deadline_ns, 1, deadline_ns + self._cells.lateness_ns[0], begun=True)
        else:
            if stage == DECIDED:
                self._answer(tick, deadline_ns)
            self._note(k, deadline_ns)
        return k

    def _on_time(self, tick: Any, k: int, deadline_ns: int) -> int:
        """Wait for the tick's time and run it, or the one whose time it is then; return its k."""
        clock, plan = self._clock, self._plan
        now_ns = clock.sleep_until(deadline_ns) if plan.pacing != "feedback" else clock.now_ns()
        gap = 1
        if now_ns - deadline_ns >= plan.period_ns:
            k, gap = self._skip(k, deadline_ns, now_ns)
            deadline_ns += (gap - 1) * plan.period_ns
        return self._one(tick, k, deadline_ns, gap, now_ns)

    def _skip(self, k: int, deadline_ns: int, now_ns: int) -> tuple[int, int]:
        """Return the tick to run now and the periods since the last one; whole periods late are skipped."""
        if self._plan.pacing == "feedback" or k == 0:
            return k, 1
        skipped = (now_ns - deadline_ns) // self._plan.period_ns
        self._outcome.skipped += skipped
        return k + skipped, 1 + skipped

    def _one(self, tick: Any, k: int, deadline_ns: int, gap: int, now_ns: int, begun: bool = False) -> int:
        """Read, judge, compute, write, record; return k, which a queue of feedback may have moved on.

        ``begun``: by a compiled tick, which has counted it.
        """
        now, t = self._clock.now_ns, self._cells
        due = begun or is_due(self._pace, t.rx_flags[0] & FRESH, t.gap[0], self._plan.every)
        self._stamp(k, deadline_ns, gap, now_ns)
        if not self._pace[HEARD]:
            t.rx_flags[0], t.missing[0] = 0, ALL_MISSING
        if self._sends_sync:
            self._exchange(tick, deadline_ns, due)
        elif self._plan.pacing == "timer":
            self._drive.receive(tick, 0)
        else:
            k, deadline_ns = self._newest_feedback(tick, k, deadline_ns, due)
        t.received_ns[0] = bounded(now() - deadline_ns)
        if self._plan.pacing == "timer":
            self._note_age(deadline_ns)
        self._step(self._ticks)
        t.computed_ns[0] = bounded(now() - deadline_ns)
        self._answer(tick, deadline_ns)
        self._note(k, deadline_ns)
        return k

    def _answer(self, tick: Any, deadline_ns: int) -> None:
        """Send the command where there is one."""
        t = self._cells
        if t.send[0]:
            self._send(tick)
        t.sent_ns[0] = bounded(self._clock.now_ns() - deadline_ns)

    def _note(self, k: int, deadline_ns: int) -> None:
        """Log what is new, then the record; find out whether the run has ended."""
        t = self._cells
        if t.rx_flags[0] & TROUBLE:
            self._trouble.note(deadline_ns, k, t.rx_flags[0])
        if t.state[0] != self._state:
            self._state = t.state[0]
            self._recorder.event(deadline_ns, k, *transition_event(self._state, t.reason[0]))
        if t.request[0] != self._requested:
            self._requested = t.request[0]
            if self._requested == RAMP_DOWN:
                self._recorder.event(deadline_ns, k, *RAMP_EVENT)
        self._recorder.tick(self._ticks)
        t.recorded_ns[0] = bounded(self._clock.now_ns() - deadline_ns)
        if t.reason[0]:
            if self._outcome.stop is None:
                self._outcome.stop = ticks_from(self._ticks.tobytes())  # .copy() goes field by field
            self._outcome.state, self._outcome.reason = t.state[0], t.reason[0]
            self._ended = t.state[0] in ENDED

    def _newest_feedback(self, tick: Any, k: int, deadline_ns: int, due: bool = True) -> tuple[int, int]:
        """Wait for cyclic feedback; of several that queued up the newest counts, the others as skipped.

        Each feedback is one period of the drive's clock, and so is each that is missing: k follows the time.
        Where the kernel sends SYNC, each SYNC is one period, and its stamp is when it came.
        Lateness is how much later it came than it was due. Returns k and its deadline.
        """
        flags, pace = self._cells.rx_flags, self._pace
        plan, drive, fresh = self._plan, self._drive, int(RxFlag.FRESH)
        if not k:
            pace[ARRIVED] = self._clock.now_ns()
        heard, pace[HEARD] = pace[HEARD], 0
        wait = wait_ns(plan, self._timed is not None) if due else plan.period_ns
        until_ns = self._clock.receive_deadline(pace[ARRIVED], wait)
        drive.receive(tick, NO_WAIT if heard else until_ns)
        while flags[0] & fresh and heard < QUEUE_MOST:
            heard += 1
            flags[0] = flags[0] & ~fresh
            drive.receive(tick, NO_WAIT)
        now_ns, jumped = self._clock.now_ns(), flags[0] & COUNTER_JUMP
        if heard:
            flags[0] = flags[0] | fresh
        if self._timed is not None:
            heard, stamp_ns = self._timed.taken()
            now_ns, jumped = stamp_ns if heard else now_ns, 0
        late_ns = now_ns - pace[ARRIVED] - plan.period_ns
        skipped = missed(heard, jumped, late_ns, plan.period_ns) if k else 0
        if skipped:
            k, deadline_ns = k + skipped, deadline_ns + skipped * plan.period_ns
            self._outcome.skipped += skipped
        expected_ns = pace[ARRIVED] + (1 + skipped) * plan.period_ns if k else now_ns
        self._stamp(k, deadline_ns, 1 + skipped, now_ns + deadline_ns - expected_ns)
        pace[ARRIVED] = now_ns if heard else expected_ns
        return k, deadline_ns

    def _note_age(self, deadline_ns: int) -> None:
        """Paced by the timer: the newest feedback may be of an earlier tick, and ``received_ns`` says so."""
        t = self._cells
        if t.rx_flags[0] & int(RxFlag.FRESH):
            self._pace[ARRIVED] = deadline_ns + t.received_ns[0]
        t.received_ns[0] = max(self._pace[ARRIVED] - deadline_ns, -MAX_NS)

    def _stamp(self, k: int, deadline_ns: int, gap: int, now_ns: int) -> None:
        t = self._cells
        t.k[0] = k
        t.t_ns[0] = deadline_ns
        t.gap[0] = gap
        t.skipped[0] = gap - 1
        t.lateness_ns[0] = bounded(now_ns - deadline_ns)
        t.request[0] = self._asked(k)
        t.log_failed[0] = self._recorder.failed

    def _exchange(self, tick: Any, deadline_ns: int, due: bool) -> None:
        """SYNC out and feedback in; where none is due, what is there."""
        wait = self._plan.timeout_ns if due else 0
        try:
            self._drive.exchange(tick, self._clock.receive_deadline(deadline_ns, wait))
        except OSError as error:
            self._cells.rx_flags[0] |= SEND_FAILED if error.errno in FULL else BUS_DOWN

    def _send(self, tick: Any) -> None:
        """Send the command; a bus that does not take it is seen by the supervisor in the next tick."""
        try:
            self._drive.send(tick)
        except OSError as error:
            t = self._cells
            self._recorder.event(t.t_ns[0], t.k[0], "send-failed", str(error))
