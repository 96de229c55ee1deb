"""The law mtpa against the emulated salient drive: past base speed, with less current, at its limits."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from hil.control.law import exact_after
from hil.control.mtpa import operating_point
from hil.report.metrics import load_step, operating
from hil.runtime.setup import Overrides, load_setup
from hil.signals import GuardFlag, Reason, TickArray
from hil.sim.demo import motor_model
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS
from tests.contract.lockstep import held_in_lockstep

PATH = CONFIGS / "salient.toml"
CASCADE = 'controller={kind="cascade", speed_pole_rad_s=80.0}'
PATIENT = "limits.following_error_s=60.0"
MATCHED = (
    "motor={R_s_ohm=2.875, L_d_h=0.033, L_q_h=0.066, psi_f_wb=0.8, n_p=3, J_kg_m2=0.011, B_f_n_m_s=2e-4}",
)
U = 0.92 * 180.0
pytestmark = [pytest.mark.compiled, pytest.mark.slow]  # whole runs: interpreted they take minutes


@cache
def simulated(plant: tuple[str, ...], *settings: str) -> TickArray:
    return simulate_ticks(load_setup(PATH, Overrides(settings=settings)), list(plant))


def between(ticks: TickArray, start: float, end: float) -> TickArray:
    own = operating(ticks)
    return own[(own["t_ns"] > start * 1e9) & (own["t_ns"] < end * 1e9)]


def motor(J: float, psi: float, R: float, L: float) -> tuple[str, ...]:
    """The plant's motor off the controller's belief by these factors."""
    return (
        f"motor={{R_s_ohm={2.875 * R!r}, L_d_h={0.033 * L!r}, L_q_h={0.066 * L!r}, psi_f_wb={0.8 * psi!r}, "
        f"n_p=3, J_kg_m2={0.011 * J!r}, B_f_n_m_s=2e-4}}",
    )


def test_past_base_speed_it_holds_load_and_speed_on_its_share_of_the_circle() -> None:
    """The plant's motor is off by 5 to 20 %; the observers make up for it, so the share is met."""
    ticks = simulated(())
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    for start, end in ((2.0, 2.45), (3.5, 4.4)):
        own = between(ticks, start, end)
        assert np.abs(own["w"] - own["w_ref"]).max() < 0.1 and own["w_ref"].min() == 120.0
        assert np.hypot(own["u_q"], own["u_d"]).mean() == pytest.approx(U, abs=0.1)
        assert np.abs(own["i_d"] - own["i_d_ref"]).max() < 0.05 and own["i_d"].max() < -9.0
        assert not own["guard_flags"].any()
    step = between(ticks, 2.5, 4.4)
    assert np.abs(step["w"] - step["w_ref"]).max() < 4.5
    assert np.abs(between(ticks, 2.7, 4.4)["w"] - 120.0).max() < 0.5


def test_without_a_d_current_the_speed_sticks() -> None:
    own = between(simulated((), CASCADE, PATIENT), 2.0, 2.45)
    assert own["w"].max() < 90.0 and (own["guard_flags"] & GuardFlag.SATURATED).all()
    assert not own["i_d_ref"].any()


def test_the_torque_takes_the_least_current_and_less_than_without_a_d_current() -> None:
    """25 N m at 40 rad/s: the ratio is that of an independent minimisation of |i| over i_d."""
    plant = (*MATCHED, 'load=[{kind="brake", torque_n_m=25.0, at_s=2.0}]', "friction.coulomb_n_m=0.0")
    plant = (*plant, "friction.static_n_m=0.0")
    settings = ("reference.w_rad_s=40.0", "limits.i2t_max_a2s=4000.0", PATIENT)
    sizes = []
    for law in ((), (CASCADE,)):
        own = between(simulated(plant, *settings, *law), 3.5, 4.4)
        assert np.abs(own["w"] - 40.0).max() < 0.2
        sizes.append(float(np.hypot(own["i_q"].mean(), own["i_d"].mean())))
    tau = (25.0 + 2e-4 * 40.0) / 4.5
    found = minimize_scalar(
        lambda x: math.hypot(x, tau / (0.8 - 0.033 * x)), bounds=(-15.0, 5.0), method="bounded"
    )
    assert sizes[0] == pytest.approx(found.fun, rel=2e-3)
    assert sizes[0] / sizes[1] == pytest.approx(found.fun / (tau / 0.8), rel=3e-3)
    assert sizes[0] < 0.97 * sizes[1]


