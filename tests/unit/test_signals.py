"""The tick record: its raw bytes are a protobuf message with the field numbers that the format promises."""

from __future__ import annotations

import struct

from hil.signals import FIELDS, TICK, DriveState, new_ticks


def test_numbers_and_names_are_unique() -> None:
    assert len({f.number for f in FIELDS}) == len(FIELDS) == len({f.name for f in FIELDS})


def test_bytes_pinned_by_hand() -> None:
    ticks = new_ticks()
    ticks["k"], ticks["w"], ticks["state"] = 3, 80.5, int(DriveState.OPERATION_ENABLED)
    raw = ticks.tobytes()
    assert raw[:9] == b"\x09" + struct.pack("<Q", 3)  # field 1, wire type 1
    assert b"\x91\x01" + struct.pack("<d", 80.5) in raw  # field 18, wire type 1
    assert b"\x85\x03" + struct.pack("<I", 4) in raw  # field 48, wire type 5


def test_a_record_has_one_length() -> None:
    assert len(new_ticks().tobytes()) == TICK.itemsize
    assert new_ticks(7).tobytes()[: TICK.itemsize] == new_ticks().tobytes()
