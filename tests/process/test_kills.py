"""A few of `make crash`: every victim once or twice."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT

pytestmark = [pytest.mark.process, pytest.mark.alone, pytest.mark.slow]


@pytest.mark.long
def test_every_kill_leaves_a_drive_at_rest_and_a_log() -> None:
    command = [sys.executable, "-m", "tests.crash.kills", "--kills", "8", "--delays", "10", "--seed", "7"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280, check=False)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "8 of 8 kills survived (controller 2, writer 2, emulator 2, guardian 2)" in done.stdout
    assert "first stop frame after SIGKILL: p50 " in done.stdout  # each under 2 ms, or the exit code is 1
    assert "of 10 kills" in done.stdout and "drive in watchdog fault: " in done.stdout
