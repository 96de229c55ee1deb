"""The drive's place on a bus as one compiled call: SYNC and commands of the house protocol, frame by frame.

:func:`attend` waits, and takes what is whole, valid and fresh: a SYNC moves the plant on and is answered at
once, a command waits for the next SYNC. So it goes on until its time is over. Everything else (a frame that
is damaged, repeated or of another identifier, an EMCY to be sent) it hands back untouched to the caller. What
is taken and how it is answered are the rules of :mod:`firmware_model.house`, which call it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.bus import Link, SocketLink
from drivers.local import pack_frame
from drivers.posix import DONE, EAGAIN, EINTR, now_ns, receive, wait, write
from drivers.wire import (
    CLASSIC_BYTES,
    FD_BYTES,
    FRAME,
    MESSAGE,
    SIGNAL,
    find,
    identifier,
    is_frame,
)
from drivers.wire import STATE as WIRE_STATE
from firmware_model.config import Record
from firmware_model.drive import advance, on_command, on_load_command, on_sync
from firmware_model.house import (
    CONTROLWORD,
    COUNTER,
    ENABLE,
    LOAD,
    STATUS,
    T_L,
    TAKEN,
    U_D,
    U_Q,
    VOLTAGE,
    HouseFrames,
    accept,
    lay_answers,
)
from firmware_model.jit import COMPILED, array_at, entry, jit, places_of, waiting
from firmware_model.plant import PARAMS, SAMPLE, STATE

IDLE_NS: Final = 5_000_000
"""So long without a frame is silence, in which the caller lets the plant catch up."""
ANSWER: Final = 1
"""What :func:`attend` returns when a SYNC was taken and the caller is to send what it is answered with; 0:
the time is over, or it was silent. Sizes of frames are more than both."""
HEARTBEAT_NS: Final = 100_000_000
LAST_NS, STARTED, UNSENT, BEAT_NS, SYNC_ID, PERIOD_NS, MODE = range(7)
"""Cells: when the plant was moved last, whether its time has begun, frames that the bus did not take, when
the next heartbeat is due; of the configuration, the identifier of SYNC, the period of lockstep, 0 in real
time, and the mode of a command."""
NEVER_NS: Final = 2**62
F8, I8, U1, U4, I4 = (np.dtype(kind) for kind in ("f8", "i8", "u1", "u4", "i4"))
ARRAYS: Final = {
    "params": PARAMS, "state": STATE, "sample": SAMPLE, "whole": I8, "real": F8, "fields": I8, "values": F8,
    "fds": I4, "times": I8, "cells": I8, "counters": I8, "raw": U1, "out": U1, "words": U4,
    "wire": WIRE_STATE, "log": FRAME,
    "taken": MESSAGE, "taken_signals": SIGNAL, "sent": MESSAGE, "sent_signals": SIGNAL, "beat": U1,
}  # fmt: skip
"""The arrays behind the places of a call, in their order. ``whole`` and ``real`` are the sample as words of
eight bytes, ``fields`` which of them go to the values, ``out`` room for each answer."""
(
    _PARAMS, _STATE, _SAMPLE, _WHOLE, _REAL, _FIELDS, _VALUES, _FDS, _TIMES, _CELLS, _COUNTERS, _RAW, _OUT,
    _WORDS, _WIRE, _LOG, _TAKEN, _TAKEN_SIGNALS, _SENT, _SENT_SIGNALS, _BEAT,
) = range(len(ARRAYS))  # fmt: skip


class Station:
    """:func:`attend` over one drive's records. ``cells`` and ``raw`` (the frame handed back) are shared."""

    attend: Callable[[int], int]
    """Serve until a moment [ns]; returns ANSWER, 0, the size of a frame in ``raw``, or -errno."""

    def __init__(
        self, link: SocketLink, frames: HouseFrames, records: tuple[Record, Record, Record], period_ns: int
    ) -> None:
        params, state, sample = records
        self.cells = np.zeros(MODE + 1, np.int64)
        self.cells[MODE] = frames.mode
        self.cells[SYNC_ID], self.cells[PERIOD_NS] = frames.sync_id or 0, period_ns
        self.cells[BEAT_NS] = NEVER_NS
        [(beat_id, beat, _)] = frames.beat()
        self.raw = frames.raw
        self._alive = {
            "params": params, "state": state, "sample": sample,
            "whole": sample.view("i8"), "real": sample.view("f8"), "fields": _fields(frames),
            "values": frames.values, "fds": link.fds, "times": np.zeros(4, np.int64), "cells": self.cells,
            "counters": frames.counters, "raw": frames.raw, "out": frames.out,
            "words": frames.words, "wire": frames.wire_state, "log": frames.log,
            "taken": frames.taken, "taken_signals": frames.taken_signals,
            "sent": frames.sent, "sent_signals": frames.sent_signals,
            "beat": np.frombuffer(pack_frame(beat_id, beat), np.uint8),
        }  # fmt: skip
        places = places_of(self._alive, ARRAYS)
        self.attend = partial(entry(attend, places, 0), places)


def station(
    link: Link, frames: object, records: tuple[Record, Record, Record], period_ns: int
) -> Station | None:
    """The compiled way, where there is one: the house's frames on a socket that carries them."""
    if not (COMPILED and isinstance(link, SocketLink) and isinstance(frames, HouseFrames)):
        return None
    if not link.carries(any(message.fd for message, _ in frames.answers)):
        return None
    return Station(link, frames, records, period_ns)


