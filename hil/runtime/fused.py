"""Ticks as one compiled call: what :mod:`hil.runtime.loop` does with its ports, where nothing is unusual.

Between two ticks the caches go cold, and an interpreter pays for every step: the loop's own Python took as
long as all that it calls. This is a part of the composition root, since it calls the kernels behind the
ports. Here are the parts of :func:`hil.runtime.rules.run_tick`: SYNC and feedback are
:func:`drivers.posix.exchange`, law, supervisor and guard :func:`hil.tick.kernel.whole_at`, the command
:func:`drivers.posix.command`, the records :func:`hil.log.push.push`, and the guardian's words as its
:class:`~hil.runtime.guardian.GuardedDrive` keeps them.
At the first thing that is unusual it returns the stage that it reached, and the loop does the rest. Some
ticks run in one call, without Python in between: what others may ask of a run meanwhile is memory that is
looked at before each tick. Lockstep's time is a word of memory, and a bus that is no descriptor is called as
:mod:`drivers.posix` says.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from drivers.client import FLUSH_AT
from drivers.drive import Drive, Seen
from drivers.jit import COMPILED, array_at, entry, jit, place_of, places_at, waiting
from drivers.posix import (
    EAR,
    EINTR,
    IO,
    LEFT,
    MONOTONIC,
    STAMP,
    STATES,
    SYNCED,
    clock_ns,
    command,
    drain,
    left,
    now_ns,
)
from drivers.posix import exchange as sync_and_drain
from drivers.wire import STATE
from hil.config.design import Machine
from hil.log.push import HEADER, NOWHERE, push
from hil.log.recorder import Recorder
from hil.log.ring import FAILED_AT
from hil.runtime.clock import LOCKSTEP_TIMEOUT_NS, Cell, RealClock
from hil.runtime.guardian import FIRED, Words, beats, commands, guardian_flags
from hil.runtime.loop import Plan, StopRequest, Whole, none_compiled, timing_of
from hil.runtime.rules import (
    END,
    LOST,
    NEWS,
    NEXT,
    NOT_BEGUN,
    PERIOD_NS,
    PLANNED,
    RAN,
    RECORDED,
    STEER_EVERY,
    SYNC_BYTES,
    TOGETHER,
    Pace,
    Timing,
    asked_in,
    is_news,
    rule,
    run_tick,
    since,
)
from hil.runtime.shadow import note_applied
from hil.signals import TICK, TickArray
from hil.tick.kernel import whole_at

PHASES: Final = (
    "loop", "sleep", "sync, receive, check, decode", "control and guard", "encode, send", "record",
)  # fmt: skip
"""Where a tick's processor time goes; ``loop`` is what lies between two calls."""
LOOP, SLEEP, READING, CONTROL, SEND, RECORD = range(6)
LAST: Final = len(PHASES)
"""Behind the phases' sums: the thread's processor time at the last border."""
Marks = npt.NDArray[np.int64]
"""Each phase's processor time [ns], added up, and :data:`LAST`."""

_types: Any = numba.types
_clock_nanosleep = _types.ExternalFunction(
    "clock_nanosleep", _types.int32(_types.int32, _types.int32, _types.uintp, _types.uintp)
)
THREAD_CPUTIME, ABSOLUTE = 3, 1
I8: Final = np.dtype(np.int64)
F8: Final = np.dtype(np.float64)

(
    RECEIVE, COMMAND, LAW, TICKS_IN, FRAMES_IN, TIMES_AT, WORDS, PLAN, TICK_AT, MARKS, PACE, REQUEST, CLOCK,
    SEEN, NUMBER, ROWS,
) = range(16)  # fmt: skip
"""Rows of the table: places of the kernels' own tables of places, then of arrays. CLOCK: the cell of a
:class:`hil.runtime.clock.LockstepClock`, of no length in real time. SEEN: what a shadow has overheard, of no
length in a run that sends."""
PARTS: Final = sys.modules[__name__]
"""The parts of a tick are functions of this module; a kernel takes a module, but no tuple of functions."""
TOGETHER_NS: Final = 4_000_000
"""How long ticks go on without Python: a signal that comes while none of them waits is late by so much."""


