"""`hil identify` over the lockstep bus of drives that take a current or a torque, each frame watched.

Frames are read by hand here, not by the codec that wrote them.
"""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.tables import RunConfig, load_toml
from hil.identify.checks import seen_in
from hil.identify.fromlogs import from_logs
from hil.identify.plan import STEPS, Step, make
from hil.log.reader import Frame, open_log
from hil.replay import replay
from tests.conftest import CONFIGS, ROOT

pytestmark = [pytest.mark.process, pytest.mark.beside]
TRUE = {"k_t_over_j": 1.5 * 3 * 0.76 / 0.01265, "j": 3.6 * 0.01265 / (1.5 * 3 * 0.76), "lag": 1e-3}
"""Of configs/motors/bench.toml, J for the k_t that is believed; the configurations believe 327 and 0.011."""
COULOMB, B_F = 0.2 * 3.6 / (1.5 * 3 * 0.76), 4e-4 * 3.6 / (1.5 * 3 * 0.76)
Place = tuple[int, str, int, float]
"""Identifier, format and place of a number, what it is to be multiplied by."""


@dataclass(frozen=True, slots=True)
class Wire:
    """Where a drive's frames carry the command, the speed [rad/s] and the current [A]."""

    command: Place
    speed: Place
    current: Place


PER_TORQUE = 1.0 / 3.6
WIRES = {
    "moteus": Wire(
        (1 << 31 | 0x8001, "<f", 14, PER_TORQUE),
        (0x100, "<f", 11, 2 * math.pi),
        (0x100, "<f", 19, 1.0),
    ),
    "odrive": Wire(
        (0x02E, "<f", 0, PER_TORQUE), (0x029, "<f", 4, 2 * math.pi), (0x034, "<f", 4, 1.0)
    ),
    "cia402": Wire(
        (0x205, "<h", 2, 0.01368 * PER_TORQUE),
        (0x185, "<i", 2, 0.001 * math.pi / 30),
        (0x185, "<h", 6, 0.01368 / (1.5 * 3 * 0.76)),
    ),
    "current": Wire((0x201, "<h", 4, 1e-3), (0x181, "<h", 2, 0.01), (0x181, "<h", 4, 1e-3)),
}  # fmt: skip


def identified(configs: Path, name: str, steps: str, code: int = 0) -> tuple[dict[str, Any], str]:
    """The result and the messages of a lockstep run with its emulator, that ends with this code."""
    command = [sys.executable, "-m", "hil.cli", "identify", str(configs / f"{name}.toml"), "--emulated"]
    command += ["--lockstep", "--json", "--steps", steps, "-o", str(configs.parent / "motor.toml")]
    command += ["--set", f'log.folder="{configs.parent / "logs"}"']
    out = subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=ROOT, check=False)
    assert out.returncode == code, out.stderr
    return json.loads(out.stdout), out.stderr


def numbers(frames: list[Frame], received: bool, place: Place) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A number of every frame of its identifier, in their order."""
    can_id, form, at, scale = place
    own = [f.data for f in frames if f.received == received and f.can_id == can_id]
    return scale * np.array([struct.unpack_from(form, data, at)[0] for data in own])


def watched(log: Path, wire: Wire, config: RunConfig) -> float:
    """Every frame of a run within the limits; the largest current that was sent [A]."""
    frames = open_log(log).frames
    sent = numbers(frames, False, wire.command)
    u_i = config.drive_k_t if config.drive.takes == "torque" else 1.0
    assert len(sent) > 300
    assert np.abs(sent).max() <= config.limits.i_max_a
    assert np.abs(np.diff(sent, prepend=0.0)).max() <= config.command.step / u_i + 1e-3
    assert sent[-1] == 0.0
    assert np.abs(numbers(frames, True, wire.speed)).max() < config.limits.w_max_rad_s
    assert np.abs(numbers(frames, True, wire.current)).max() < config.limits.i_max_a
    return float(np.abs(sent).max())


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("moteus", "standstill,inertia"),
        ("odrive", "sensors,standstill"),
        ("cia402", "sensors,standstill"),
        ("current", "sensors,standstill"),
    ],
)
def test_a_drive_with_a_loop_of_its_own_over_the_bus(configs: Path, name: str, steps: str) -> None:
    """Several runs with one emulator; their logs replay and tell the same figures again."""
    result, said = identified(configs, name, steps)
    assert [row["step"] for row in result["steps"]] == steps.split(",")
    p, whole = result["parameters"], "inertia" in steps
    for key, true in TRUE.items():
        assert p[key]["told"] and p[key]["low"] <= p[key]["value"] <= p[key]["high"], (key, said)
        assert p[key]["value"] == pytest.approx(true, rel=0.005 if whole else 0.03), key
    assert p["delay"]["value"] == 1.0 and p["delay"]["told"]
    if whole:
        assert p["coulomb"]["value"] == pytest.approx(COULOMB, rel=0.1)
        assert p["b_f"]["value"] == pytest.approx(B_F, rel=0.1)
    assert result["motor_s"] < 60.0 and result["motor_s"] == pytest.approx(seconds(result["logs"]), abs=0.1)
    config = load_toml(configs / f"{name}.toml", RunConfig)
    logs = [Path(log) for log in result["logs"]]
    sent = [watched(log, WIRES[name], config) for log in logs]
    assert [current > 0.5 for current in sent] == [row["step"] != "sensors" for row in result["steps"]]
    assert replay(logs[1]).verdict == "same"
    again, *_ = from_logs(logs)
    for key, row in again["parameters"].items():
        assert row["value"] == pytest.approx(p[key.lower()]["value"], rel=0.02, abs=1e-4), key


@pytest.mark.long
def test_an_open_phase_behind_a_current_loop_is_named_by_the_current_that_nobody_asked_for(
    configs: Path,
) -> None:
    """Seen by i_d; of a drive that reports none by what i_q is off."""
    plant = configs / "plants" / "current.toml"
    kept = plant.read_text(encoding="utf-8").partition("[[load]]")[0]
    plant.write_text(f'{kept}\n[[fault]]\nkind = "phase-loss"\nat_s = 0.0\n', encoding="utf-8")
    result, said = identified(configs, "current", "spinning", code=1)
    assert len(result["faults"]) == 1 and result["file"] is None, said
    assert result["faults"][0].startswith("i_d is 0.") and "an open phase" in result["faults"][0]
    config = load_toml(configs / "current.toml", RunConfig)
    step = make("spinning", config, config.motor)
    ticks = open_log(Path(result["logs"][0]), frames=False).ticks
    ticks["i_d"] = math.nan
    assert isinstance(step, Step)
    (fault,) = seen_in(step, ticks).faults
    assert fault.startswith("i_q is 0.") and "an open phase" in fault


def test_the_whole_run_takes_under_a_minute_of_the_motor() -> None:
    """By the plan, whose rows end no later; drives of voltage are measured in the demo's whole run."""
    for name in WIRES:
        config = load_toml(CONFIGS / f"{name}.toml", RunConfig)
        steps = [make(step, config, config.motor) for step in STEPS]
        assert sum(step.seconds + 0.2 for step in steps if isinstance(step, Step)) < 60.0, name


def seconds(logs: list[str]) -> float:
    """Time of the motor over all runs, by the ticks."""
    spans = [open_log(Path(log), frames=False).ticks["t_ns"] for log in logs]
    return float(sum(t[-1] - t[0] for t in spans)) * 1e-9
