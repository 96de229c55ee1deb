"""A log outlives the version that wrote it: what is new since format 1 says what its absence means."""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from hil.control.law import LAW_NEUTRAL, LAW_PARAMS, LAW_STATE
from hil.control.references import REFERENCE, REFERENCE_NEUTRAL
from hil.log.check import first_broken, share, sums
from hil.log.container import Block, Container
from hil.log.info import info
from hil.log.layouts import FORMAT_1, TICK_FIELDS_1
from hil.log.mcapfile import RunFile
from hil.log.named import fill, read_named, to_named
from hil.log.reader import Log, LogError, open_log
from hil.log.recover import recover
from hil.log.schema import TYPES, file_descriptor_set
from hil.replay import replay_log
from hil.report.view import verdict_text
from hil.signals import FIELDS, TickArray, tag
from hil.tick.guard import SAFETY_NEUTRAL, SAFETY_PARAMS, SAFETY_STATE
from tests.golden.kept import LOGS
from tests.logfiles import some_ticks

GOLDEN = LOGS / "1a4c819"

RECORDS = {
    "safety": (SAFETY_PARAMS, SAFETY_NEUTRAL),
    "law": (LAW_PARAMS, LAW_NEUTRAL),
}
STATES = {"safety_state": SAFETY_STATE, "law_state": LAW_STATE}


def test_a_new_input_says_what_a_log_without_it_stands_for() -> None:
    new = [field for field in FIELDS if field.number not in TICK_FIELDS_1]
    assert [f.name for f in new if f.role == "input" and f.absent is None] == []
    assert [f.name for f in FIELDS if f.number in TICK_FIELDS_1 and f.absent is not None] == []
    assert {field.number for field in FIELDS} >= TICK_FIELDS_1, "a field of format 1 is gone"


@pytest.mark.parametrize("name", RECORDS)
def test_a_new_parameter_has_a_neutral_value_and_an_old_one_none(name: str) -> None:
    layout, neutral = RECORDS[name]
    old, now = set(FORMAT_1[name].names or ()), set(layout.names or ())
    assert old <= now, "a parameter of format 1 is gone"
    assert now - old == set(neutral), "say in the table beside it what a log without it stands for"


def test_the_reference_has_its_neutral_values() -> None:
    old = "kind w at down_at rate jerk offset frequency i_q count t_table w_table"
    since = set(REFERENCE.names or ()) - set(old.split())
    assert since == set(REFERENCE_NEUTRAL)


@pytest.mark.parametrize("name", STATES)
def test_states_of_format_1_have_their_place(name: str) -> None:
    old, now = FORMAT_1[name], STATES[name]
    for field in old.names or ():
        was, is_now = old[field], now[field]
        assert was.base == is_now.base and was.shape[1:] == is_now.shape[1:], field
        assert was.shape[:1] <= is_now.shape[:1], field


def random_record(layout: np.dtype[Any]) -> np.ndarray[Any, Any]:
    """Bits at random: NaN of every kind, denormals, negative zero."""
    raw = np.random.default_rng(5).integers(0, 256, layout.itemsize, np.uint8)
    record = raw.view(layout).copy()
    first = next(name for name in layout.names or () if layout[name].base.kind == "f")
    record[first] = -0.0
    return record


def same_bits(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> bool:
    return all(a[name].tobytes() == b[name].tobytes() for name in a.dtype.names or ())


@pytest.mark.parametrize("layout", [SAFETY_PARAMS, LAW_PARAMS, SAFETY_STATE, LAW_STATE, REFERENCE])
def test_a_record_by_name_comes_back_to_the_bit(layout: np.dtype[Any]) -> None:
    record, again = random_record(layout), np.zeros(1, layout)
    text = json.dumps(to_named(record), allow_nan=False)
    assert fill(again, read_named("safety", json.loads(text)), {}) == []
    assert same_bits(record, again)


def test_what_a_log_lacks_takes_the_neutral_value_or_stays_as_it_begins() -> None:
    layout = np.dtype([("old", "f8"), ("new", "f8"), ("row", "i8", 3)], align=True)
    given = read_named("safety", {"old": 2.5, "row": [1, 2, 3]})
    record = np.zeros(1, layout)
    assert fill(record, given, {"new": math.inf}) == ["new"]
    assert record[0].tolist()[:2] == (2.5, math.inf)
    state = np.array([(0.0, 7.0, (9, 9, 9))], layout)
    assert fill(state, read_named("safety", {"old": 1.0, "row": [4, 5]})) == ["new"]
    assert state["new"][0] == 7.0 and state["row"][0].tolist() == [4, 5, 9]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"old": 1.0}, "lacks new"),
        ({"old": 1.0, "new": 2.0, "newer": 1}, "newer: not known"),
        ({"old": [1.0, 2.0], "new": 1.0}, "shape"),
        ({"old": "x", "new": 1.0}, "old is no number"),
        ({"old": True, "new": 1.0}, "old is no number"),
        ({"old": None, "new": 1.0}, "old is no number"),
        ({"old": [[1.0], [1.0, 2.0]], "new": 1.0}, "old is no number"),
        ({"old": 10**30, "new": 1.0}, "old is no number"),
        ({"old": "nan:12", "new": 1.0}, "old is no number"),
        ("00", "has 1 bytes"),
        ([1, 2], "neither"),
    ],
)
def test_what_is_no_record_is_refused(given: Any, words: str) -> None:
    layout = np.dtype([("old", "f8"), ("new", "f8")])
    none: Mapping[str, float] = {}
    with pytest.raises(ValueError, match=words):
        fill(np.zeros(1, layout), read_named("safety", given), none)


