"""The quick start's second run: an emulator that has been run before, and stood idle, is run again."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from hil.log.reader import open_log
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Reason
from hil.sim.demo import emulator_process
from tests.process.test_run import Settings

pytestmark = pytest.mark.process


@pytest.mark.long
@pytest.mark.parametrize("stop", ["stop.ramp_rad_s2=0.0", "stop.ramp_max_s=5.0"])
def test_a_second_run_finds_the_drive_at_rest(configs: Path, settings: Settings, stop: str) -> None:
    """The first is cut while the load is on, with and without a ramp; then nobody commands the drive."""
    overrides = Overrides(settings=settings("loop.duration_s=2.8", stop))
    path = configs / "demo.toml"
    setup = load_setup(path, overrides)
    with emulator_process(path, overrides):
        first = run(setup)
        time.sleep(3.0)
        second = run(setup)
    for result in (first, second):
        assert Reason(result.outcome.reason) == Reason.STOP_REQUESTED
    ticks = open_log(Path(second.log)).ticks
    operating = ticks[ticks["state"] == DriveState.OPERATION_ENABLED]
    assert abs(operating["w"][0]) < 0.1 and operating["w"].max() > 75.0
    assert {int(state) for state in ticks["drive_state"][:1]} == {DriveState.SWITCH_ON_DISABLED}
