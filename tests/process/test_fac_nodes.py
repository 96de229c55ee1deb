"""One law over two CiA 402 nodes on one emulated shaft: the load machine's torque holds the speed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.log.reader import Log, open_log
from hil.signals import Reason
from tests.process.test_nodes import LOAD, MOTOR, OFF, SYNC
from tests.process.test_run import call, flags

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
LOCKSTEP = ('loop.clock="lockstep"', "loop.duration_s=1.2")
MOVING = 'reference={kind="ramp", w_rad_s=40.0, rate_rad_s2=400.0, at_s=0.05, i_q_a=1.5}'
K_T = 3.6
"""Torque constant of the motors that both believe in [N m/A]."""


def bench(configs: Path, load_first: bool = False) -> Path:
    """`configs/dyno-fac.toml` with its load step at 0.5 s; ``load_first``: the entries exchanged."""
    plant = configs / "plants" / "dyno-fac-motor.toml"
    plant.write_text(
        plant.read_text(encoding="utf-8").replace("2.5", "0.5").replace("4.5", "0.9"), encoding="utf-8"
    )
    path = configs / "dyno-fac.toml"
    if load_first:
        head, motor, load = path.read_text(encoding="utf-8").split("[[drive]]")
        path.write_text("[[drive]]".join((head, load, motor)), encoding="utf-8")
    return path


def demo(path: Path, own: tuple[str, ...]) -> tuple[int, dict[str, Any]]:
    done = call("demo", str(path), "--json", *flags(own))
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def nodes_of(result: dict[str, Any]) -> tuple[Log, Log]:
    return tuple(open_log(Path(result["log"]), node=name) for name in ("motor", "load"))  # type: ignore[return-value]


@pytest.mark.long
@pytest.mark.parametrize("motor_at", [0, 1])
def test_one_law_commands_both(configs: Path, settings: Settings, motor_at: int, tmp_path: Path) -> None:
    """The speed is held against a load that nobody tells of, by the load machine; i_q stays what is asked."""
    path = bench(configs, load_first=motor_at == 1)
    code, result = demo(path, settings(*LOCKSTEP, f"drive.{motor_at}.{MOVING}"))
    assert code == 0 and {node["ended"] for node in result["nodes"].values()} == {"stop_requested"}
    assert {name: one["verdict"] for name, one in result["replay"]["nodes"].items()} == {
        "motor": "same", "load": "same"
    }  # fmt: skip
    first, second = nodes_of(result)
    motor, load = first.ticks, second.ticks
    asked = -motor["T_L"] / K_T
    assert load["i_q_ref_in"].tobytes() == (0.0 + asked).tobytes(), "told in the same tick"
    assert motor["T_L_in"].tobytes() == (0.0 - K_T * load["i_q"]).tobytes(), "its own measurement"
    assert np.array_equal(motor["T_L_sent"][400:], -load["u_q"][399:-1]), "what it has latched"
    step = int(np.argmax(np.diff(motor["T_L_true"] - motor["T_L_in"]))) + 1
    before, after = slice(step - 100, step), slice(step + 100, step + 300)
    assert np.abs(motor["w"][step : step + 50] - 40.0).max() < 1.7, "the dip"
    assert np.abs(motor["w"][after] - 40.0).max() < 0.1
    assert np.abs(motor["i_q"][after] - 1.5).max() < 0.02, "the load step is none of the drive under test's"
    moved = motor["T_L"][before].mean() - motor["T_L"][after].mean()
    assert moved == pytest.approx(5.4 / 0.95, rel=0.02), "by its torque constant, which is 5 % off"
    told = motor["T_L_hat"][after].mean() - motor["T_L_hat"][before].mean()
    assert abs(told) < 0.05, "the shaft is loaded as before: what the machine gives less the load gives"
    sent = [frame.can_id for frame in first.frames if not frame.received]
    order = [SYNC, LOAD, MOTOR] if motor_at else [SYNC, MOTOR, LOAD]
    assert sent[2:302] == order * 100, "commanded in the file's order, whoever commands"


@pytest.mark.long
@pytest.mark.parametrize(("faulty", "other"), [(1, 0), (0, 1)])
def test_a_fault_of_one_stops_both(configs: Path, settings: Settings, faulty: int, other: int) -> None:
    """Also where the law that commands both is the other one's: neither has a torque from that tick on."""
    own = (*LOCKSTEP, f"drive.0.{MOVING}", f"drive.{faulty}.limits.w_max_rad_s=30.0")
    code, result = demo(bench(configs), settings(*own))
    assert code == 1 and result["ended"] == "over_speed" and result["replay"]["verdict"] == "same"
    assert result["nodes"][("motor", "load")[other]]["ended"] == "node_stopped"
    logs = nodes_of(result)
    firsts = [log.ticks[log.ticks["reason"] != 0][0] for log in logs]
    assert {int(tick["reason"]) for tick in firsts} == {Reason.OVER_SPEED, Reason.NODE_STOPPED}
    assert firsts[0]["k"] == firsts[1]["k"]
    assert [float(tick["u_q"]) for tick in firsts] == [0.0, 0.0] and float(firsts[0]["T_L"]) == 0.0
    sent = [f for f in logs[0].frames if not f.received and f.t_ns == int(firsts[0]["t_ns"])]
    assert [(f.can_id, f.data) for f in sent] == [(SYNC, b""), (MOTOR, OFF[0]), (LOAD, OFF[0])]


