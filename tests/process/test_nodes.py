"""Two CiA 402 nodes on one bus and one emulated shaft: the dyno bench closed, a fault of one, SIGKILL."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.log.errors import LogError
from hil.log.reader import Log, open_log
from hil.runtime.setup import Overrides
from hil.signals import Controlword, DriveState, Reason, Request
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags, hil

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
NMT, SYNC, MOTOR, LOAD = 0x000, 0x080, 0x205, 0x206
SHORT = ("loop.duration_s=1.2", "drive.0.reference.at_s=0.05", "drive.0.reference.rate_rad_s2=400.0",
         "drive.0.reference.jerk_rad_s3=2e4", "drive.0.reference.w_rad_s=40.0",
         "drive.0.reference.down_at_s=100.0", "drive.1.controller.for_s=[0.5,0.4,100.0]")  # fmt: skip
LOCKSTEP = ('loop.clock="lockstep"', *SHORT)
OFF = struct.pack("<Hh", int(Controlword.QUICK_STOP), 0), struct.pack("<Hh", 0, 0)
"""A command without torque that ends operation."""


def demo(configs: Path, own: tuple[str, ...]) -> tuple[int, dict[str, Any]]:
    done = call("demo", str(configs / "dyno.toml"), "--json", *flags(own))
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def nodes_of(result: dict[str, Any]) -> tuple[Log, Log]:
    path = Path(result["log"])
    return open_log(path), open_log(path, node="load")


def test_the_bench_runs_and_replays(configs: Path, settings: Settings) -> None:
    """The motor holds its speed against the load machine's 5.4 N m, and both controllers replay."""
    code, result = demo(configs, settings(*LOCKSTEP))
    assert code == 0
    assert {name: node["ended"] for name, node in result["nodes"].items()} == dict.fromkeys(
        ("motor", "load"), "stop_requested"
    )
    assert {name: one["verdict"] for name, one in result["replay"]["nodes"].items()} == {
        "motor": "same", "load": "same"
    }  # fmt: skip
    motor, load = nodes_of(result)
    assert motor.damage is None and motor.nodes == ("motor", "load")
    assert (motor.ticks["k"] == load.ticks["k"]).all() and len(motor.ticks) == result["ticks"]
    pushed = (motor.ticks["k"] > 700) & (motor.ticks["k"] < 890)
    assert np.abs(motor.ticks["w"][pushed] - 40.0).max() < 0.3, "back at its speed under load"
    assert np.allclose(load.ticks["u_q"][pushed], -5.4, atol=0.01)
    told = motor.ticks["T_L_hat"][pushed] - motor.ticks["T_L_true"][pushed]
    assert np.abs(told).max() < 0.1 * 5.4, "its drive is off by 5 % in its torque constant"
    assert np.abs(load.ticks["w"][1:] - motor.ticks["w"][1:]).max() < 0.1, "one shaft"
    with pytest.raises(LogError, match="has no node 'other'; it has motor and load"):
        open_log(Path(result["log"]), node="other")
    assert open_log(Path(result["log"]), node="motor").ticks.tobytes() == motor.ticks.tobytes()
    assert_one_sync_a_tick(motor)


def assert_one_sync_a_tick(log: Log) -> None:
    """Start and leave of both nodes in the file's order; in operation SYNC, then each node's command."""
    sent = [(frame.can_id, frame.data) for frame in log.frames if not frame.received]
    nmt = [data for can_id, data in sent if can_id == NMT]
    assert nmt == [bytes(both) for both in ((1, 5), (1, 6), (0x80, 5), (0x80, 6))]
    assert [can_id for can_id, _ in sent[2:302]] == [SYNC, MOTOR, LOAD] * 100
    heard = [frame.can_id for frame in log.frames if frame.received]
    assert heard.count(0x185) == heard.count(0x186) == len(log.ticks), "each frame once"