def other_version(path: Path, ticks: TickArray, *, lacks: tuple[str, ...], has: tuple[Any, ...]) -> Path:
    """A log of a version that lacks some of today's fields and has others, by Container alone."""
    fields = [(f.number, f.name, f.kind, ticks[f.name]) for f in FIELDS if f.name not in lacks]
    fields += [(number, name, kind, np.full(len(ticks), value)) for number, name, kind, value in has]
    fields.sort(key=lambda row: row[0])
    file = FileDescriptorProto(name="hil.proto", package="hil", syntax="proto3")
    message = file.message_type.add(name="Tick")
    parts: list[tuple[str, str]] = []
    for number, name, kind, _ in fields:
        message.field.add(name=name, number=number, type=TYPES[kind], label=1)
        parts += [(f"_{number}", f"S{len(tag(number, kind))}"), (f"v{number}", f"<{kind}")]
    records = np.empty(len(ticks), parts)
    for number, _, kind, values in fields:
        records[f"_{number}"], records[f"v{number}"] = tag(number, kind), values
    out = Container(path)
    schema = out.add_schema("hil.Tick", FileDescriptorSet(file=[file]).SerializeToString())
    channel = out.add_channel("/tick", schema)
    out.add_metadata("run", {"format": "2"})
    block, size = Block(), records.itemsize
    for row, record in enumerate(records):
        raw = (
            struct.pack("<BQHIQQ", 5, 22 + size, channel, row, int(ticks["t_ns"][row]), 0) + record.tobytes()
        )
        one = np.array([1], np.int64)
        block.add(one * channel, ticks["t_ns"][row : row + 1].astype(np.int64), one * len(raw), raw)
    out.add_chunk(block)
    out.finish()
    return path


def test_fields_that_are_not_known_are_skipped_and_those_lacking_are_absent(tmp_path: Path) -> None:
    ticks = some_ticks(50)
    lacks = ("T_L_hat", "filled", "lateness_ns")
    has = ((15, "older", "u4", 7), (900, "newer", "f8", 1.5))
    ticks["check"] = sums(ticks, lacks) + share(np.full(50, 7, "<u4"), 15) + share(np.full(50, 1.5), 900)
    log = open_log(other_version(tmp_path / "a.mcap", ticks, lacks=lacks, has=has))
    assert log.damage is None and log.absent == set(lacks) and log.unknown == ("older", "newer")
    assert all(np.isnan(log.ticks["T_L_hat"])) and not log.ticks["filled"].any()
    for field in FIELDS:
        if field.name not in (*lacks, "check"):
            assert log.ticks[field.name].tobytes() == ticks[field.name].tobytes(), field.name
    assert first_broken(log.ticks, log.absent) is None, "the check holds over what is kept"
    assert set(log.to_numpy().dtype.names or ()) == {f.name for f in FIELDS} - set(lacks)


def test_what_is_absent_stays_absent_in_a_recovered_log(tmp_path: Path) -> None:
    first = other_version(tmp_path / "a.mcap", some_ticks(50), lacks=("T_L_hat",), has=())
    recover(first, tmp_path / "b.mcap")
    again = open_log(tmp_path / "b.mcap")
    assert again.absent == {"T_L_hat"} and again.ticks.tobytes() == open_log(first).ticks.tobytes()


