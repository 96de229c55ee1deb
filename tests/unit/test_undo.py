"""A tick that is taken back has left no trace in its controller's states: each byte is what it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.config.design import Machine
from hil.control.jit import entry
from hil.control.law import new_law_state
from hil.runtime.nodesetup import load_node_setups
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request, RxFlag, new_ticks
from hil.tick.kernel import new_safety_state
from hil.tick.setpoint import new_setpoint_state
from hil.tick.undo import WHOLE, Undo, keep
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

TICKS = 1500
"""More than the longest ring has entries."""
PLL = ("drive.speed_filter.kind='pll'", "drive.speed_filter.pole_1_rad_s=1000.0",
       "drive.speed_filter.pole_2_rad_s=1000.0")  # fmt: skip
SHAFT = ("motor.shaft={resonance_hz=60.0, damping_ratio=0.01, inertia_ratio=1.0}",)
NOISE = "w_noise_rad_s=0.01, i_noise_a=0.002"
ADAPTIVE = tuple(
    f'observer.{name}={{kind="adaptive", delay_ms=20.0, short_ms=8.0, {NOISE}}}'
    for name in ("speed", "current")
)
CASES = {
    "house": ("demo.toml", ()),
    "a filter": ("cia402.toml", PLL),
    "a shaft": ("demo.toml", SHAFT),
    "adaptive": ("demo.toml", ADAPTIVE),
    "current": ("current.toml", ()),
}


def machine_of(name: str) -> Machine:
    if name in ("motor", "load"):
        nodes = load_node_setups(CONFIGS / "dyno-fac.toml", Overrides())
        assert nodes is not None
        return nodes[name].machine.fresh()
    config, settings = CASES[name]
    return load_setup(Path(CONFIGS / config), Overrides(settings=settings)).machine.fresh()


def states_of(machine: Machine) -> list[bytes]:
    return [one.tobytes() for one in (machine.safety_state, machine.law_state, machine.setpoint_state)]


@pytest.mark.compiled
@pytest.mark.parametrize("name", [*CASES, "motor", "load"])
@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_left_of_a_tick_that_is_taken_back(name: str, seed: int) -> None:
    """Gaps, missing measurements, an arming and a stop among them; each is then run for good."""
    rng = np.random.default_rng(seed)
    machine, ticks = machine_of(name), new_ticks()
    undo = Undo(
        machine.safety, machine.law, (machine.safety_state, machine.law_state, machine.setpoint_state)
    )
    blank = Undo(machine.safety, machine.law, (new_safety_state(), new_law_state(), new_setpoint_state()))
    kept = entry(keep, blank.places, 1)
    step, t, usual = machine.looped(), ticks[0], 0
    states = (DriveState.SWITCH_ON_DISABLED, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED)
    for k in range(TICKS):
        t["k"], t["gap"] = k, rng.choice([1, 1, 1, 1, 1, 1, 1, 2, 5]) if k % 97 < 10 else 1
        t["rx_flags"] = 0 if rng.random() < 0.02 else int(RxFlag.FRESH)
        t["w"], t["i_q"], t["i_d"] = rng.normal(0.0, 1.0, 3)
        t["drive_state"], t["echo"] = int(states[min(k // 20, 2)]), int(machine.safety_state["counter"][0])
        t["request"] = int(Request.ARM if k < TICKS - 200 else Request.STOP)
        asked, before = ticks.copy(), states_of(machine)
        kept(undo.places, int(t["gap"]))
        usual += not undo._starts[WHOLE]
        step(ticks)
        first, after = ticks.copy(), states_of(machine)
        undo.restore()
        assert states_of(machine) == before, k
        undo.keep()
        ticks[:] = asked
        t["request"] = int(Request.NODE_STOPPED)
        step(ticks)
        undo.restore()
        assert states_of(machine) == before, k
        ticks[:] = asked
        step(ticks)
        assert states_of(machine) == after and ticks.tobytes() == first.tobytes(), k
    assert usual > 0.7 * TICKS
    assert machine.safety_state["state"][0] != 0 and machine.law_state["filled"][0] > 0
