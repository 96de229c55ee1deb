"""Rows of the fault matrix on real processes; a weakened guard fails its row."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hil.config.tables import load_toml
from hil.faults.case import check_rows, run_row
from hil.faults.matrix import ClockStep, Matrix, load_matrix
from hil.log.reader import open_log
from hil.signals import FIELDS
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
