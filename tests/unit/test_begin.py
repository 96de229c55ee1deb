"""What one needs once: hil init, hil completion, hil --version; and the one case of JSON keys."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from hil.cli import main
from hil.commands.begin import KINDS
from hil.commands.common import print_json
from hil.runtime.setup import Overrides, load_setup
from hil.sim.emulate import load_plant


@pytest.mark.parametrize("like", KINDS)
def test_a_copied_configuration_is_whole(
    tmp_path: Path, like: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine" / "first"
    assert main(["init", str(folder), "--like", like, "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    files = sorted(str(path) for path in folder.rglob("*") if path.is_file())
    assert made == {"config": str(folder / f"{like}.toml"), "files": files}
    setup = load_setup(Path(made["config"]), Overrides())
    assert setup.config.log.folder == "logs", "logs stay inside the new folder"
    if setup.config.emulator:
        load_plant(setup.path, setup.config, [])


def test_what_is_there_is_not_touched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "demo.toml").write_text("mine")
    (tmp_path / "file").write_text("")
    for folder in (tmp_path, tmp_path / "file", tmp_path / "file" / "below"):
        assert main(["init", str(folder)]) == 2
        assert capsys.readouterr().err.startswith(f"hil: {folder}: ")
    assert (tmp_path / "demo.toml").read_text() == "mine" and len(list(tmp_path.iterdir())) == 2


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and capsys.readouterr().out == f"hil {version('hil-drive')}\n"


def test_bash_completes_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    ask = '\nCOMP_WORDS=(hil {0}); COMP_CWORD={1}; _shtab_hil; printf "%s\\n" "${{COMPREPLY[@]}}"\n'
    for words, at, wanted in (("si", 1, "simulate"), ("run --sh", 2, "--shadow"), ("completion z", 2, "zsh")):
        done = subprocess.run(
            ["bash", "-c", script + ask.format(words, at)], capture_output=True, text=True, timeout=60
        )
        assert done.stdout.split() == [wanted], done.stderr
    for shell in ("zsh", "tcsh"):
        assert main(["completion", shell]) == 0
        assert "simulate" in capsys.readouterr().out


def test_json_has_names_in_one_case_and_keeps_what_is_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"T_L_hat": 1.0, "python-can": [{"N": 2}], "motor.R_s_ohm": 3, "logs/A.mcap": 4, "w": 5})
    assert json.loads(capsys.readouterr().out) == {
        "t_l_hat": 1.0, "python_can": [{"n": 2}], "motor.R_s_ohm": 3, "logs/A.mcap": 4, "w": 5,
    }  # fmt: skip