def test_the_point_is_that_of_the_plants_own_motor_when_it_is_known() -> None:
    own = between(simulated(MATCHED), 3.5, 4.4)
    setup = load_setup(PATH, Overrides())
    tau = float(np.mean((0.8 - 0.033 * own["i_d"]) * own["i_q"]))
    i_d, i_q, capped = operating_point(setup.machine.law[0], tau, 360.0, U)
    assert not capped
    assert own["i_d"].mean() == pytest.approx(i_d, abs=0.03)
    assert own["i_q"].mean() == pytest.approx(i_q, abs=0.01)


def test_a_table_from_a_file_is_followed_in_the_loop(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        "i_q_a = [0.0, 5.0, 15.0]\ni_d_a = [0.0, -3.0, -5.0]\n", encoding="utf-8"
    )
    ticks = simulated((), "reference.w_rad_s=40.0", f'controller.i_d_table="{tmp_path / "own.toml"}"')
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = between(ticks, 3.5, 4.4)
    assert np.abs(own["w"] - 40.0).max() < 0.1 and not own["guard_flags"].any()
    assert np.allclose(own["i_d_ref"], -0.6 * own["i_q_ref"]) and own["i_d_ref"].max() < -0.5
    assert np.abs(own["i_d"] - own["i_d_ref"]).max() < 0.05


def test_the_estimate_is_judged_with_the_reluctance_torque_that_the_model_knows() -> None:
    setup = load_setup(PATH, Overrides())
    own, N = motor_model(setup.config.motor), exact_after(setup.machine.law)[0]
    step = load_step(
        simulated((*MATCHED, "friction.coulomb_n_m=0.0", "friction.static_n_m=0.0")), N, own, own
    )
    assert step is not None and abs(step.step) > 400.0
    assert step.estimate_error < 0.005 * abs(step.step)  # i_d i_q is held over a tick


@pytest.mark.parametrize(
    "factors", [(0.7, 0.8, 0.7, 0.8), (1.3, 1.1, 1.3, 1.2), (1.3, 0.8, 0.7, 1.2)], ids=str
)
def test_a_motor_that_is_off_is_held_too(factors: tuple[float, float, float, float]) -> None:
    ticks = simulated(motor(*factors))
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = between(ticks, 3.5, 4.4)
    assert np.abs(own["w"] - 120.0).max() < 0.3
    assert np.hypot(own["u_q"], own["u_d"]).mean() < U + 0.5


def test_a_link_that_gives_less_is_kept_to() -> None:
    """280 V in place of 325: the circle is v_dc / sqrt 3, what the drive really applies is what is sent."""
    ticks = simulated((), "limits.v_dc_min_v=200.0")
    low = simulated(("inverter.v_dc_v=280.0",), "limits.v_dc_min_v=200.0")
    own = between(low, 3.5, 4.4)
    assert np.abs(own["w"] - 120.0).max() < 0.2 and not own["limited"].any()
    link = own["v_dc"] / math.sqrt(3.0)
    assert np.hypot(own["u_q"], own["u_d"]).mean() == pytest.approx(0.92 * link.mean(), abs=0.2)
    assert own["i_d"].mean() < between(ticks, 3.5, 4.4)["i_d"].mean() - 1.0


def test_a_load_past_the_most_torque_is_flagged_and_trips() -> None:
    ticks = simulated(('load=[{kind="brake", torque_n_m=30.0, at_s=2.5}]',))
    assert Reason(int(ticks["reason"][-1])) == Reason.FOLLOWING_ERROR
    stop = int(np.argmax(ticks["reason"] != 0))
    assert (ticks["guard_flags"][stop - 20 : stop] & GuardFlag.SATURATED).all()
    assert np.hypot(ticks["i_q_ref"], ticks["i_d_ref"]).max() <= 15.0 * (1 + 1e-12)
    late = ticks[stop:]
    assert not late["u_q"].any() and not late["u_d"].any() and not late["i_d_ref"].any()


def test_on_the_bus_in_lockstep_it_holds_and_replays_to_the_bit(tmp_path: Path) -> None:
    assert held_in_lockstep(PATH, tmp_path).verdict == "same"
