"""One tick after the other: read, judge, compute, write, record. Knows ports only.

The law, the supervisor and the guard are one pure function handed in as ``step``; this module owns the
deadlines. A late tick is never caught up by a burst: whole periods are skipped and counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from hil.ports import Clock, Drive, Recorder
from hil.signals import DriveState, Reason, Request, RxFlag, TickArray

Pacing = Literal["sync", "feedback", "timer"]
Step = Callable[[TickArray], None]
MAX_NS = 2**31 - 1
NO_WAIT = 1
"""A deadline that has long passed: one feedback if it is there already."""
QUEUE_MOST = 4096
"""Queued feedback that one tick takes; a flood can't hold it longer."""


class StopRequest:
    """What the operator asks: nothing, a stop (first Ctrl-C, SIGTERM) or a quick stop (second)."""

    STOPS = (int(Request.STOP), int(Request.QUICK_STOP))

    def __init__(self) -> None:
        self.value = int(Request.ARM)

    def stop(self, *_: object) -> None:
        """Ask for a stop; asked twice, for a quick stop. Safe as a signal handler."""
        again = self.value in self.STOPS
        self.value = int(Request.QUICK_STOP if again else Request.STOP)


@dataclass(frozen=True, slots=True)
class Plan:
    """Timing of a run: period and feedback timeout [ns], pacing, length in ticks (None: until stopped)."""

    period_ns: int
    timeout_ns: int
    pacing: Pacing
    ticks: int | None


@dataclass(slots=True)
class Outcome:
    """What a run was: ticks, skipped periods, why it ended."""

    ticks: int = 0
    skipped: int = 0
    reason: int = 0
    state: int = 0


def transition_event(state: int, reason: int) -> tuple[str, str]:
    """Kind and text of the event that a change of the supervisor's state is logged as."""
    name = DriveState(state).name
    return ("stop", f"{name}: {Reason(reason).name}") if reason else ("state", name)


