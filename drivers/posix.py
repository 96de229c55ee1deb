"""The exchange with a socket as compiled kernels that call the C library: no interpreter between the frames.

:func:`drain` is the wait for a tick's feedback: ppoll to an absolute deadline with nanoseconds, one read a
frame, each handed to :func:`drivers.wire.take`. What it can't judge itself it hands back to the caller, who
calls again to go on. The symbols are the process's own (POSIX), so that the compiled form can be cached.
"""

from __future__ import annotations

from typing import Any, Final

import numba
import numpy as np
from numba import types

from drivers.frames import FRESH
from drivers.jit import jit, waiting
from drivers.states import ENABLE_OPERATION, FAULT_RESET
from drivers.wire import DATA_AT, REFUSED, STATE_RAW, encode, note, take

_types: Any = types
carray: Any = numba.carray  # type: ignore[attr-defined]
_int, _word, _pointer = _types.int32, _types.intp, _types.uintp
_recv = _types.ExternalFunction("recv", _word(_int, _pointer, _pointer, _int))
_send = _types.ExternalFunction("send", _word(_int, _pointer, _pointer, _int))
_ppoll = _types.ExternalFunction("ppoll", _int(_pointer, _pointer, _pointer, _pointer))
_clock_gettime = _types.ExternalFunction("clock_gettime", _int(_int, _pointer))
_errno_location = _types.ExternalFunction("__errno_location", _types.CPointer(_int)())

MONOTONIC: Final = 1
DONTWAIT: Final = 0x40
POLLIN: Final = 1
EINTR: Final = 4
EAGAIN: Final = 11
DONE, HANDED_BACK, PENDING = range(3)
"""What a kernel returns: it is done; the caller has a frame to judge or the log is full; frames wait."""
REFUSED_COMMAND: Final = -1000
"""A value of the command fits no signal; other negative results are -errno."""
RECEIVING, SENDING, POLL_FD, POLL_EVENTS = range(4)
FLAGS, SEEN, SIZE, MORE = range(4)


@jit
def errno() -> Any:
    """The C library's errno."""
    return carray(_errno_location(), 1)[0]


@jit
def now_ns(times: Any) -> Any:
    """CLOCK_MONOTONIC [ns]. ``times``: int64 scratch of four, a timespec to read and one to wait."""
    _clock_gettime(MONOTONIC, times.ctypes.data)
    return times[0] * 1_000_000_000 + times[1]


@jit
def wait(fds: Any, times: Any, left_ns: int) -> Any:
    """Wait until there is something to read: 1, 0 when the time has passed, or -errno."""
    fds[POLL_FD], fds[POLL_EVENTS] = fds[RECEIVING], POLLIN
    times[2], times[3] = left_ns // 1_000_000_000, left_ns % 1_000_000_000
    ready = _ppoll(fds[POLL_FD:].ctypes.data, 1, times[2:].ctypes.data, 0)
    return -errno() if ready < 0 else ready


@waiting
def drain(
    fds: Any, times: Any, io: Any, raw: Any, messages: Any, signals: Any, last: Any, state: Any, words: Any,
    tick: Any, log: Any, deadline_ns: int, late: bool,
) -> Any:  # fmt: skip
    """Take frames until feedback came or the deadline passed; deadline 0: what is there.

    ``io``: FLAGS of all taken, SEEN and SIZE of the frame that is handed back, and MORE, how many may still
    be read once the time has passed. Returns DONE, HANDED_BACK or -errno.
    """
    while io[MORE] > 0:
        left_ns = max(deadline_ns - now_ns(times), 0) if deadline_ns > 0 else 0
        if left_ns > 0:
            ready = wait(fds, times, left_ns)
            if ready == 0:
                continue
            if ready < 0 and ready != -EINTR:
                return ready
        else:
            io[MORE] -= 1
        size = _recv(fds[RECEIVING], raw.ctypes.data, len(raw), DONTWAIT)
        if size < 0:
            code = errno()
            if code == EINTR or (code == EAGAIN and left_ns > 0):
                continue
            return DONE if code == EAGAIN else -code
        seen = take(raw, messages, signals, last, state, words, tick, log, size, late, now_ns(times))
        if seen < 0 or seen >= STATE_RAW or state[0]["logged"] >= len(log) - 1 > 0:
            io[SEEN], io[SIZE] = seen, size
            return HANDED_BACK
        io[FLAGS] |= seen
        if deadline_ns > 0 and seen & FRESH:
            return DONE
    return DONE


@jit
def transmit(fds: Any, raw: Any, size: int, state: Any, log: Any) -> Any:
    """Send a frame that is laid out; it then counts in the log. Returns DONE or -errno."""
    while _send(fds[SENDING], raw.ctypes.data, size, 0) < 0:
        code = errno()
        if code != EINTR:
            return -code
    if state[0]["logged"] < len(log):
        state[0]["logged"] += 1
    return DONE


@jit
def latch(fds: Any, times: Any, raw: Any, size: int, state: Any, log: Any, count: int) -> Any:
    """Send SYNC with its count, unless frames wait to be taken as late ones. PENDING, DONE or -errno."""
    if wait(fds, times, 0) != 0:
        return PENDING
    if raw[4] > 0:
        raw[DATA_AT] = count
    note(log, state[0], raw, 0, now_ns(times))
    return transmit(fds, raw, size, state, log)


@jit
def gather(values: Any, tick: Any, places: Any) -> None:
    """Values of a tick's command: counter, controlword, u_q, u_d, T_L from their ``places`` in the tick."""
    for index in range(2):
        at = places[index]
        values[index] = float(tick[at : at + 4].view(np.uint32)[0])
    for index in range(2, 5):
        at = places[index]
        values[index] = tick[at : at + 8].view(np.float64)[0]
    word = int(values[1])
    values[5] = 1.0 if word == ENABLE_OPERATION else 0.0
    values[6] = 1.0 if word & FAULT_RESET else 0.0


@jit
def command(
    fds: Any, times: Any, raw: Any, values: Any, messages: Any, signals: Any,
    state: Any, words: Any, log: Any, tick: Any, places: Any,
) -> Any:  # fmt: skip
    """Lay out and send a tick's command of one message. Returns DONE, REFUSED_COMMAND or -errno."""
    gather(values, tick, places)
    size = encode(raw, values, 0, messages, signals, state, words, log, now_ns(times))
    if size == REFUSED:
        return REFUSED_COMMAND
    code = transmit(fds, raw, size, state, log)
    if code == DONE:
        state[0]["last_sent"], state[0]["controlword"] = int(values[0]), int(values[1])
    return code
