"""The exchange with a bus as compiled kernels that call the C library: no interpreter between the frames.

:func:`drain` is the wait for a tick's feedback: ppoll to an absolute deadline with nanoseconds, one read a
frame, each handed to :func:`drivers.wire.take`. What it can't judge itself it hands back to the caller, who
calls again to go on. The symbols are the process's own (POSIX), so that the compiled form can be cached.
A bus that is no descriptor, and a clock that is not the system's, are functions of Python's that are called
in the C library's place; all else is the same. So it is with the compiler off.

To unpack an array of numpy's at every call costs more than what most kernels here do with it. Those that a
tick calls take one array instead: the places (address and length) of all the others, as
:func:`drivers.jit.places_of` writes them down.
"""

from __future__ import annotations

import time
from typing import Any, Final

import numba
import numpy as np
from numba import types

from drivers.frames import ENABLE_OPERATION, FOREIGN_COMMAND, FRESH
from drivers.jit import COMPILED, array_at, call, jit, waiting
from drivers.states import ENABLED, FAULT_RESET, of_controlword, state_of
from drivers.wire import (
    CLASSIC_BYTES,
    DATA_AT,
    FD_BYTES,
    FRAME,
    MESSAGE,
    OVERHEARD,
    REFUSED,
    SIGNAL,
    STATE,
    STATE_RAW,
    encode_command,
    note,
    overhear,
    take,
)

_types: Any = types
carray: Any = numba.carray  # type: ignore[attr-defined]
_int, _word, _pointer = _types.int32, _types.intp, _types.uintp
_recv = _types.ExternalFunction("recv", _word(_int, _pointer, _pointer, _int))
_recvmsg = _types.ExternalFunction("recvmsg", _word(_int, _pointer, _int))
_send = _types.ExternalFunction("send", _word(_int, _pointer, _pointer, _int))
_ppoll = _types.ExternalFunction("ppoll", _int(_pointer, _pointer, _pointer, _pointer))
_poll = _types.ExternalFunction("poll", _int(_pointer, _pointer, _int))
_clock_gettime = _types.ExternalFunction("clock_gettime", _int(_int, _pointer))
_errno_location = _types.ExternalFunction("__errno_location", _types.CPointer(_int)())

REALTIME, MONOTONIC = 0, 1
DONTWAIT: Final = 0x40
POLLIN: Final = 1
SYNC_COUNTS: Final = 240
"""SYNC's counter goes from 1 to here (CiA 301)."""
EINTR: Final = 4
EAGAIN: Final = 11
DONE, HANDED_BACK, PENDING = range(3)
"""What a kernel returns: it is done; the caller has a frame to judge or the log is full; frames wait."""
REFUSED_COMMAND: Final = -1000
"""A value of the command fits no signal: this and less by the message's place; others are -errno."""
UNSENT: Final = -2000
"""What -errno of a SYNC that was not sent is added to."""
BEFORE: Final = -4000
"""What is added to what :func:`drain` returns of the frames that came before SYNC."""
RAISED: Final = -999
"""In place of -errno: the function of Python's has raised something."""
OVER: Final = -998
"""In place of -errno: a bus that is no descriptor has nothing more, whatever time is left."""
RECEIVING, SENDING, POLL_FD, POLL_EVENTS = range(4)
FLAGS, SEEN, SIZE, MORE, FLAGS_AT, STATE_AT, LEFT, ASKS, SILENT, RECEIVES, SENDS, TELLS, IO_WORDS = range(13)
"""Of ``io``. LEFT: what a kernel returned that a compiled tick has left to the client, 0 for nothing.
FLAGS_AT, STATE_AT: offsets of the tick's rx_flags and drive_state. ASKS: SYNC is a request, which has no
counter; SILENT: the drive does not say its state. RECEIVES, SENDS, TELLS: functions to call, 0 for the
descriptors and CLOCK_MONOTONIC."""
EAR_FD, PERIOD, SYNCED, STAMP, MESSAGE_AT = range(5)
IOV_AT, CONTROL_AT, FRAME_AT, EAR_WORDS = 11, 13, 21, 30
"""Words of an ear: its descriptor, the period, how many SYNCs were heard since the last look, when the newest
was [ns]; then the message header of recvmsg, and what it points to: control data with a stamp, a frame."""
CONTROL_BYTES, FRAME_BYTES = 8 * (FRAME_AT - CONTROL_AT), 8 * (EAR_WORDS - FRAME_AT)
HEAR_MOST: Final = 1024
"""SYNCs that one look takes."""
AGE_MOST_NS: Final = 1_000_000_000
"""Older stamps are those of a clock that was set meanwhile."""
DRAIN_MOST: Final = 256
"""Frames that are still read once the time has passed; a flood can't exceed it."""

