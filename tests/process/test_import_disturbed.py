"""A run whose controller or drive is stopped at random (SIGSTOP) comes back from its recording."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hil.exchange.export import export
from hil.exchange.importing import OURS, import_recording
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.setup import Overrides
from hil.signals import FIELDS, DriveState, RxFlag
from hil.sim.demo import emulator_process
from tests.conftest import CONFIGS

pytestmark = pytest.mark.process

NOT_ON_THE_WIRE = {"t_ns", "lateness_ns", "received_ns", "computed_ns", "sent_ns", "recorded_ns", "check"}
"""Times, and the check that a record carries over all its fields, these included; replay judges that."""
ESTIMATES = {"d_hat_w", "d_hat_q", "d_hat_d", "T_L_hat", "filled"}
RUN = """
import json, sys
from pathlib import Path
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
print(json.dumps(run(load_setup(Path(sys.argv[1]), Overrides(settings=tuple(sys.argv[2:])))).log))
"""
STOPS = """
import os, random, signal, sys, time
pid, until = int(sys.argv[1]), time.monotonic() + 60
random.seed(sys.argv[2])
while time.monotonic() < until:
    time.sleep(random.uniform(0.005, 0.08))
    os.kill(pid, signal.SIGSTOP)
    time.sleep(random.choice([0.0005, 0.001, 0.002, 0.005, 0.02, 0.04]))
    os.kill(pid, signal.SIGCONT)
"""


@contextlib.contextmanager
def stopped_at_random(pid: int, seed: str) -> Iterator[None]:
    """Another process stops that one for 0.5 to 40 ms, again and again."""
    helper = subprocess.Popen([sys.executable, "-c", STOPS, str(pid), seed], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        helper.kill()
        helper.wait()
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


@pytest.mark.long
@pytest.mark.parametrize("who", ["controller", "drive"])
@pytest.mark.parametrize("name", ["demo.toml", "inverter.toml"])
def test_a_run_that_was_stopped_again_and_again_comes_back(tmp_path: Path, name: str, who: str) -> None:
    """Skipped periods, waits in vain and queued feedback, with SYNC and without.

    Where no command depends on it, the wire does not tell when a period was skipped: k is asked for at the
    measurements that the controller took while it operated, and the estimates that rest on it while it did.
    """
    shutil.copytree(CONFIGS, tmp_path / "configs")
    path = tmp_path / "configs" / name
    settings = (
        f'bus.channel="stopped-{name}-{who}"', f'log.folder="{tmp_path / "logs"}"', "loop.duration_s=2.0",
        "realtime.lock_memory=false", "feedback.hold_ticks=150", "feedback.quick_stop_ticks=200",
        "loop.max_gap_ticks=64",
    )  # fmt: skip
    with emulator_process(path, Overrides(settings=settings), ("firmware.watchdog_ms=400.0",)) as drive:
        run = subprocess.Popen(
            [sys.executable, "-c", RUN, str(path), *settings], stdout=subprocess.PIPE, start_new_session=True
        )
        with stopped_at_random(run.pid if who == "controller" else drive, f"{name} {who}"):
            out, _ = run.communicate(timeout=100)
    log = Path(json.loads(out))
    export(log, tmp_path / "a.log")
    found = import_recording(tmp_path / "a.log", tmp_path / "back.mcap", path, settings)
    assert found.commands == OURS, found
    a, b = open_log(log).ticks, open_log(tmp_path / "back.mcap").ticks
    assert a["skipped"].sum() > 20 or (a["rx_flags"] & RxFlag.FRESH == 0).sum() > 20, "it was disturbed"
    assert len(a) == len(b) > 500
    operating = a["state"] == DriveState.OPERATION_ENABLED
    for field in {field.name for field in FIELDS} - NOT_ON_THE_WIRE - {"k", "gap", "skipped"}:
        rows = operating if field in ESTIMATES else slice(None)
        assert a[field][rows].tobytes() == b[field][rows].tobytes(), field
    taken = operating & (a["rx_flags"] & RxFlag.FRESH > 0)
    assert taken.sum() > 300
    assert len(np.unique(a["k"][taken].astype(int) - b["k"][taken].astype(int))) == 1
    assert replay(tmp_path / "back.mcap").verdict == "same"
