"""Logged frames read again by the kernels that read the bus: what each tick must have measured."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.frames import EMERGENCY, FRESH, LENGTH_ERROR
from drivers.jit import jit
from drivers.posix import gather
from drivers.wire import CLASSIC_BYTES, DATA_AT, FD_BYTES, REFUSED, STATE_RAW, encode, find, take


@jit
def lay_out(frame: Any, raw: Any) -> int:
    """A logged frame as it came from the socket; its size there."""
    can_id, size = int(frame["can_id"]), int(frame["size"])
    for index in range(4):
        raw[index] = (can_id >> 8 * index) & 0xFF
    raw[4] = size
    for index in range(64):
        raw[DATA_AT + index] = frame["data"][index]
    return FD_BYTES if size > 8 else CLASSIC_BYTES


@jit
def refeed(
    frames: Any, limits: Any, counters: Any, listens: Any, ids: Any, messages: Any, signals: Any, last: Any,
    state: Any, words: Any, raw: Any, tick: Any, log: Any, error_at: int, rows: Any, flags: Any,
) -> int:  # fmt: skip
    """Fill ``rows`` (n, bytes of a tick) and ``flags`` (n) with what n ticks must hold; frames used.

    ``limits``: when each tick was computed, on the frames' clock: what came later is another's. ``ids``: SYNC
    that the controller sends (-1: none), its command, the drive's emergency (-1: none). ``counters`` (n + 1):
    of the command before the first tick, then of each tick's; ``tick``: its bytes before the first. A command
    that the drive answers is its own SYNC.
    ``listens`` (n): ticks that sent no SYNC, since the guardian had stopped the drive.
    """
    at = 0
    for j in range(limits.shape[0]):
        late, seen, done = ids[0] >= 0 and not listens[j], 0, False
        while at < frames.shape[0] and frames[at]["t_ns"] <= limits[j]:
            frame = frames[at]
            can_id = int(frame["can_id"])
            if not frame["received"]:
                if can_id == ids[0]:
                    late, done = False, False
                    state[0]["got"] = 0
                    if can_id == ids[1]:  # the last tick's command, which the drive answers
                        state[0]["last_sent"] = counters[j]
                elif can_id == ids[1]:  # a clock of lockstep stands still from feedback to command
                    state[0]["last_sent"] = counters[j + (frame["t_ns"] == limits[j])]
            elif can_id == ids[2]:
                if frame["size"] == 8:
                    code = int(frame["data"][0]) | int(frame["data"][1]) << 8
                    tick[error_at : error_at + 4].view(np.uint32)[0] = code
                    seen |= EMERGENCY if code else 0
                else:
                    seen |= LENGTH_ERROR
            else:
                size = lay_out(frame, raw)
                found = take(raw, messages, signals, last, state, words, tick, log, size, late or done, 0)
                if found > 0:
                    seen |= found & (STATE_RAW - 1)
                    done = done or (ids[0] >= 0 and found & FRESH != 0)
            at += 1
        rows[j, :] = tick
        flags[j] = seen
    return at


@jit
def resend(
    frames: Any, owners: Any, ticks: Any, fields: Any, values: Any, messages: Any, signals: Any, state: Any,
    words: Any, raw: Any, log: Any, wrong: Any,
) -> None:  # fmt: skip
    """Set ``wrong`` (n frames) where a sent command's bytes are not those that its tick makes.

    ``owners``: each frame's row of ``ticks`` (bytes of records), -1 for none; ``fields``: of
    :func:`drivers.posix.gather`. Frames that the map does not send are not judged.
    """
    for row in range(frames.shape[0]):
        frame = frames[row]
        lay_out(frame, raw)
        index = find(raw, messages)
        if index < 0 or owners[row] < 0 or frame["received"]:
            continue
        gather(values, ticks[owners[row]], fields)
        size = encode(raw, values, index, messages, signals, state, words, log, 0)
        wrong[row] = size == REFUSED or int(frame["size"]) != messages[index]["length"]
        for at in range(messages[index]["length"]):
            wrong[row] |= raw[DATA_AT + at] != frame["data"][at]
