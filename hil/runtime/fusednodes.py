"""Ticks of several nodes as one compiled call: what :mod:`hil.runtime.nodes` does, where nothing is unusual.

Like :mod:`hil.runtime.fused`, of whose pieces it is made, it has no rules of its own, and at the first thing
that is unusual it returns the stage that it reached; the pace says how many steps of it are done. Each node
has a table as :func:`hil.runtime.fused.table_of` makes it, with what is kept of its controller's states
behind it: :mod:`hil.tick.undo`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.jit import COMPILED, array_at, entry, jit, place_of, places_at, waiting
from drivers.posix import (
    DONE,
    STATES,
    before,
    command,
    drain,
    left,
    opened,
)
from drivers.wire import STATE
from hil.control.law import LAW_PARAMS
from hil.log.push import NOWHERE, push
from hil.log.recorder import Recorder
from hil.runtime import fused
from hil.runtime.clock import Cell, RealClock
from hil.runtime.fused import (
    COMMAND,
    CONTROL,
    FRAMES_IN,
    I8,
    LAW,
    MARKS,
    NUMBER,
    PACE,
    PLAN,
    READING,
    RECEIVE,
    RECORD,
    REQUEST,
    ROWS,
    SEND,
    TICK_AT,
    TICKS_IN,
    TIMES_AT,
    WORDS,
    Marks,
    mark,
    table_of,
    ticks_of,
)
from hil.runtime.guardian import ARMED, BEAT_NS, DISARMED, FIRED, Words, beats, guardian_flags
from hil.runtime.loop import Plan, StopRequest, Whole, none_compiled, timing_of
from hil.runtime.nodes import ALONE, COUNTERS, LEFT, Axis
from hil.runtime.rules import DID, FRESH, NEWS, NO_WAIT, PLANNED, SYNC_BYTES, Pace, begin, since, stamp
from hil.runtime.trouble import TROUBLE
from hil.signals import TICK
from hil.tick.kernel import PLACED, whole_at
from hil.tick.pair import ask, leads
from hil.tick.pair import tell as tell_load
from hil.tick.undo import keep

KEPT, NODES, NODE_ROWS = ROWS, ROWS + 1, ROWS + 2
"""Behind a node's table: the places of what is kept of its controller's states; behind the first's that of
the nodes' tables, too."""
LAW_AT: Final = PLACED.index(LAW_PARAMS)
QUIET, STOPPED, ENDS = ALONE
PARTS: Final = sys.modules[__name__]
"""As :data:`hil.runtime.fused.PARTS`; these are as there, of the first node."""
sleep, now, until, asked = fused.sleep, fused.now, fused.until, fused.asked
receive, synced = fused.receive, fused.synced


def whole_nodes(
    axes: Sequence[Axis],
    words: Words | None,
    recorder: Recorder,
    plan: Plan,
    request: StopRequest,
    pace: Pace,
    number: memoryview | None = None,
    marks: Marks | None = None,
    clock: Cell = RealClock.cell,
) -> Whole:
    """The ticks of a run of several nodes; :func:`hil.runtime.fused.whole_tick`."""
    ports = [axis.client.compiled() for axis in axes]
    tables: list[npt.NDArray[np.int64]] = []
    alive: list[Any] = [axes, recorder]
    for place, (axis, port) in enumerate(zip(axes, ports, strict=True)):
        if port is None:
            return none_compiled
        own = [port.exchange if place == 0 else port.receive, port.command, axis.machine.places()]
        own += recorder.places(port.log, place)
        timing = timing_of(plan, False, port.sync_bytes)
        table, held = table_of(own, timing, axis.ticks, words, request, pace, number, marks, clock)
        kept = axis.undo.places.reshape(-1)
        tables.append(np.concatenate([table, [place_of(kept, I8), (0, 0)]]))
        alive += [held, kept]
    nodes = np.array([place_of(table.reshape(-1), I8) for table in tables])
    tables[0][NODES] = place_of(nodes.reshape(-1), I8)
    call = partial(_compiled(), tables[0])
    call.__dict__["alive"] = (alive, tables, nodes)  # the places are of them
    return call


