"""A log outlives the version that wrote it: what is new since format 1 says what its absence means."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from hil.control.law import LAW_NEUTRAL, LAW_PARAMS, LAW_STATE
from hil.control.references import REFERENCE, REFERENCE_NEUTRAL
from hil.guard import SAFETY_NEUTRAL, SAFETY_PARAMS, SAFETY_STATE
from hil.log.layouts import FORMAT_1, TICK_FIELDS_1
from hil.log.named import fill, read_named, to_named
from hil.signals import FIELDS

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
