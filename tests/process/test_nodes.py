"""Two CiA 402 nodes on one bus and one emulated shaft: the dyno bench closed, a fault of one, SIGKILL."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.cli import main
from hil.log.errors import LogError
from hil.log.reader import Log, open_log
from hil.replay import replay
from hil.runtime.registry import matching
from hil.runtime.setup import Overrides
from hil.signals import Controlword, DriveState, Reason, Request
from hil.sim.demo import emulator_process
from hil.watch.look import Look
from tests.process.test_run import call, flags, hil
from tests.process.test_set import wait_for_operation

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


@pytest.mark.long
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


@pytest.mark.corners
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


@pytest.mark.long
def test_the_second_node_s_reference_is_set_while_it_runs(
    configs: Path, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The motor as the file's second entry: its reference moves, in its own ticks alone, and replays."""
    text = (configs / "dyno.toml").read_text(encoding="utf-8")
    head, motor, load = text.split("[[drive]]")
    path = configs / "swapped.toml"
    path.write_text("[[drive]]".join((head, load, motor)), encoding="utf-8")
    own = settings(
        "loop.rate_hz=200", "loop.duration_s=120.0", "drive.0.controller.for_s=[100.0,0.1,0.1]",
        "drive.1.reference.down_at_s=100.0", "drive.1.setpoint.rate_rad_s2=100.0",
        *(f"drive.{node}.canopen.rpdo_timeout_ms=60000" for node in (0, 1)),
    )  # fmt: skip
    with emulator_process(path, Overrides(settings=own)):
        for name in ("load", "motor"):
            done = call("configure", str(path), *flags((*own, f'node="{name}"')))
            assert done.returncode == 0, done.stdout + done.stderr
        with hil("run", str(path), *flags(own)) as run:
            wait_for_operation(run)
            done = call("set", "w=40", str(run.pid), "--node", "motor", "--json")
            assert done.returncode == 0, done.stderr
            told = json.loads(done.stdout)
            assert (told["node"], told["set"], told["rate"]) == ("motor", {"w": 40.0}, {"w": 100.0})
            for words, said in (
                (["w=1", "--node", "brake"], "has no node 'brake'; it has load and motor; nothing was set"),
                (["w=400", "--node", "motor"], "node motor of PID"),
                (["w=1", "--node", "load"], "this run takes no set-point"),
                (["w=1"], "this run takes no set-point"),
            ):
                assert main(["set", *words, "--run", str(run.pid)]) == 2
                refused = capsys.readouterr().err
                assert said in refused and len(refused.splitlines()) == 1, refused
            time.sleep(1.5)
            (entry,) = matching(str(run.pid))
            for node, said in (
                ("motor", "set: w = 30 rad/s"),
                ("load", "refused: this run takes no set-point"),
            ):
                with closing(Look(entry, node)) as look:  # as the live page's button
                    assert look.set({"w": 30.0}, "a page") == said
            time.sleep(0.3)
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=60)
            assert run.returncode == 0
    (log_path,) = tmp_path.rglob("*.mcap")
    motor_log, load_log = open_log(log_path, node="motor"), open_log(log_path)
    assert (motor_log.ticks["w_ref"] == 40.0).sum() > 100 and (load_log.ticks["w_ref"] == 0.0).all()
    assert np.abs(motor_log.ticks["w"] - 40.0).min() < 0.5
    set_points = [event["text"] for event in load_log.events if event["kind"] == "set-point"]
    assert [text.partition(", PID")[0] for text in set_points] == [
        "motor: w = 40 rad/s: taken, asked by hil set", "motor: w = 30 rad/s: taken, asked by a page",
    ]  # fmt: skip
    assert {name: one.verdict for name, one in replay(log_path).nodes.items()} == {
        "load": "same", "motor": "same"
    }  # fmt: skip


@pytest.mark.long
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


@pytest.mark.long
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