ARRAYS: Final = {
    "fds": np.dtype("i4"), "times": np.dtype("i8"), "io": np.dtype("i8"), "raw": np.dtype("u1"),
    "values": np.dtype("f8"), "messages": MESSAGE, "signals": SIGNAL, "last": np.dtype("i8"), "state": STATE,
    "words": np.dtype("u4"), "tick": np.dtype("u1"), "log": FRAME, "fields": np.dtype("i8"),
    "sync": np.dtype("u1"), "codes": np.dtype("i8"), "ear": np.dtype("i8"), "seldom": np.dtype("u1"),
    "held": np.dtype("u1"), "seen": np.dtype("f8"),
}  # fmt: skip
"""The arrays behind a kernel's places, in their order. ``fds``, ``times``, ``io`` and ``fields`` are of the
kernels here, the others of :mod:`drivers.wire`."""
FDS, TIMES, IO, RAW, VALUES, MESSAGES, SIGNALS, LAST = range(8)
STATES, WORDS, TICK, LOG, FIELDS, SYNC, CODES, EAR, SELDOM, HELD, SEEN_AT = range(8, 19)
I4, I8, U1, F8, U4 = (np.dtype(kind) for kind in ("i4", "i8", "u1", "f8", "u4"))


@jit
def errno() -> Any:
    """The C library's errno."""
    return carray(_errno_location(), 1)[0]


@jit
def clock_ns(clock: int, times: Any) -> Any:
    """A clock of the system [ns]. ``times``: int64 scratch of four, a timespec to read and one to wait."""
    _clock_gettime(clock, times.ctypes.data)
    return times[0] * 1_000_000_000 + times[1]


@jit
def now_ns(times: Any) -> Any:
    """CLOCK_MONOTONIC [ns], with the scratch of :func:`clock_ns`."""
    return clock_ns(MONOTONIC, times)


def _interpreted_now_ns(times: Any) -> Any:
    return time.monotonic_ns()


if not COMPILED:
    now_ns = _interpreted_now_ns


@jit
def stamp_ns(io: Any, times: Any) -> Any:
    """The time by the client's clock, for the log [ns]."""
    return now_ns(times) if io[TELLS] == 0 else call(io[TELLS], 0, 0)


@jit
def wait(fds: Any, times: Any, left_ns: int) -> Any:
    """Wait until there is something to read: 1, 0 when the time has passed, or -errno."""
    fds[POLL_FD], fds[POLL_EVENTS] = fds[RECEIVING], POLLIN
    times[2], times[3] = left_ns // 1_000_000_000, left_ns % 1_000_000_000
    ready = _ppoll(fds[POLL_FD:].ctypes.data, 1, times[2:].ctypes.data, 0)
    return -errno() if ready < 0 else ready


