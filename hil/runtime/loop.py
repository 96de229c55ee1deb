"""One tick after the other: read, judge, compute, write, record. Knows ports only.

The law, the supervisor and the guard are one pure function handed in as ``step``; this module owns the
deadlines. A late tick is never caught up by a burst: whole periods are skipped and counted.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.ports import Clock, Drive, Inbox, Recorder, Timed
from hil.runtime.rules import (
    END,
    LOST,
    NEVER,
    NEXT,
    NOT_BEGUN,
    PACINGS,
    RAN,
    RECORDED,
    STEER_EVERY,
    Fields,
    Pace,
    Pacing,
    Timing,
    asked_in,
    is_news,
    new_pace,
    run_tick,
    since,
)
from hil.runtime.trouble import TROUBLE, Trouble
from hil.signals import DriveState, Reason, Request, RxFlag, TickArray, ticks_from

Step = Callable[[TickArray], None]
Whole = Callable[[int, int, bool], int]
"""Whole ticks in one compiled call, as far as they go: the first one's number, its deadline [ns], whether the
log failed; see :mod:`hil.runtime.fused`. It returns the stage that the last one reached."""
FULL = (errno.ENOBUFS, errno.EAGAIN)
"""A bus that takes nothing more for now; what the loop sends next is still worth trying."""
ENDED = (int(DriveState.SWITCH_ON_DISABLED), int(DriveState.FAULT))
RAMP_DOWN = int(Request.RAMP_DOWN)
BUS_DOWN, SEND_FAILED = int(RxFlag.BUS_DOWN), int(RxFlag.SEND_FAILED)
RAMP_EVENT = "ramp-down", "a stop was asked: the speed reference ramps to 0"


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

    ``every``: ticks from one feedback to the next. ``together``: periods, skipped ones too, after which a
    compiled call begins no other tick; a signal that comes while none of them waits is late by so much.
    """

    period_ns: int
    timeout_ns: int
    pacing: Pacing
    ticks: int | None
    every: int = 1
    together: int = 1


def timing_of(plan: Plan, timed: bool, sync_bytes: int = 0) -> Timing:
    """The plan, as the rules read it; ``timed``: the kernel sends SYNC, of that size."""
    end = NEVER if plan.ticks is None else plan.ticks
    wait_ns = plan.period_ns + plan.timeout_ns if timed else plan.period_ns * 3 // 2
    paced = PACINGS.index(plan.pacing)
    row = plan.period_ns, plan.timeout_ns, end, wait_ns, plan.every, plan.together, paced, sync_bytes
    return np.array(row, np.int64)


@dataclass(slots=True)
class Outcome:
    """What a run was: ticks, skipped periods, why it ended."""

    ticks: int = 0
    skipped: int = 0
    reason: int = 0
    state: int = 0
    stop: TickArray | None = None
    """The first tick with a reason."""


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


class Course:
    """What is logged of a drive besides its records, and how its run ends; ``of`` is before what is said.

    Only of a drive alone, or the first, it is said that a stop ramps.
    """

    def __init__(self, t: Fields, ticks: TickArray, recorder: Recorder, of: str = "") -> None:
        self._t, self._ticks, self._recorder, self._of = t, ticks, recorder, of
        self._trouble = Trouble(self._say)
        self._state, self._request = int(DriveState.SWITCH_ON_DISABLED), int(Request.ARM)
        self.outcome, self._ended = Outcome(), False

    def _say(self, t_ns: int, k: int, kind: str, text: str) -> None:
        self._recorder.event(t_ns, k, kind, self._of + text)

    def tell(self) -> None:
        """Log what is new in this tick."""
        t = self._t
        if not is_news(t, self._state, self._request):
            return
        t_ns, k, state, request = t["t_ns"], t["k"], t["state"], t["request"]
        if t["rx_flags"] & TROUBLE:
            self._trouble.note(t_ns, k, t["rx_flags"])
        if state != self._state:
            self._say(t_ns, k, *transition_event(state, t["reason"]))
        if request != self._request and request == RAMP_DOWN and not self._of:
            self._say(t_ns, k, *RAMP_EVENT)
        self._state, self._request = state, request

    def conclude(self) -> bool:
        """Whether the run has ended, with the tick as it stands: no state in which it drives is left."""
        t, outcome = self._t, self.outcome
        if t["reason"]:
            if outcome.stop is None:
                outcome.stop = ticks_from(self._ticks.tobytes())  # .copy() goes field by field
            outcome.state, outcome.reason = t["state"], t["reason"]
            self._ended = t["state"] in ENDED
        return self._ended


