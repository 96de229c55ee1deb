"""Ticks as one compiled call: what :mod:`hil.runtime.loop` does with its ports, where nothing is unusual.

Between two ticks the caches go cold, and an interpreter pays for every step: the loop's own Python took as
long as all that it calls. This is a part of the composition root, since it calls the kernels behind the
ports. Its rules are those of :mod:`hil.runtime.rules`; SYNC and feedback are :func:`drivers.posix.exchange`,
law, supervisor and guard :func:`hil.tick.kernel.whole_at`, the command :func:`drivers.posix.command`, the
records :func:`hil.log.push.push`, and the guardian's words as its :class:`~hil.runtime.guardian.GuardedDrive`
keeps them.
At the first thing that is unusual it returns the stage that it reached, and the loop does the rest. Some
ticks run in one call, without Python in between: what others may ask of a run meanwhile is memory that is
looked at before each tick.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from drivers.client import FLUSH_AT
from drivers.drive import Drive
from drivers.jit import COMPILED, array_at, entry, jit, place_of, places_at, waiting
from drivers.posix import (
    COMMANDED,
    DONE,
    EAR,
    EINTR,
    EXCHANGED,
    IO,
    MONOTONIC,
    PENDING,
    STAMP,
    STATES,
    SYNCED,
    clock_ns,
    command,
    drain,
    exchange,
    now_ns,
)
from drivers.wire import STATE
from hil.config.design import Machine
from hil.log.push import HEADER, NOWHERE, push
from hil.log.recorder import Recorder
from hil.log.ring import FAILED_AT
from hil.runtime.guardian import FIRED, Words, beats, commands, guardian_flags
from hil.runtime.loop import Plan, StopRequest, Whole, none_compiled, wait_ns
from hil.runtime.rules import (
    ARRIVED,
    BEGUN,
    COUNTER_JUMP,
    DECIDED,
    DID,
    LOST,
    NEVER,
    NEXT,
    NOT_BEGUN,
    RAN,
    RECORDED,
    SENT,
    STEER_EVERY,
    Pace,
    asked_in,
    begin,
    bounded,
    count,
    is_due,
    is_news,
    newest,
    stamp,
    wake,
)
from hil.signals import TICK, TickArray
from hil.tick.kernel import whole_at

PHASES: Final = (
    "loop", "sleep", "sync, receive, check, decode", "control and guard", "encode, send", "record",
)  # fmt: skip
"""Where a tick's processor time goes; ``loop`` is what lies between two calls."""
LOOP, SLEEP, READ, CONTROL, SEND, RECORD = range(6)
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

(
    RECEIVE, COMMAND, LAW, TICKS_IN, FRAMES_IN, TIMES_AT, WORDS, PLAN, TICK_AT, MARKS, PACE, REQUEST, NUMBER,
    ROWS,
) = range(14)  # fmt: skip
"""Rows of the table: places of the kernels' own tables of places, then of arrays."""
PERIOD_NS, TIMEOUT_NS, SYNC_BYTES, END, WAIT_NS, EVERY, TOGETHER, FOLLOWS, PLANNED = range(9)
TOGETHER_NS: Final = 4_000_000
"""How long ticks go on without Python: a signal that comes while none of them waits is late by so much."""


def together(period_ns: int, request: StopRequest) -> int:
    """How many ticks one compiled call may run."""
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
) -> Whole:
    """The ticks of a run on a socket, paced by SYNC or feedback in real time; others are the loop's alone.

    The client must be prepared for the recorder's record, and for no other later; the pace is the loop's.
    ``number``: of the newest set-point that was asked for, in memory that outlives the run; no array of it
    stays, which would keep it from being released.
    """
    ports = client.compiled()
    receive = None if ports is None else {"sync": ports.exchange, "feedback": ports.follow}.get(plan.pacing)
    if ports is None or receive is None:
        return none_compiled
    timing = timing_of(plan, ports.sync_bytes, client.timed is not None)
    tables = [receive, ports.command, machine.places(), *recorder.places(ports.log)]
    table, alive = table_of(tables, timing, recorder.record, words, request, pace, number, marks)
    call = partial(_compiled(), table)
    call.__dict__["alive"] = (client, machine, recorder, alive)  # the places are of them
    return call


def timing_of(plan: Plan, sync_bytes: int, timed: bool) -> npt.NDArray[np.int64]:
    """The plan, as compiled ticks read it."""
    end = NEVER if plan.ticks is None else plan.ticks
    row = [
        plan.period_ns, plan.timeout_ns, sync_bytes, end, wait_ns(plan, timed), plan.every, plan.together,
        plan.pacing == "feedback",
    ]  # fmt: skip
    return np.array(row, np.int64)