def _compiled() -> Any:
    """The compiled form; the call that makes it may run no tick."""
    table = np.zeros((NODE_ROWS, 2), np.int64)
    known = {TIMES_AT: 4, PLAN: PLANNED, PACE: NEWS + 1, REQUEST: 1, NUMBER: 1}
    arrays = {row: np.zeros(size, np.int64) for row, size in known.items()}
    arrays[TICKS_IN] = np.array([place_of(*one) for one in NOWHERE]).reshape(-1)
    for row, array in arrays.items():
        table[row] = place_of(array, I8)
    return entry(run_together, table, 0, 0, False)


def load() -> None:
    """Compile it, or load it."""
    if COMPILED:
        _compiled()


@jit
def tick_of(table: Any) -> Any:
    """A node's tick."""
    return array_at(table, TICK_AT, TICK)[0]


@jit
def state_of(table: Any) -> Any:
    """What a client's kernels share."""
    return array_at(places_at(table, RECEIVE), STATES, STATE)[0]


@jit
def hand_on(table: Any) -> None:
    """A node's frames into their ring, before another's follow."""
    s = state_of(table)
    if s["logged"] > 0:
        push(places_at(table, FRAMES_IN), s["logged"])
        s["logged"] = 0


@jit
def begun(table: Any, t: Any) -> None:
    """Of :class:`hil.runtime.rules.Parts`, as are :func:`sync`, :func:`law` and the last four."""
    nodes, pace = places_at(table, NODES), array_at(table, PACE, I8)
    pace[DID] = 0
    for i in range(1, len(nodes)):
        one = tick_of(places_at(nodes, i))
        stamp(one, t["k"], t["t_ns"], t["gap"], t["lateness_ns"])
        begin(one, t["request"], t["log_failed"])


@jit
def waits(nodes: Any) -> bool:
    """Whether a client has something to tell first: flags, a bus that was down."""
    for i in range(len(nodes)):
        s = state_of(places_at(nodes, i))
        if s["pending"] != 0 or s["down"] != 0:
            return True
    return False


@jit
def take_late(table: Any) -> Any:
    """:meth:`drivers.client.DriveClient.follow`. Returns what :func:`drivers.posix.before` does."""
    places = places_at(table, RECEIVE)
    code = before(places)
    if not left(places, code):
        hand_on(table)
    return code


@jit
def sync(table: Any, _t: Any, until_ns: int) -> Any:
    """SYNC and the feedback of all."""
    nodes, words, pace = places_at(table, NODES), array_at(table, WORDS, I8), array_at(table, PACE, I8)
    if waits(nodes) or (len(words) > 0 and beats(words, now(table))):
        return False
    for i in range(1, len(nodes)):
        if take_late(places_at(nodes, i)) != DONE:
            return False
        pace[DID] += 1
    places = places_at(table, RECEIVE)
    if left(places, opened(places, array_at(table, PLAN, I8)[SYNC_BYTES])):
        return False
    hand_on(table)
    pace[DID] += 1
    for i in range(len(nodes) - 1, -1, -1):
        if listen(places_at(nodes, i), until_ns, i == len(nodes) - 1) != DONE:
            return False
        pace[DID] += 1
    if len(words) > 0:
        for i in range(len(nodes)):
            tick_of(places_at(nodes, i))["rx_flags"] |= guardian_flags(words)
    mark(array_at(table, MARKS, I8), READING, array_at(table, TIMES_AT, I8))
    return True


@jit
def listen(table: Any, until_ns: int, first: bool) -> Any:
    """A node's feedback; but for the ``first`` that is listened to it is there already. As drain returns."""
    places, code = places_at(table, RECEIVE), DONE
    if not first:
        code = drain(places, NO_WAIT, False)
    if code == DONE and tick_of(table)["rx_flags"] & FRESH == 0:
        code = drain(places, until_ns, False)
    if not left(places, code):
        hand_on(table)
    return code


@jit
def ticks_at(nodes: Any, i: int) -> Any:
    """A node's record."""
    return array_at(places_at(nodes, i), TICK_AT, TICK)


