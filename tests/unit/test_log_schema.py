"""The bytes that are logged are valid messages of the schemas that are embedded."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from hil.log import schema
from hil.log.records import EVENT, EVENT_BYTES, FRAME_RECORD, pack_event_record
from hil.signals import FIELDS, TICK, new_ticks

INT64 = st.integers(-(2**63), 2**63 - 1)
UINT64 = st.integers(0, 2**64 - 1)


def message(name: str) -> type:
    pool = descriptor_pool.DescriptorPool()
    for file in schema.file_descriptor_set().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def test_a_tick_record_is_a_tick_message_field_by_field() -> None:
    ticks = new_ticks()
    for number, field in enumerate(FIELDS, start=1):
        ticks[field.name] = number * 1.25 if field.kind == "f8" else number
    decoded = message("hil.Tick").FromString(ticks.tobytes())
    assert {f.name: getattr(decoded, f.name) for f in FIELDS} == {f.name: ticks[f.name][0] for f in FIELDS}
    assert len(decoded.ListFields()) == len(FIELDS), "no field unknown, none lost"


def test_nan_infinity_and_negative_zero_survive_to_the_bit() -> None:
    ticks = new_ticks()
    ticks["w"], ticks["u_q"], ticks["i_q"], ticks["lateness_ns"] = np.inf, -0.0, np.nan, -5
    decoded = message("hil.Tick").FromString(ticks.tobytes())
    assert decoded.w == np.inf and struct.pack("<d", decoded.u_q) == struct.pack("<d", -0.0)
    assert np.isnan(decoded.i_q) and decoded.lateness_ns == -5


@given(t_ns=INT64, can_id=st.integers(0, 2**32 - 1), data=st.binary(max_size=64), received=st.booleans())
def test_frames_are_messages_and_come_back(t_ns: int, can_id: int, data: bytes, received: bool) -> None:
    frames = np.frombuffer(FRAME_RECORD.pack(t_ns, can_id, received, len(data), data), schema.FRAME)
    messages = schema.frame_messages(frames)
    raw = messages.tobytes()[: schema.FRAME_HEAD + len(data)]
    decoded = message("hil.CanFrame").FromString(raw)
    assert (decoded.t_ns, decoded.can_id, decoded.data) == (t_ns, can_id, data)
    messages["data"][0, len(data) :] = 0xEE  # what lies behind a shorter frame is another message
    again = schema.frames_from_messages(messages, np.array([len(raw)]), received)
    assert again.tobytes() == frames.tobytes()


@given(t_ns=INT64, k=UINT64, kind=st.text(max_size=20), text=st.text(max_size=400))
def test_events_are_messages_and_come_back(t_ns: int, k: int, kind: str, text: str) -> None:
    raw = schema.pack_event(t_ns, k, kind, text)
    decoded = message("hil.Event").FromString(raw)
    assert (decoded.t_ns, decoded.k, decoded.kind, decoded.text) == (t_ns, k, kind, text)
    assert schema.unpack_event(raw) == (t_ns, k, kind, text)


@given(st.binary(max_size=80))
def test_foreign_bytes_are_no_event_but_no_crash(raw: bytes) -> None:
    try:
        schema.unpack_event(raw)
    except ValueError:
        return
    assert len(raw) >= 22, "a header and two texts"


def test_stats_are_a_message() -> None:
    raw = schema.pack_stats(7, {"ticks": 5, "lateness_max_ns": -3, "file_bytes": 2**40})
    decoded = message("hil.Stats").FromString(raw)
    assert (decoded.t_ns, decoded.ticks, decoded.dropped) == (7, 5, 0)
    assert (decoded.lateness_max_ns, decoded.file_bytes) == (-3, 2**40)


def test_layouts_tell_versions_apart() -> None:
    own = schema.file_descriptor_set()
    layout = schema.message_layout(own.SerializeToString(), "hil.Tick")
    assert layout is not None and len(layout) == len(FIELDS)
    own.file[0].message_type[0].field[3].number = 99
    assert schema.message_layout(own.SerializeToString(), "hil.Tick") != layout
    assert schema.message_layout(b"\xff\xff", "hil.Tick") is None


def test_every_field_has_unit_and_meaning() -> None:
    names = {name for name in TICK.names or () if not name.startswith("_")}
    assert set(schema.units()) == set(schema.meanings()) == names
    assert all(schema.meanings().values())


@pytest.mark.parametrize("text", ["", "x" * 5000, "ü" * 400, "\ud800"])
def test_an_event_of_any_length_fits_its_record(text: str) -> None:
    record = pack_event_record(1, 2, "kind", text)
    assert len(record) == EVENT_BYTES
    t_ns, k, kind_size, text_size = EVENT.unpack_from(record)
    assert (t_ns, k, kind_size) == (1, 2, 4) and EVENT.size + kind_size + text_size <= EVENT_BYTES
