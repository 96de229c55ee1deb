"""Regeneration limits against a DC link with a capacitor and no brake resistor: it trips, or it is held."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hil.replay import replay
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, load_setup
from hil.signals import GuardFlag, Reason, TickArray
from hil.sim.demo import closed_loop
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

PATH = CONFIGS / "salient.toml"
BRAKING = (
    "reference.rate_rad_s2=400.0",
    "reference.jerk_rad_s3=10000.0",
    "reference.down_at_s=1.0",
    "loop.duration_s=2.5",
    "limits.following_error_rad_s=1000.0",  # it brakes more slowly than is asked: that is the limit's price
)
POWER = "limits.p_regen_max_w=300.0"
LINK = ("limits.v_dc_regen_from_v=480.0", "limits.v_dc_regen_max_v=580.0")
PLANT = "inverter={v_dc_v=325.0, capacitance_f=2e-4, rectifier_ohm=0.5, v_dc_trip_v=750.0}"
IDEAL = "inverter.v_dc_v=325.0"
pytestmark = pytest.mark.compiled  # whole runs: interpreted they take minutes


@cache
def simulated(inverter: str, *settings: str) -> TickArray:
    setup = load_setup(PATH, Overrides(settings=(*BRAKING, *settings)))
    return simulate_ticks(setup, ["load=[]", inverter])


def braking(ticks: TickArray) -> TickArray:
    own = operating(ticks)
    return own[own["t_ns"] > 1.0e9]


def fed_back(own: TickArray) -> float:
    """Most power [W] back to the link over a tick: voltage applied, mean of the currents at its ends."""
    i_q, i_d = (0.5 * (own[name][1:] + own[name][:-1]) for name in ("i_q", "i_d"))
    return float(-(1.5 * (own["ua_q"][1:] * i_q + own["ua_d"][1:] * i_d)).min())


def test_without_a_limit_the_link_trips_the_run() -> None:
    ticks = simulated(PLANT)
    assert Reason(int(ticks["reason"][-1])) == Reason.DC_LINK_OVER_VOLTAGE
    assert np.nanmax(ticks["v_dc"]) > 650.0 and fed_back(braking(ticks)) > 350.0


def test_as_the_link_nears_its_end_braking_is_reduced_and_holds_it() -> None:
    """Nothing but friction and the copper takes energy then; the speed falls on, but not as was asked."""
    ticks = simulated(PLANT, POWER, *LINK)
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = braking(ticks)
    assert 575.0 < np.nanmax(own["v_dc"]) < 595.0
    late = own[own["t_ns"] > 1.2e9]
    assert (late["guard_flags"][:1000] & GuardFlag.SATURATED).all()
    assert late["w"][0] > late["w_ref"][0] + 20.0 and 0.0 < late["w"][-1] < 15.0
    assert fed_back(own) < 330.0  # steady by the law; the rest is the magnetic energy of changing currents


def test_a_power_alone_is_kept_to_though_the_motor_is_off() -> None:
    """The observers correct the balance: 20 % more flux, 20 % less R_s; by the model alone a fourth less."""
    motor = "motor={R_s_ohm=2.3, L_d_h=0.033, L_q_h=0.066, psi_f_wb=0.96, n_p=3, J_kg_m2=0.011}"
    setup = load_setup(PATH, Overrides(settings=(*BRAKING, "limits.p_regen_max_w=200.0")))
    own = braking(simulate_ticks(setup, ["load=[]", IDEAL, motor]))
    assert fed_back(own) < 215.0
    own = own[(own["guard_flags"] & GuardFlag.SATURATED) != 0]
    own = own[(own["t_ns"] > 1.15e9) & (own["t_ns"] < 1.2e9)]
    i_q, i_d = own["i_q"], own["i_d"]
    given = 1.5 * (own["ua_q"] * i_q + own["ua_d"] * i_d)
    believed = 1.5 * (2.875 * (i_q**2 + i_d**2) + 3.0 * own["w"] * (0.8 - 0.033 * i_d) * i_q)
    assert len(own) > 30 and given.mean() == pytest.approx(-200.0, rel=0.1)
    assert believed.mean() > -150.0


def test_a_limit_that_never_binds_changes_no_bit() -> None:
    free, bound = (simulated(IDEAL, *more) for more in ((), ("limits.p_regen_max_w=1e6",)))
    assert free.tobytes() == bound.tobytes()


def test_on_the_bus_in_lockstep_it_brakes_and_replays_to_the_bit(tmp_path: Path) -> None:
    plant = tmp_path / "no-resistor.toml"
    plant.write_text(
        f'dbc = "{CONFIGS}/drives/hil_pmsm.dbc"\nmotor = "{CONFIGS}/motors/salient.toml"\n'
        "inverter = { v_dc_v = 325.0, capacitance_f = 2e-4, v_dc_trip_v = 750.0 }\n"
        "sensors = { w_noise_rad_s = 0.01, i_noise_a = 0.002 }\n"
    )
    own = (
        'loop.clock="lockstep"',
        "loop.duration_s=1.5",
        f'log.folder="{tmp_path}"',
        f'emulator.plant="{plant}"',
    )
    _, result, log = closed_loop(PATH, Overrides(settings=(*BRAKING, *own, POWER, *LINK)))
    assert result.outcome.reason == Reason.STOP_REQUESTED
    held = braking(log.ticks)
    assert 575.0 < np.nanmax(held["v_dc"]) < 595.0 and (held["guard_flags"] & GuardFlag.SATURATED).any()
    assert replay(Path(result.log)).verdict == "same"