@pytest.mark.long
def test_a_limit_of_the_load_machine_is_told(configs: Path, settings: Settings) -> None:
    """Its guard cuts off what its limits no longer allow: the law is told what it gives, and flags it."""
    own = (*LOCKSTEP, f"drive.0.{MOVING}", "drive.0.limits.T_L_max_n_m=2.0")
    code, result = demo(bench(configs), settings(*own))
    assert code == 1 and result["ended"] == "following_error", "1.5 A against 2 N m: the speed runs away"
    motor, load = (log.ticks for log in nodes_of(result))
    assert np.abs(motor["T_L"]).max() == 2.0 and np.abs(load["u_q"]).max() <= 2.0
    assert result["replay"]["verdict"] == "same"
    end = int(np.argmax(motor["reason"] != 0))
    assert (motor["T_L"][end - 40 : end] == 2.0).all() and (motor["guard_flags"][end - 40 : end] != 0).all()
    as_load = np.abs(motor["d_hat_w"][end - 10 : end] * 0.022).max()
    assert as_load < 0.7, "of 3.4 N m that are cut off none is a load: k_t and J are 5 and 15 % off"


@pytest.mark.long
@pytest.mark.slow
def test_what_if_report_and_export_have_both(
    configs: Path, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, own = bench(configs), settings(*LOCKSTEP, f"drive.0.{MOVING}")
    _, result = demo(path, own)
    log = result["log"]
    assert main(["replay", log, "--config", str(path), "--json"]) == 0
    rows = {name: one["rows"] for name, one in json.loads(capsys.readouterr().out)["nodes"].items()}
    for name in ("motor", "load"):
        found = {row["signal"]: row for row in rows[name]}
        assert found["i_q_ref"]["max"] == 0.0 and found["i_q_ref"]["ticks"] > 1000, "the same controller"
        assert found["d_hat_w"]["rms"] < 0.1
    for words, said in (
        (["-o", str(tmp_path / "x.mcap")], "has 2 nodes, -o takes one's ticks; leave it out"),
        ([], ""),
    ):
        assert main(["replay", log, "--config", str(configs / "dyno.toml"), *words]) == (2 if said else 0)
        told = capsys.readouterr()
        assert said in told.err
    page = tmp_path / "page.html"
    assert main(["report", log, "-o", str(page), "--json"]) in (0, 1)
    capsys.readouterr()
    assert main(["export", log, "-o", str(tmp_path / "run.csv")]) == 0
    assert (tmp_path / "run.csv").is_file() and (tmp_path / "run.load.csv").is_file() and page.is_file()


@pytest.mark.long
def test_another_log_does_not_say_what_each_told_the_other(
    configs: Path, settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    short = (*LOCKSTEP, "loop.duration_s=0.4")
    done = call("demo", str(configs / "dyno.toml"), "--json", *flags(settings(*short)))
    log = json.loads(done.stdout)["log"]
    assert main(["replay", log, "--config", str(configs / "dyno-fac.toml")]) == 2
    told = capsys.readouterr().err
    assert "half of one law over two nodes, and this log is of no run under it" in told
