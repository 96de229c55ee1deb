"""The whole controller against the whole emulated drive, in the simulation that equals a lockstep bus."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest

from hil.config.design import motor_model
from hil.report.metrics import load_step, operating, tracking_rms
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Reason, TickArray
from hil.sim.demo import resolution_bound, true_motor
from hil.sim.emulate import load_plant
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

PATH = CONFIGS / "demo.toml"
MATCHED = 'emulator.plant="plants/matched.toml"'


@cache
def simulated(plant: tuple[str, ...], *settings: str) -> TickArray:
    setup = load_setup(PATH, Overrides(settings=settings))
    return simulate_ticks(setup, list(plant))


def corner(J: float, psi: float, R: float, L: float) -> tuple[str, ...]:
    """The plant's motor off the controller's belief by these factors."""
    motor = {
        "J_kg_m2": 0.011 * J, "psi_f_wb": 0.8 * psi, "R_s_ohm": 2.875 * R,
        "L_d_h": 0.033 * L, "L_q_h": 0.033 * L, "n_p": 3, "B_f_n_m_s": 2e-4,
    }  # fmt: skip
    inline = ", ".join(f"{name} = {value!r}" for name, value in motor.items())
    return (f"motor={{ {inline} }}",)


def test_the_estimate_is_within_what_the_frames_resolve() -> None:
    setup = load_setup(PATH, Overrides(settings=(MATCHED,)))
    plant, _ = load_plant(PATH, setup.config)
    N = int(setup.machine.law["N"][0, 0])
    step = load_step(simulated((), MATCHED), N, motor_model(setup.config.motor), true_motor(plant.motor))
    assert step is not None
    bound = resolution_bound(setup)
    print(f"estimate error {step.estimate_error:.3f} rad/s2 of {abs(step.step):.0f}, bound {bound:.3f}")
    assert step.step == pytest.approx(-5.4 / 0.011, rel=1e-6)
    assert 0 < step.estimate_error <= bound


def test_the_length_of_a_block_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = simulated((), "loop.duration_s=0.5")
    monkeypatch.setattr("hil.sim.simulate.BLOCK", 7)
    parts = simulate_ticks(load_setup(PATH, Overrides(settings=("loop.duration_s=0.5",))), [])
    assert len(whole) > 500 and parts.tobytes() == whole.tobytes()


def test_the_matched_loop_dips_and_recovers() -> None:
    ticks = simulated((), MATCHED)
    own = operating(ticks)
    error = own["w"] - own["w_ref"]
    assert np.abs(error).max() < 4.5
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    assert tracking_rms(ticks) < 0.6


@pytest.mark.parametrize("factors", list(itertools.product((0.7, 1.3), repeat=4)), ids=str)
def test_thirty_percent_off_in_every_corner(factors: tuple[float, float, float, float]) -> None:
    ticks = simulated(corner(*factors))
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = operating(ticks)
    error = np.abs(own["w"] - own["w_ref"])
    before, after = own["t_ns"] < 2.45e9, (own["t_ns"] > 3.0e9) & (own["t_ns"] < 4.4e9)
    assert error.max() < 9.0
    assert error[after].max() < 0.5, "the speed returns within half a second"
    assert error[before & (own["t_ns"] > 1.6e9)].max() < 0.5


@pytest.mark.parametrize(
    "load",
    [
        'load=[{kind="constant", torque_n_m=3.0}]',
        'load=[{kind="sine", torque_n_m=2.0, frequency_hz=1.0}]',
        'load=[{kind="fan", k_n_m_s2=5e-4}]',
        'load=[{kind="coupler", torque_at_zero_gap_n_m=6.0, gap_mm=2.0, decay_length_mm=10.0, '
        "slip_at_max_rad_s=40.0}]",
    ],
)
def test_other_loads_are_held_too(load: str) -> None:
    own = operating(simulated((load,)))
    steady = (own["t_ns"] > 2.0e9) & (own["t_ns"] < 4.8e9)
    assert np.abs(own["w"] - own["w_ref"])[steady].max() < 1.0
    estimate = own["T_L_hat"][steady]
    assert np.abs(estimate).max() > 0.5, "the load is seen"


def test_a_voltage_limit_that_is_reached_does_not_wind_up() -> None:
    ticks = simulated((), MATCHED, "limits.u_max_v=205.0", "limits.guard_trip_ticks=100000")
    own = operating(ticks)
    assert np.hypot(own["u_q"], own["u_d"]).max() <= 205.01
    late = (own["t_ns"] > 3.5e9) & (own["t_ns"] < 4.4e9)
    assert np.abs(own["w"] - own["w_ref"])[late].max() < 3.0


def test_a_conventional_dob_runs_through_the_same_loop() -> None:
    dob = (
        'observer.speed={kind="dob", gamma_1_rad_s=60.0}',
        'observer.current={kind="dob", gamma_1_rad_s=120.0}',
    )
    own = operating(simulated((), MATCHED, *dob))
    assert 2.0 < np.abs(own["w"] - own["w_ref"]).max() < 15.0


@pytest.mark.parametrize(
    "name", ["odrive.toml", "moteus.toml", "cia402.toml", "current.toml", "inverter.toml"]
)
def test_a_drive_of_several_slow_messages_runs_to_its_end(name: str) -> None:
    setup = load_setup(CONFIGS / name, Overrides(settings=("loop.duration_s=1.0",)))
    ticks = simulate_ticks(setup)
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    messages = int(setup.machine.safety["messages"][0])
    came = ticks["missing"][ticks["missing"] != 2**32 - 1]
    assert (came == 2**32 - 2**messages).all() and bool(len(came)) == (messages > 0)
