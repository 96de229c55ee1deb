"""A move over the lockstep bus by a CiA 402 drive in CST: set up, run through a load step, to the bit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.runtime.setup import Overrides, load_setup
from hil.signals import FIELDS
from hil.sim.simulate import simulate_ticks
from tests.canopen import PATIENT
from tests.process.test_run import call, flags

pytestmark = pytest.mark.process
SHORT = (PATIENT, 'loop.clock="lockstep"', "loop.duration_s=2.0", "reference.target_turns=8.0",
         "reference.at_s=0.05", "reference.rate_rad_s2=400.0", "reference.jerk_rad_s3=2e4",
         "criteria={angle_error_peak_max_rad=0.06, angle_settling_max_s=0.3}")  # fmt: skip
NOT_CARRIED = ("rx_flags", "echo", "v_dc", "temperature_motor", "temperature_inverter", "T_L_true")
"""What the simulated drive tells beside what its PDOs carry; no law reads it."""


def test_a_move_on_the_bus_is_the_simulated_one_to_the_bit(
    configs: Path, settings: Callable[..., tuple[str, ...]]
) -> None:
    plant = configs / "plants" / "cia402.toml"
    text = plant.read_text(encoding="utf-8").replace("at_s = 2.5", "at_s = 0.5")
    plant.write_text(text.replace("until_s = 4.5", "until_s = 0.7"), encoding="utf-8")
    path, own = configs / "position.toml", settings(*SHORT)
    done = call("demo", str(path), "--json", *flags(own))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ended"] == "stop_requested" and result["replay"]["verdict"] == "same"
    bus, simulated = (
        open_log(Path(result["log"])).ticks,
        simulate_ticks(load_setup(path, Overrides(settings=own))),
    )
    assert len(bus) == len(simulated)
    bus, simulated = (
        ticks[ticks["reason"] == 0] for ticks in (bus, simulated)
    )  # how it stops is the node's own
    assert len(bus) == len(simulated) == 2000
    for field in FIELDS:
        if field.role in ("input", "output") and field.name not in NOT_CARRIED:
            np.testing.assert_array_equal(bus[field.name], simulated[field.name], field.name)
    error = bus["theta_error"]
    assert 0.02 < np.abs(error).max() < 0.06 and abs(error[-1]) < 2e-3
    judged = call("report", result["log"], "--strict")
    assert judged.returncode == 0, judged.stdout + judged.stderr
