"""`hil identify --steps cogging` on the default bus: its runs replay, and a log of them tells the same."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.identify import coggingrun
from hil.replay import replay
from hil.runtime.setup import Overrides, load_setup
from hil.sim.demo import closed_loop
from hil.sim.simulate import simulate_ticks
from tests.conftest import ROOT

pytestmark = [pytest.mark.process, pytest.mark.beside]


def identify(*args: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil.cli", "identify", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=ROOT, check=False)


def told(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    """What the command line says, in this process."""
    assert main(["identify", *args, "--steps", "cogging", "--json"]) == 0, capsys.readouterr().err
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


@pytest.mark.long
def test_a_motor_is_taught_over_the_bus_and_from_its_log(
    configs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One short round; that of tests/closed_loop/test_anticogging.py are the command's two."""
    monkeypatch.setattr(coggingrun, "LAPS", (2,))
    file, own = configs.parent / "own.toml", ("--set", f'log.folder="{configs.parent / "logs"}"')
    result = told(capsys, str(configs / "cogging.toml"), "--emulated", "--lockstep", *own, "-o", str(file))
    assert result["ok"] and result["faults"] == [] and [row["step"] for row in result["steps"]] == ["cogging"]
    orders = [row["order"] for row in result["cogging"]["harmonics"]]
    assert {1, 36, 72} <= set(orders)
    p = result["parameters"]["order_36"]
    assert p["low"] < p["value"] < p["high"] and p["unit"] == "N m" and p["told"]
    assert p["value"] * 0.76 / 0.8 == pytest.approx(0.35, rel=0.1)
    written = tomllib.loads(file.read_text(encoding="utf-8"))
    assert written["orders"] == orders and written["motor"] == "reconstruction" and written["date"]
    assert written["logs"] == result["logs"] and len(written["error_n_m"]) == len(orders)
    assert Path(result["picture"]).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    again = told(capsys, "--from", *result["logs"], "-o", str(configs.parent / "again.toml"))
    assert again["cogging"]["harmonics"] == result["cogging"]["harmonics"]


def test_a_run_over_the_bus_with_a_file_replays_and_is_the_simulated_one(
    configs: Path, tmp_path: Path
) -> None:
    table = "n_p = 3, k_t_n_m_a = 3.6, orders = [1, 36], cos_n_m = [0.1, 0.2], sin_n_m = [0.0, 0.3]"
    own = (f"controller.anticogging={{ {table} }}", 'loop.clock="lockstep"', "loop.duration_s=1.0",
           "reference.down_at_s=0.9", f'log.folder="{tmp_path}"')  # fmt: skip
    path = configs / "cogging.toml"
    setup, result, log = closed_loop(path, Overrides(settings=own))
    assert replay(Path(result.log)).verdict == "same"
    simulated = simulate_ticks(load_setup(path, Overrides(settings=own)))
    assert setup.machine.law["cogs"][0] == 2 and np.isfinite(log.ticks["theta"]).all()
    for name in ("theta", "w", "d_hat_w", "T_L_hat", "i_q_ref", "u_q", "u_d"):
        assert np.array_equal(log.ticks[name][:900], simulated[name][:900]), name


@pytest.mark.corners
@pytest.mark.parametrize(
    ("args", "said"),
    [
        (
            ("configs/cogging.toml", "--steps", "cogging,inertia"),
            "cogging writes a file of its own; run it by itself",
        ),
        (
            ("configs/demo.toml", "--emulated", "--steps", "cogging"),
            "drive.signals.angle: missing; cogging is learned",
        ),
        (
            ("--from", "tests/golden/logs/1a4c819/fac.mcap", "--steps", "cogging"),
            "its drive reported no angle",
        ),
        (("--from", "x.mcap", "--steps", "inertia"), "--from re-estimates from logs"),
        (
            ("configs/cogging.toml", "--emulated", "--steps", "cogging", "--set", "loop.shadow=true"),
            "loop.shadow",
        ),
    ],
)
def test_what_can_not_be_taught_is_refused_in_one_line(args: tuple[str, ...], said: str) -> None:
    out = identify(*args)
    assert out.returncode == 2 and said in out.stderr and len(out.stderr.strip().splitlines()) == 1, (
        out.stderr
    )