@jit
def law_at(nodes: Any, i: int) -> Any:
    """A node's law."""
    return array_at(places_at(places_at(nodes, i), LAW), LAW_AT, LAW_PARAMS)


@jit
def lead_of(nodes: Any) -> Any:
    """The node whose law commands the other one, too; -1: none."""
    for i in range(len(nodes)):
        if leads(law_at(nodes, i)):
            return i
    return -1


@jit
def law(table: Any, t: Any) -> Any:
    """Each node's controller; not all that is to be done where the others must stop with one."""
    nodes, pace = places_at(table, NODES), array_at(table, PACE, I8)
    left, going, pace[NEWS] = False, False, 0
    for i in range(1, len(nodes)):
        tick_of(places_at(nodes, i))["received_ns"] = t["received_ns"]
    lead = lead_of(nodes)
    first, load = max(lead, 0), 1 - lead
    for n in range(len(nodes)):
        i = (first + n) % len(nodes)
        if lead >= 0 and n == 0:
            tell_load(ticks_at(nodes, lead), ticks_at(nodes, load), law_at(nodes, load))
        elif lead >= 0:
            ask(ticks_at(nodes, lead), ticks_at(nodes, load), law_at(nodes, load))
        one = places_at(nodes, i)
        ticks = array_at(one, TICK_AT, TICK)
        state, before = ticks[0]["state"], ticks[0]["reason"]
        keep(places_at(one, KEPT), ticks[0]["gap"])
        whole_at(places_at(one, LAW), ticks)
        reason = ticks[0]["reason"]
        left |= reason not in (QUIET, STOPPED, ENDS)
        going |= reason == QUIET
        if reason != before or ticks[0]["state"] != state or ticks[0]["rx_flags"] & TROUBLE != 0:
            pace[NEWS] = 1
    pace[DID] = LEFT if left and going else 0
    mark(array_at(table, MARKS, I8), CONTROL, array_at(table, TIMES_AT, I8))
    return pace[DID] != LEFT


@jit
def answer(table: Any, t: Any) -> Any:
    """The commands, in the nodes' order."""
    nodes, words, pace = places_at(table, NODES), array_at(table, WORDS, I8), array_at(table, PACE, I8)
    armed = 0
    for i in range(len(nodes)):
        one = tick_of(places_at(nodes, i))
        one["computed_ns"] = t["computed_ns"]
        armed |= int(one["state"] != DISARMED)
        if len(words) > 0:
            words[COUNTERS + i] = one["counter"]
    if len(words) > 0:
        words[BEAT_NS], words[ARMED] = now(table), armed
    for i in range(len(nodes)):
        node = places_at(nodes, i)
        one = tick_of(node)
        if one["send"] != 0:
            if len(words) > 0 and words[FIRED] != 0:
                return False
            places = places_at(node, COMMAND)
            if left(places, command(places)):
                return False
            hand_on(node)
        one["sent_ns"] = since(now, table, t)
        pace[DID] += 1
    mark(array_at(table, MARKS, I8), SEND, array_at(table, TIMES_AT, I8))
    return True


@jit
def tell(table: Any, t: Any, _state: int, request: int) -> Any:
    """What there is to say is the loop's."""
    return array_at(table, PACE, I8)[NEWS] == 0 and t["request"] == request


@jit
def store(table: Any, t: Any) -> None:
    """The records into their rings; when the first was stored stands in all."""
    nodes = places_at(table, NODES)
    push(places_at(table, TICKS_IN), 1)
    stored_ns = since(now, table, t)
    for i in range(1, len(nodes)):
        push(places_at(places_at(nodes, i), TICKS_IN), 1)
    for i in range(len(nodes)):
        tick_of(places_at(nodes, i))["recorded_ns"] = stored_ns
    mark(array_at(table, MARKS, I8), RECORD, array_at(table, TIMES_AT, I8))


@waiting
def run_together(table: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """:func:`hil.runtime.fused.ticks_of` several nodes; ``table``: the first's."""
    return ticks_of(PARTS, table, k, deadline_ns, log_failed)
