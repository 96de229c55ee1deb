"""A drive of another protocol by configuration alone: closed loop, replay, check, refusals, bytes by hand."""

from __future__ import annotations

import json
import os
import signal
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.bus import Frame
from drivers.codec import Database
from drivers.errors import DatabaseError
from firmware_model.config import PlantConfig, build_params, new_sample, new_state
from firmware_model.inverter import InverterFrames, int24
from firmware_model.kernels import Kernels
from firmware_model.plant import State
from hil.config.tables import load_toml
from hil.errors import ArmingError, ConfigError
from hil.log.reader import open_log
from hil.runtime.refusals import check_load
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Reason
from hil.sim.demo import emulator_process
from tests.conftest import CONFIGS
from tests.process.test_arming import Monitor, assert_silent, senders
from tests.process.test_run import call, flags, hil, only_log, wait_for_log

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
DEMAND = 0x98FF1100
NAME = "inverter.toml"


@pytest.fixture
def patient(configs: Path) -> Path:
    """The shipped config with a drive that is patient with a busy host."""
    plant = configs / "plants" / NAME
    text = plant.read_text(encoding="utf-8")
    plant.write_text(text.replace("watchdog_ms = 50.0", "watchdog_ms = 400.0"), encoding="utf-8")
    return configs / NAME


@pytest.mark.long
def test_it_settles_and_replays_to_the_bit(patient: Path, settings: Settings) -> None:
    own = settings("loop.duration_s=4.0", "reference.at_s=0.1")
    done = call("demo", str(patient), "--json", *flags(own))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ended"] == "stop_requested" and result["replay"]["verdict"] == "same"
    ticks = open_log(Path(result["log"])).ticks
    before, after = (ticks[(ticks["k"] > k - 400) & (ticks["k"] < k)] for k in (2300, 4000))
    assert np.abs(before["w"] - 80.0).max() < 1.0
    assert np.abs(after["w"] - 80.0).max() < 1.0, "the load step did not come back"
    assert after["T_L_true"].mean() - before["T_L_true"].mean() == pytest.approx(5.4, abs=0.01)


def test_a_drive_that_dies_stops_the_run(patient: Path, settings: Settings) -> None:
    own = settings("loop.duration_s=60.0", "drive.heartbeat_timeout_s=10.0")
    with (
        emulator_process(patient, Overrides(settings=own)) as pid,
        hil("run", str(patient), "--json", *flags(own)) as process,
    ):
        wait_for_log(patient.parent.parent)
        os.kill(pid, signal.SIGKILL)
        out, errors = process.communicate(timeout=60)
    assert process.returncode == 1, errors
    ended = json.loads(out)["ended"]
    assert Reason[ended.upper()] not in (Reason.STOP_REQUESTED, Reason.QUICK_STOP_REQUESTED), ended