class Loop:
    """A closed loop over a drive port. :meth:`run` returns after a safe stop, whatever happened.

    It is prepared when it is made: that sends nothing and takes longer than many ticks.

    ``whole`` makes, for the prepared drive and the loop's pace, the ticks in which nothing is unusual; what
    they leave is done here, by the same rules: :mod:`hil.runtime.rules`.
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
        self._timing: Any = timing_of(plan, timed is not None).data
        self._t = Fields(ticks)
        self._courses = [Course(self._t, ticks, recorder)]
        self._outcome = self._courses[0].outcome
        pace = new_pace()
        self._pace: Any = pace.data
        self._start_ns = 0
        self._inbox, self._taken = inbox, 0
        self._number: Any = inbox.number if inbox else [0]
        self._tick: Any = ticks[0]
        drive.prepare(self._tick)
        self._whole = whole(pace)

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
        period_ns, whole, pace, plan = self._plan.period_ns, self._whole, self._pace, self._timing
        compiled, outcome, t = whole is not none_compiled, self._outcome, self._t
        start_ns = self._start_ns = self._clock.now_ns()
        if self._timed is not None:
            self._timed.start()
        k, stage, ended = 0, NOT_BEGUN, False
        while not ended:
            if compiled:
                self.asked(k)  # a set-point that waits, and what has to be polled
                pace[RAN], pace[LOST], pace[NEXT] = 0, 0, k
                stage = whole(k, start_ns + k * period_ns, self._recorder.failed)
                outcome.ticks += pace[RAN]
                outcome.skipped += pace[LOST]
                k = pace[NEXT]
            if stage != RECORDED:
                failed = self._recorder.failed
                run_tick(type(self), self, t, pace, plan, stage, k, start_ns + k * period_ns, failed)
                ended = all([*map(Course.conclude, self._courses)])
                outcome.ticks += 1
                outcome.skipped += t["skipped"]
                k = t["k"] + 1
            if self._timed is not None and not (ended or (k - 1) % STEER_EVERY):
                self._timed.steer(k - 1, start_ns + (k - 1) * period_ns)

    def asked(self, k: int) -> int:
        """What is asked of the supervisor, once a set-point that waits is taken."""
        asked = asked_in(k, self._timing[END], self._request.value)
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
        return (self._t["state"],)

    def sleep(self, deadline_ns: int) -> int:
        """Wait by this clock. A part of a tick, as what follows: :class:`hil.runtime.rules.Parts`."""
        return self._clock.sleep_until(deadline_ns)

    def now(self) -> int:
        """Time of this clock."""
        return self._clock.now_ns()

    def until(self, ns: int, wait: int) -> int:
        """The deadline by this clock."""
        return self._clock.receive_deadline(ns, wait)

    def begun(self, t: Fields) -> None:
        """There is no other node."""

    def sync(self, t: Fields, deadline_ns: int) -> bool:
        """SYNC out and feedback in."""
        try:
            self._drive.exchange(self._tick, deadline_ns)
        except OSError as error:
            t["rx_flags"] |= SEND_FAILED if error.errno in FULL else BUS_DOWN
        return True

    def receive(self, t: Fields, deadline_ns: int) -> bool:
        """Feedback alone."""
        self._drive.receive(self._tick, deadline_ns)
        return True

    def synced(self) -> tuple[int, int]:
        """SYNCs of the kernel's."""
        return (-1, 0) if self._timed is None else self._timed.taken()

    def law(self, t: Fields) -> bool:
        """Law, supervisor and guard."""
        self._step(self._ticks)
        return True

    def answer(self, t: Fields) -> bool:
        """Send the command; a bus that does not take it is seen by the supervisor in the next tick."""
        try:
            if t["send"]:
                self._drive.send(self._tick)
        except OSError as error:
            self._recorder.event(t["t_ns"], t["k"], "send-failed", str(error))
        t["sent_ns"] = since(Loop.now, self, t)
        return True

    def tell(self, t: Fields, state: int, request: int) -> bool:
        """Log what is new."""
        for course in self._courses:
            course.tell()
        return True

    def store(self, t: Fields) -> None:
        """The record into its ring."""
        self._recorder.tick(self._ticks)
        t["recorded_ns"] = since(Loop.now, self, t)