def together(period_ns: int, request: StopRequest) -> int:
    """Periods after which a compiled call begins no other tick."""
    return 1 if request.polled else max(1, TOGETHER_NS // period_ns)


def whole_tick(
    client: Drive,
    words: Words | None,
    machine: Machine,
    recorder: Recorder,
    plan: Plan,
    request: StopRequest,
    pace: Pace,
    number: memoryview | None = None,
    marks: Marks | None = None,
    clock: Cell = RealClock.cell,
    seen: Seen | None = None,
) -> Whole:
    """The ticks of a run; a client that is not compiled leaves them to the loop.

    The client must be prepared for the recorder's record, and for no other later; the pace is the loop's.
    ``number``: of the newest set-point that was asked for, in memory that outlives the run; no array of it
    stays, which would keep it from being released. ``clock``: the cell of the loop's. ``seen``: a shadow's.
    """
    ports = client.compiled()
    if ports is None:
        return none_compiled
    receive = ports.exchange if plan.pacing == "sync" else ports.receive
    timing = timing_of(plan, client.timed is not None, ports.sync_bytes)
    tables = [receive, ports.command, machine.places(), *recorder.places(ports.log)]
    table, alive = table_of(tables, timing, recorder.record, words, request, pace, number, marks, clock, seen)
    call = partial(compiled_of(run_ticks, ROWS), table)
    call.__dict__["alive"] = (client, machine, recorder, alive)  # the places are of them
    return call


def table_of(
    tables: list[npt.NDArray[np.int64]],
    timing: Timing,
    record: TickArray,
    words: Words | None,
    request: StopRequest,
    pace: Pace,
    number: memoryview | None,
    marks: Marks | None,
    clock: Cell,
    seen: Seen | None = None,
) -> tuple[npt.NDArray[np.int64], Any]:
    """The table of a compiled tick, RECEIVE to NUMBER; beside it what must live as long.

    ``tables``: RECEIVE to FRAMES_IN.
    """
    shared = np.frombuffer(words.cells, np.int64) if words else np.zeros(0, np.int64)
    marks, asked = np.zeros(0, np.int64) if marks is None else marks, np.zeros(1, np.int64)
    heard = np.zeros(0) if seen is None else seen
    arrays = [np.zeros(4, np.int64), shared, timing, record, marks, pace, request.cell, clock, heard]
    kinds = {id(record): TICK, id(heard): F8}
    rows = [place_of(table.reshape(-1), I8) for table in tables]
    rows += [place_of(array, kinds.get(id(array), I8)) for array in arrays]
    rows.append(place_of(asked if number is None else np.frombuffer(number, np.int64), I8))
    return np.array(rows), (tables, arrays, asked)


def compiled_of(ticks: Any, rows: int) -> Callable[..., int]:
    """The compiled form over tables of so many rows; the call that makes it may run no tick."""
    table = np.zeros((rows, 2), np.int64)
    sizes = {TIMES_AT: 4, PLAN: PLANNED, PACE: NEWS + 1, REQUEST: 1, NUMBER: 1}
    known = {row: np.zeros(size, np.int64) for row, size in sizes.items()}
    known[TICKS_IN] = np.array([place_of(*one) for one in NOWHERE]).reshape(-1)
    for row, array in known.items():
        table[row] = place_of(array, I8)
    compiled: Callable[..., int] = entry(ticks, table, 0, 0, False)
    return compiled


def new_marks() -> Marks:
    """All zero."""
    return np.zeros(LAST + 1, np.int64)


def load() -> None:
    """Compile it, or load it."""
    if COMPILED:
        compiled_of(run_ticks, ROWS)


@jit
def mark(marks: Any, phase: int, times: Any) -> None:
    """Add what the thread took since the last border to a phase."""
    if len(marks) > 0:
        ns = clock_ns(THREAD_CPUTIME, times)
        marks[phase] += ns - marks[LAST]
        marks[LAST] = ns


@jit
def mark_often(marks: Any, count: int) -> None:
    """So many borders of nothing, for what one takes."""
    times = np.zeros(4, np.int64)
    for _ in range(count):
        mark(marks, LOOP, times)


@jit
def sleep(table: Any, deadline_ns: int) -> Any:
    """A part of a tick, as what follows: :class:`hil.runtime.rules.Parts`."""
    times, marks = array_at(table, TIMES_AT, I8), array_at(table, MARKS, I8)
    clock = array_at(table, CLOCK, I8)
    if len(clock) > 0:
        clock[0] = deadline_ns
        return deadline_ns
    woken_ns = now_ns(times)
    while woken_ns < deadline_ns:
        times[2], times[3] = deadline_ns // 1_000_000_000, deadline_ns % 1_000_000_000
        failed = _clock_nanosleep(MONOTONIC, ABSOLUTE, times[2:].ctypes.data, 0)
        woken_ns = now_ns(times)
        if failed == EINTR:
            break
    mark(marks, SLEEP, times)
    return woken_ns


@jit
def now(table: Any) -> Any:
    """CLOCK_MONOTONIC, or the time that stands still [ns]."""
    clock = array_at(table, CLOCK, I8)
    return clock[0] if len(clock) > 0 else now_ns(array_at(table, TIMES_AT, I8))


@jit
def until(table: Any, ns: int, wait_ns: int) -> Any:
    """In real time; where time stands still, as long as the drive may take to compute."""
    if len(array_at(table, CLOCK, I8)) > 0:
        return now_ns(array_at(table, TIMES_AT, I8)) + LOCKSTEP_TIMEOUT_NS
    return ns + wait_ns


@jit
def asked(table: Any, k: int) -> Any:
    """What is asked of the supervisor in tick k."""
    return asked_in(k, array_at(table, PLAN, I8)[END], array_at(table, REQUEST, I8)[0])


@jit
def begun(table: Any, _t: Any) -> None:
    """Nothing is left of the tick before: a guardian that fired may have kept the client from taking it."""
    array_at(places_at(table, RECEIVE), IO, I8)[LEFT] = 0


@jit
def sync(table: Any, t: Any, deadline_ns: int) -> Any:
    """SYNC and feedback."""
    if len(array_at(table, SEEN, F8)) > 0:
        return False
    words, places = array_at(table, WORDS, I8), places_at(table, RECEIVE)
    if len(words) > 0 and beats(words, now(table)):
        return False
    return taken(table, t, sync_and_drain(places, array_at(table, PLAN, I8)[SYNC_BYTES], deadline_ns))


@jit
def receive(table: Any, t: Any, deadline_ns: int) -> Any:
    """What the client must tell first is the loop's, as is a guardian that has fired."""
    places, words = places_at(table, RECEIVE), array_at(table, WORDS, I8)
    s = array_at(places, STATES, STATE)[0]
    if s["pending"] != 0 or s["down"] != 0 or (len(words) > 0 and words[FIRED] != 0):
        return False
    if not taken(table, t, drain(places, deadline_ns, False)):
        return False
    seen = array_at(table, SEEN, F8)
    if len(seen) > 0:
        note_applied(t, seen, deadline_ns)
    return True


@jit
def taken(table: Any, t: Any, code: int) -> Any:
    """Whether a kernel of the client's is done; else the client goes on from there."""
    words, marks = array_at(table, WORDS, I8), array_at(table, MARKS, I8)
    mark(marks, READING, array_at(table, TIMES_AT, I8))
    if left(places_at(table, RECEIVE), code):
        return False
    if len(words) > 0:
        t["rx_flags"] |= guardian_flags(words)
    return True


@jit
def synced(table: Any) -> tuple[int, int]:
    """SYNCs that the ear has heard."""
    ear = array_at(places_at(table, RECEIVE), EAR, I8)
    if len(ear) == 0:
        return -1, 0
    count, ear[SYNCED] = ear[SYNCED], 0
    return count, ear[STAMP]


@jit
def law(table: Any, _t: Any) -> Any:
    """Law, supervisor and guard."""
    whole_at(places_at(table, LAW), array_at(table, TICK_AT, TICK))
    mark(array_at(table, MARKS, I8), CONTROL, array_at(table, TIMES_AT, I8))
    return True


@jit
def answer(table: Any, t: Any) -> Any:
    """The command, if there is one."""
    words, times = array_at(table, WORDS, I8), array_at(table, TIMES_AT, I8)
    places = places_at(table, COMMAND)
    if t["send"] != 0:
        if len(array_at(table, SEEN, F8)) > 0:
            return False
        if len(words) > 0 and commands(words, now_ns(times), t["state"], t["counter"]):
            return False
        if left(places, command(places)):
            return False
    t["sent_ns"] = since(now, table, t)
    mark(array_at(table, MARKS, I8), SEND, times)
    return True


@jit
def hand_on(table: Any) -> None:
    """Frames into their ring, some ticks' together."""
    state = array_at(places_at(table, RECEIVE), STATES, STATE)
    if state[0]["logged"] >= FLUSH_AT:
        push(places_at(table, FRAMES_IN), state[0]["logged"])
        state[0]["logged"] = 0


@jit
def tell(table: Any, t: Any, state: int, request: int) -> Any:
    """Frames are handed on; what there is to say is the loop's."""
    hand_on(table)
    return not is_news(t, state, request)


@jit
def store(table: Any, t: Any) -> None:
    """The record into its ring."""
    times = array_at(table, TIMES_AT, I8)
    push(places_at(table, TICKS_IN), 1)
    t["recorded_ns"] = since(now, table, t)
    mark(array_at(table, MARKS, I8), RECORD, times)


@jit
def news(table: Any) -> Any:
    """A number that is another once a set-point was asked for or the writer has failed: both only grow."""
    return array_at(table, NUMBER, I8)[0] + array_at(places_at(table, TICKS_IN), HEADER, I8)[FAILED_AT]


@rule
def ticks_of(io: Any, table: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """Ticks from k on, the first at its deadline [ns], until one is left to the loop or Python has its turn.

    Returns the stage of :mod:`hil.runtime.rules` that the last one reached; the pace says how many ran.
    """
    plan, pace, marks = array_at(table, PLAN, I8), array_at(table, PACE, I8), array_at(table, MARKS, I8)
    before, t = news(table), array_at(table, TICK_AT, TICK)[0]
    while pace[RAN] + pace[LOST] < plan[TOGETHER]:  # by time: with a dead drive a tick is many periods
        mark(marks, LOOP, array_at(table, TIMES_AT, I8))
        stage = run_tick(io, table, t, pace, plan, NOT_BEGUN, k, deadline_ns, log_failed)
        if stage != RECORDED:
            return stage
        k, deadline_ns = int(t["k"]) + 1, int(t["t_ns"]) + plan[PERIOD_NS]
        pace[RAN], pace[LOST], pace[NEXT] = pace[RAN] + 1, pace[LOST] + t["skipped"], k
        if t["k"] % STEER_EVERY == 0 or news(table) != before:
            break
    return RECORDED


@waiting
def run_ticks(table: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """:func:`ticks_of` one drive."""
    return ticks_of(PARTS, table, k, deadline_ns, log_failed)
