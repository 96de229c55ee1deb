"""Frames to and from a tick as two compiled kernels over tables: what :mod:`drivers.tables` made of a DBC.

A frame arrives as the bytes of SocketCAN's layout in a buffer. :func:`take` knows it by identifier and
length, checks CRC and counter and writes its signals to the tick; :func:`encode` lays out a command for the
socket. A tick spends most of its time between sockets and tick, and an interpreter pays for every step of it.
The rules are those of :mod:`drivers.signal` and :mod:`drivers.e2e`; equality with the codec is tested.
"""

from __future__ import annotations

from binascii import crc_hqx
from typing import Any, Final

import numpy as np

from drivers.e2e import CRC8_TABLE
from drivers.frames import (
    CONTROLWORD,
    COUNTER_JUMP,
    COUNTER_REPEATED,
    CRC_ERROR,
    ENABLE_OPERATION,
    FRESH,
    LENGTH_ERROR,
)
from drivers.jit import jit
from drivers.local import ERR_FLAG

STATE_RAW: Final = 1 << 16
"""What :func:`take` flags when the state that it wrote to the tick is the drive's own, to be translated."""
UNKNOWN: Final = -1
"""What :func:`take` returns for a frame that measures nothing and yet says something to its caller."""
WATCHED, OVERHEARD = UNKNOWN, -2
"""The ``bit`` of a message that is none to take: :func:`take` returns it. OVERHEARD: another's command."""
NO_SELECTOR: Final = -1
REFUSED: Final = -1
"""What :func:`encode` returns for a value that a signal can't carry, or a frame that says something else."""
CLASSIC_BYTES: Final = 16
FD_BYTES: Final = 72
DATA_AT: Final = 8
FLOAT32_END: Final = (2.0 - 2.0**-24) * 2.0**127
"""Magnitude from which on a number rounds to infinity in 32 bits."""
ROOM: Final = 512
"""Frames that one tick can log before they are handed on."""

F8, U4, U8, I4, I8 = range(5)
SIGNAL: Final = np.dtype(
    [
        ("at", "i8"), ("kind", "i8"), ("source", "i8"), ("shift", "i8"), ("bits", "i8"),
        ("big", "?"), ("signed", "?"), ("real", "?"), ("whole", "?"),
        ("scale", "f8"), ("offset", "f8"), ("low", "f8"), ("high", "f8"),
    ],
    align=True,
)  # fmt: skip
"""``at``: offset of the tick's field; ``source``: place in a command's values; ``low``, ``high``: raw, or
physical for a float."""
MESSAGE: Final = np.dtype(
    [
        ("id", "i8"), ("length", "i8"), ("profile", "i8"), ("ids", "u1", (16,)), ("modulus", "i8"),
        ("first", "i8"), ("count", "i8"), ("bit", "i8"), ("seen", "i8"), ("fd", "?"),
        ("selector", "i8"), ("wanted", "i8"), ("under", "u1", (64,)), ("slow", "i8"),
    ],
    align=True,
)  # fmt: skip
"""``modulus`` 0: no counter, else the first signal is one. ``bit``: one for each measurement in it, 0 for
slow values; ``seen``: what a good frame is flagged with besides. ``selector``: the signal that must have the
value ``wanted``, or NO_SELECTOR; rows of one identifier follow one another. ``under``: what never changes
of a command. ``slow``: its bit in the tick's ``missing``."""
STATE: Final = np.dtype(
    [
        ("got", "i8"), ("needed", "i8"), ("echo_at", "i8"), ("logged", "i8"),
        ("last_sent", "i8"), ("controlword", "i8"), ("syncs", "i8"), ("pending", "i8"), ("down", "i8"),
        ("odd_id", "i8"), ("odd_length", "i8"), ("missing_at", "i8"),
    ]
)  # fmt: skip
"""``last_sent``, ``controlword``: of the last command; ``syncs``: SYNC's counter. ``pending``: flags for the
next tick; ``down``: the bus was down, nothing more is sent; the client sets both and looks at them.
``echo_at``: offset of the tick's echo for a drive that has none, -1 for one that has. ``odd_id``,
``odd_length``: of the newest frame whose length is not its message's. ``missing_at``: offset of the tick's
``missing``, 0 for a record without."""
FRAME: Final = np.dtype(
    [("t_ns", "<i8"), ("can_id", "<u4"), ("received", "u1"), ("size", "u1"), ("data", "u1", (64,))]
)
"""A frame as it is logged."""

_CRC16: Final = np.array([crc_hqx(bytes((byte,)), 0) for byte in range(256)])
_CRC8: Final = np.frombuffer(CRC8_TABLE, np.uint8).astype(np.int64)