def table_of(
    tables: list[npt.NDArray[np.int64]],
    timing: npt.NDArray[np.int64],
    record: TickArray,
    words: Words | None,
    request: StopRequest,
    pace: Pace,
    number: memoryview | None,
    marks: Marks | None,
) -> tuple[npt.NDArray[np.int64], Any]:
    """The table of a compiled tick, RECEIVE to NUMBER; beside it what must live as long.

    ``tables``: RECEIVE to FRAMES_IN.
    """
    shared = np.frombuffer(words.cells, np.int64) if words else np.zeros(0, np.int64)
    marks, asked = np.zeros(0, np.int64) if marks is None else marks, np.zeros(1, np.int64)
    arrays = [np.zeros(4, np.int64), shared, timing, record, marks, pace, request.cell]
    rows = [place_of(table.reshape(-1), I8) for table in tables]
    rows += [place_of(array, TICK if array is record else I8) for array in arrays]
    rows.append(place_of(asked if number is None else np.frombuffer(number, np.int64), I8))
    return np.array(rows), (tables, arrays, asked)


def _compiled() -> Callable[..., int]:
    """The compiled form; the call that makes it is for a first tick that is late, which it leaves alone."""
    table = np.zeros((ROWS, 2), np.int64)
    sizes = {TIMES_AT: 4, PLAN: PLANNED, PACE: DID + 1, REQUEST: 1, NUMBER: 1}
    known = {row: np.zeros(size, np.int64) for row, size in sizes.items()}
    known[TICKS_IN] = np.array([place_of(*one) for one in NOWHERE]).reshape(-1)
    for row, array in known.items():
        table[row] = place_of(array, I8)
    compiled: Callable[..., int] = entry(run_ticks, table, 0, 0, False)
    return compiled


def new_marks() -> Marks:
    """All zero."""
    return np.zeros(LAST + 1, np.int64)


def load() -> None:
    """Compile it, or load it."""
    if COMPILED:
        _compiled()


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
def sleep_until(deadline_ns: int, times: Any) -> Any:
    """Sleep to the absolute deadline, or to a signal; return the time of waking."""
    woken_ns = now_ns(times)
    while woken_ns < deadline_ns:
        times[2], times[3] = deadline_ns // 1_000_000_000, deadline_ns % 1_000_000_000
        failed = _clock_nanosleep(MONOTONIC, ABSOLUTE, times[2:].ctypes.data, 0)
        woken_ns = now_ns(times)
        if failed == EINTR:
            break
    return woken_ns


@jit
def since(deadline_ns: int, times: Any) -> Any:
    """Time after the deadline, as the record holds it."""
    return bounded(now_ns(times) - deadline_ns)


@jit
def read(table: Any, t: Any, deadline_ns: int, due: bool) -> Any:
    """SYNC and feedback. Returns the stage reached: DECIDED once the law can go on."""
    words, plan = array_at(table, WORDS, I8), array_at(table, PLAN, I8)
    places, times = places_at(table, RECEIVE), array_at(table, TIMES_AT, I8)
    io = array_at(places, IO, I8)
    if len(words) > 0 and beats(words, now_ns(times)):
        return NOT_BEGUN
    code = exchange(places, plan[SYNC_BYTES], deadline_ns + (plan[TIMEOUT_NS] if due else 0))
    if code == PENDING:
        return NOT_BEGUN
    if code != DONE:
        io[EXCHANGED] = code
        return BEGUN
    if len(words) > 0:
        t["rx_flags"] |= guardian_flags(words)
    return DECIDED


@jit
def answer(table: Any, t: Any) -> Any:
    """The command, if there is one. Returns the stage reached: SENT when the loop has nothing to send."""
    words, places = array_at(table, WORDS, I8), places_at(table, COMMAND)
    times, io = array_at(table, TIMES_AT, I8), array_at(places, IO, I8)
    if t["send"] == 0:
        return SENT
    if len(words) > 0 and commands(words, now_ns(times), t["state"], t["counter"]):
        return DECIDED
    code = command(places)
    if code != DONE:
        io[COMMANDED] = code
        return DECIDED
    return SENT


@jit
def hand_on(table: Any) -> None:
    """Frames into their ring, some ticks' together."""
    state = array_at(places_at(table, RECEIVE), STATES, STATE)
    if state[0]["logged"] >= FLUSH_AT:
        push(places_at(table, FRAMES_IN), state[0]["logged"])
        state[0]["logged"] = 0


@jit
def run_tick(table: Any, k: int, deadline_ns: int, asked: int, log_failed: bool) -> Any:
    """A tick at its deadline [ns]; returns the stage of :mod:`hil.runtime.rules` that it reached."""
    times, marks = array_at(table, TIMES_AT, I8), array_at(table, MARKS, I8)
    mark(marks, LOOP, times)
    woken_ns = sleep_until(deadline_ns, times)
    mark(marks, SLEEP, times)
    late_ns = woken_ns - deadline_ns
    plan = array_at(table, PLAN, I8)
    if late_ns < 0 or late_ns >= plan[PERIOD_NS]:
        return NOT_BEGUN
    ticks = array_at(table, TICK_AT, TICK)
    t = ticks[0]
    request, pace = t["request"], array_at(table, PACE, I8)
    stamp(t, k, deadline_ns, 1, late_ns)
    begin(t, asked, log_failed)
    stage = read(table, t, deadline_ns, is_due(pace, plan[EVERY]))
    mark(marks, READ, times)
    if stage < DECIDED:
        return stage
    return conclude(table, ticks, deadline_ns, request)


