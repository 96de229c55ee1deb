"""Frames taken from the socket's bytes do what frames taken apart do, whatever arrives."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.binding import bind
from drivers.bus import unpack_frame
from drivers.codec import Database
from drivers.fast import key_of, size_of, taker
from drivers.frames import Incoming
from drivers.local import pack_frame
from drivers.mapping import house_map
from drivers.record import cell_of
from hil.signals import TickArray, new_ticks
from tests.conftest import CONFIGS


def frames_of(path: Path, name: str, rng: np.random.Generator, count: int) -> list[bytes]:
    """Good frames, repeated ones, jumps of the counter and damaged bits."""
    message, out, counter = Database(path).message(name), [], 0
    for _ in range(count):
        counter = (counter + int(rng.choice([0, 1, 1, 1, 3]))) % message.counter_modulus
        data = bytearray(rng.bytes(message.length))
        at = 1 if message.profile == 2 else 2
        data[at] = (data[at] & 0xF0 | counter) if message.profile == 2 else counter
        message.protect(data)
        if rng.random() < 0.1:
            data[int(rng.integers(message.length))] ^= 1 << int(rng.integers(8))
        out.append(pack_frame(message.send_id, bytes(data), message.fd))
    return out


@pytest.mark.parametrize(
    ("dbc", "name"), [("hil_pmsm", "FEEDBACK"), ("hil_pmsm", "STATUS"), ("hil_pmsm_fd", "FEEDBACK")]
)
@pytest.mark.parametrize("seed", range(5))
def test_both_ways_agree_on_flags_and_bytes(dbc: str, name: str, seed: int) -> None:
    path, rng = CONFIGS / f"drives/{dbc}.dbc", np.random.default_rng(seed)
    database = Database(path)
    bound = next(b for b in bind(house_map(database), database).incoming if b.message.name == name)
    plain, shared = Incoming(bound), Incoming(bound)
    ticks: list[TickArray] = [new_ticks(), new_ticks()]
    for incoming, record in zip((plain, shared), ticks, strict=True):
        incoming.cells = [cell_of(record[0], field) for field in incoming.fields]
    take = taker(bound)(shared, shared.cells)
    for raw in frames_of(path, name, rng, 300):
        frame, late = unpack_frame(raw), bool(rng.random() < 0.2)
        assert frame is not None and raw[:5] == key_of(bound) and len(raw) == size_of(bound)
        assert plain.take(frame.data, late) == take(raw, late), f"seed {seed}"
        assert ticks[0].tobytes() == ticks[1].tobytes(), f"seed {seed}"
        assert plain.last == shared.last


def test_taking_frames_leaves_nothing_for_the_collector() -> None:
    path = CONFIGS / "drives/hil_pmsm.dbc"
    database, ticks = Database(path), new_ticks()
    bound = next(b for b in bind(house_map(database), database).incoming if b.message.name == "FEEDBACK")
    incoming = Incoming(bound)
    take = taker(bound)(incoming, [cell_of(ticks[0], field) for field in incoming.fields])
    frames = frames_of(path, "FEEDBACK", np.random.default_rng(1), 4000)
    gc.collect()
    gc.disable()
    try:
        objects, blocks = gc.get_count()[0], sys.getallocatedblocks()
        for raw in frames:
            take(raw, False)
        assert gc.get_count()[0] - objects <= 5
        assert sys.getallocatedblocks() - blocks <= 50
    finally:
        gc.enable()