@pytest.mark.parametrize(("faulty", "other"), [(1, 0), (0, 1)])
def test_a_fault_of_one_stops_all(configs: Path, settings: Settings, faulty: int, other: int) -> None:
    """The other one is stopped in the same tick, with a reason of its own; in the file's order."""
    code, result = demo(configs, settings(*LOCKSTEP, f"drive.{faulty}.limits.w_max_rad_s=30.0"))
    assert code == 1 and result["ended"] == "over_speed"
    names = ("motor", "load")
    assert result["nodes"][names[other]]["ended"] == "node_stopped"
    assert result["replay"]["verdict"] == "same"
    logs = nodes_of(result)
    reasons = (Reason.OVER_SPEED, Reason.NODE_STOPPED)
    firsts = [log.ticks[log.ticks["reason"] != 0][0] for log in (logs[faulty], logs[other])]
    assert [int(tick["reason"]) for tick in firsts] == [int(reason) for reason in reasons]
    k = int(firsts[0]["k"])
    assert int(firsts[1]["k"]) == k and int(firsts[1]["request"]) == Request.NODE_STOPPED
    assert [float(tick["u_q"]) for tick in firsts] == [0.0, 0.0]
    assert int(firsts[1]["state"]) == DriveState.QUICK_STOP_ACTIVE
    sent = [frame for frame in logs[0].frames if not frame.received and frame.t_ns == int(firsts[0]["t_ns"])]
    assert [(frame.can_id, frame.data) for frame in sent] == [(SYNC, b""), (MOTOR, OFF[0]), (LOAD, OFF[0])]
    assert {int(log.ticks["state"][-1]) for log in logs} <= {DriveState.FAULT, DriveState.SWITCH_ON_DISABLED}
    assert open_log(Path(result["log"]), node=names[other]).result["ended"] == "node_stopped"


def test_the_guardian_stops_both(configs: Path, settings: Settings, channel: str) -> None:
    """SIGKILL of the controller: without anybody's help both drives are commanded no torque and left."""
    path = configs / "dyno.toml"
    patient = ("loop.rate_hz=200", "drive.0.canopen.rpdo_timeout_ms=60000",
               "drive.1.canopen.rpdo_timeout_ms=60000", "drive.1.controller.for_s=[0.2,100.0,100.0]",
               "guardian.timeout_ms=5000", "loop.duration_s=100.0")  # fmt: skip
    own = settings(*SHORT[1:6], *patient)
    with emulator_process(path, Overrides(settings=own)):
        for name in ("motor", "load"):
            done = call("configure", str(path), *flags((*own, f'node="{name}"')))
            assert done.returncode == 0, done.stdout + done.stderr
        with (
            can.Bus(interface="hil-local", channel=channel) as bus,
            hil("run", str(path), *flags(own)) as run,
        ):
            await_torque(run, bus)
            run.send_signal(signal.SIGKILL)
            sent = until_left(bus)
    for command in (MOTOR, LOAD):
        assert sent[command][-1] == OFF[1], "torque 0, voltage off"
    assert set(sent[NMT]) == {bytes((0x80, 5)), bytes((0x80, 6))}


def await_torque(run: subprocess.Popen[str], bus: can.BusABC) -> None:
    """Wait until the load machine is commanded its torque: both drives are enabled then."""
    until = time.monotonic() + 90.0  # kernels may have to be compiled first
    while time.monotonic() < until and run.poll() is None:
        frame = bus.recv(0.5)
        if frame is not None and frame.arbitration_id == LOAD and struct.unpack("<Hh", frame.data)[1] < -100:
            return
    raise AssertionError(f"the run does not begin: {run.stderr.read() if run.poll() is not None else ''}")


def until_left(bus: can.BusABC) -> dict[int, list[bytes]]:
    """What the controller's side sends until both nodes are told to leave operation."""
    sent: dict[int, list[bytes]] = {NMT: [], SYNC: [], MOTOR: [], LOAD: []}
    until = time.monotonic() + 30.0
    while time.monotonic() < until and len(set(sent[NMT])) < 2:
        frame = bus.recv(0.5)
        if frame is not None and frame.arbitration_id in sent:
            sent[frame.arbitration_id].append(bytes(frame.data))
    return sent


def test_the_check_looks_at_both(configs: Path, settings: Settings) -> None:
    """Nobody has set the drives up: so says the check of each, and a run is refused."""
    path, own = configs / "dyno.toml", settings(*LOCKSTEP)
    with emulator_process(path, Overrides(settings=own)):
        done = call("check", str(path), "--json", *flags(own))
        ran = call("run", str(path), *flags(own))
    assert ran.returncode == 2 and "node motor: the drive is not as hil configure sets it" in ran.stderr
    rows = {row["check"]: row for row in json.loads(done.stdout)["rows"]}
    assert done.returncode == 1
    for name in ("motor", "load"):
        assert rows[f"{name}: canopen"]["verdict"] == "fail", "nobody has set it up"
    assert "motor RPDO1" in rows["bus load"]["found"] and "load RPDO1" in rows["bus load"]["found"]
    assert rows["bus load"]["found"].count("SYNC") == 1