@jit
def crc_16(crc: int, byte: int) -> int:
    """One byte of CRC-16 with polynomial 0x1021."""
    return int((crc << 8) & 0xFFFF ^ _CRC16[(crc >> 8) ^ byte])


@jit
def crc_of(raw: Any, m: Any) -> int:
    """CRC of a frame's data by its message's profile."""
    end = DATA_AT + m["length"]
    if m["profile"] == 2:
        crc = 0xFF
        for index in range(DATA_AT + 1, end):
            crc = _CRC8[crc ^ int(raw[index])]
        return int(_CRC8[crc ^ int(m["ids"][int(raw[DATA_AT + 1]) & 15])]) ^ 0xFF
    crc = 0xFFFF
    for index in range(DATA_AT + 2, end):
        crc = crc_16(crc, int(raw[index]))
    return crc_16(crc_16(crc, int(m["ids"][1])), int(m["ids"][0]))


@jit
def is_valid(raw: Any, m: Any) -> bool:
    """Is the CRC right?"""
    if m["profile"] == 0:
        return True
    crc = crc_of(raw, m)
    if m["profile"] == 2:
        return int(raw[DATA_AT]) == crc
    return (int(raw[DATA_AT]) | int(raw[DATA_AT + 1]) << 8) == crc


@jit
def halves(raw: Any, length: int, g: Any) -> tuple[int, int]:
    """Bits of a signal as (low 32, the rest)."""
    low, high, done = 0, 0, 0
    while done < g["bits"]:
        place = g["shift"] + done
        byte = place >> 3
        if g["big"]:
            byte = length - 1 - byte
        inside = place & 7
        part = (int(raw[DATA_AT + byte]) >> inside) & 0xFF
        room = min(8 - inside, g["bits"] - done)
        part &= (1 << room) - 1
        if done < 32:
            low |= part << done
        else:
            high |= part << (done - 32)
        done += room
    return low & 0xFFFFFFFF, high | low >> 32


@jit
def real_of(low: int, high: int, bits: int, words: Any) -> float:
    """IEEE number of 16, 32 or 64 bits. ``words``: scratch of two uint32."""
    if bits == 16:
        exponent, fraction = (low >> 10) & 31, low & 1023
        sign = -1.0 if low & 0x8000 else 1.0
        if exponent == 31:
            return sign * np.inf if fraction == 0 else np.nan
        if exponent == 0:
            return sign * fraction * 2.0**-24
        return sign * (1024 + fraction) * 2.0 ** (exponent - 25)
    words[0], words[1] = low, high
    if bits == 32:
        return float(words.view(np.float32)[0])
    return float(words.view(np.float64)[0])


@jit
def phys_of(raw: Any, length: int, g: Any, words: Any) -> Any:
    """Physical value of a signal: raw * scale + offset."""
    low, high = halves(raw, length, g)
    if g["real"]:
        return real_of(low, high, g["bits"], words) * g["scale"] + g["offset"]
    if g["signed"]:
        if g["bits"] <= 32:
            low -= (low >> (g["bits"] - 1)) << g["bits"]
        else:
            high -= (high >> (g["bits"] - 33)) << (g["bits"] - 32)
    return (high * 4294967296.0 + low) * g["scale"] + g["offset"]


@jit
def put(tick: Any, g: Any, value: float) -> None:
    """Write a value to its field of the tick; a whole one that the field can't hold is cut to its range."""
    at = g["at"]
    if g["kind"] == F8:
        tick[at : at + 8].view(np.float64)[0] = value
        return
    whole = np.rint(value) if g["whole"] else value
    if np.isnan(whole):
        whole = np.inf  # as a state it is none that is known
    if g["kind"] == U4:
        tick[at : at + 4].view(np.uint32)[0] = int(min(max(whole, 0.0), 4294967295.0))
    elif g["kind"] == I4:
        tick[at : at + 4].view(np.int32)[0] = int(min(max(whole, -2147483648.0), 2147483647.0))
    else:
        tick[at : at + 8].view(np.int64)[0] = int(min(max(whole, 0.0), 9.0e18))


@jit
def is_frame(raw: Any, size: int) -> bool:
    """Whether what the socket gave is one: it may be any datagram."""
    return size in (CLASSIC_BYTES, FD_BYTES) and int(raw[4]) <= size - DATA_AT


@jit
def is_whole(raw: Any, m: Any, size: int) -> bool:
    """Whether a frame of ``size`` bytes on the socket has its message's length."""
    return int(raw[4]) == m["length"] and (size == FD_BYTES or m["length"] <= 8)


@jit
def identifier(raw: Any) -> int:
    """Identifier of a frame with SocketCAN's flag bits."""
    return int(raw[0]) | int(raw[1]) << 8 | int(raw[2]) << 16 | int(raw[3]) << 24


