"""Ticks of several nodes as one compiled call: what :mod:`hil.runtime.nodes` does, where nothing is unusual.

Like :mod:`hil.runtime.fused`, of whose pieces it is made, it has no rules of its own, those of several nodes
being :mod:`hil.runtime.noderules`, and at the first thing that is unusual it returns the stage that it
reached; the pace says how many steps of it are done. Each node
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

from drivers.jit import COMPILED, array_at, jit, place_of, places_at, waiting
from drivers.posix import (
    DONE,
    FDS,
    IO,
    RECEIVING,
    STATES,
    before,
    command,
    drain,
    has_come,
    left,
    look,
    opened,
)
from drivers.wire import STATE
from hil.control.law import LAW_PARAMS
from hil.log.push import push
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
    PACE,
    PLAN,
    READING,
    RECEIVE,
    RECORD,
    ROWS,
    SEND,
    TICK_AT,
    TICKS_IN,
    TIMES_AT,
    WORDS,
    Marks,
    compiled_of,
    mark,
    table_of,
    ticks_of,
)
from hil.runtime.guardian import Words
from hil.runtime.loop import Plan, StopRequest, Whole, none_compiled, timing_of
from hil.runtime.noderules import answer_all, begin_all, exchange, law_of_all, tell_all
from hil.runtime.nodes import Axis
from hil.runtime.rules import FRESH, NEWS, NO_WAIT, SYNC_BYTES, Pace, since
from hil.runtime.trouble import TROUBLE
from hil.signals import TICK
from hil.tick.kernel import PLACED, whole_at
from hil.tick.undo import keep

KEPT, NODES, POLLED, NODE_ROWS = range(ROWS, ROWS + 4)
"""Behind a node's table: the places of what is kept of its controller's states; behind the first's that of
the nodes' tables and of what :func:`drivers.posix.look` asks with, too."""
LAW_AT: Final = PLACED.index(LAW_PARAMS)
I4: Final = np.dtype(np.int32)
PARTS: Final = sys.modules[__name__]
"""As :data:`hil.runtime.fused.PARTS`, and those of :mod:`hil.runtime.noderules`; these are as there, of
the first node."""
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
        tables.append(np.concatenate([table, [place_of(kept, I8), (0, 0), (0, 0)]]))
        alive += [held, kept]
    nodes = np.array([place_of(table.reshape(-1), I8) for table in tables])
    polled = np.zeros(2 * len(nodes), np.int32)
    tables[0][NODES], tables[0][POLLED] = place_of(nodes.reshape(-1), I8), place_of(polled, I4)
    call = partial(compiled_of(run_together, NODE_ROWS), tables[0])
    call.__dict__["alive"] = (alive, tables, nodes, polled)  # the places are of them
    return call


def load() -> None:
    """Compile it, or load it."""
    if COMPILED:
        compiled_of(run_together, NODE_ROWS)


@jit
def node_at(table: Any, i: int) -> Any:
    """A node's table."""
    return places_at(places_at(table, NODES), i)


@jit
def state_of(node: Any) -> Any:
    """What a client's kernels share."""
    return array_at(places_at(node, RECEIVE), STATES, STATE)[0]


@jit
def hand_on(node: Any) -> None:
    """A node's frames into their ring, before another's follow."""
    s = state_of(node)
    if s["logged"] > 0:
        push(places_at(node, FRAMES_IN), s["logged"])
        s["logged"] = 0


@jit
def words(table: Any) -> Any:
    """Of the parts of :mod:`hil.runtime.noderules`, as what follows."""
    return array_at(table, WORDS, I8)


@jit
def node(table: Any, i: int) -> Any:
    """A node's tick."""
    return ticks(table, i)[0]


@jit
def ticks(table: Any, i: int) -> Any:
    """A node's record."""
    return array_at(node_at(table, i), TICK_AT, TICK)


@jit
def law_of(table: Any, i: int) -> Any:
    """A node's law."""
    return array_at(places_at(node_at(table, i), LAW), LAW_AT, LAW_PARAMS)


@jit
def came(table: Any, i: int) -> Any:
    """Whether something of a node may have come late."""
    return has_come(array_at(places_at(node_at(table, i), RECEIVE), IO, I8), array_at(table, POLLED, I4), i)


