"""`hil tune`: the identified motor's configuration does in simulation what was predicted; what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hil.cli import main
from hil.config.tables import RunConfig, load_toml
from hil.identify.tune import LEAST_SPREAD, UNKNOWN_SPREAD, spread_of

MOTOR = """
R_s_ohm = 3.45
L_d_h = 0.0297
L_q_h = 0.0297
psi_f_wb = 0.76
n_p = 3
J_kg_m2 = 0.01265
B_f_n_m_s = 4e-4
[identified]
date = "2026-11-27T12:00:00+00:00"
drive = "node 1"
w_noise_rad_s = 0.0104
i_noise_a = 0.0028
delay_ticks = 1
low = { R_s_ohm = 3.44, L_d_h = 0.0296, L_q_h = 0.0296, psi_f_wb = 0.759, J_kg_m2 = 0.0120 }
high = { R_s_ohm = 3.46, L_d_h = 0.0298, L_q_h = 0.0298, psi_f_wb = 0.761, J_kg_m2 = 0.0130 }
"""


@pytest.fixture
def motor(tmp_path: Path) -> Path:
    path = tmp_path / "identified.toml"
    path.write_text(MOTOR, encoding="utf-8")
    return path


@pytest.mark.compiled
def test_the_dip_is_as_predicted_over_the_intervals(
    configs: Path, motor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo, to = configs / "demo.toml", configs / "tuned.toml"
    fast = ("--effort", "0.03", "--cases", "6", "--load", "5.4", "--json")
    assert main(["tune", str(demo), "--motor", str(motor), "-o", str(to), *fast]) == 0
    result = json.loads(capsys.readouterr().out)
    found, predicted = result["yield"], result["predicted"]
    assert found["passed"] == found["cases"] == 6
    assert found["worst_dip_rad_s"] == pytest.approx(predicted["dip_rad_s"], rel=0.15)
    assert result["limits"] and result["margins"]["phase_deg"] > 30.0
    assert result["spread"]["j"] == pytest.approx(0.65 / 12.65)
    config = load_toml(to, RunConfig)
    assert config.motor.J_kg_m2 == 0.01265 and config.motor.identified is not None
    assert config.controller.speed_pole_rad_s == result["tables"]["controller"]["speed_pole_rad_s"]


def test_the_spread_is_the_intervals(configs: Path, motor: Path) -> None:
    told = load_toml(configs / "demo.toml", RunConfig, (f'motor="{motor}"',)).motor
    assert spread_of(told)["psi_f"] == pytest.approx(LEAST_SPREAD)
    guessed = load_toml(configs / "demo.toml", RunConfig).motor
    assert list(spread_of(guessed).values()) == pytest.approx([UNKNOWN_SPREAD] * 4)


def test_a_longer_delay_and_a_missing_motor_are_refused(
    configs: Path, motor: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    motor.write_text(MOTOR.replace("delay_ticks = 1", "delay_ticks = 2"), encoding="utf-8")
    demo = str(configs / "demo.toml")
    assert main(["tune", demo, "--motor", str(motor)]) == 2
    assert "2 ticks" in capsys.readouterr().err
    assert main(["tune", demo, "--motor", str(motor.with_name("none.toml"))]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["tune", demo, "-o", demo]) == 2
    assert "is the configuration itself" in capsys.readouterr().err
    assert not (configs / "demo-tuned.toml").exists()