@jit
def note(log: Any, s: Any, raw: Any, received: int, t_ns: int) -> None:
    """Write a frame to the next place of the log, which counts once ``logged`` goes on; none when full."""
    if s["logged"] >= len(log):
        return
    entry = log[s["logged"]]
    entry["t_ns"], entry["received"], entry["size"] = t_ns, received, min(int(raw[4]), 64)
    entry["can_id"] = identifier(raw)
    for index in range(min(int(raw[4]), 64)):
        entry["data"][index] = raw[DATA_AT + index]


@jit
def note_sent(log: Any, state: Any, raw: Any, t_ns: int) -> int:
    """:func:`note` for a frame that stands in its buffer."""
    note(log, state[0], raw, 0, t_ns)
    return 0


@jit
def find(raw: Any, messages: Any) -> int:
    """Place of a frame's message by its identifier, -1 for none."""
    can_id = identifier(raw)
    for index in range(len(messages)):
        if messages[index]["id"] == can_id:
            return index
    return -1


@jit
def chosen(raw: Any, messages: Any, index: int, signals: Any) -> int:
    """Place of the row whose multiplexer value a frame has, from its identifier's first on; -1 for none."""
    while index < len(messages) and messages[index]["id"] == identifier(raw):
        m = messages[index]
        if m["selector"] == NO_SELECTOR:
            return index
        low, high = halves(raw, m["length"], signals[m["selector"]])
        if high == 0 and low == m["wanted"]:
            return index
        index += 1
    return -1


@jit
def judge(raw: Any, m: Any, last: Any, index: int, signals: Any, words: Any) -> int:
    """Flags of a frame's counter against the last one's."""
    if m["modulus"] == 0:
        return FRESH
    counter = int(phys_of(raw, m["length"], signals[m["first"]], words))
    before = last[index]
    last[index] = counter
    if counter == before:
        return COUNTER_REPEATED
    return FRESH if before < 0 or counter == (before + 1) % m["modulus"] else FRESH | COUNTER_JUMP


@jit
def complete(s: Any, m: Any, tick: Any, flags: int) -> Any:
    """Flags of a measuring message: fresh once all of this tick's have come."""
    s["got"] |= m["bit"]
    if s["got"] != s["needed"]:
        return flags & ~FRESH
    s["got"] = 0
    if s["echo_at"] >= 0:
        tick[s["echo_at"] : s["echo_at"] + 4].view(np.uint32)[0] = s["last_sent"]
    return flags


@jit
def take(
    raw: Any, messages: Any, signals: Any, last: Any, state: Any, words: Any, tick: Any, log: Any,
    size: int, late: bool, t_ns: int,
) -> Any:  # fmt: skip
    """Check a frame of ``size`` bytes on the socket and apply it to the tick, whole or not at all.

    ``late``: the frame is checked and counted; a measurement is not applied. ``last``: each message's last
    counter, -1 before the first; ``log``: room for frames, none to log nothing. Returns flags, UNKNOWN or
    OVERHEARD; other nodes' frames have no flags.
    """
    s = state[0]
    if not is_frame(raw, size):
        return 0
    if s["logged"] < len(log):
        note(log, s, raw, 1, t_ns)
        s["logged"] += 1
    index = find(raw, messages)
    if index < 0:
        return UNKNOWN if identifier(raw) & ERR_FLAG else 0
    m = messages[index]
    if m["bit"] < 0:
        return m["bit"]
    if not is_whole(raw, m, size):
        s["odd_id"], s["odd_length"] = identifier(raw), int(raw[4])
        return LENGTH_ERROR
    if not is_valid(raw, m):
        return CRC_ERROR
    flags = judge(raw, m, last, index, signals, words)
    if m["selector"] != NO_SELECTOR:
        index = chosen(raw, messages, index, signals)
        if index < 0:
            return flags & ~FRESH
        m = messages[index]
    if not flags & FRESH or (late and m["bit"] != 0):
        return flags & ~FRESH
    first = m["first"] + (1 if m["modulus"] > 0 else 0)
    for place in range(first, m["first"] + m["count"]):
        put(tick, signals[place], phys_of(raw, m["length"], signals[place], words))
    if m["slow"] != 0 and s["missing_at"] > 0:
        at = s["missing_at"]
        tick[at : at + 4].view(np.uint32)[0] &= np.uint32(0xFFFFFFFF - m["slow"])
    if m["bit"] == 0:
        return (flags & ~FRESH) | m["seen"]
    return complete(s, m, tick, flags) | m["seen"]