def _fields(frames: HouseFrames) -> npt.NDArray[np.int64]:
    """Word of the sample and whether it is a whole number, for each value from the second on."""
    kinds = [SAMPLE.fields[name][:2] for name in frames.fields]  # type: ignore[index]
    return np.array([(at // 8, kind.kind == "i") for kind, at in kinds], np.int64).ravel()


@jit
def send_answer(places: Any, status_due: int) -> bool:
    """Lay all out, then send: False, and nothing is sent, where a value does not fit its signal."""
    fds, cells = array_at(places, _FDS, I4), array_at(places, _CELLS, I8)
    counters, out = array_at(places, _COUNTERS, I8), array_at(places, _OUT, U1)
    messages, signals = array_at(places, _SENT, MESSAGE), array_at(places, _SENT_SIGNALS, SIGNAL)
    whole, real = array_at(places, _WHOLE, I8), array_at(places, _REAL, F8)
    values, fields = array_at(places, _VALUES, F8), array_at(places, _FIELDS, I8)
    words, wire = array_at(places, _WORDS, U4), array_at(places, _WIRE, WIRE_STATE)
    log = array_at(places, _LOG, FRAME)
    for place in range(len(fields) // 2):
        word = fields[2 * place]
        values[place + 1] = float(whole[word]) if fields[2 * place + 1] else real[word]
    left_out = 0 if status_due else STATUS
    if lay_answers(left_out, counters, messages, signals, values, out, words, wire, log) >= 0:
        return False
    for index in range(len(messages)):
        m = messages[index]
        if not m["bit"] & left_out:
            size = FD_BYTES if m["fd"] else CLASSIC_BYTES
            cells[UNSENT] += write(fds, out[index * FD_BYTES :], size) != DONE
    return True


@jit
def send_beat(places: Any, now_ns: int) -> None:
    """The heartbeat, and when the next is due."""
    fds, cells, beat = array_at(places, _FDS, I4), array_at(places, _CELLS, I8), array_at(places, _BEAT, U1)
    cells[UNSENT] += write(fds, beat, len(beat)) != DONE
    cells[BEAT_NS] = now_ns + HEARTBEAT_NS


@jit
def take_sync(places: Any, now_ns: int) -> int:
    """Move the plant on, latch, sample, answer. Returns DONE or ANSWER."""
    p, s = array_at(places, _PARAMS, PARAMS)[0], array_at(places, _STATE, STATE)[0]
    cells, out = array_at(places, _CELLS, I8), array_at(places, _SAMPLE, SAMPLE)[0]
    if not cells[STARTED]:
        cells[STARTED], cells[LAST_NS] = 1, now_ns
    elif cells[PERIOD_NS] > 0:
        advance(p, s, cells[PERIOD_NS])
    else:
        advance(p, s, now_ns - cells[LAST_NS])
        cells[LAST_NS] = now_ns
    on_sync(p, s, out)
    if out["emcy_due"] or not send_answer(places, out["status_due"]):
        return ANSWER
    return DONE


@jit
def take_command(places: Any, index: int, now_ns: int) -> bool:
    """Take a command that is whole, valid and fresh; False, and nothing has changed, for another."""
    raw, counters = array_at(places, _RAW, U1), array_at(places, _COUNTERS, I8)
    messages, signals = array_at(places, _TAKEN, MESSAGE), array_at(places, _TAKEN_SIGNALS, SIGNAL)
    values, words = array_at(places, _VALUES, F8), array_at(places, _WORDS, U4)
    p, s = array_at(places, _PARAMS, PARAMS)[0], array_at(places, _STATE, STATE)[0]
    cells, m = array_at(places, _CELLS, I8), messages[index]
    if accept(raw, index, cells[MODE], counters, messages, signals, values, words) != TAKEN:
        return False
    if m["bit"] & VOLTAGE and cells[STARTED] and cells[PERIOD_NS] == 0:
        advance(p, s, now_ns - cells[LAST_NS])
        cells[LAST_NS] = now_ns
    if m["bit"] & LOAD:
        on_load_command(s, values[T_L] if values[ENABLE] else 0.0)
    if m["bit"] & VOLTAGE:
        on_command(s, int(values[COUNTER]), int(values[CONTROLWORD]), values[U_Q], values[U_D])
    return True


@waiting
def attend(places: Any, until_ns: int) -> Any:
    """Take frames until ``until_ns`` [ns of CLOCK_MONOTONIC], silence, or one that the caller is to judge.

    Neither a heartbeat nor the caller may keep a SYNC waiting: their time is when the command has come that
    follows one. Returns ANSWER, 0, the size of that frame in ``raw``, or -errno.
    """
    fds, times = array_at(places, _FDS, I4), array_at(places, _TIMES, I8)
    cells, raw = array_at(places, _CELLS, I8), array_at(places, _RAW, U1)
    messages = array_at(places, _TAKEN, MESSAGE)
    expecting = False
    while True:
        left_ns = min(until_ns, cells[BEAT_NS]) - now_ns(times)
        if left_ns <= 0 and (not expecting or left_ns < -IDLE_NS):
            if cells[BEAT_NS] > until_ns:
                return 0
            send_beat(places, now_ns(times))
            continue
        ready = wait(fds, times, min(left_ns, IDLE_NS) if left_ns > 0 else IDLE_NS)
        if ready <= 0:
            return 0 if ready == -EINTR else ready
        size = receive(fds, raw)
        if size < 0:
            return 0 if size in (-EAGAIN, -EINTR) else size
        if not is_frame(raw, size):
            continue
        if identifier(raw) == cells[SYNC_ID] and int(raw[4]) <= 1:  # CANopen: no data or the counter
            if take_sync(places, now_ns(times)) != DONE:
                return ANSWER
            expecting = True
            continue
        expecting = False
        index = find(raw, messages)
        if index < 0 or not take_command(places, index, now_ns(times)):
            return size
