"""The compiled kernels between frames and tick do what the codec does, for every message of every DBC."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.binding import Binding, Bound, bind
from drivers.codec import Database
from drivers.errors import DatabaseError, EncodeError
from drivers.frames import COUNTER_JUMP, COUNTER_REPEATED, CRC_ERROR, FRESH, LENGTH_ERROR, SOURCES
from drivers.local import ERR_FLAG, FD, pack_frame
from drivers.mapping import COMMANDED_D, COMMANDED_Q, RECEIVED, house_map
from drivers.tables import Tables, incoming_tables, laid_out, outgoing_tables
from drivers.wire import (
    FRAME,
    MESSAGE,
    OVERHEARD,
    ROOM,
    SIGNAL,
    STATE,
    UNKNOWN,
    encode,
    overhear,
    phys_of,
    take,
)
from hil.log.schema import FRAME as LOGGED_FRAME
from hil.runtime.setup import Overrides, load_setup
from hil.signals import TICK, new_ticks
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

DBCS = sorted((CONFIGS / "drives").glob("*.dbc"))


def house(name: str) -> Binding:
    database = Database(CONFIGS / f"drives/{name}.dbc")
    return bind(house_map(database), database, load=True)


BINDINGS = {
    "classic": house("hil_pmsm"),
    "fd": house("hil_pmsm_fd"),
    "inverter": load_setup(CONFIGS / "inverter.toml", Overrides()).binding,
}


class Taker:
    """The receiving kernel over a tick of its own."""

    def __init__(self, binding: Binding, overhears: bool = False) -> None:
        self.ticks = new_ticks()
        self.messages, self.signals, needed = incoming_tables(binding, TICK, overhears)
        self.state, self.log = np.zeros(1, STATE), np.zeros(ROOM, FRAME)
        self.state["needed"], self.state["echo_at"] = needed, -1
        self.last, self.words = np.full(len(self.messages), -1), np.zeros(2, np.uint32)
        self.buffer = np.zeros(128, np.uint8)

    def take(self, raw: bytes, late: bool = False) -> int:
        self.state["logged"] = 0
        self.buffer[: len(raw)] = np.frombuffer(raw, np.uint8)
        tick = self.ticks.view("u1")
        args: Any = (self.messages, self.signals, self.last, self.state, self.words, tick, self.log)
        return int(take(self.buffer, *args, len(raw), late, 7))


def random_frames(bound: Bound, rng: np.random.Generator, count: int) -> list[bytes]:
    """Good frames, repeated ones, jumps of the counter and damaged bits."""
    message, out, counter = bound.message, [], 0
    for _ in range(count):
        counter = (counter + int(rng.choice([0, 1, 1, 1, 3]))) % bound.counter_modulus
        data = bytearray(rng.bytes(message.length))
        if bound.counter:
            place = message.signals[bound.counter]
            order = "big" if place.big_endian else "little"
            bits = int.from_bytes(data, order)  # type: ignore[arg-type]
            mask = ((1 << place.length) - 1) << place.shift
            bits = bits & ~mask | counter << place.shift
            data = bytearray(bits.to_bytes(message.length, order))  # type: ignore[arg-type]
        message.protect(data)
        if rng.random() < 0.1:
            data[int(rng.integers(message.length))] ^= 1 << int(rng.integers(8))
        out.append(pack_frame(message.send_id, bytes(data), message.fd))
    return out


def judged(bound: Bound, data: bytes, last: int) -> tuple[int, int]:
    """Flags of a frame by the codec and the rules in plain words, and the last counter after it."""
    if not bound.message.valid(data):
        return CRC_ERROR, last
    if not bound.counter:
        return FRESH, last
    counter = int(bound.message.reader(bound.counter)(data)[0])
    if counter == last:
        return COUNTER_REPEATED, counter
    jump = last >= 0 and counter != (last + 1) % bound.counter_modulus
    return FRESH | (COUNTER_JUMP if jump else 0), counter


def expected_fields(bound: Bound, data: bytes) -> dict[str, float]:
    """What a frame writes to the tick, by the codec; whole fields are cut to their range."""
    out = {}
    for part, name in bound.parts:
        rule = RECEIVED[part]
        (value,) = bound.message.reader(name)(data)
        out[rule.field] = value if rule.units else float(min(max(round(value), 0), 2**32 - 1))
    return out


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, bound.message.name) for kind, binding in BINDINGS.items() for bound in binding.incoming],
)
@pytest.mark.parametrize("seed", range(3))
def test_frames_are_taken_as_the_codec_says(kind: str, name: str, seed: int) -> None:
    binding, rng = BINDINGS[kind], np.random.default_rng(seed)
    bound = next(b for b in binding.incoming if b.message.name == name)
    taker, last = Taker(binding), -1
    bit = int(taker.messages[list(binding.incoming).index(bound)]["bit"])
    taker.state["needed"] = bit
    for raw in random_frames(bound, rng, 200):
        data, late = raw[8 : 8 + bound.message.length], bool(rng.random() < 0.2)
        before = taker.ticks.copy()
        flags, last = judged(bound, data, last)
        seen = taker.take(raw, late)
        if late and bit:
            flags &= ~FRESH
        if flags & FRESH:
            for field, value in expected_fields(bound, data).items():
                before[field] = value
        slow = 0 if bit else FRESH
        marks = int(taker.messages[list(binding.incoming).index(bound)]["seen"]) if flags & FRESH else 0
        assert seen == flags & ~slow | marks, f"seed {seed}"
        assert taker.ticks.tobytes() == before.tobytes(), f"seed {seed}: {data.hex()}"
        logged = taker.log[0]
        assert taker.state["logged"] == 1 and logged["data"][: len(data)].tobytes() == data
        assert (logged["can_id"], logged["received"], logged["t_ns"]) == (bound.message.send_id, 1, 7)


def test_a_frame_of_another_length_or_size_is_not_taken() -> None:
    taker = Taker(BINDINGS["classic"])
    feedback = BINDINGS["classic"].incoming[0].message
    good = pack_frame(feedback.send_id, feedback.encode({"Counter": 1, "Speed": 5.0}))
    before = taker.ticks.tobytes()
    for length in (0, 7, 12, 64):
        data = good[8:].ljust(64, b"\0")[:length]
        assert taker.take(pack_frame(feedback.send_id, data, fd=length > 8)) == LENGTH_ERROR
    assert taker.take(good[:4] + bytes([64]) + good[5:]) == 0, "a classic frame of 64 bytes is no frame"
    for size in (12, 17, 38, 71):
        assert taker.take(FD.pack(feedback.send_id, 8, 4, good[8:])[:size]) == 0, "no frame has that size"
    assert taker.take(pack_frame(0x123, b"")) == 0, "another node's"
    assert taker.take(pack_frame(0x123 | ERR_FLAG, bytes(8))) == UNKNOWN
    for message in (
        BINDINGS["classic"].command.message,
        BINDINGS["classic"].sync,
        BINDINGS["classic"].emergency,
    ):
        assert message is not None
        assert taker.take(pack_frame(message.send_id, b"")) == UNKNOWN, message.name
    assert taker.ticks.tobytes() == before
    assert taker.take(FD.pack(feedback.send_id, 8, 4, good[8:])) & FRESH, "the same data in an FD frame"


@pytest.mark.parametrize("path", DBCS, ids=lambda path: path.stem)
def test_each_signal_reads_as_the_codec_says(path: Path) -> None:
    rng, words = np.random.default_rng(1), np.zeros(2, np.uint32)
    for message in Database(path).messages.values():
        for signal in message.signals.values():
            g = signal_row(signal)
            for _ in range(30):
                data = rng.bytes(message.length)
                raw = np.zeros(128, np.uint8)
                raw[8 : 8 + message.length] = np.frombuffer(data, np.uint8)
                (value,) = message.reader(signal.name)(data)
                same = phys_of(raw, message.length, g, words)
                assert struct.pack("<d", same) == struct.pack("<d", value), f"{message.name}.{signal.name}"


def signal_row(signal: Any) -> Any:
    row = np.zeros(1, SIGNAL)
    row["shift"], row["bits"], row["big"] = signal.shift, signal.length, signal.big_endian
    row["signed"], row["real"] = signal.signed, signal.is_float
    row["scale"], row["offset"] = signal.scale, signal.offset
    return row[0]


@pytest.mark.parametrize(("length", "start"), [(64, 0), (63, 1), (53, 3), (40, 5), (33, 7), (32, 2), (16, 0)])
@pytest.mark.parametrize("signed", [False, True])
def test_wide_signals_are_exact(length: int, start: int, signed: bool) -> None:
    """Integers of more than 53 bits round once, as Python's do."""
    rng, words = np.random.default_rng(length), np.zeros(2, np.uint32)
    for data in [b"\xff" * 16, bytes(16), *(rng.bytes(16) for _ in range(50))]:
        bits = int.from_bytes(data, "little") >> start & ((1 << length) - 1)
        value = bits - (1 << length) if signed and bits >> (length - 1) else bits
        row = np.zeros(1, SIGNAL)
        row["shift"], row["bits"], row["signed"], row["scale"] = start, length, signed, 1.0
        raw = np.zeros(128, np.uint8)
        raw[8:24] = np.frombuffer(data, np.uint8)
        assert phys_of(raw, 16, row[0], words) == float(value)


