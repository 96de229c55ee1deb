"""A host that can't hold the demo's rate: it says so and goes on in lockstep."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.log.reader import open_log
from tests.process.test_run import flags, wait_for_log

pytestmark = [pytest.mark.process, pytest.mark.alone]
Settings = Callable[..., tuple[str, ...]]


@pytest.mark.corners
@pytest.mark.parametrize("name", [(), ('log.name="mine"',)])
def test_it_goes_on_in_lockstep(
    configs: Path, settings: Settings, tmp_path: Path, name: tuple[str, ...]
) -> None:
    own = flags(settings("loop.duration_s=5.0", "reference.down_at_s=3.0", *name))
    command = [sys.executable, "-m", "hil.cli", "demo", str(configs / "demo.toml"), "--json", *own]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        first = wait_for_log(tmp_path)
        demo.send_signal(signal.SIGSTOP)  # what a host without time for it does, only longer
        time.sleep(1.0)
        demo.send_signal(signal.SIGCONT)
        out, err = demo.communicate(timeout=280)
    result = json.loads(out)
    assert demo.returncode == 0 and result["ended"] == "stop_requested", err
    assert result["clock"] == "lockstep" and result["replay"]["verdict"] == "same"
    assert result["too_slow"].startswith("this host can't hold 1000 Hz (") and result["too_slow"] in err
    assert "going on in lockstep" in err
    assert Path(result["log"]) != first and open_log(first).result["ended"] != "stop_requested"
    assert not name or Path(result["log"]).name == "mine-lockstep.mcap"
