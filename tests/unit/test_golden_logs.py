"""Logs of former versions open, report, export and replay to the same bits, or are signed with a reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hil.cli import main
from hil.log.reader import open_log
from tests.golden import kept

RUNS = kept.runs()


def test_no_kept_log_and_no_signature_was_touched() -> None:
    assert kept.sums() == kept.written_sums(), "kept for ever; `make golden` says what is new"
    kinds: dict[str, set[str]] = {}
    for name in RUNS:
        kinds.setdefault(name.partition("/")[0], set()).add(name.partition("/")[2])
    assert kinds == {
        "1a4c819": {"simulate", "fac", "split", "lockstep", "lockstep-fac", "fault", "inverter"},
        "e11b868": {"own-loop", "position", "two-nodes"},
    }
    assert sum(path.stat().st_size for path in kept.LOGS.rglob("*.mcap")) < 2_000_000 * len(
        list(kept.LOGS.glob("*/"))
    )


def test_every_signature_is_of_a_kept_log_and_has_a_reason() -> None:
    assert kept.signed().keys() <= RUNS.keys()
    assert all(len(row["reason"].split()) >= 3 for row in kept.signed().values())


@pytest.mark.parametrize("name", RUNS)
def test_it_replays_to_the_same_bits_or_as_it_is_signed(name: str) -> None:
    verdict, row = kept.found(RUNS[name])
    expected = {key: value for key, value in kept.signed().get(name, {}).items() if key != "reason"}
    assert row == (expected or {"verdict": "same"}), verdict
    assert verdict.ticks > 400 or expected


@pytest.mark.parametrize("name", RUNS)
def test_it_opens_undamaged_and_tells_its_format(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in RUNS[name]:
        log = open_log(path)
        assert log.damage is None and log.unknown == () and len(log.ticks) > 100
    paths = [str(path) for path in RUNS[name]]
    assert main(["info", *paths, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["format"] >= 1 and found["written_by"].startswith("hil-drive ")
    assert (found["format"] == 1) == name.startswith("1a4c819/")


@pytest.mark.parametrize("name", RUNS)
def test_it_reports_and_exports(name: str, tmp_path: Path) -> None:
    paths = [str(path) for path in RUNS[name]]
    page, table = tmp_path / "page.html", tmp_path / "ticks.csv"
    assert main(["report", *paths, "-o", str(page)]) in (0, 1)
    assert "u_q" in page.read_text(encoding="utf-8")
    assert main(["export", *paths, "-o", str(table)]) == 0
    ticks = sum(len(open_log(path, frames=False).ticks) for path in RUNS[name])
    lines = [line for line in table.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    assert len(lines) == ticks + 1