@pytest.mark.parametrize("length", [16, 32, 64])
def test_floats_are_exact(length: int) -> None:
    rng, words = np.random.default_rng(length), np.zeros(2, np.uint32)
    row = np.zeros(1, SIGNAL)
    row["bits"], row["real"], row["scale"] = length, True, 1.0
    for data in [b"\0" * 8, b"\xff\x7b" * 4, b"\0\x7c" * 4, b"\1\0" * 4, *(rng.bytes(8) for _ in range(200))]:
        (value,) = struct.unpack({16: "<e", 32: "<f", 64: "<d"}[length], data[: length // 8])
        raw = np.zeros(128, np.uint8)
        raw[8:16] = np.frombuffer(data, np.uint8)
        assert np.array_equal(phys_of(raw, 8, row[0], words), value, equal_nan=True)


@pytest.mark.parametrize("kind", BINDINGS)
def test_commands_are_laid_out_as_the_codec_says(kind: str) -> None:
    binding, rng = BINDINGS[kind], np.random.default_rng(3)
    messages, signals = outgoing_tables(binding)
    assert messages.dtype == MESSAGE
    values, words = np.zeros(len(SOURCES)), np.zeros(2, np.uint32)
    refused = 0
    for _ in range(500):
        values[0], values[1] = rng.integers(256), rng.choice([0, 2, 6, 7, 15, 128])
        values[2:5] = rng.choice([0.0, 1e-3, 1.0, 100.0, 1e3, 1e9]) * rng.standard_normal(3)
        if rng.random() < 0.3:
            values[2 + rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf])
        values[5:8] = rng.integers(2, size=3)
        for index, bound in enumerate(binding.outgoing):
            message = bound.message
            given = {name: float(values[SOURCES.index(part)]) for part, name in bound.parts}
            if bound.counter:
                given[bound.counter] = float(values[0] % bound.counter_modulus)
            raw, log = laid_out(message.send_id, message.length, message.fd), np.zeros(ROOM, FRAME)
            size = encode(raw, values, index, messages, signals, np.zeros(1, STATE), words, log, 9)
            try:
                frame = pack_frame(message.send_id, bound.encode(given), message.fd)
            except EncodeError:
                refused += 1
                assert size == -1, f"{given}"
                continue
            assert raw[:size].tobytes() == frame, f"{given}"
            assert log[0]["data"][: message.length].tobytes() == frame[8 : 8 + message.length]
            assert (log[0]["received"], log[0]["t_ns"]) == (0, 9)
    assert refused > 50


def test_frames_are_logged_as_hil_lays_them_out() -> None:
    assert FRAME == LOGGED_FRAME


@pytest.mark.parametrize("kind", BINDINGS)
@pytest.mark.parametrize("rows", [1, 16])
def test_a_command_is_overheard_as_the_codec_says(kind: str, rows: int) -> None:
    """Whole and valid or not at all, by its counter; of a drive without echo the newest."""
    bound, rng = BINDINGS[kind].command, np.random.default_rng(rows)
    taker, seen = Taker(BINDINGS[kind], overhears=True), np.zeros(2 * rows)
    parts, wanted = dict(bound.parts), np.zeros((rows, 2))
    axes = [next((parts[part] for part in axis if part in parts), "") for axis in (COMMANDED_Q, COMMANDED_D)]
    taken = 0
    for raw in random_frames(bound, rng, 200):
        assert taker.take(raw) == OVERHEARD and taker.state["logged"] == 1
        size = len(raw) if rng.random() > 0.1 else 72 + 16 - len(raw)
        args: Any = (taker.messages, taker.signals, taker.words, seen)
        overhear(taker.buffer, *args, size)
        data = raw[8 : 8 + bound.message.length]
        if bound.message.valid(data) and (size == 72 or bound.message.length <= 8):
            counter = int(bound.message.reader(bound.counter)(data)[0]) if bound.counter else 0
            wanted[counter % rows] = [bound.message.reader(name)(data)[0] if name else 0.0 for name in axes]
            taken += 1
        assert seen.tobytes() == wanted.tobytes()
    assert 50 < taken < 200 or bound.message.profile == 0


def test_a_shadow_of_a_drive_with_two_voltages_in_two_messages_is_refused() -> None:
    database = Database(CONFIGS / "drives/hil_pmsm.dbc")
    binding = bind(house_map(database), database)
    bound = replace(binding.command, parts=tuple(row for row in binding.command.parts if row[0] != "u_d"))
    with pytest.raises(DatabaseError, match="u_q and u_d in one message; drop --shadow"):
        Tables().overhear(bound)
