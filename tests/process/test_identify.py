"""`hil identify` on the default bus: an emulated motor that nobody told it, its log, its file, bad motors."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.motor import MotorTable
from hil.config.tables import RunConfig, load_toml
from hil.log.reader import open_log
from hil.replay import replay
from tests.conftest import CONFIGS, ROOT

pytestmark = [pytest.mark.process, pytest.mark.beside]
GOALS = {"R_s": 0.02, "L_d": 0.02, "L_q": 0.02, "psi_f": 0.02, "J": 0.03}
KEYS = {"R_s": "R_s_ohm", "L_d": "L_d_h", "L_q": "L_q_h", "psi_f": "psi_f_wb", "J": "J_kg_m2"}


def hil(*args: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil.cli", "identify", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=folder, check=False)


def emulated(configs: Path, *args: str) -> tuple[int, dict[str, Any], str]:
    """Exit code, result and messages of a lockstep run with its emulator."""
    quiet = ("--set", f'log.folder="{configs.parent / "logs"}"', "-o", str(configs.parent / "motor.toml"))
    out = hil(str(configs / "demo.toml"), "--emulated", "--lockstep", "--json", *quiet, *args, folder=ROOT)
    assert out.stdout, out.stderr
    return out.returncode, json.loads(out.stdout), out.stderr


def test_an_unknown_motor_is_found_within_the_limits_and_replays(configs: Path) -> None:
    """The demo's drive: +-20 % off what the configuration believes, friction, a brake that comes and goes."""
    code, result, said = emulated(configs)
    assert code == 0, said
    true = tomllib.loads((CONFIGS / "motors" / "bench.toml").read_text(encoding="utf-8"))
    found = {name.lower(): value for name, value in result["parameters"].items()}
    for name, share in GOALS.items():
        p = found[name.lower()]
        assert p["told"] and p["low"] <= p["value"] <= p["high"] and p["unit"]
        assert p["value"] == pytest.approx(true[KEYS[name]], rel=share), name
    assert found["coulomb"]["value"] == pytest.approx(0.2, rel=0.1)
    assert found["b_f"]["value"] == pytest.approx(4e-4, rel=0.1)
    assert found["breakaway"]["low"] <= 0.25 <= found["breakaway"]["high"]
    assert found["delay"]["value"] == 1 and result["motor_s"] < 60.0
    assert [line for line in said.splitlines() if line.startswith("step ")] != []
    motor = load_toml(Path(result["file"]), MotorTable)
    assert motor.identified is not None and motor.identified.delay_ticks == 1
    assert motor.identified.low["J_kg_m2"] < motor.J_kg_m2 < motor.identified.high["J_kg_m2"]
    limits = load_toml(configs / "demo.toml", RunConfig).limits
    for log in result["logs"]:
        ticks = open_log(Path(log)).ticks
        assert np.hypot(ticks["i_q"], ticks["i_d"]).max() < limits.i_max_a
        assert np.abs(ticks["w"]).max() < limits.w_max_rad_s
        assert np.hypot(ticks["u_q"], ticks["u_d"]).max() <= limits.u_max_v
    assert replay(Path(result["logs"][1])).verdict == "same"
    again = hil("--from", *result["logs"], "--json", "-o", str(configs.parent / "again.toml"), folder=ROOT)
    assert again.returncode == 0, again.stderr
    later = json.loads(again.stdout)
    assert later["parameters"]["r_s"]["value"] == pytest.approx(true["R_s_ohm"], rel=0.02)
    assert not later["drift"]["psi_f"]["drifts"] and len(later["runs"]) == len(result["logs"])
    asked = configs / "demo.toml"  # a configuration takes the file as its motor
    text = asked.read_text(encoding="utf-8")
    head, _, rest = text.partition("[motor]")
    kept = rest[rest.index("[controller]") :]
    asked.write_text(f'motor = "{result["file"]}"\n{head}{kept}', encoding="utf-8")
    assert load_toml(asked, RunConfig).motor.J_kg_m2 == motor.J_kg_m2


def plant(configs: Path, text: str) -> None:
    """Put something more into the demo's plant, its brake left out."""
    path = configs / "plants" / "demo.toml"
    kept = path.read_text(encoding="utf-8").partition("[[load]]")[0]
    path.write_text(f"{kept}\n[firmware]\nwatchdog_ms = 400.0\n{text}", encoding="utf-8")


BLOCKED = '[[load]]\nkind = "brake"\ntorque_n_m = 100.0\n'
DRIVEN = '[[load]]\nkind = "constant"\ntorque_n_m = 1.5\n'
FAN = '[[load]]\nkind = "fan"\nk_n_m_s2 = 2.0\n'
OPEN = '[[fault]]\nkind = "phase-loss"\nat_s = 0.0\n'
REVERSED = '[[fault]]\nkind = "encoder-reversed"\nat_s = 0.0\n'
SWAPPED = '[[fault]]\nkind = "phase-swap"\nat_s = 0.0\n'
SLIP = '[[fault]]\nkind = "encoder-slip"\nangle_deg = 180.0\nat_s = 0.0\n'


@pytest.mark.long
@pytest.mark.parametrize(
    ("steps", "more", "settings", "words"),
    [
        ("spinning", BLOCKED, (), "does not turn"),
        ("spinning", DRIVEN, (), "turns against the torque"),
        ("standstill", OPEN, (), "open phase"),
        ("spinning", SLIP, (), "turns against the torque"),
        ("spinning", REVERSED, (), "turns against the torque: phase order or encoder direction is wrong"),
        ("spinning", SWAPPED, (), "turns against the torque: phase order or encoder direction is wrong"),
        ("standstill", REVERSED, (), "encoder counts the wrong way, or two phases are swapped"),
        ("standstill", SWAPPED, (), "encoder counts the wrong way, or two phases are swapped"),
        ("spinning", FAN + SWAPPED, (), "degrees, then stands with 7.49 A: phase order or encoder"),
        (
            "standstill,spinning",
            "",
            ("--set", "motor.n_p=4", "--set", "motor.psi_f_wb=0.6"),
            "3 pole pairs, not 4",
        ),
    ],
)
def test_what_is_wrong_with_the_motor_is_named(
    configs: Path, steps: str, more: str, settings: tuple[str, ...], words: str
) -> None:
    plant(configs, more)
    code, result, said = emulated(configs, "--steps", steps, *settings)
    assert code == 1, said
    assert words in "; ".join(result["faults"]), (result["faults"], said)
    assert result["file"] is None and not (configs.parent / "motor.toml").exists()


@pytest.mark.corners
@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("{config}", "--steps", "spin"), "there are sensors, standstill, spinning, inertia"),
        ((), "needs a CONFIG"),
        (("{config}", "--from", "a.mcap"), "takes no CONFIG"),
        (("--from", "no.mcap"), "no.mcap"),
        (("{config}", "--set", "loop.shadow=true"), "loop.shadow"),
        (("{config}", "--set", 'controller.kind="fac"'), "controller.kind: fac"),
        (("{config}", "-o", "{config}"), "is the configuration itself"),
        (("{config}", "-i", "socketcan", "-c", "can9"), "nothing was sent"),
        (("{config}", "--emulated", "-i", "socketcan", "-c", "can9"), "--emulated"),
    ],
)
def test_what_is_refused_says_why(configs: Path, args: tuple[str, ...], words: str) -> None:
    out = hil(*(arg.format(config=configs / "demo.toml") for arg in args), folder=configs.parent)
    assert out.returncode == 2 and words in out.stderr, out.stderr
    assert "Traceback" not in out.stderr and not out.stdout