@pytest.mark.long
def test_a_shadow_beside_a_controller_sends_nothing_and_computes_the_same(
    patient: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    """Without an echo the shadow takes the newest command that it saw for what is applied."""
    own = settings("loop.duration_s=300.0", "reference.down_at_s=290.0", "drive.heartbeat_timeout_s=10.0")
    folder = tmp_path / "shadow"
    its = (*own, f'log.folder="{folder / "logs"}"', "loop.duration_s=2.0")
    monitor = Monitor(channel)
    with (
        emulator_process(patient, Overrides(settings=own)),
        hil("run", str(patient), *flags(own)) as master,
    ):
        wait_for_log(tmp_path)
        before = senders(monitor.count(0.5))
        with hil("run", str(patient), "--shadow", *flags(its)) as shadow:
            during: Counter[tuple[int, int]] = Counter()
            while shadow.poll() is None:
                during += monitor.count(0.2)
            assert shadow.returncode == 0, shadow.communicate()
        during += monitor.count(0.2)
        master.send_signal(signal.SIGTERM)
        assert master.wait(30) == 0
    monitor.close()
    assert len(before) == 2 and senders(during) == before, "a third one sent something"
    assert_silent(only_log(folder), least=1000)


@pytest.mark.long
def test_check_sees_it_by_its_own_names(patient: Path, settings: Settings) -> None:
    own = settings("drive.heartbeat_timeout_s=1.0")
    with emulator_process(patient, Overrides(settings=own)):
        done = call("check", str(patient), "--json", *flags(own))
    rows = {r["check"]: r for r in json.loads(done.stdout)["rows"]}
    assert "MotorState" in rows["drive"]["found"] and "Supply" in rows["drive"]["found"]
    for name in (
        "drive",
        "frames",
        "other controller",
        "drive state",
        "speed and current",
        "supply and heat",
    ):
        assert rows[name]["verdict"] == "pass", rows[name]
    assert "protocol version" not in rows


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("drive.signals.speed='MotorState.Speeed'", "speed: "),
        ("drive.signals.i_q='MotorState.Rpm'", "give it one of A, mA"),
        ("drive.signals.sped='MotorState.Rpm'", "sped: unknown"),
        ("loop.rate_hz=2000", "comes every 1 ms by the DBC"),
    ],
)
def test_each_mistake_of_the_map_is_one_clear_line(more: str, words: str) -> None:
    with pytest.raises(DatabaseError) as caught:
        load_setup(CONFIGS / NAME, Overrides(settings=(more,)))
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_wrong_map_ends_with_exit_code_2(settings: Settings) -> None:
    done = call("run", str(CONFIGS / NAME), *flags(settings("drive.signals.u_q='Demand.On'")))
    assert done.returncode == 2 and "Traceback" not in done.stderr and "u_q: Demand.On" in done.stderr


@pytest.mark.parametrize("more", ['loop.pacing="sync"', 'loop.clock="lockstep"'])
def test_without_sync_it_is_not_paced_by_it(more: str) -> None:
    with pytest.raises(ConfigError, match="SYNC"):
        load_setup(CONFIGS / NAME, Overrides(settings=(more,)))


@pytest.mark.parametrize(("bitrate", "refused"), [(1_000_000, False), (125_000, True)])
def test_a_real_bus_is_not_overloaded(bitrate: int, refused: bool) -> None:
    real = ('bus.interface="slcan"', f"bus.bitrate={bitrate}", 'loop.pacing="feedback"')
    setup = load_setup(CONFIGS / NAME, Overrides(settings=real))
    if not refused:
        return check_load(setup)
    with pytest.raises(ArmingError, match=r"MotorState \d+ %.*nothing was sent.*under 70 %"):
        run(setup, arm=True)
    return None


def demand(data: bytes, can_id: int = DEMAND, *, fd: bool = True) -> Frame:
    return Frame(can_id & 0x1FFFFFFF, data, can_id & 0x80000000, fd)


def test_bytes_by_hand() -> None:
    """u_q 100 V = 100000 = 0x0186A0, u_d -1 V = 0xFFFC18, on, key 90, alive 5."""
    plant = load_toml(CONFIGS / "plants" / NAME, PlantConfig, [])
    frames = InverterFrames(truth=False)
    params = build_params(plant, frames.wire)
    drive = Kernels(params, new_state(params, 15), new_sample())
    good = bytes.fromhex("0186A0 FFFC18 80 5A 50 000000")
    command = Database(CONFIGS / "drives" / "inverter_fd.dbc", 1).message("Demand")
    values = {"Uq": 100.0, "Ud": -1.0, "On": 1, "ClearFault": 0, "Key": 90, "Alive": 5}
    assert command.encode(values) == good and command.send_id == DEMAND
    refused = {
        "length": demand(good[:8], fd=False),
        "key": demand(good[:7] + b"\x5b" + good[8:]),
    }
    for name, frame in refused.items():
        frames.take(frame, drive, lambda: None)
        assert frames.ignored == {name: 1}, name
        frames.ignored.clear()
    fed: list[int] = []
    frames.take(demand(good), drive, lambda: fed.append(1))
    frames.take(demand(good), drive, lambda: fed.append(1))  # stale: the same alive counter
    frames.take(demand(good, 0x98FF1101), drive, lambda: fed.append(1))
    assert fed == [1] and frames.ignored == {"repeated": 1}
    assert drive.state["state"] == State.SWITCH_ON_DISABLED
    assert (int24(1e9), int24(-1.0)) == (b"\x7f\xff\xff", b"\xff\xff\xff")
