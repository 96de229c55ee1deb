"""A wheel, installed without its source tree, runs the demo in an empty folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests.conftest import ROOT

pytestmark = [pytest.mark.process, pytest.mark.slow]

SOURCES = ("hil", "drivers", "firmware_model", "configs", "pyproject.toml", "README.md", "LICENSE")


def run(*command: str | Path, cwd: Path) -> str:
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=cwd, env=inherited, capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with the wheel; the packages that it needs are those of the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in SOURCES:  # a build leaves a folder in the tree, and what stands there in the next wheel
        path = ROOT / name
        shutil.copytree(path, folder / "tree" / name) if path.is_dir() else shutil.copy(path, folder / "tree")
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, "./tree", cwd=folder)
    venv.create(folder / "env", symlinks=True)
    place = sysconfig.get_path("purelib", vars={"base": str(folder / "env"), "platbase": str(folder / "env")})
    (Path(place) / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (wheel,) = folder.glob("*.whl")
    python = folder / "env" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--force-reinstall", wheel, cwd=folder)
    return folder / "env"


@pytest.mark.long
def test_the_demo_runs_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    where = run(installed / "bin" / "python", "-c", "import hil; print(hil.__file__)", cwd=tmp_path)
    assert Path(where).is_relative_to(installed)
    found = json.loads(run(installed / "bin" / "hil", "demo", "--lockstep", "--json", cwd=tmp_path))
    assert found["ended"] == "stop_requested"
    assert found["replay"]["verdict"] == "same"
    assert Path(found["log"]).is_relative_to(tmp_path / "logs")
