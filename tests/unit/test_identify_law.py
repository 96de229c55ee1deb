"""The law of the experiments, in simulation: within the limits, it brakes, ends, and replays to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.design import law_spec
from hil.config.tables import RunConfig, load_toml
from hil.control.errors import ControlDesignError
from hil.control.law import ROWS, design_law
from hil.errors import HilError
from hil.identify.plan import STEPS, Skipped, Step, chosen, config_of, make
from hil.replay import replay
from hil.runtime.setup import setup_of
from hil.signals import Reason, TickArray
from hil.sim.simulate import simulate, simulate_ticks
from tests.conftest import CONFIGS

DEMO = CONFIGS / "demo.toml"
NO_LOAD = "load=[]"
pytestmark = pytest.mark.compiled


def step_config(name: str, *settings: str) -> RunConfig:
    config = load_toml(DEMO, RunConfig, settings)
    step = make(name, config, config.motor)
    assert isinstance(step, Step)
    return config_of(config, step, config.motor, f"identify-{name}")


def ticks_of(name: str, plant: tuple[str, ...] = (NO_LOAD,), *settings: str) -> TickArray:
    return simulate_ticks(setup_of(DEMO, step_config(name, *settings)), list(plant))


@pytest.mark.parametrize("name", STEPS)
def test_a_step_stays_within_every_limit_and_ends_at_rest(name: str) -> None:
    limits, ticks = load_toml(DEMO, RunConfig).limits, ticks_of(name)
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    assert np.hypot(ticks["i_q"], ticks["i_d"]).max() < limits.i_max_a
    assert np.abs(ticks["i_d"]).max() < (limits.i_d_max_a or 0)
    assert np.abs(ticks["w"]).max() < limits.w_max_rad_s
    assert max(np.abs(np.diff(ticks[u])).max() for u in ("u_q", "u_d")) <= limits.du_max_v
    assert np.hypot(ticks["u_q"], ticks["u_d"]).max() <= limits.u_max_v
    assert np.abs(ticks["w"][-50:]).max() < 1.0
    assert not ticks["guard_flags"].any()  # it was never the guard that kept it there


def test_a_step_replays_to_the_bit(tmp_path: Path) -> None:
    setup = setup_of(DEMO, step_config("standstill", f'log.folder="{tmp_path}"'))
    result = simulate(setup, [NO_LOAD])
    assert replay(Path(result["log"])).verdict == "same"


def test_pulses_grow_until_the_currents_reach_their_goals_whatever_the_motor_is() -> None:
    """A thirtieth of the resistance and inductance: the voltage that moves the demo's motor were too much."""
    small = "motor={R_s_ohm=0.1, L_d_h=0.9e-3, L_q_h=1.2e-3, psi_f_wb=0.1, n_p=3, J_kg_m2=0.002}"
    for plant in ((NO_LOAD,), (NO_LOAD, small)):
        ticks = ticks_of("standstill", plant)
        assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
        assert 0.7 < np.abs(ticks["i_d"]).max() < 2.0
        assert 2.0 < np.abs(ticks["i_q"]).max() < 9.0


def test_a_shaft_that_turns_the_wrong_way_gets_no_more_torque() -> None:
    """A load of 1 N m drives it backwards before the torque has grown."""
    ticks = ticks_of("spinning", ('load=[{kind="constant", torque_n_m=1.0}]',))
    backwards = np.flatnonzero(ticks["w"] < -0.05 * 60.0 - 1.0)
    assert len(backwards) and not ticks["i_q_ref"][backwards].any()


def test_a_stop_in_the_middle_brakes_the_shaft() -> None:
    config = step_config("inertia")
    loop = config.loop.model_copy(update={"duration_s": 1.0})
    ticks = simulate_ticks(setup_of(DEMO, config.model_copy(update={"loop": loop})), [NO_LOAD])
    assert np.abs(ticks["w"][990]) > 20.0
    assert np.abs(ticks["w"][-1]) < 2.0 and len(ticks) < 2000


def test_a_blocked_shaft_times_out() -> None:
    ticks = ticks_of("spinning", ('load=[{kind="brake", torque_n_m=100.0}]',))
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    assert np.abs(ticks["i_q"]).max() == pytest.approx(7.5, abs=0.2)
    assert np.abs(ticks["w"]).max() < 0.1


def test_a_step_that_the_limits_do_not_allow_names_them() -> None:
    config = load_toml(DEMO, RunConfig, ("limits.i2t_max_a2s=1.0", "limits.i_continuous_a=1.0"))
    skipped = make("inertia", config, config.motor)
    assert isinstance(skipped, Skipped) and "i2t_max_a2s" in skipped.why


def test_steps_are_chosen_by_name() -> None:
    assert chosen(None) == STEPS
    assert chosen("inertia, sensors") == ("sensors", "inertia")
    with pytest.raises(HilError, match=r"no step 'standstil'; there are sensors, standstill"):
        chosen("standstil")
    with pytest.raises(HilError, match=r"--steps"):
        chosen(" , ")


def test_a_table_with_missing_entries_is_refused() -> None:
    config: Any = step_config("inertia")
    short = config.controller.model_copy(update={"w_rad_s": [1.0]})
    with pytest.raises(ControlDesignError, match=r"one entry a row, 8 as q"):
        design_law(law_spec(config.model_copy(update={"controller": short})), 1e-3)
    assert len(config.controller.q) <= ROWS
