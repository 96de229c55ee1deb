"""What holds among several nodes of a run, each rule said once, as :mod:`hil.runtime.rules` for one drive.

The loop's own form and the compiled one call these. ``io`` has the parts, which go over ``x``; a node ``i``
is named by its place among the ``count`` in the configuration's order, and ``t`` is the first one's record.

``words(x)`` are the guardian's words, of no length without one, ``now(x)`` is the time [ns]. Of a node,
``node(x, i)`` are the fields of its record, which ``ticks(x, i)`` and the law's parameters ``law_of(x, i)``
are for the laws. ``take_late(x, i)`` takes what came of it, ``send_sync(x, fired)`` sends the one SYNC after
that of the first one's, ``listen(x, i, until_ns)`` waits for its feedback, ``decide(x, i, kept)`` runs its
controller, whose states can be put back if ``kept``, ``send(x, i, fired)`` sends its command; nothing is sent
once the guardian has ``fired``. A part that returns False has left the tick to the loop.
"""

from __future__ import annotations

from typing import Any, Final

from hil.runtime.guardian import ARMED, DISARMED, FIRED, GUARD_NS, beats, guardian_flags
from hil.runtime.rules import DID, begin, rule, since, stamp
from hil.signals import Reason
from hil.tick.pair import ask, leads, tell

COUNTERS: Final = GUARD_NS + 1
"""Word of the first node's newest command counter; those of the others follow."""
QUIET, STOPPED, ENDS = (int(Reason.NONE), int(Reason.STOP_REQUESTED), int(Reason.NODE_STOPPED))
"""Reasons with which a node leaves the others as they are: each ends an orderly stop by its own ramp."""
LEFT: Final = -1
"""In place of how many steps are done: the laws have run, and the others must stop with one."""


@rule
def begin_all(io: Any, x: Any, t: Any, pace: Any, count: int) -> None:
    """All ticks are as the first one's, which is stamped."""
    pace[DID] = 0
    for i in range(1, count):
        one = io.node(x, i)
        stamp(one, t["k"], t["t_ns"], t["gap"], t["lateness_ns"])
        begin(one, t["request"], t["log_failed"])


@rule
def exchange(io: Any, x: Any, pace: Any, count: int, until_ns: int) -> bool:
    """What came late of each node, one SYNC, then each node's feedback, from the step on that is due.

    Late frames stand before SYNC in the log, too. The last node is waited for first: its answer is the last
    on the bus, and the others' are there then.
    """
    words = io.words(x)
    fired = len(words) > 0 and beats(words, io.now(x))
    for step in range(pace[DID], 2 * count):
        if step < count - 1:
            done = io.take_late(x, step + 1)
        elif step == count - 1:
            done = io.send_sync(x, fired)
        else:
            done = io.listen(x, 2 * count - 1 - step, until_ns)
        if not done:
            return False
        pace[DID] = step + 1
    return True


@rule
def tell_all(io: Any, x: Any, count: int) -> None:
    """What the guardian did, into each node's record."""
    words = io.words(x)
    for i in range(count if len(words) > 0 else 0):
        io.node(x, i)["rx_flags"] |= guardian_flags(words)


@rule
def lead_of(io: Any, x: Any, count: int) -> int:
    """The node whose law commands the other one, too; -1: none."""
    for i in range(count):
        if leads(io.law_of(x, i)):
            return i
    return -1


@rule
def law_of_all(io: Any, x: Any, t: Any, pace: Any, count: int) -> bool:
    """Each node's controller. False once one has left by a fault or a quick stop: all stop in this tick.

    Those without a reason of their own are then to be computed once more, from the same states.
    """
    if pace[DID] != LEFT:
        pace[DID] = LEFT if must_stop(io, x, t, count) else 0
    return bool(pace[DID] != LEFT)


@rule
def must_stop(io: Any, x: Any, t: Any, count: int) -> bool:
    """Each node's controller, one that commands the other first; whether any must stop with one that left.

    A node's states are kept for that, the last one's only where one before it has left: if none has, it is
    the last itself that leaves, and it has its own reason.
    """
    left, going, lead = False, False, lead_of(io, x, count)
    first = max(lead, 0)
    for n in range(count):
        i = (first + n) % count
        if lead >= 0:
            test, load = io.ticks(x, lead), io.ticks(x, 1 - lead)
            if n == 0:
                tell(test, load, io.law_of(x, 1 - lead))
            else:
                ask(test, load, io.law_of(x, 1 - lead))
        one = io.node(x, i)
        one["received_ns"] = t["received_ns"]
        io.decide(x, i, left or n < count - 1)
        reason = one["reason"]
        left |= reason not in (QUIET, STOPPED, ENDS)
        going |= reason == QUIET
    return bool(left and going)


@rule
def answer_all(io: Any, x: Any, t: Any, pace: Any, count: int) -> bool:
    """The commands, in the configuration's order, from the one on that is due.

    The guardian is told of all before the first goes, and looked at before each.
    """
    words, armed = io.words(x), False
    for i in range(count):
        one = io.node(x, i)
        one["computed_ns"] = t["computed_ns"]
        armed |= one["state"] != DISARMED
        if len(words) > 0:
            words[COUNTERS + i] = one["counter"]
    if len(words) > 0:
        beats(words, io.now(x))
        words[ARMED] = int(armed)
    for i in range(pace[DID], count):
        one = io.node(x, i)
        if one["send"] != 0 and not io.send(x, i, len(words) > 0 and words[FIRED] != 0):
            return False
        one["sent_ns"] = since(io.now, x, t)
        pace[DID] = i + 1
    return True
