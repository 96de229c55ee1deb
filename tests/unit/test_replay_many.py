"""`hil replay` over many logs, in a window, as JUnit, and with another controller in open loop."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from hil.cli import main
from hil.config.tables import RunConfig, load_toml
from hil.errors import HilError
from hil.log.mcapfile import RunFile
from hil.log.reader import open_log
from hil.replay import Window, replay
from hil.replay.whatif import what_if
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request
from hil.sim.simulate import simulate

CONFIG = Path(__file__).parents[2] / "configs" / "demo.toml"


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = (f'log.folder="{tmp_path_factory.mktemp("logs")}"', "loop.duration_s=4.0")
    return Path(simulate(load_setup(CONFIG, Overrides(settings=settings)), [])["log"])


@pytest.fixture(scope="module")
def differing(logged: Path) -> Path:
    """The same log with one output changed at t = 3 s."""
    log, path = open_log(logged), logged.with_name("differing.mcap")
    log.ticks["u_q"][3000] += 0.01
    header = {"metadata": log.metadata["run"], "attachments": log.attachments}
    with RunFile(path, header) as file:
        file.add_ticks(log.ticks)
        file.finish({"ended": "stop_requested"})
    return path


def test_worst_exit_code_and_junit(logged: Path, differing: Path, tmp_path: Path) -> None:
    xml = tmp_path / "replay.xml"
    assert main(["replay", str(logged)]) == 0
    assert main(["replay", str(logged), str(differing), "--junit", str(xml)]) == 1
    assert main(["replay", str(logged), str(tmp_path / "none.mcap"), str(differing)]) == 2
    suite = ET.parse(xml).getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    failure = suite.find("testcase/failure")
    assert failure is not None and "tick 3000" in str(failure.get("message"))


def test_json_of_one_log_and_of_many(
    logged: Path, differing: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["replay", "--json", str(logged)])
    assert json.loads(capsys.readouterr().out)["verdict"] == "same"
    main(["replay", "--json", str(logged), str(differing)])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["verdict"] for row in rows] == ["same", "differs"] and rows[1]["log"] == str(differing)


def test_a_window_compares_its_own_ticks_alone(differing: Path) -> None:
    assert replay(differing, Window(0.5, 2.5)).verdict == "same"
    assert replay(differing, Window(0.5, 2.5)).ticks == 2001
    found = replay(differing, Window(2.5))
    assert found.first_difference is not None and found.first_difference.tick == 3000
    assert replay(differing, Window(3.5)).verdict == "same"
    assert replay(differing, Window(100.0)).why == "the window has no ticks"


def test_progress_is_told(logged: Path) -> None:
    seen: list[int] = []
    verdict = replay(logged, seen=seen.append)
    assert seen == sorted(seen) and len(seen) > 2 and seen[-1] == verdict.ticks


def test_the_same_controller_what_if_differs_by_nothing(logged: Path) -> None:
    found = what_if(logged, CONFIG, load_toml(CONFIG, RunConfig))
    ticks = open_log(logged).ticks
    ramp = ticks["request"] == int(Request.RAMP_DOWN)
    assert found.ticks == len(ticks) > 4004 and ramp.sum() > 500, "the ramp of the stop is compared too"
    enabled = ticks["state"] == int(DriveState.OPERATION_ENABLED)
    assert found.spreads["d_hat_w"].count == enabled.sum() > found.ticks - 10
    assert {name: spread.top for name, spread in found.spreads.items() if spread.top != 0.0} == {}


def test_another_observer_what_if(logged: Path, tmp_path: Path) -> None:
    out = tmp_path / "whatif.mcap"
    settings = ["observer.speed.delay_ms=20.0", "controller.current_pole_rad_s=200.0"]
    found = what_if(logged, CONFIG, load_toml(CONFIG, RunConfig, settings), out)
    assert found.spreads["d_hat_w"].top > 1.0 and found.spreads["u_q_law"].top > 0.1
    assert found.spreads["d_hat_q"].top == 0.0  # its window is as it was
    assert replay(out).verdict == "same"
    log, again = open_log(logged), open_log(out)
    difference = np.abs(again.ticks["d_hat_w"] - log.ticks["d_hat_w"]).max()
    assert difference == pytest.approx(found.spreads["d_hat_w"].top)
    with pytest.raises(HilError, match="exists already; name another file with -o"):
        what_if(logged, CONFIG, load_toml(CONFIG, RunConfig), out)


@pytest.mark.parametrize(
    ("settings", "why"),
    [(["loop.rate_hz=500"], "same"), (['controller.kind="fac"', "limits.T_L_max_n_m=8.0"], "fac")],
)
def test_what_if_refuses_what_no_log_can_answer(logged: Path, settings: list[str], why: str) -> None:
    with pytest.raises(HilError, match=why):
        what_if(logged, CONFIG, load_toml(CONFIG, RunConfig, settings))


@pytest.mark.parametrize(
    "flags",
    [["--from", "3", "--to", "2"], ["-o", "x.mcap"], ["--config", str(CONFIG), "--from", "1"]],
)
def test_flags_that_do_not_go_together(logged: Path, flags: list[str]) -> None:
    assert main(["replay", str(logged), *flags]) == 2
