"""`hil simulate --sweep` and `--no-log`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hil.campaign.sweep import axis, job_of_sweep
from hil.cli import main
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate

CONFIG = Path(__file__).parents[2] / "configs" / "demo.toml"


def test_axes_become_every_combination() -> None:
    plant = ["sensors.i_noise_a=[0.0, 0.001, 0.002]", "seed=[1, 2]"]
    _, stand = job_of_sweep(CONFIG, Overrides(), [], ["loop.duration_s=[1, 2.0]"], plant)
    assert stand.plan.count == 12
    assert stand.plan.settings(0) == {
        "loop.duration_s": 1,
        "plant:sensors.i_noise_a": 0.0,
        "plant:seed": 1,
    }
    assert list(stand.plan.settings(11).values()) == [2.0, 0.002, 2]
    assert axis("--sweep", "a.b=[true]") == ("a.b", [True])


@pytest.mark.parametrize("text", ["a.b=3", "a.b=[]", "a.b", "=[1]", "a.b=[1", "a.b={x=1}"])
def test_what_is_no_axis_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="is not of the form"):
        axis("--sweep", text)


def test_too_many_cases_are_refused() -> None:
    wide = f"={list(range(200))}"
    with pytest.raises(ConfigError, match="40000 combinations"):
        job_of_sweep(CONFIG, Overrides(), [], ["a.b" + wide, "a.c" + wide], [])


def test_a_heavier_motor_dips_less(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", str(CONFIG), "--json", "--plant-sweep", "motor.J_kg_m2=[0.008, 0.0143]"]
    assert main(words) == 0
    light, heavy = json.loads(capsys.readouterr().out)["rows"]
    assert light["case"] == ["motor.J_kg_m2=0.008"] and heavy["case"] == ["motor.J_kg_m2=0.0143"]
    assert light["dip_rad_s"] > heavy["dip_rad_s"] > 1.0


def test_a_key_that_is_none_is_named_before_any_case_runs() -> None:
    assert main(["simulate", str(CONFIG), "--sweep", "controller.speed_pole=[1.0]"]) == 2


def test_without_a_log_nothing_is_written(tmp_path: Path) -> None:
    settings = (f'log.folder="{tmp_path}"', "loop.duration_s=1.0")
    seen: list[int] = []
    result = simulate(load_setup(CONFIG, Overrides(settings=settings)), [], log=False, seen=seen.append)
    assert result["log"] is None and result["ok"] and list(tmp_path.iterdir()) == []
    assert seen[-1] == result["ticks"]
