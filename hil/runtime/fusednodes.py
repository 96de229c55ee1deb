"""Ticks of several nodes as one compiled call: what :mod:`hil.runtime.nodes` does, where nothing is unusual.

Like :mod:`hil.runtime.fused`, of whose pieces it is made, it has no rules of its own, and at the first thing
that is unusual it returns the stage that it reached; the pace says how many steps of it are done. Each node
has a table as :func:`hil.runtime.fused.table_of` makes it, with what it keeps of its controller's state
behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from drivers.jit import COMPILED, array_at, entry, jit, place_of, places_at, waiting
from drivers.posix import (
    COMMANDED,
    DONE,
    EXCHANGED,
    IO,
    LATE,
    PENDING,
    STATES,
    command,
    drain,
    exchange,
    now_ns,
)
from drivers.wire import STATE
from hil.control.law import LAW_PARAMS
from hil.log.push import NOWHERE, push
from hil.log.recorder import Recorder
from hil.runtime.fused import (
    COMMAND,
    CONTROL,
    FRAMES_IN,
    I8,
    LAW,
    LOOP,
    MARKS,
    NUMBER,
    PACE,
    PERIOD_NS,
    PLAN,
    PLANNED,
    READ,
    RECEIVE,
    RECORD,
    REQUEST,
    ROWS,
    SEND,
    SLEEP,
    SYNC_BYTES,
    TICK_AT,
    TICKS_IN,
    TIMEOUT_NS,
    TIMES_AT,
    TOGETHER,
    WORDS,
    Marks,
    asked_at,
    mark,
    news,
    since,
    sleep_until,
    table_of,
    timing_of,
)
from hil.runtime.guardian import ARMED, BEAT_NS, DISARMED, FIRED, Words, beats, guardian_flags
from hil.runtime.loop import Plan, StopRequest, Whole, none_compiled
from hil.runtime.nodes import ALONE, COUNTERS, LEFT, Axis
from hil.runtime.rules import (
    BEGUN,
    DECIDED,
    DID,
    NEXT,
    NOT_BEGUN,
    RAN,
    RECORDED,
    SENT,
    Pace,
    begin,
    stamp,
)
from hil.runtime.trouble import TROUBLE
from hil.signals import TICK
from hil.tick.kernel import PLACED, whole_at
from hil.tick.pair import ask, leads, tell

NODE_ROWS: Final = ROWS + 1
KEPT: Final = ROWS
"""Behind a node's table: the places of its controller's states, then of what is kept of them."""
ADDRESS, LENGTH = 0, 1
LAW_AT: Final = PLACED.index(LAW_PARAMS)
QUIET, STOPPED, ENDS = ALONE
CALM, NEW, OTHERS = range(3)
U1: Final = np.dtype(np.uint8)
_word: Any = numba.types.uintp
_memcpy: Any = numba.types.ExternalFunction("memcpy", _word(_word, _word, _word))


def whole_nodes(
    axes: Sequence[Axis],
    words: Words | None,
    recorder: Recorder,
    plan: Plan,
    request: StopRequest,
    pace: Pace,
    number: memoryview | None = None,
    marks: Marks | None = None,
) -> Whole:
    """The ticks of a run of several nodes, each on a socket of its own; others are the loop's alone."""
    ports = [axis.client.compiled() for axis in axes]
    tables: list[npt.NDArray[np.int64]] = []
    alive: list[Any] = [axes, recorder]
    for place, (axis, port) in enumerate(zip(axes, ports, strict=True)):
        if port is None or port.exchange is None:
            return none_compiled
        own = [port.exchange if place == 0 else port.follow, port.command, axis.machine.places()]
        own += recorder.places(port.log, place)
        timing = timing_of(plan, port.sync_bytes, False)
        table, held = table_of(own, timing, axis.ticks, words, request, pace, number, marks)
        kept = np.array([place_of(array, U1) for array in axis.states()])
        tables.append(np.concatenate([table, [place_of(kept.reshape(-1), I8)]]))
        alive += [held, kept]
    nodes = np.array([place_of(table.reshape(-1), I8) for table in tables])
    call = partial(_compiled(), nodes)
    call.__dict__["alive"] = (alive, tables)  # the places are of them
    return call