@jit
def conclude(table: Any, ticks: Any, deadline_ns: int, request: int) -> Any:
    """Law, command and record of a tick whose feedback was waited for; ``request``: the last tick's."""
    times, marks, t = array_at(table, TIMES_AT, I8), array_at(table, MARKS, I8), ticks[0]
    t["received_ns"] = since(deadline_ns, times)
    state = t["state"]
    whole_at(places_at(table, LAW), ticks)
    t["computed_ns"] = since(deadline_ns, times)
    mark(marks, CONTROL, times)
    stage = answer(table, t)
    if stage < SENT:
        return stage
    t["sent_ns"] = since(deadline_ns, times)
    mark(marks, SEND, times)
    hand_on(table)
    if is_news(t, state, request):
        return SENT
    count(array_at(table, PACE, I8), t)
    push(places_at(table, TICKS_IN), 1)
    t["recorded_ns"] = since(deadline_ns, times)
    mark(marks, RECORD, times)
    return RECORDED


@jit
def receive(table: Any, t: Any, deadline_ns: int) -> Any:
    """For :func:`newest`. What the client must tell first is the loop's, as is a guardian that has fired."""
    places, words = places_at(table, RECEIVE), array_at(table, WORDS, I8)
    s = array_at(places, STATES, STATE)[0]
    if s["pending"] != 0 or s["down"] != 0 or (len(words) > 0 and words[FIRED] != 0):
        return False
    code = drain(places, deadline_ns, False)
    if code != DONE:
        array_at(places, IO, I8)[EXCHANGED] = code
        return False
    if len(words) > 0:
        t["rx_flags"] |= guardian_flags(words)
    return True


@jit
def heard(table: Any, t: Any, came: int) -> None:
    """Stamp a tick that feedback, or SYNC of the kernel's, woke."""
    times, pace, plan = array_at(table, TIMES_AT, I8), array_at(table, PACE, I8), array_at(table, PLAN, I8)
    ear = array_at(places_at(table, RECEIVE), EAR, I8)
    now, jumped = now_ns(times), t["rx_flags"] & COUNTER_JUMP
    if len(ear) > 0:
        came, jumped, ear[SYNCED] = ear[SYNCED], 0, 0
        now = ear[STAMP] if came > 0 else now
    wake(t, pace, plan[PERIOD_NS], came, jumped, now)
    t["request"] = asked_at(table, int(t["k"]))


@jit
def run_followed(table: Any, k: int, deadline_ns: int, asked: int, log_failed: bool) -> Any:
    """:func:`run_tick` for a tick that begins when the drive's cyclic feedback comes."""
    times, marks = array_at(table, TIMES_AT, I8), array_at(table, MARKS, I8)
    mark(marks, LOOP, times)
    if k == 0:
        return NOT_BEGUN
    pace, plan, ticks = array_at(table, PACE, I8), array_at(table, PLAN, I8), array_at(table, TICK_AT, TICK)
    t = ticks[0]
    request = t["request"]
    stamp(t, k, deadline_ns, 1, 0)
    begin(t, asked, log_failed)
    wait = plan[WAIT_NS if is_due(pace, plan[EVERY]) else PERIOD_NS]
    came = newest(receive, table, t, pace, pace[ARRIVED] + wait)
    mark(marks, READ, times)
    if came < 0:
        return BEGUN
    heard(table, t, came)
    return conclude(table, ticks, int(t["t_ns"]), request)


@jit
def asked_at(table: Any, k: int) -> Any:
    """What is asked of the supervisor in tick k."""
    return asked_in(k, array_at(table, PLAN, I8)[END], array_at(table, REQUEST, I8)[0])


@jit
def news(table: Any) -> Any:
    """A number that is another once a set-point was asked for or the writer has failed: both only grow."""
    return array_at(table, NUMBER, I8)[0] + array_at(places_at(table, TICKS_IN), HEADER, I8)[FAILED_AT]


@waiting
def run_ticks(table: Any, k: int, deadline_ns: int, log_failed: bool) -> Any:
    """Ticks from k on, the first at its deadline [ns], until one is left to the loop or Python has its turn.

    Returns the stage of :mod:`hil.runtime.rules` that the last one reached; the pace says how many ran.
    """
    plan, pace = array_at(table, PLAN, I8), array_at(table, PACE, I8)
    before = news(table)
    while True:
        if plan[FOLLOWS] != 0:
            stage = run_followed(table, k, deadline_ns, asked_at(table, k), log_failed)
        else:
            stage = run_tick(table, k, deadline_ns, asked_at(table, k), log_failed)
        if stage != RECORDED:
            return stage
        t = array_at(table, TICK_AT, TICK)[0]
        k, deadline_ns = int(t["k"]), int(t["t_ns"])
        pace[RAN], pace[LOST], pace[NEXT] = pace[RAN] + 1, pace[LOST] + t["skipped"], k + 1
        if pace[RAN] >= plan[TOGETHER] or k % STEER_EVERY == 0 or news(table) != before:
            return RECORDED
        k, deadline_ns = k + 1, deadline_ns + plan[PERIOD_NS]
