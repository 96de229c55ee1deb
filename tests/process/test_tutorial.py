"""docs/tutorial.md: every command of it runs as it stands, in an empty folder."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from hil.cli import main
from tests.unit.test_tutorial import COMMANDS

pytestmark = pytest.mark.process


@pytest.mark.long
@pytest.mark.timeout(900)  # it begins with kernels that may have to be compiled
def test_every_command_of_the_tutorial_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for line in COMMANDS:
        assert main(shlex.split(line)[1:]) == 0, f"{line}\n{capsys.readouterr()}"
    assert (tmp_path / "motor" / "first.html").stat().st_size > 100_000
    assert (tmp_path / "motor" / "design.toml").read_text(encoding="utf-8").startswith("[controller]")
