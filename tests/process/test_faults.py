"""Rows of the fault matrix on real processes; a weakened guard fails its row."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hil.config.tables import load_toml
from hil.errors import ConfigError
from hil.faults.case import check_rows, run_row
from hil.faults.matrix import ClockStep, Matrix, Row, load_matrix
from hil.log.reader import open_log
from hil.signals import FIELDS, Reason
from tests.conftest import CONFIGS

pytestmark = pytest.mark.process


def run(config: Path, folder: Path, *words: str) -> tuple[int, list[dict[str, Any]]]:
    command = [sys.executable, "-m", "hil.cli", "faults", str(config), "--json", "--folder", str(folder)]
    done = subprocess.run([*command, *words], capture_output=True, text=True, timeout=280, check=False)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)["rows"]


def test_rows_in_lockstep(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    names = ["no feedback any more", "all commands", "bus-off", "brown-out: 3 ms", "a tenth of the feedback"]
    only = [word for name in names for word in ("--only", name)]
    code, rows = run(CONFIGS / "faults.toml", tmp_path, *only, "--html", str(page))
    assert code == 0, rows
    assert [row["verdict"] for row in rows] == ["as expected"] * (len(names) + 1)  # two of bus-off
    by_name = {row["fault"]: row for row in rows}
    assert by_name["bus-off"]["reaction"] == "stop: bus_down"
    assert 5 <= by_name["frame drop: no feedback any more"]["time_to_safe_ms"] <= 8
    assert by_name["frame drop: a tenth of the feedback"]["time_to_safe_ms"] is None
    text = page.read_text(encoding="utf-8")
    assert text.count("<figure>") == len(rows) and "http" not in text


@pytest.mark.long
@pytest.mark.parametrize(
    ("drive", "names", "safe_ms"),
    [
        ("moteus", ["commands", "bus-off"], [None, 19, 19]),
        ("odrive", ["torques: none", "sag"], [49, 3]),
        ("cia402", ["none reaches", "bus-off", "brown-out", "EMCY lost"], [19, 191, 51, 19, 4, 0]),
    ],
)
def test_rows_of_drives_by_others(
    drive: str, names: list[str], safe_ms: list[int | None], tmp_path: Path
) -> None:
    own, path = load_matrix(CONFIGS / f"faults/{drive}.toml", CONFIGS / "faults.toml")
    check_rows(path, own, own.row)  # all of them load
    only = [word for name in names for word in ("--only", name)]
    code, rows = run(CONFIGS / f"faults/{drive}.toml", tmp_path, *only)
    assert code == 0, rows
    found = [row["time_to_safe_ms"] for row in rows]
    assert [one if one is None else round(one) for one in found] == safe_ms


@pytest.mark.long
def test_rows_of_two_nodes(tmp_path: Path) -> None:
    """What happens to one stops the other in the same tick; both have their say in the row."""
    path = CONFIGS / "faults/dyno.toml"
    own, run_path = load_matrix(path, CONFIGS / "faults.toml")
    assert list(check_rows(run_path, own, own.row)) == ["motor", "load"]
    only = [
        word for name in ("load's TPDO1", "bus-off of the motor", "EMCY lost") for word in ("--only", name)
    ]
    code, rows = run(path, tmp_path, *only)
    assert code == 0, rows
    assert [row["reaction"].removeprefix("stop: ") for row in rows] == [
        "ride through", "ride through", "stale_feedback", "stale_feedback", "drive_fault",
    ]  # fmt: skip
    found = [row["time_to_safe_ms"] for row in rows]
    assert [one if one is None else round(one) for one in found] == [None, None, 6, 19, 232]
    motor, load = (open_log(Path(rows[2]["path"]), node=node) for node in ("motor", "load"))
    firsts = [log.ticks[log.ticks["reason"] != 0][0] for log in (motor, load)]
    assert [Reason(int(tick["reason"])).name for tick in firsts] == ["NODE_STOPPED", "STALE_FEEDBACK"]
    assert firsts[0]["k"] == firsts[1]["k"] and {row["replay"] for row in rows} == {"same"}
    sent = [f.can_id for f in motor.frames if not f.received and f.t_ns == int(firsts[0]["t_ns"])]
    assert sent == [0x080, 0x205, 0x206], "SYNC, then the commands in the configuration's order"


def test_a_row_that_expects_another_node_to_stop_fails(tmp_path: Path) -> None:
    own, path = load_matrix(CONFIGS / "faults/dyno.toml", CONFIGS / "faults.toml")
    row = next(row for row in own.row if row.name == "load's TPDO1: none any more")
    row = row.model_copy(update={"expect": row.expect.model_copy(update={"node": "motor"})})
    result = run_row(path, own, row, tmp_path / "run")
    assert result.why == ["motor: reason node_stopped", "load: reason stale_feedback"]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"fault": [{"kind": "drop", "at_s": 0.5, "message": "TPDO1", "node": "brake"}]},
         "fault: node 'brake': there are motor and load"),
        ({"fault": [{"kind": "drop", "at_s": 0.5, "message": "FEEDBACK", "node": "load"}]}, "FEEDBACK"),
        ({"expect": {"reaction": "stop", "reason": ["over_speed"], "within_ms": 1.0}},
         "expect.node: missing; which of motor and load stops for that reason?"),
        ({"expect": {"reaction": "stop", "reason": ["over_speed"], "within_ms": 1.0, "node": "brake"}},
         "expect.node: 'brake': there are motor and load"),
    ],
)  # fmt: skip
def test_a_node_that_is_none_is_said(changed: dict[str, Any], said: str) -> None:
    own, path = load_matrix(CONFIGS / "faults/dyno.toml", CONFIGS / "faults.toml")
    row = Row.model_validate({"name": "odd", "expect": {"reaction": "ride through"}} | changed)
    with pytest.raises(ConfigError, match=said) as caught:
        check_rows(path, own, [row])
    assert len(caught.value.problems) == 1 and "row 'odd': " in caught.value.problems[0]


def test_of_one_drive_no_fault_names_a_node() -> None:
    row = Row.model_validate(
        {
            "name": "odd",
            "expect": {"reaction": "stop", "reason": ["over_speed"], "within_ms": 1.0, "node": "a"},
        }
    )
    with pytest.raises(ConfigError, match=r"expect\.node: 'a': the bus has one drive"):
        check_rows(CONFIGS / "demo.toml", matrix(), [row])
    bad = row.model_copy(update={"expect": matrix().row[0].expect,
                                 "fault": [{"kind": "bus-off", "at_s": 0.5, "node": "a"}]})  # fmt: skip
    with pytest.raises(ConfigError, match="fault: node 'a': the bus has one drive; leave the node out"):
        check_rows(CONFIGS / "demo.toml", matrix(), [bad])


@pytest.mark.long
def test_rows_in_real_time(tmp_path: Path) -> None:
    only = ["--only", "writer killed", "--only", "disk full"]
    code, rows = run(CONFIGS / "faults.toml", tmp_path, *only)
    assert code == 0, rows
    assert all(row["reaction"] == "stop: log_failed" and "readable" in row["log"] for row in rows)


def matrix(*settings: str) -> Matrix:
    return load_toml(CONFIGS / "faults.toml", Matrix, settings)


def row_of(name: str, *more: str) -> Any:
    row = next(row for row in matrix().row if row.name == name)
    return row.model_copy(update={"set": [*row.set, *more]})


@pytest.mark.corners
@pytest.mark.parametrize(
    ("name", "weaker", "why"),
    [
        ("frozen value while accelerating", ("feedback.frozen_ticks=10000",), "reason"),
        ("frame drop: no command reaches the drive", ("feedback.hold_ticks=1000",), "reason drive_fault"),
        ("sensor bias: 25 A in i_d", ("limits.trip_ticks=1000",), "reason drive_fault"),
        ("phase loss at 2 N m", ("limits.open_phase_min_a=5.0",), "did not stop"),
        ("DC-link sag: 300 V", ("limits.v_dc_min_v=0.0",), "did not stop"),
    ],
)
def test_a_weakened_guard_fails_its_row(tmp_path: Path, name: str, weaker: tuple[str, ...], why: str) -> None:
    result = run_row(CONFIGS / "demo.toml", matrix(), row_of(name, *weaker), tmp_path / "run")
    assert result.verdict == "not as expected" and any(why in text for text in result.why), result.why


IDLE = [
    ({"fault": [{"kind": "drop", "at_s": 9.0}]}, "did nothing: drop"),
    ({"fault": [{"kind": "dc-link", "at_s": 0.3, "v_dc_v": 540.0}]}, "did nothing: dc-link"),
    ({"host": ClockStep(kind="clock-step", at_s=0.2, step_s=0.0)}, "did nothing: clock-step"),
]


@pytest.mark.corners
@pytest.mark.parametrize(("changed", "why"), IDLE)
def test_a_fault_that_does_nothing_fails_its_row(tmp_path: Path, changed: dict[str, Any], why: str) -> None:
    row = row_of("no fault").model_copy(update=changed)
    result = run_row(CONFIGS / "demo.toml", matrix(), row, tmp_path / "run")
    assert why in result.why, result.why


def test_a_row_is_the_same_to_the_bit_each_time(tmp_path: Path) -> None:
    ticks = []
    for number in range(2):
        row = row_of("reordering: all feedback")
        result = run_row(CONFIGS / "demo.toml", matrix(), row, tmp_path / str(number))
        assert result.verdict == "as expected", result.why
        ticks.append(open_log(Path(result.path)).ticks)
    for field in FIELDS:
        if field.name != "recorded_ns":
            assert ticks[0][field.name].tobytes() == ticks[1][field.name].tobytes(), field.name
