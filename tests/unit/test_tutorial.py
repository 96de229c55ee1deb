"""docs/tutorial.md: the command line takes every command; those that need no kernel run as they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from hil.cli import _parser, main
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
COMMANDS = [
    line for block in re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()
]
RUN = ("hil init", "hil config")


def test_there_are_commands() -> None:
    assert len(COMMANDS) > 9 and sum(line.startswith(RUN) for line in COMMANDS) == 4


@pytest.mark.parametrize("line", COMMANDS)
def test_the_command_line_takes_it(line: str) -> None:
    program, *words = shlex.split(line)
    assert program == "hil" and callable(_parser().parse_args(words).run)


def test_what_needs_no_kernel_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert [main(shlex.split(line)[1:]) for line in COMMANDS if line.startswith(RUN)] == [0, 0, 0, 0]
    for name in ("demo.toml", "plants/demo.toml", "motors/bench.toml"):
        assert (tmp_path / "motor" / name).is_file() and name in PAGE


def test_the_row_of_faults_is_one() -> None:
    (row,) = re.findall(r'--only "([^"]+)"', PAGE)
    assert f'name = "{row}"' in (ROOT / "configs" / "faults.toml").read_text(encoding="utf-8")
