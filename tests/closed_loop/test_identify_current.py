"""Drives that take a current or a torque, identified from simulated runs: shaft, lag of the loop, delay."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from hil.config.tables import RunConfig, load_toml
from hil.identify.innerloop import estimate_for
from hil.identify.session import Session, planned, setup_for
from hil.signals import Reason, TickArray
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

pytestmark = [pytest.mark.compiled, pytest.mark.slow]
TRUE = 1.5 * 3 * 0.76 / 0.01265
"""k_t / J of configs/motors/bench.toml; the configurations believe 327."""
IN_TORQUE = 3.6 / (1.5 * 3 * 0.76)
"""Torques are told for the k_t of the configuration."""
SLOW = ('drive.signals.i_q=""',), ('firmware={takes="current",current_loop_rad_s=333.33}',), 3e-3
CASES = {
    "current": ((), (), 1e-3),
    "current, 3 ms, no i_q reported": SLOW,
    "moteus": ((), (), 1e-3),
    "cia402": ((), (), 1e-3),
}


def runs_of(tmp_path: Path, name: str, steps: tuple[str, ...]) -> tuple[RunConfig, list[TickArray]]:
    """The steps' runs on the shipped plant, whose brake comes at 2.5 s; within every limit."""
    own, plant, _ = CASES[name]
    shutil.copytree(CONFIGS, tmp_path, dirs_exist_ok=True)
    path = tmp_path / f"{name.split(',')[0]}.toml"
    config = load_toml(path, RunConfig, own)
    session, limits, runs = Session(path, config, config.motor), config.limits, []
    for step in planned(session, steps):
        ticks = simulate_ticks(setup_for(session, step), list(plant))
        assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED, step.name
        assert np.abs(ticks["w"]).max() < limits.w_max_rad_s
        assert not ticks["guard_flags"].any()  # it was never the guard that kept it there
        assert np.abs(np.diff(ticks["u_q"])).max() <= config.command.step
        assert np.abs(ticks["u_q"]).max() <= config.command.most
        assert np.abs(ticks["w"][-50:]).max() < 1.0
        runs.append(ticks)
    return config, runs


@pytest.mark.corners
@pytest.mark.parametrize("name", CASES)
def test_shaft_lag_and_delay_are_found_within_the_limits(tmp_path: Path, name: str) -> None:
    config, runs = runs_of(tmp_path, name, ("standstill", "inertia"))
    found = estimate_for(config, config.motor, runs)
    p = found.parameters
    assert found.faults == []
    for key, true, off in (
        ("k_t_over_J", TRUE, 0.005),
        ("J", 3.6 / TRUE, 0.005),
        ("coulomb", 0.2 * IN_TORQUE, 0.02),
        ("B_f", 4e-4 * IN_TORQUE, 0.1),
        ("lag", CASES[name][2], 0.02),
    ):
        assert p[key].told and p[key].low <= p[key].value <= p[key].high, key
        assert p[key].value == pytest.approx(true, rel=off), key
    assert p["delay"].value == 1.0 and p["delay"].told
    wrong_lag = any("drive.current_lag_ms is 1" in line for line in found.findings)
    assert wrong_lag == (CASES[name][2] != 1e-3)


def test_commands_that_act_later_are_told_by_their_ticks(tmp_path: Path) -> None:
    """The same run as if each command had been sent two ticks before it was."""
    config, runs = runs_of(tmp_path, "current", ("standstill",))
    for ticks in runs:
        ticks["u_q"] = np.roll(ticks["u_q"], -2)
    found = estimate_for(config, config.motor, runs)
    assert found.parameters["delay"].value == 3.0 and found.parameters["delay"].told
    assert any("drive.delay_ticks is 0, the commands act 2 later" in line for line in found.findings)


def test_a_drive_at_rest_tells_its_noise_and_what_else_it_takes(tmp_path: Path) -> None:
    config, runs = runs_of(tmp_path, "current", ("sensors",))
    p = estimate_for(config, config.motor, runs).parameters
    assert p["w_noise"].value == pytest.approx(0.0104, rel=0.15) and p["w_noise"].told
    assert not p["k_t_over_J"].told and "step inertia" in p["k_t_over_J"].why
