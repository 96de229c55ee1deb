"""The tick of two nodes on one bus: one SYNC, then for each node read, judge, compute, write, record.

A node is a whole controller: its records, law, guard and supervisor are those of a run of one drive, and so
are the kernels. Here is what they share: time, SYNC, the guardian's words, and the rule that none drives on
alone. When one leaves operation by a fault or a quick stop, the others are asked to stop in the same tick:
their tick is computed once more, from the same state, with that request as its input.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, Protocol

from hil.config.design import Machine
from hil.log.recorder import Recorder
from hil.ports import Clock, Inbox
from hil.runtime.guardian import ARMED, BEAT_NS, DISARMED, FIRED, GUARD_NS, Words, guardian_flags
from hil.runtime.loop import (
    BUS_DOWN,
    FULL,
    SEND_FAILED,
    Course,
    Loop,
    Outcome,
    Plan,
    StopRequest,
    Whole,
    no_whole,
)
from hil.runtime.rules import DID, Fields, Pace, begin, since, stamp
from hil.signals import Reason, Request, TickArray
from hil.tick.pair import ask, leads, tell
from hil.tick.undo import Undo

COUNTERS: Final = GUARD_NS + 1
"""Word of the first node's newest command counter; those of the others follow."""
ALONE: Final = (int(Reason.NONE), int(Reason.STOP_REQUESTED), int(Reason.NODE_STOPPED))
"""Reasons with which a node leaves the others as they are: each ends an orderly stop by its own ramp."""
LEFT: Final = -1
"""In place of how many commands are sent: none, the laws have run, and the others must stop with one."""
NODE_STOPPED: Final = int(Request.NODE_STOPPED)


class Client(Protocol):
    """What a tick asks of a node's client, :class:`drivers.client.DriveClient`."""

    def prepare(self, tick: Any) -> None:
        """Get ready for this very record."""

    def sync(self, tick: Any) -> None:
        """Send SYNC, for all nodes; what came before is taken as late."""

    def follow(self, tick: Any) -> None:
        """Take what came before another client's SYNC as late."""

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Wait for the node's measurements."""

    def send(self, tick: Any) -> None:
        """Send the tick's command. Raises OSError."""

    def stop(self) -> None:
        """Send the stop frames and leave; never raises."""

    def flush(self) -> None:
        """Hand on the frames that came and went."""

    def compiled(self) -> Any:
        """What a compiled tick calls; None: the loop calls the methods."""

    def odd_length(self) -> str:
        """Which message came with another length than it should, in words."""

    def close(self) -> None:
        """Release the bus."""


class Axis:
    """One node: its client, controller and record."""

    def __init__(self, name: str, client: Client, machine: Machine, ticks: TickArray) -> None:
        self.name, self.client, self.machine, self.ticks = name, client, machine, ticks
        self.tick: Any = ticks[0]
        self.t = Fields(ticks)
        self.step = machine.looped()
        self.outcome = Outcome()
        states = (machine.safety_state, machine.law_state, machine.setpoint_state)
        self.undo = Undo(machine.safety, machine.law, states)
        client.prepare(self.tick)

    def decide(self) -> bool:
        """Run the controller; True when the others must stop with it."""
        self.undo.keep()
        self.step(self.ticks)
        return self.t["reason"] not in ALONE

    def stop_too(self) -> None:
        """The same tick once more for a node that has no reason of its own: another one has."""
        if self.t["reason"]:
            return
        self.undo.restore()
        self.t["request"] = NODE_STOPPED
        self.step(self.ticks)


class Together:
    """The nodes as the one drive that a loop stops; each was prepared with its own record."""

    def __init__(self, axes: Sequence[Axis], words: Any) -> None:
        self._axes, self._words = axes, words

    def prepare(self, tick: Any) -> None:
        """Done by each node."""

    def exchange(self, tick: Any, deadline_ns: int, did: int = 0) -> None:
        """SYNC once, then each node's feedback; nothing is sent once the guardian has fired.

        The last node is waited for first: its answer is the last on the bus, and the others' are there then.
        ``did``: how many of these steps a compiled tick has done: what came late of each node after the
        first, SYNC, the feedback of each.
        """
        first, *more = self._axes
        steps = [*(partial(self.late, axis) for axis in more), partial(self.open, first)]
        steps += [partial(self.listen, axis, deadline_ns) for axis in reversed(self._axes)]
        for step in steps[did:]:
            step()

    @staticmethod
    def late(axis: Axis) -> None:
        """What came late of a node; it stands before the SYNC in the log, too."""
        axis.client.follow(axis.tick)
        axis.client.flush()

    def open(self, axis: Axis) -> None:
        """SYNC, after what came late of its node."""
        if self._words is not None and self._words[FIRED]:
            axis.client.follow(axis.tick)
        else:
            axis.client.sync(axis.tick)
        axis.client.flush()

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Each node's feedback."""
        for axis in self._axes:
            self.listen(axis, deadline_ns)

    @staticmethod
    def listen(axis: Axis, deadline_ns: int) -> None:
        """One node's feedback; its frames are logged before the next node's."""
        axis.client.receive(axis.tick, deadline_ns)
        axis.client.flush()

    def send(self, tick: Any) -> None:
        """Each node sends its own command: see :class:`NodesLoop`."""

    def stop(self) -> None:
        """The stop frames of each node in the configuration's order; the guardian's stand."""
        if self._words is None or not self._words[FIRED]:
            for axis in self._axes:
                axis.client.stop()
        if self._words is not None:
            self._words[ARMED] = 0

    def close(self) -> None:
        """Release the bus."""
        for axis in reversed(self._axes):
            axis.client.close()