@pytest.mark.parametrize(
    ("lacks", "has", "words"),
    [
        (("i_q",), (), "lack i_q"),
        (("w",), ((18, "speed", "f8", 1.0),), "field 18 of a tick is speed"),
        (("w",), ((18, "w", "i8", 1),), "field 18 of a tick is w of type"),
        ((), ((900, "w", "f8", 1.0),), "one number or name"),
    ],
)
def test_fields_of_another_meaning_are_refused(
    tmp_path: Path, lacks: tuple[str, ...], has: tuple[Any, ...], words: str
) -> None:
    path = other_version(tmp_path / "a.mcap", some_ticks(5), lacks=lacks, has=has)
    with pytest.raises(LogError, match=words):
        open_log(path)


def test_ticks_that_another_program_encoded_anew_are_read(tmp_path: Path) -> None:
    """proto3 leaves zeros out, so that the messages are of many lengths."""
    ticks, path = some_ticks(40), tmp_path / "a.mcap"
    ticks["guard_flags"][::2] = 0
    ticks["i_d"][::3] = 0.0
    pool = DescriptorPool()
    for file in file_descriptor_set().file:
        pool.Add(file)
    Tick = GetMessageClass(pool.FindMessageTypeByName("hil.Tick"))
    out = Container(path)
    channel = out.add_channel("/tick", out.add_schema("hil.Tick", file_descriptor_set().SerializeToString()))
    out.add_metadata("run", {})
    block, one = Block(), np.array([1], np.int64)
    for tick in ticks:
        data = Tick(**{f.name: tick[f.name].item() for f in FIELDS}).SerializeToString()
        raw = struct.pack("<BQHIQQ", 5, 22 + len(data), channel, 0, int(tick["t_ns"]), 0) + data
        block.add(one * channel, one * int(tick["t_ns"]), one * len(raw), raw)
    out.add_chunk(block)
    out.finish()
    log = open_log(path)
    assert log.damage is None and log.ticks.tobytes() == ticks.tobytes()


@pytest.mark.parametrize("number", ["3", "99999999999999999999", "0", "-1", "two", ""])
def test_a_later_format_is_refused_in_one_line(tmp_path: Path, number: str) -> None:
    path = tmp_path / "a.mcap"
    run = {"format": number, "version hil-drive": "9.9"}
    with RunFile(path, {"metadata": run}) as file:
        file.add_ticks(some_ticks(5))
        file.finish({})
    for read in (open_log, info):
        with pytest.raises(LogError, match=r"format .*written by hil-drive 9\.9.*reads 1 to 2") as refused:
            read(path)
        assert "\n" not in str(refused.value)


def changed_log(log: Log, name: str, text: str) -> Log:
    """The same log with another attachment, as one of another version."""
    log.attachments[name] = text
    log.metadata["run"]["version hil-drive"] = "another"
    return log


def test_a_parameter_that_a_log_lacks_is_named_in_the_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    log = open_log(GOLDEN / "simulate.mcap")
    given = json.loads(log.attachments["controller.json"])
    safety = read_named("safety", given["safety"])
    record = np.zeros(1, FORMAT_1["safety"])
    fill(record, safety, {})
    named = to_named(record)
    del named["open_phase_min"]
    monkeypatch.setitem(SAFETY_NEUTRAL, "open_phase_min", math.inf)
    verdict = replay_log(changed_log(log, "controller.json", json.dumps(given | {"safety": named})))
    assert verdict.verdict == "same"
    assert "the log lacks safety.open_phase_min, taken as inf" in verdict.notes
    assert verdict.as_dict()["notes"] == list(verdict.notes)
    assert "open_phase_min, taken as inf" in verdict_text(verdict.as_dict())


def test_parameters_in_the_log_stand_against_another_design() -> None:
    log = open_log(GOLDEN / "simulate.mcap")
    config = json.loads(log.attachments["config.json"])
    config["limits"]["w_max_rad_s"] += 1.0
    verdict = replay_log(changed_log(log, "config.json", json.dumps(config)))
    assert verdict.verdict == "same"
    assert any("would design w_max otherwise" in note for note in verdict.notes)
    config["limits"]["not there any more"] = 1.0
    verdict = replay_log(changed_log(log, "config.json", json.dumps(config)))
    assert verdict.verdict == "same" and "does not take the config" in verdict.notes[0]


def test_a_config_inside_a_log_opens_no_path(tmp_path: Path) -> None:
    fifo = tmp_path / "motor.toml"
    os.mkfifo(fifo)
    log = open_log(GOLDEN / "simulate.mcap")
    config = json.loads(log.attachments["config.json"]) | {"motor": str(fifo)}
    verdict = replay_log(changed_log(log, "config.json", json.dumps(config)))
    assert any("opens no file" in note for note in verdict.notes)