@jit
def take_late(table: Any, i: int) -> Any:
    """:meth:`drivers.client.DriveClient.follow`, unless the client has something to tell first."""
    one = node_at(table, i)
    s, places = state_of(one), places_at(one, RECEIVE)
    if s["pending"] != 0 or s["down"] != 0 or left(places, before(places, came(table, i))):
        return False
    hand_on(one)
    return True


@jit
def send_sync(table: Any, fired: bool) -> Any:
    """SYNC by :func:`drivers.posix.opened`."""
    places = places_at(table, RECEIVE)
    if fired or left(places, opened(places, array_at(table, PLAN, I8)[SYNC_BYTES], came(table, 0))):
        return False
    hand_on(table)
    return True


@jit
def listen(table: Any, i: int, until_ns: int) -> Any:
    """A node's feedback; but for the last, which is listened to first, it is there already."""
    one, code = node_at(table, i), DONE
    places = places_at(one, RECEIVE)
    if i < len(places_at(table, NODES)) - 1:
        code = drain(places, NO_WAIT, False)
    if code == DONE and node(table, i)["rx_flags"] & FRESH == 0:
        code = drain(places, until_ns, False)
    if left(places, code):
        return False
    hand_on(one)
    return True


@jit
def decide(table: Any, i: int, kept: bool) -> None:
    """A node's controller; what is new of it is noted."""
    one = node_at(table, i)
    record = array_at(one, TICK_AT, TICK)
    t = record[0]
    state, before = t["state"], t["reason"]
    if kept:
        keep(places_at(one, KEPT), t["gap"])
    whole_at(places_at(one, LAW), record)
    if t["reason"] != before or t["state"] != state or t["rx_flags"] & TROUBLE != 0:
        array_at(table, PACE, I8)[NEWS] = 1


@jit
def send(table: Any, i: int, fired: bool) -> Any:
    """A node's command."""
    one = node_at(table, i)
    places = places_at(one, COMMAND)
    if fired or left(places, command(places)):
        return False
    hand_on(one)
    return True


@jit
def begun(table: Any, t: Any) -> None:
    """Of :class:`hil.runtime.rules.Parts`, as what follows: the rules of several over the parts above."""
    pace, count = array_at(table, PACE, I8), len(places_at(table, NODES))
    pace[NEWS] = 0
    for i in range(count):
        fused.begun(node_at(table, i), t)
    begin_all(PARTS, table, t, pace, count)


@jit
def sync(table: Any, _t: Any, until_ns: int) -> Any:
    """SYNC and the feedback of all; what came late is asked of all sockets at once."""
    count, polled = len(places_at(table, NODES)), array_at(table, POLLED, I4)
    for i in range(count):
        polled[2 * i] = array_at(places_at(node_at(table, i), RECEIVE), FDS, I4)[RECEIVING]
    look(polled)
    if not exchange(PARTS, table, array_at(table, PACE, I8), count, until_ns):
        return False
    tell_all(PARTS, table, count)
    mark(array_at(table, MARKS, I8), READING, array_at(table, TIMES_AT, I8))
    return True


@jit
def law(table: Any, t: Any) -> Any:
    """Each node's controller."""
    done = law_of_all(PARTS, table, t, array_at(table, PACE, I8), len(places_at(table, NODES)))
    mark(array_at(table, MARKS, I8), CONTROL, array_at(table, TIMES_AT, I8))
    return done


@jit
def answer(table: Any, t: Any) -> Any:
    """The commands."""
    done = answer_all(PARTS, table, t, array_at(table, PACE, I8), len(places_at(table, NODES)))
    mark(array_at(table, MARKS, I8), SEND, array_at(table, TIMES_AT, I8))
    return done


@jit
def tell(table: Any, t: Any, _state: int, request: int) -> Any:
    """What there is to say is the loop's."""
    return array_at(table, PACE, I8)[NEWS] == 0 and t["request"] == request


@jit
def store(table: Any, t: Any) -> None:
    """The records into their rings; when the first was stored stands in all."""
    push(places_at(table, TICKS_IN), 1)
    stored_ns, count = since(now, table, t), len(places_at(table, NODES))
    for i in range(1, count):
        push(places_at(node_at(table, i), TICKS_IN), 1)
    for i in range(count):
        node(table, i)["recorded_ns"] = stored_ns
    mark(array_at(table, MARKS, I8), RECORD, array_at(table, TIMES_AT, I8))


@waiting
def run_together(table: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """:func:`hil.runtime.fused.ticks_of` several nodes; ``table``: the first's."""
    return ticks_of(PARTS, table, k, deadline_ns, log_failed)