class NodesLoop(Loop):
    """:class:`hil.runtime.loop.Loop` over several nodes; it ends when all have ended."""

    def __init__(
        self,
        axes: Sequence[Axis],
        clock: Clock,
        recorder: Recorder,
        plan: Plan,
        request: StopRequest,
        words: Words | None = None,
        whole: Callable[[Pace], Whole] = no_whole,
        inbox: Inbox | None = None,
    ) -> None:
        self._axes, self._more, self._rings = axes, axes[1:], recorder
        self._words: Any = words.cells if words else None
        self._together, first = Together(axes, self._words), axes[0]
        self._lead = next((axis for axis in axes if leads(axis.machine.law)), None)
        super().__init__(
            self._together, clock, recorder, first.step, first.ticks, plan, request, whole, inbox
        )
        self._courses += [Course(axis.t, axis.ticks, recorder, f"{axis.name}: ") for axis in self._more]
        for axis, course in zip(axes, self._courses, strict=True):
            axis.outcome = course.outcome

    def begun(self, t: Fields) -> None:
        """All ticks are as the first."""
        self._pace[DID] = 0
        for axis in self._more:
            stamp(axis.t, t["k"], t["t_ns"], t["gap"], t["lateness_ns"])
            begin(axis.t, t["request"], t["log_failed"])

    def sync(self, t: Fields, deadline_ns: int) -> bool:
        """SYNC out and feedback in; a SYNC that is not out is told to all, and what the guardian did."""
        words, flags = self._words, 0
        if words is not None:
            words[BEAT_NS] = self._clock.now_ns()
        try:
            self._together.exchange(self._tick, deadline_ns, self._pace[DID])
        except OSError as error:
            flags = SEND_FAILED if error.errno in FULL else BUS_DOWN
        flags |= 0 if words is None else guardian_flags(words)
        for axis in self._axes:
            axis.t["rx_flags"] |= flags
        self._pace[DID] = 0
        return True

    def law(self, t: Fields) -> bool:
        """Each node's controller; once one has left by a fault or a quick stop, all stop in this tick."""
        for axis in self._more:
            axis.t["received_ns"] = t["received_ns"]
        if self._pace[DID] == LEFT or self._decided():
            for axis in self._axes:
                axis.stop_too()
        self._pace[DID] = 0
        return True

    def _decided(self) -> bool:
        """Each node's controller, one that commands the other first; True when all must stop with one."""
        if self._lead is None:
            left = [axis.decide() for axis in self._axes]
            return any(left)
        lead, (load,) = self._lead, [axis for axis in self._axes if axis is not self._lead]
        tell(lead.ticks, load.ticks, load.machine.law)
        leaves = lead.decide()
        ask(lead.ticks, load.ticks, load.machine.law)
        return load.decide() or leaves

    def _states(self) -> tuple[int, ...]:
        """Of each node's supervisor."""
        return tuple(axis.t["state"] for axis in self._axes)

    def answer(self, t: Fields) -> bool:
        """The commands, in the configuration's order, unless the guardian has stopped the drives."""
        words, axes = self._words, self._axes
        for axis in self._more:
            axis.t["computed_ns"] = t["computed_ns"]
        if words is not None:
            words[BEAT_NS] = self._clock.now_ns()
            for place, axis in enumerate(axes, COUNTERS):
                words[place] = axis.t["counter"]
            words[ARMED] = any(axis.t["state"] != DISARMED for axis in axes)
        for axis in axes[self._pace[DID] :]:
            if axis.t["send"]:
                self._command(axis)
            axis.t["sent_ns"] = since(Loop.now, self, t)
        return True

    def _command(self, axis: Axis) -> None:
        """Send one node's command; a bus that does not take it is seen in the next tick."""
        t, why = axis.t, "the guardian has stopped the drive"
        try:
            if self._words is None or not self._words[FIRED]:
                axis.client.send(axis.tick)
                axis.client.flush()
                return
        except OSError as error:
            why = str(error)
        self._recorder.event(t["t_ns"], t["k"], "send-failed", f"{axis.name}: {why}")

    def store(self, t: Fields) -> None:
        """The records; when the first was stored stands in all."""
        super().store(t)
        self._rings.more_ticks()
        for axis in self._more:
            axis.t["recorded_ns"] = t["recorded_ns"]