class Loop:
    """A closed loop over a drive port. :meth:`run` returns after a safe stop, whatever happened."""

    def __init__(
        self,
        drive: Drive,
        clock: Clock,
        recorder: Recorder,
        prepare: Step,
        step: Step,
        ticks: TickArray,
        plan: Plan,
        request: StopRequest,
    ) -> None:
        self._drive, self._clock, self._recorder = drive, clock, recorder
        self._prepare, self._step = prepare, step
        self._ticks, self._plan, self._request = ticks, plan, request
        self._outcome = Outcome()
        self._arrived_ns = 0
        self._state = int(DriveState.SWITCH_ON_DISABLED)

    def run(self) -> Outcome:
        """Run until the supervisor has ended the run. The drive is stopped on every way out."""
        try:
            self._run()
        finally:
            self._drive.stop()
        return self._outcome

    def _run(self) -> None:
        tick: Any = self._ticks[0]
        clock, plan, outcome = self._clock, self._plan, self._outcome
        start_ns = clock.now_ns()
        k = 0
        while True:
            deadline_ns = start_ns + k * plan.period_ns
            now_ns = clock.sleep_until(deadline_ns) if plan.pacing != "feedback" else clock.now_ns()
            k, gap = self._skip(k, deadline_ns, now_ns)
            k = self._one(tick, k, start_ns + k * plan.period_ns, gap, now_ns)
            outcome.ticks += 1
            if self._ended(tick, k):
                return
            k += 1

    def _skip(self, k: int, deadline_ns: int, now_ns: int) -> tuple[int, int]:
        """Return the tick to run now and the periods since the last one; whole periods late are skipped."""
        if self._plan.pacing == "feedback" or k == 0:
            return k, 1
        skipped = (now_ns - deadline_ns) // self._plan.period_ns
        if skipped <= 0:
            return k, 1
        self._outcome.skipped += skipped
        return k + skipped, 1 + skipped

    def _one(self, tick: Any, k: int, deadline_ns: int, gap: int, now_ns: int) -> int:
        """Read, judge, compute, write, record; return k, which a queue of feedback may have moved on."""
        clock = self._clock
        self._stamp(tick, k, deadline_ns, gap, now_ns)
        tick["rx_flags"] = 0
        if self._plan.pacing == "feedback":
            k, deadline_ns = self._newest_feedback(tick, k, deadline_ns)
        else:
            self._exchange(tick, deadline_ns)
        tick["received_ns"] = min(clock.now_ns() - deadline_ns, MAX_NS)
        self._prepare(self._ticks)
        self._step(self._ticks)
        tick["computed_ns"] = min(clock.now_ns() - deadline_ns, MAX_NS)
        if tick["send"]:
            self._send(tick)
        tick["sent_ns"] = min(clock.now_ns() - deadline_ns, MAX_NS)
        if tick["state"] != self._state:
            self._state = int(tick["state"])
            self._recorder.event(deadline_ns, k, *transition_event(self._state, int(tick["reason"])))
        self._recorder.tick(self._ticks)
        tick["recorded_ns"] = min(clock.now_ns() - deadline_ns, MAX_NS)
        return k

    def _newest_feedback(self, tick: Any, k: int, deadline_ns: int) -> tuple[int, int]:
        """Wait for cyclic feedback; of several that queued up the newest counts, the others as skipped.

        Each feedback is one period of the drive's clock; lateness is then how much later it came than one
        period after the last. Returns k and its deadline.
        """
        plan, drive, fresh = self._plan, self._drive, int(RxFlag.FRESH)
        wait_ns = plan.period_ns * 3 // 2
        drive.receive(tick, self._clock.receive_deadline(self._clock.now_ns(), wait_ns))
        heard = 0
        while int(tick["rx_flags"]) & fresh and heard < QUEUE_MOST:
            heard += 1
            tick["rx_flags"] = int(tick["rx_flags"]) & ~fresh
            drive.receive(tick, NO_WAIT)
        skipped = max(heard - 1, 0) if k else 0
        if heard:
            tick["rx_flags"] = int(tick["rx_flags"]) | fresh
        if skipped:
            k, deadline_ns = k + skipped, deadline_ns + skipped * plan.period_ns
            self._outcome.skipped += skipped
        now_ns = self._clock.now_ns()
        expected_ns = self._arrived_ns + (1 + skipped) * plan.period_ns if k else now_ns
        self._stamp(tick, k, deadline_ns, 1 + skipped, now_ns + deadline_ns - expected_ns)
        self._arrived_ns = now_ns
        return k, deadline_ns

    def _stamp(self, tick: Any, k: int, deadline_ns: int, gap: int, now_ns: int) -> None:
        tick["k"] = k
        tick["t_ns"] = deadline_ns
        tick["gap"] = gap
        tick["skipped"] = gap - 1
        tick["lateness_ns"] = max(min(now_ns - deadline_ns, MAX_NS), -MAX_NS)
        tick["request"] = self._requested(k)
        tick["log_failed"] = self._recorder.failed

    def _requested(self, k: int) -> int:
        """The operator's request; at the end of the planned length, a stop."""
        if self._plan.ticks is not None and k >= self._plan.ticks:
            return max(int(Request.STOP), self._request.value)
        return self._request.value

    def _exchange(self, tick: Any, deadline_ns: int) -> None:
        """SYNC out and feedback in (sync), or what has come (timer)."""
        plan, drive = self._plan, self._drive
        if plan.pacing == "timer":
            drive.receive(tick, 0)
            return
        if plan.pacing == "sync":
            try:
                drive.sync(tick)
            except OSError:
                tick["rx_flags"] |= int(RxFlag.BUS_DOWN)
                return
            drive.receive(tick, self._clock.receive_deadline(deadline_ns, plan.timeout_ns))

    def _send(self, tick: Any) -> None:
        """Send the command; a bus that does not take it is seen by the supervisor in the next tick."""
        try:
            self._drive.send(tick)
        except OSError as error:
            tick["send"] = 0
            self._recorder.event(int(tick["t_ns"]), int(tick["k"]), "send-failed", str(error))

    def _ended(self, tick: Any, k: int) -> bool:
        """True once the supervisor has left every state in which it drives the drive."""
        self._outcome.state, self._outcome.reason = int(tick["state"]), int(tick["reason"])
        done = tick["state"] in (int(DriveState.SWITCH_ON_DISABLED), int(DriveState.FAULT))
        return bool(done and tick["reason"] != Reason.NONE)
