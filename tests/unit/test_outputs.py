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

from hil.cli import main
from hil.commands.common import output_folder
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