def _compiled() -> Any:
    """The compiled form; the call that makes it is for a first tick that is late, which it leaves alone."""
    table = np.zeros((NODE_ROWS, 2), np.int64)
    known = {TIMES_AT: 4, PLAN: PLANNED, PACE: DID + 1, REQUEST: 1, NUMBER: 1}
    arrays = {row: np.zeros(size, np.int64) for row, size in known.items()}
    arrays[TICKS_IN] = np.array([place_of(*one) for one in NOWHERE]).reshape(-1)
    for row, array in arrays.items():
        table[row] = place_of(array, I8)
    return entry(run_together, np.array([place_of(table.reshape(-1), I8)]), 0, 0, False)


def load() -> None:
    """Compile it, or load it."""
    if COMPILED:
        _compiled()


@jit
def tick_of(table: Any) -> Any:
    """A node's tick."""
    return array_at(table, TICK_AT, TICK)[0]


@jit
def io_of(table: Any, row: int) -> Any:
    """What a client's kernel was left with."""
    return array_at(places_at(table, row), IO, I8)


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
def waits(nodes: Any) -> bool:
    """Whether a client has something to tell first: flags, a bus that was down, a frame to be judged."""
    for i in range(len(nodes)):
        table = places_at(nodes, i)
        s = state_of(table)
        if s["pending"] != 0 or s["down"] != 0 or io_of(table, RECEIVE)[LATE] != 0:
            return True
    return False


@jit
def take_late(table: Any) -> Any:
    """:meth:`drivers.client.DriveClient.follow`. Returns what :func:`drivers.posix.drain` does."""
    s = state_of(table)
    s["got"] = 0
    code = drain(places_at(table, RECEIVE), 0, True)
    if code != DONE:
        io_of(table, RECEIVE)[LATE] = code
        return code
    s["got"] = 0
    hand_on(table)
    return code


@jit
def read(nodes: Any, deadline_ns: int) -> Any:
    """SYNC and the feedback of all. Returns the stage reached: DECIDED once the laws can go on."""
    first = places_at(nodes, 0)
    words, pace, plan = array_at(first, WORDS, I8), array_at(first, PACE, I8), array_at(first, PLAN, I8)
    if waits(nodes):
        return NOT_BEGUN
    if len(words) > 0 and beats(words, now_of(first)):
        return NOT_BEGUN
    pace[DID] = 0
    for i in range(1, len(nodes)):
        if take_late(places_at(nodes, i)) != DONE:
            return BEGUN
        pace[DID] += 1
    until_ns = deadline_ns + plan[TIMEOUT_NS]
    for i in range(len(nodes)):
        table = places_at(nodes, i)
        places = places_at(table, RECEIVE)
        code = exchange(places, plan[SYNC_BYTES], until_ns) if i == 0 else drain(places, until_ns, False)
        if code != DONE:
            if code != PENDING or i > 0:
                io_of(table, RECEIVE)[EXCHANGED] = code
            return BEGUN
        hand_on(table)
        pace[DID] += 1
    return DECIDED


@jit
def now_of(table: Any) -> Any:
    """CLOCK_MONOTONIC [ns]."""
    return now_ns(array_at(table, TIMES_AT, I8))


@jit
def keep(table: Any) -> None:
    """Keep the controller's states, to which its tick may have to go back."""
    places = places_at(table, KEPT)
    count = len(places) // 2
    for i in range(count):
        _memcpy(places[count + i, ADDRESS], places[i, ADDRESS], places[i, LENGTH])


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
def decide(nodes: Any) -> Any:
    """Each node's controller: OTHERS when those must stop with one, NEW when there is something to log."""
    found, left, going = CALM, False, False
    lead = lead_of(nodes)
    first, load = max(lead, 0), 1 - lead
    for n in range(len(nodes)):
        i = (first + n) % len(nodes)
        if lead >= 0 and n == 0:
            tell(ticks_at(nodes, lead), ticks_at(nodes, load), law_at(nodes, load))
        elif lead >= 0:
            ask(ticks_at(nodes, lead), ticks_at(nodes, load), law_at(nodes, load))
        table = places_at(nodes, i)
        ticks = array_at(table, TICK_AT, TICK)
        state, before = ticks[0]["state"], ticks[0]["reason"]
        keep(table)
        whole_at(places_at(table, LAW), ticks)
        reason = ticks[0]["reason"]
        left |= reason not in (QUIET, STOPPED, ENDS)
        going |= reason == QUIET
        if reason != before or ticks[0]["state"] != state or ticks[0]["rx_flags"] & TROUBLE != 0:
            found = NEW
    return OTHERS if left and going else found


