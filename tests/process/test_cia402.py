"""The loop over CANopen CiA 402 drives in lockstep: ours and one on strangers' stack; what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.runtime.setup import Overrides
from hil.signals import DriveState
from hil.sim.demo import emulator_process
from tests.canopen import NODE, PATIENT, durand_drive, recorded, run_config
from tests.process.test_run import call, flags

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
NMT, SYNC, RPDO = 0x000, 0x080, 0x200 + NODE
SHORT = (PATIENT, 'loop.clock="lockstep"', "loop.duration_s=1.6", "reference.at_s=0.05",
         "reference.rate_rad_s2=400.0", "reference.jerk_rad_s3=2e4", "reference.down_at_s=1.4")  # fmt: skip


@pytest.fixture
def path(configs: Path) -> Path:
    """The shipped config, its load step early, its motor the one that is believed in, without noise."""
    plant = configs / "plants" / "cia402.toml"
    text = plant.read_text(encoding="utf-8").replace("at_s = 2.5", "at_s = 0.7")
    text = text.replace("until_s = 4.5", "until_s = 1.2").replace("motors/bench", "motors/reconstruction")
    plant.write_text(text.replace("_rad_s = 0.01", "_rad_s = 0.0"), encoding="utf-8")
    return configs / "cia402.toml"


def refuses_to_run(path: Path, own: tuple[str, ...], channel: str) -> str:
    """What ``hil run`` says; neither NMT nor SYNC nor a command may be on the bus."""
    with recorded(channel) as frames:
        done = call("run", str(path), *flags(own))
    assert done.returncode == 2, done.stderr
    assert not {NMT, SYNC, RPDO} & {frame.arbitration_id for frame in frames}
    return done.stderr


def test_the_demo_closes_the_loop(path: Path, settings: Settings) -> None:
    """Set up, started by NMT, enabled, a load step of 5.4 N m, left: the estimate is within 2 % after N."""
    done = call("demo", str(path), "--json", *flags(settings(*SHORT)))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ended"] == "stop_requested" and result["replay"]["verdict"] == "same"
    assert result["estimate_error_after_n"] < 0.02 * abs(result["estimate_step_rad_s2"])
    assert 1.0 < result["dip_rad_s"] < 5.0
    log = open_log(Path(result["log"]))
    sent = [(frame.can_id, frame.data) for frame in log.frames if not frame.received]
    start, leave = (NMT, bytes((0x01, NODE))), (NMT, bytes((0x80, NODE)))
    assert sent[0] == start and sent[-1] == leave
    assert [one for one in sent if one[0] == NMT] == [start, leave]
    ticks = log.ticks
    assert np.isnan(ticks["i_d"]).all() and (ticks["drive_state"] == DriveState.OPERATION_ENABLED).any()


@pytest.mark.long
def test_a_drive_that_lost_its_mapping_is_found_before_arming(
    path: Path, settings: Settings, channel: str
) -> None:
    own = settings(*SHORT, "drive.heartbeat_timeout_s=2.0")
    with emulator_process(path, Overrides(settings=own)):
        said = refuses_to_run(path, own, channel)
        assert "the drive is not as hil configure sets it: 1400h:1 is 0x80000205" in said
        before = check(path, own)
        assert before["verdict"] == "fail" and "1A00h:2 is 0x0" in before["found"]
        done = call("configure", str(path), *flags(own))
        assert done.returncode == 0, done.stderr
        assert check(path, own)["verdict"] == "pass"
        ran = call("run", str(path), "--json", *flags(own))
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["ended"] == "stop_requested"


def check(path: Path, own: tuple[str, ...]) -> dict[str, str]:
    done = call("check", str(path), "--json", *flags(own))
    return next(row for row in json.loads(done.stdout)["rows"] if row["check"] == "canopen")


@pytest.mark.long
def test_a_drive_on_strangers_stack(configs: Path, settings: Settings, channel: str) -> None:
    """durand: set up by its own EDS, NMT, states, a load step, stop; the log replays to the bit."""
    path, eds = run_config(configs), configs / "durand.eds"
    own = settings(*SHORT, f'canopen.eds="{eds}"', "reference.w_rad_s=40.0")
    with durand_drive(channel, eds):
        made = call("configure", str(path), "--dbc", str(configs / "drives" / "cia402.dbc"), *flags(own))
        assert made.returncode == 0, made.stderr
        done = call("run", str(path), "--json", *flags(own))
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    assert result["ended"] == "stop_requested"
    ticks = open_log(Path(result["log"])).ticks
    settled = ticks[(ticks["k"] > 800) & (ticks["k"] < 950)]
    assert np.abs(settled["w"] - 40.0).max() < 0.5
    replayed = call("replay", result["log"])
    assert replayed.returncode == 0, replayed.stdout
