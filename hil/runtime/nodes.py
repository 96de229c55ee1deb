"""The tick of two nodes on one bus: one SYNC, then for each node read, judge, compute, write, record.

A node is a whole controller: its records, law, guard and supervisor are those of a run of one drive, and so
are the kernels. Here is what they share: time, SYNC, the guardian's words, and the rule that none drives on
alone, by the rules of :mod:`hil.runtime.noderules`. When one leaves operation by a fault or a quick stop, the
others are asked to stop in the same tick: their tick is computed once more, from the same state, with that
request as its input.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from hil.config.design import Machine
from hil.log.recorder import Recorder
from hil.ports import Clock, Inbox
from hil.runtime.guardian import ARMED, FIRED, Words
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
from hil.runtime.noderules import answer_all, begin_all, exchange, law_of_all, tell_all
from hil.runtime.rules import DID, Fields, Pace
from hil.signals import Request, TickArray
from hil.tick.undo import Undo

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

    def stop(self) -> None:
        """The stop frames of each node in the configuration's order; the guardian's stand."""
        words = self._words
        if not (len(words) and words[FIRED]):
            for axis in self._axes:
                axis.client.stop()
        if len(words):
            words[ARMED] = 0


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
        self._axes, self._rings, self._count = axes, recorder, len(axes)
        self._words: Any = words.cells if words else ()
        together: Any = Together(axes, self._words)
        first = axes[0]
        super().__init__(together, clock, recorder, first.step, first.ticks, plan, request, whole, inbox)
        self._courses += [Course(axis.t, axis.ticks, recorder, f"{axis.name}: ") for axis in axes[1:]]
        for axis, course in zip(axes, self._courses, strict=True):
            axis.outcome = course.outcome

    def _states(self) -> tuple[int, ...]:
        """Of each node's supervisor."""
        return tuple(axis.t["state"] for axis in self._axes)

    def begun(self, t: Fields) -> None:
        """A part of a tick, as what follows: the rules of several nodes over the parts below."""
        begin_all(type(self), self, t, self._pace, self._count)

    def sync(self, t: Fields, deadline_ns: int) -> bool:
        """SYNC out and feedback in; a SYNC that is not out is told to all, and no feedback waited for."""
        try:
            exchange(type(self), self, self._pace, self._count, deadline_ns)
        except OSError as error:
            for axis in self._axes:
                axis.t["rx_flags"] |= SEND_FAILED if error.errno in FULL else BUS_DOWN
        tell_all(type(self), self, self._count)
        return True

    def law(self, t: Fields) -> bool:
        """Each node's controller, and those that must stop with another one once more."""
        if not law_of_all(type(self), self, t, self._pace, self._count):
            for axis in self._axes:
                axis.stop_too()
            self._pace[DID] = 0
        return True

    def answer(self, t: Fields) -> bool:
        """The commands."""
        return answer_all(type(self), self, t, self._pace, self._count)

    def store(self, t: Fields) -> None:
        """The records; when the first was stored stands in all."""
        super().store(t)
        self._rings.more_ticks()
        for axis in self._axes[1:]:
            axis.t["recorded_ns"] = t["recorded_ns"]

    def words(self) -> Any:
        """Of the parts of :mod:`hil.runtime.noderules`, as what follows."""
        return self._words

    def node(self, i: int) -> Fields:
        """A node's fields."""
        return self._axes[i].t

    def ticks(self, i: int) -> TickArray:
        """A node's record."""
        return self._axes[i].ticks

    def law_of(self, i: int) -> Any:
        """A node's law."""
        return self._axes[i].machine.law

    def take_late(self, i: int) -> bool:
        """By its client."""
        axis = self._axes[i]
        axis.client.follow(axis.tick)
        axis.client.flush()
        return True

    def send_sync(self, fired: bool) -> bool:
        """By the first node's client."""
        axis = self._axes[0]
        (axis.client.follow if fired else axis.client.sync)(axis.tick)
        axis.client.flush()
        return True

    def listen(self, i: int, until_ns: int) -> bool:
        """By its client; its frames are logged before the next node's."""
        axis = self._axes[i]
        axis.client.receive(axis.tick, until_ns)
        axis.client.flush()
        return True

    def decide(self, i: int, kept: bool) -> None:
        """A node's controller."""
        axis = self._axes[i]
        if kept:
            axis.undo.keep()
        axis.step(axis.ticks)

    def send(self, i: int, fired: bool) -> bool:
        """A node's command; a bus that does not take it is seen in the next tick."""
        axis = self._axes[i]
        t, why = axis.t, "the guardian has stopped the drive"
        try:
            if not fired:
                axis.client.send(axis.tick)
                axis.client.flush()
                return True
        except OSError as error:
            why = str(error)
        self._recorder.event(t["t_ns"], t["k"], "send-failed", f"{axis.name}: {why}")
        return True
