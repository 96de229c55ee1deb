"""`hil set` and the ramp before a stop, with real processes: what is taken, refused, logged and replayed."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from hil.cli import main
from hil.log.reader import Log, open_log
from hil.replay import replay
from hil.runtime.registry import matching
from hil.runtime.setup import Overrides
from hil.signals import DriveState, Reason, Request
from hil.sim.demo import emulator_process
from hil.watch.look import Look
from tests.process.test_run import Settings, call, flags, hil, only_log, wait_for_log

pytestmark = pytest.mark.process


def wait_for_operation(process: subprocess.Popen[str]) -> None:
    """Until the run is announced and its drive enabled."""
    for _ in range(1200):
        for entry in matching(str(process.pid)):
            with closing(Look(entry)) as look:
                newest = look.latest(1)
            if len(newest) and newest["state"][-1] == DriveState.OPERATION_ENABLED:
                return
        time.sleep(0.05)
    raise AssertionError("the run does not operate")


def events(log: Log, kind: str) -> list[str]:
    return [event["text"] for event in log.events if event["kind"] == kind]


def test_a_run_takes_what_its_law_and_range_allow_and_says_no_to_the_rest(
    configs: Path, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = settings("loop.duration_s=120.0", "setpoint.rate_rad_s2=100.0", 'loop.clock="realtime"')
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_operation(process)
        done = call("set", "w=40", str(process.pid), "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout) == {
            "pid": process.pid, "log": str(only_log(tmp_path)), "set": {"w": 40.0}, "rate": {"w": 100.0},
        }  # fmt: skip
        for words, said in (
            (["w=400"], "out of range: -135 to 135"),
            (["w=nan"], "out of range"),
            (["i_q=1"], "this run's law takes w, not i_q"),
            (["w=fast"], "is not a number"),
            (["w=1", "w=2"], "given twice"),
            (["12"], "say what to set"),
        ):
            assert main(["set", *words, "--run", str(process.pid)]) == 2
            refused = capsys.readouterr().err
            assert said in refused and len(refused.splitlines()) == 1
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        assert process.returncode == 0
    log = open_log(only_log(tmp_path))
    assert len(events(log, "set-point")) == 1 and "w = 40 rad/s: taken" in events(log, "set-point")[0]
    assert (log.ticks["w_ref"] == 40.0).sum() > 100 and replay(log.path).verdict == "same"
    assert log.ticks["request"][log.ticks["reason"] != 0][0] == Request.STOP
    assert events(log, "ramp-down")


def test_without_a_run_and_with_two_it_is_said(configs: Path, settings: Settings) -> None:
    if matching(None):
        pytest.skip("another run of this user is running")
    refused = call("set", "w=60")
    assert refused.returncode == 2 and "no run of this user is running" in refused.stderr


@pytest.mark.long
def test_a_second_ctrl_c_cuts_the_ramp(configs: Path, settings: Settings, tmp_path: Path) -> None:
    own = settings("loop.duration_s=120.0", "stop.ramp_rad_s2=10.0", "stop.ramp_max_s=60.0")
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_log(tmp_path)
        time.sleep(1.5)
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    log = open_log(only_log(tmp_path))
    down = log.ticks["request"] == Request.RAMP_DOWN
    assert down.sum() > 20 and (np.diff(np.abs(log.ticks["w_ref"][down])) <= 0).all()
    assert Reason[log.result["ended"].upper()] == Reason.QUICK_STOP_REQUESTED
    stopped = log.ticks[log.ticks["reason"] != 0]
    assert (stopped["u_q"] == 0).all() and replay(log.path).verdict == "same"