@jit
def look(polled: Any) -> None:
    """Ask several descriptors at once whether something is there; :func:`has_come` has the answer of each.

    ``polled``: int32, a descriptor and room for each. It costs less than to read each in vain.
    """
    for at in range(1, len(polled), 2):
        polled[at] = POLLIN
    if _poll(polled.ctypes.data, len(polled) // 2, 0) < 0:  # not known: each may have something
        for at in range(1, len(polled), 2):
            polled[at] = 0


@jit
def has_come(io: Any, polled: Any, i: int) -> Any:
    """Whether the i-th may have a frame or an error; a bus that is no descriptor always may."""
    return io[RECEIVES] != 0 or polled[2 * i + 1] != POLLIN


@jit
def receive(fds: Any, raw: Any) -> Any:
    """Read what is there into ``raw``: its size, or -errno, -EAGAIN when there is nothing."""
    size = _recv(fds[RECEIVING], raw.ctypes.data, len(raw), DONTWAIT)
    return -errno() if size < 0 else size


@jit
def next_frame(io: Any, fds: Any, times: Any, raw: Any, left_ns: int) -> Any:
    """The next frame, waited for: its size in ``raw``; -errno, -EAGAIN when there is none, or OVER."""
    if io[RECEIVES] != 0:
        return call(io[RECEIVES], left_ns, 0)
    if left_ns > 0:
        ready = wait(fds, times, left_ns)
        if ready <= 0:
            return -EAGAIN if ready == 0 else ready
    return receive(fds, raw)


@waiting
def drain(places: Any, deadline_ns: int, late: bool) -> Any:
    """Take frames until feedback came or the deadline passed; deadline 0: what is there.

    ``IO``: FLAGS of all taken so far, SEEN and SIZE of the frame that is handed back, MORE, how many may
    still be read once the time has passed. When it is done the flags are in the tick, at FLAGS_AT, and the
    next call begins anew. Returns DONE, HANDED_BACK or -errno.
    """
    fds, times, io = array_at(places, FDS, I4), array_at(places, TIMES, I8), array_at(places, IO, I8)
    raw, last, state = array_at(places, RAW, U1), array_at(places, LAST, I8), array_at(places, STATES, STATE)
    messages, signals = array_at(places, MESSAGES, MESSAGE), array_at(places, SIGNALS, SIGNAL)
    words, tick, log = array_at(places, WORDS, U4), array_at(places, TICK, U1), array_at(places, LOG, FRAME)
    ear = array_at(places, EAR, I8)
    while io[MORE] > 0:
        left_ns = max(deadline_ns - now_ns(times), 0) if deadline_ns > 0 else 0
        if left_ns == 0:
            io[MORE] -= 1
        size = next_frame(io, fds, times, raw, left_ns)
        if size < 0:
            if size == -EINTR or (size == -EAGAIN and left_ns > 0):
                continue
            if size not in (-EAGAIN, OVER):
                return size
            break
        if len(ear) > 0:
            hear(ear, io, state, log, times)
            late = ear[SYNCED] == 0
        seen = take(raw, messages, signals, last, state, words, tick, log, size, late, stamp_ns(io, times))
        if seen >= STATE_RAW:
            cell = tick[io[STATE_AT] : io[STATE_AT] + 4].view(np.uint32)
            raw_state: Any = np.int64(cell[0])
            cell[0] = state_of(array_at(places, CODES, I8), raw_state, state[0]["controlword"])
            seen ^= STATE_RAW
        if seen == OVERHEARD:
            overhear(raw, messages, signals, words, array_at(places, SEEN_AT, F8), size)
            seen = 0
        if seen < 0 or state[0]["logged"] >= len(log) - 1 > 0:
            io[SEEN], io[SIZE] = seen, size
            return HANDED_BACK
        io[FLAGS] |= seen
        if deadline_ns > 0 and seen & FRESH:
            break
    if len(ear) > 0:
        hear(ear, io, state, log, times)
    finish(io, tick)
    return DONE


@jit
def hear(ear: Any, io: Any, state: Any, log: Any, times: Any) -> None:
    """Take the SYNCs that the kernel has sent for us, with their stamps, before what answers them.

    One that does not have the next counter is another controller's. Nothing is looked for while none is due.
    The stamps are of the wall clock: their age counts, and one of an impossible age is as if heard just now.
    """
    if ear[SYNCED] > 0 and now_ns(times) - ear[STAMP] < ear[PERIOD] // 2:
        return
    s, raw = state[0], ear[FRAME_AT:].view(np.uint8)
    for _ in range(HEAR_MOST):
        ear[MESSAGE_AT + 5] = CONTROL_BYTES
        if _recvmsg(np.int32(ear[EAR_FD]), ear[MESSAGE_AT:].ctypes.data, DONTWAIT) <= 0:
            return
        sent_ns = ear[CONTROL_AT + 2] * 1_000_000_000 + ear[CONTROL_AT + 3]
        age_ns = clock_ns(REALTIME, times) - sent_ns
        if age_ns < 0 or age_ns > AGE_MOST_NS:
            age_ns = 0
        at_ns, due = now_ns(times) - age_ns, s["syncs"] % SYNC_COUNTS + 1
        own = raw[4] == 0 or raw[DATA_AT] == due
        note(log, s, raw, 0 if own else 1, at_ns)
        if s["logged"] < len(log):
            s["logged"] += 1
        if not own:
            io[FLAGS] |= FOREIGN_COMMAND
            continue
        s["syncs"], ear[STAMP] = due, at_ns
        ear[SYNCED] += 1
        if age_ns < ear[PERIOD] // 2:
            return


@jit
def finish(io: Any, tick: Any) -> None:
    """Put the flags of all taken into the tick, and begin anew."""
    at = io[FLAGS_AT]
    tick[at : at + 4].view(np.uint32)[0] |= np.uint32(io[FLAGS])
    io[FLAGS], io[MORE] = 0, DRAIN_MOST


@jit
def write(fds: Any, raw: Any, size: int) -> Any:
    """Send a frame that is laid out. Returns DONE or -errno."""
    while _send(fds[SENDING], raw.ctypes.data, size, 0) < 0:
        code = errno()
        if code != EINTR:
            return -code
    return DONE


@jit
def transmit(io: Any, fds: Any, raw: Any, size: int, state: Any, log: Any) -> Any:
    """:func:`write`, on whatever bus; the frame then counts in the log."""
    code = write(fds, raw, size) if io[SENDS] == 0 else call(io[SENDS], raw.ctypes.data, size)
    if code == DONE and state[0]["logged"] < len(log):
        state[0]["logged"] += 1
    return code


@jit
def rest(raw: Any) -> None:
    """Let a command that went out in SYNC's place say off, as the frame behind it does, until the next."""
    for at in range(FD_BYTES, len(raw)):
        raw[at - FD_BYTES] = raw[at]


@waiting
def exchange(places: Any, size: int, deadline_ns: int) -> Any:
    """:func:`opened`, then :func:`drain`, whose codes it returns once SYNC was sent."""
    code = opened(places, size, True)
    return drain(places, deadline_ns, False) if code == DONE else code


@jit
def opened(places: Any, size: int, late: bool) -> Any:
    """:func:`before`, then :func:`begin`. PENDING, and nothing is done, where SYNC must wait.

    It waits for flags to be told, and a bus that was down.
    """
    s = array_at(places, STATES, STATE)[0]
    if s["pending"] != 0 or s["down"] != 0:
        return PENDING
    code = before(places, late)
    return begin(places, size) if code == DONE else code


@jit
def before(places: Any, late: bool) -> Any:
    """Take what waits as late, where there may be any. Returns DONE, or BEFORE and what can't be judged."""
    s, code = array_at(places, STATES, STATE)[0], DONE
    s["got"] = 0
    if late:
        code = drain(places, 0, True)
    s["got"] = 0
    return DONE if code == DONE else BEFORE + code


@jit
def begin(places: Any, size: int) -> Any:
    """Send SYNC with its counter, or what stands in its place. Returns DONE or UNSENT - errno.

    A command that the drive answers stands there, the frame that says off behind it.
    """
    fds, times, raw = array_at(places, FDS, I4), array_at(places, TIMES, I8), array_at(places, SYNC, U1)
    state, log, io = array_at(places, STATES, STATE), array_at(places, LOG, FRAME), array_at(places, IO, I8)
    s = state[0]
    if len(raw) == 0:
        return DONE
    s["syncs"] = s["syncs"] % SYNC_COUNTS + 1
    if raw[4] == 1 and io[ASKS] == 0:
        raw[DATA_AT] = s["syncs"]
    note(log, s, raw, 0, stamp_ns(io, times))
    code = transmit(io, fds, raw, size, state, log)
    rest(raw)
    return DONE if code == DONE else UNSENT + code


@jit
def left(places: Any, code: int) -> Any:
    """Whether a compiled tick has something left to the client, which then goes on from this code."""
    if code not in (DONE, PENDING):
        array_at(places, IO, I8)[LEFT] = code
    return code != DONE


@jit
def gather(values: Any, tick: Any, fields: Any) -> None:
    """Values of a tick's command: counter, controlword, u_q, u_d, T_L from their ``fields``' offsets."""
    for index in range(2):
        at = fields[index]
        values[index] = float(tick[at : at + 4].view(np.uint32)[0])
    for index in range(2, 5):
        at = fields[index]
        values[index] = tick[at : at + 8].view(np.float64)[0]
    word = int(values[1])
    values[5] = 1.0 if word == ENABLE_OPERATION else 0.0
    values[6] = 1.0 if word & FAULT_RESET else 0.0


@jit
def command(places: Any) -> Any:
    """Lay out all messages of a tick's command, then send them. Returns DONE, REFUSED_COMMAND... or -errno.

    One that the drive answers is laid in SYNC's place, from where :func:`begin` sends it. A ``SELDOM`` one
    is sent when it is another than the one sent last, which is ``HELD``.
    """
    fds, times, raw = array_at(places, FDS, I4), array_at(places, TIMES, I8), array_at(places, RAW, U1)
    values, fields = array_at(places, VALUES, F8), array_at(places, FIELDS, I8)
    messages, signals = array_at(places, MESSAGES, MESSAGE), array_at(places, SIGNALS, SIGNAL)
    state, words = array_at(places, STATES, STATE), array_at(places, WORDS, U4)
    tick, log, io = array_at(places, TICK, U1), array_at(places, LOG, FRAME), array_at(places, IO, I8)
    gather(values, tick, fields)
    at_ns, size = stamp_ns(io, times), 0
    for index in range(len(messages)):
        one = raw[FD_BYTES * index : FD_BYTES * (index + 1)]
        size = encode_command(one, values, index, messages, signals, state, words, log, at_ns)
        if size == REFUSED:
            return REFUSED_COMMAND - index
    sync, code = array_at(places, SYNC, U1), DONE
    for at in range(min(FD_BYTES, len(sync))):
        sync[at] = raw[at]
    if len(sync) == 0 and len(messages) == 1:
        code = transmit(io, fds, raw, size, state, log)
    elif len(sync) == 0:
        code = transmit_all(places, at_ns)
    if code == DONE:
        state[0]["last_sent"], state[0]["controlword"] = int(values[0]), int(values[1])
        if io[SILENT] != 0:
            lead(tick, io[STATE_AT], int(values[1]))
    return code


@jit
def lead(tick: Any, at: int, controlword: int) -> None:
    """A drive that does not say its state is taken to be where the command leads."""
    on = controlword == ENABLE_OPERATION
    tick[at : at + 4].view(np.uint32)[0] = ENABLED if on else of_controlword(controlword)


@jit
def transmit_all(places: Any, at_ns: int) -> Any:
    """Send the messages of a command that are due, each noted as it goes. Returns DONE or -errno."""
    fds, raw, state = array_at(places, FDS, I4), array_at(places, RAW, U1), array_at(places, STATES, STATE)
    log, messages, io = (
        array_at(places, LOG, FRAME),
        array_at(places, MESSAGES, MESSAGE),
        array_at(places, IO, I8),
    )
    seldom, held = array_at(places, SELDOM, U1), array_at(places, HELD, U1)
    for index in range(len(messages)):
        first = FD_BYTES * index
        one, last = raw[first : first + FD_BYTES], held[first : first + FD_BYTES]
        if seldom[index] != 0 and not differ(one, last):
            continue
        note(log, state[0], one, 0, at_ns)
        size = FD_BYTES if messages[index]["fd"] else CLASSIC_BYTES
        code = transmit(io, fds, one, size, state, log)
        if code != DONE:
            return code
        for at in range(FD_BYTES):
            last[at] = one[at]
    return DONE


@jit
def differ(one: Any, other: Any) -> bool:
    """Are two frames not equal?"""
    found = False
    for at in range(FD_BYTES):
        found |= one[at] != other[at]
    return found
