"""Where a command writes its results: refused before the work when it can't; with the user's own rights."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hil.campaign.store import Folder, make
from hil.cli import main
from hil.log.outputs import output_folder
from tests.conftest import CONFIGS
from tests.logfiles import some_frames, some_ticks, write_log

CASES = {
    "no folder for the page": (["faults", "--html", "none/page.html"], "no such folder"),
    "a folder for the page": (["faults", "--html", "."], "is a folder"),
    "no folder for the verdicts": (["replay", "run.mcap", "--junit", "none/verdicts.xml"], "no such folder"),
    "a file for the bench's folder": (["bench", "-o", "file"], "can't be made: File exists"),
    "a file above the paper's folder": (["paper", "-o", "file/paper"], "can't be made: Not a directory"),
}


@pytest.mark.parametrize("case", list(CASES))
def test_what_can_not_be_written_is_refused_at_once(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    words, said = CASES[case]
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    assert main(words) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "another" in error
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_results_folder_has_the_rights_that_the_umask_gives(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        output_folder(tmp_path / "a" / "b")
    finally:
        os.umask(before)
    assert [(tmp_path / name).stat().st_mode & 0o777 for name in ("a", "a/b")] == [0o750, 0o750]


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["bench", "-o", "out"], "bench.html"),
        (["bench", "-o", "out"], "lateness.png"),
        (["paper", "-o", "out"], "paper.html"),
        (["compare", str(CONFIGS / "demo.toml"), "-o", "out"], "compare.html"),
    ],
)
def test_a_log_in_a_results_folder_is_not_written_over(
    words: list[str], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    write_log(Path("out") / name, some_ticks(10), some_frames(0))
    before = (Path("out") / name).read_bytes()
    assert main(words) == 2
    assert "holds a log; name another" in capsys.readouterr().err
    assert (Path("out") / name).read_bytes() == before and len(list(Path("out").iterdir())) == 1


PLAN = f"""
config = "{CONFIGS / "demo.toml"}"
set = ["loop.duration_s=0.05"]
[grid]
"controller.speed_pole_rad_s" = [20.0, 30.0]
"""


def test_a_campaign_writes_over_nothing_of_another_kind(tmp_path: Path, capsys: Any) -> None:
    """Its page over a log, its rows over rows: both were possible on going on."""
    plan, out = tmp_path / "few.toml", tmp_path / "out"
    plan.write_text(PLAN)
    words = ["campaign", str(plan), "-o", str(out), "-j", "0", "--json"]
    assert main(words) == 0
    (out / "report.html").unlink()
    write_log(out / "report.html", some_ticks(10), some_frames(0))
    before = (out / "report.html").read_bytes()
    assert main([*words, "--resume"]) == 2
    assert "holds a log; name another" in capsys.readouterr().err
    assert (out / "report.html").read_bytes() == before
    (tmp_path / "file").write_text("mine")
    assert main(["campaign", str(plan), "-o", str(tmp_path / "file"), "-j", "0"]) == 2
    assert (tmp_path / "file").read_text() == "mine"


def test_a_part_that_was_removed_leaves_the_others(tmp_path: Path) -> None:
    folder = make(tmp_path / "out", {"schema": {"case": "i8"}, "count": 4}, (), resume=False)
    for case in range(3):
        folder.add([{"case": case}])
        folder.flush()
    folder.parts()[0].unlink()
    again = Folder(folder.path, folder.about)
    again.add([{"case": 0}])
    again.flush()
    assert again.done().tolist() == [True, True, True, False]


@pytest.mark.process
@pytest.mark.parametrize("words", [["info", "long.mcap", "--json"], ["--help"], ["replay", "--help"]])
def test_a_reader_that_leaves_ends_a_command_quietly(words: list[str], tmp_path: Path) -> None:
    """As `hil ... | head` does."""
    write_log(tmp_path / "long.mcap", some_ticks(100), some_frames(0))
    reading, writing = os.pipe()
    os.close(reading)
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", "hil.cli", *words],
            cwd=tmp_path, env=buffered, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60,
            check=False,
        )  # fmt: skip
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.corners
@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_an_export_that_is_ended_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    log, out = tmp_path / "long.mcap", tmp_path / "out"
    write_log(log, some_ticks(200_000), some_frames(0), block=2000)
    out.mkdir()
    export = subprocess.Popen(
        [sys.executable, "-m", "hil.cli", "export", str(log), "-o", str(out / "long.csv")],
        stderr=subprocess.PIPE,
    )
    end = time.monotonic() + 60.0
    while not list(out.iterdir()) and time.monotonic() < end:
        time.sleep(0.002)
    assert [path.name for path in out.iterdir()] == [".long.csv.part.csv"]
    export.send_signal(number)
    export.communicate(timeout=60)
    assert export.returncode == {signal.SIGTERM: 143, signal.SIGINT: 130}[number]
    assert not list(out.iterdir())