@jit
def answer(nodes: Any, deadline_ns: int) -> Any:
    """The commands, in the nodes' order. Returns the stage reached: SENT when the loop has none to send."""
    first = places_at(nodes, 0)
    words, pace, times = array_at(first, WORDS, I8), array_at(first, PACE, I8), array_at(first, TIMES_AT, I8)
    if len(words) > 0:
        words[BEAT_NS] = now_of(first)
        armed = 0
        for i in range(len(nodes)):
            t = tick_of(places_at(nodes, i))
            words[COUNTERS + i] = t["counter"]
            armed |= int(t["state"] != DISARMED)
        words[ARMED] = armed
    pace[DID] = 0
    for i in range(len(nodes)):
        table = places_at(nodes, i)
        t = tick_of(table)
        if t["send"] != 0:
            if len(words) > 0 and words[FIRED] != 0:
                return DECIDED
            code = command(places_at(table, COMMAND))
            if code != DONE:
                io_of(table, COMMAND)[COMMANDED] = code
                return DECIDED
            hand_on(table)
        t["sent_ns"] = since(deadline_ns, times)
        pace[DID] += 1
    return SENT


@jit
def run_tick(nodes: Any, k: int, deadline_ns: int, asked: int, log_failed: bool) -> Any:
    """A tick at its deadline [ns]; returns the stage of :mod:`hil.runtime.rules` that it reached."""
    first = places_at(nodes, 0)
    times, marks = array_at(first, TIMES_AT, I8), array_at(first, MARKS, I8)
    mark(marks, LOOP, times)
    woken_ns = sleep_until(deadline_ns, times)
    mark(marks, SLEEP, times)
    late_ns = woken_ns - deadline_ns
    if late_ns < 0 or late_ns >= array_at(first, PLAN, I8)[PERIOD_NS]:
        return NOT_BEGUN
    request = tick_of(first)["request"]
    for i in range(len(nodes)):
        t = tick_of(places_at(nodes, i))
        stamp(t, k, deadline_ns, 1, late_ns)
        begin(t, asked, log_failed)
    stage = read(nodes, deadline_ns)
    mark(marks, READ, times)
    return conclude(nodes, deadline_ns, request) if stage == DECIDED else stage


@jit
def conclude(nodes: Any, deadline_ns: int, request: int) -> Any:
    """Laws, commands and records of a tick whose feedback was waited for; ``request``: the last tick's."""
    first = places_at(nodes, 0)
    times, marks, words = (
        array_at(first, TIMES_AT, I8),
        array_at(first, MARKS, I8),
        array_at(first, WORDS, I8),
    )
    received_ns, flags = since(deadline_ns, times), 0
    if len(words) > 0:
        flags = guardian_flags(words)
    for i in range(len(nodes)):
        t = tick_of(places_at(nodes, i))
        t["rx_flags"] |= np.uint32(flags)
        t["received_ns"] = received_ns
    found = decide(nodes)
    if found == OTHERS:
        array_at(first, PACE, I8)[DID] = LEFT
        return DECIDED
    computed_ns = since(deadline_ns, times)
    for i in range(len(nodes)):
        tick_of(places_at(nodes, i))["computed_ns"] = computed_ns
    mark(marks, CONTROL, times)
    stage = answer(nodes, deadline_ns)
    mark(marks, SEND, times)
    if stage < SENT or found == NEW or tick_of(first)["request"] != request:
        return stage
    record(nodes, deadline_ns)
    mark(marks, RECORD, times)
    return RECORDED


@jit
def record(nodes: Any, deadline_ns: int) -> None:
    """The ticks into their rings; when the first was stored stands in all."""
    first = places_at(nodes, 0)
    push(places_at(first, TICKS_IN), 1)
    stored_ns = since(deadline_ns, array_at(first, TIMES_AT, I8))
    for i in range(1, len(nodes)):
        push(places_at(places_at(nodes, i), TICKS_IN), 1)
    for i in range(len(nodes)):
        tick_of(places_at(nodes, i))["recorded_ns"] = stored_ns


@waiting
def run_together(nodes: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """:func:`hil.runtime.fused.run_ticks` of several nodes."""
    first = places_at(nodes, 0)
    plan, pace = array_at(first, PLAN, I8), array_at(first, PACE, I8)
    before = news(first)
    while True:
        stage = run_tick(nodes, k, deadline_ns, asked_at(first, k), log_failed)
        if stage != RECORDED:
            return stage
        pace[RAN], pace[NEXT] = pace[RAN] + 1, k + 1
        if pace[RAN] >= plan[TOGETHER] or news(first) != before:
            return RECORDED
        k, deadline_ns = k + 1, deadline_ns + plan[PERIOD_NS]
