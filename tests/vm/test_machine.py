"""The bench machine itself: what a command finds there when it has gone on from the image."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.vm.conftest import REQUIRED
from tests.vm.machine import ROOT, missing_packages, run_in_machine

pytestmark = [pytest.mark.vm, pytest.mark.timeout(900)]


@pytest.fixture(autouse=True)
def _needs() -> None:
    if missing_packages() and not REQUIRED:
        pytest.skip(f"no bench machine: apt-get install {' '.join(missing_packages())}")


def test_a_command_runs_in_the_tree_at_the_hosts_time(tmp_path: Path) -> None:
    """The clock is the host's when the machine wakes; the code is the command's, its output apart."""
    begin = time.time()
    script = "date +%s; pwd; ip -br link show vcan0; echo said >&2; exit 7"
    result = run_in_machine(["bash", "-c", script], out=tmp_path)
    seconds, folder, link = result.stdout.splitlines()
    assert (result.returncode, result.stderr) == (7, "said\n")
    assert folder == str(ROOT) and link.startswith("vcan0")
    assert -1.0 < float(seconds) - begin < 3600.0


def test_python_begins_with_the_packages_imported_and_the_tree_as_it_is(tmp_path: Path) -> None:
    """A file that was written after the image was made is read; the packages are there before any import."""
    (tmp_path / "look.py").write_text(
        "import sys\nbefore = set(sys.modules)\nimport can, hil.cli, probe\n"
        "print('numba' in before, 'can' in before, 'hil' in before, probe.SAYS)\n"
    )
    (tmp_path / "probe.py").write_text(f"SAYS = {str(tmp_path)!r}\n")
    result = run_in_machine(["python", str(tmp_path / "look.py")])
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["True", "True", "False", str(tmp_path)]