@jit
def overhear(raw: Any, messages: Any, signals: Any, words: Any, seen: Any, size: int) -> None:
    """Write what another controller commands to ``seen``, the frame whole and valid or not at all.

    ``seen``: (q, d) [V, A or N m] by the command's counter, one after the other; or the newest alone.
    """
    m = messages[find(raw, messages)]
    if not (is_whole(raw, m, size) and is_valid(raw, m)):
        return
    first, at = m["first"], 0
    if m["modulus"] > 0:
        at = 2 * (int(phys_of(raw, m["length"], signals[first], words)) % (len(seen) // 2))
        first += 1
    seen[at + 1] = 0.0
    for place in range(first, m["first"] + m["count"]):
        g = signals[place]
        seen[at + g["at"]] = phys_of(raw, m["length"], g, words)


@jit
def raw_of(g: Any, value: float) -> Any:
    """Raw number of a physical value, NaN where it does not fit. As :meth:`drivers.signal.Signal.to_bits`."""
    if not np.isfinite(value):
        return np.nan
    number = (value - g["offset"]) / g["scale"]
    if g["real"]:
        return number if g["bits"] != 16 and g["low"] <= value <= g["high"] else np.nan
    number = np.rint(number)
    return number if g["low"] <= number <= g["high"] else np.nan


@jit
def lay(raw: Any, length: int, g: Any, number: float, words: Any) -> bool:
    """Put a raw number's bits into a zeroed frame; False when it overflows a float of 32 bits."""
    if g["real"]:
        if g["bits"] == 32:
            if abs(number) >= FLOAT32_END:
                return False
            words.view(np.float32)[0] = number
        else:
            words.view(np.float64)[0] = number
        low, high = int(words[0]), int(words[1])
    else:
        high_part = np.floor(number / 4294967296.0)
        low, high = int(number - high_part * 4294967296.0), int(high_part)
    done = 0
    while done < g["bits"]:
        place = g["shift"] + done
        byte = place >> 3
        if g["big"]:
            byte = length - 1 - byte
        inside = place & 7
        room = min(8 - inside, g["bits"] - done)
        if done < 32:
            part = low >> done
            if done + room > 32:
                part |= high << (32 - done)
        else:
            part = high >> (done - 32)
        part &= (1 << room) - 1
        raw[DATA_AT + byte] = int(raw[DATA_AT + byte]) | part << inside
        done += room
    return True


@jit
def encode(
    raw: Any,
    values: Any,
    index: int,
    messages: Any,
    signals: Any,
    state: Any,
    words: Any,
    log: Any,
    t_ns: int,
) -> int:
    """Lay a frame out in ``raw``, whose first eight bytes stand; return its size on the socket or REFUSED.

    ``values``: counter, then what :data:`drivers.frames.SOURCES` names. The frame is noted in the log as sent
    at ``t_ns``; it counts once the caller says that it was.
    """
    m = messages[index]
    for at in range(m["length"]):
        raw[DATA_AT + at] = m["under"][at]
    for place in range(m["first"], m["first"] + m["count"]):
        g = signals[place]
        number = raw_of(g, value_of(values, m, g, place))
        if np.isnan(number) or not lay(raw, m["length"], g, number, words):
            return REFUSED
    if m["profile"] == 2:
        raw[DATA_AT] = crc_of(raw, m)
    elif m["profile"] == 5:
        crc = crc_of(raw, m)
        raw[DATA_AT], raw[DATA_AT + 1] = crc & 0xFF, crc >> 8
    note(log, state[0], raw, 0, t_ns)
    return FD_BYTES if m["fd"] else CLASSIC_BYTES


@jit
def value_of(values: Any, m: Any, g: Any, place: int) -> Any:
    """What a signal of a frame must say."""
    value = values[g["source"]]
    return value % m["modulus"] if place == m["first"] and m["modulus"] > 0 else value


@jit
def says(raw: Any, values: Any, index: int, messages: Any, signals: Any, words: Any) -> bool:
    """Does a frame that is laid out, read again, say what it was to say, to half a step each?"""
    m = messages[index]
    for place in range(m["first"], m["first"] + m["count"]):
        g = signals[place]
        value = value_of(values, m, g, place)
        off = abs(phys_of(raw, m["length"], g, words) - value)
        most = (abs(value) + abs(g["offset"])) * 2.0**-22 if g["real"] else abs(g["scale"]) * 0.500001
        if not off <= most:
            return False
    return is_valid(raw, m)


@jit
def encode_command(
    raw: Any,
    values: Any,
    index: int,
    messages: Any,
    signals: Any,
    state: Any,
    words: Any,
    log: Any,
    t_ns: int,
) -> int:
    """:func:`encode` for a command. One that does not let the drive operate is read again before it leaves.

    It may say nothing but zero and off, and no table, however wrong, may make anything else of it.
    """
    size = encode(raw, values, index, messages, signals, state, words, log, t_ns)
    if size == REFUSED or values[CONTROLWORD] == ENABLE_OPERATION:
        return size
    return size if says(raw, values, index, messages, signals, words) else REFUSED
