"""What may be wrong around a motor, in simulation: each named in a line, or ridden through without a lie."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hil.config.tables import RunConfig, load_toml
from hil.identify.session import Session, planned, setup_for
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

pytestmark = [pytest.mark.compiled, pytest.mark.slow]
BLOCKED = 'load=[{kind="brake",torque_n_m=100.0}]'
DRIVEN = 'load=[{kind="constant",torque_n_m=1.5}]'
HANGS = 'load=[{kind="constant",torque_n_m=0.15}]'
NO_LOAD = "load=[]"
WEAK = 'firmware={takes="current",i_limit_a=1.0}'
LOW = "inverter={v_dc_v=60.0}"
SALIENT = (
    "motor={R_s_ohm=3.45, L_d_h=0.0297, L_q_h=0.04, psi_f_wb=0.76, n_p=3, J_kg_m2=0.01265, B_f_n_m_s=4e-4, "
    "L_q_saturation_a=8.0}"
)
FEW_VOLTS = ("limits.v_dc_min_v=20.0",)


def seen(name: str, steps: tuple[str, ...], *plant: str, own: tuple[str, ...] = ()) -> Session:
    """The session of a shipped drive, its plant changed, until a fault."""
    path = CONFIGS / f"{name}.toml"
    config = load_toml(path, RunConfig, own)
    session = Session(path, config, config.motor)
    for step in planned(session, steps):
        session.note(step, simulate_ticks(setup_for(session, step), list(plant)))
        if session.faults:
            break
    return session


@pytest.mark.parametrize(
    ("steps", "plant", "words"),
    [
        (("spinning",), (BLOCKED,), "does not turn with 7.5 A"),
        (("spinning",), (DRIVEN,), "turns against the torque"),
        (("standstill",), (NO_LOAD, WEAK), "of 3.18 A that were asked for 1 A came"),
    ],
)
def test_a_drive_with_a_current_loop_names_it_too(
    steps: tuple[str, ...], plant: tuple[str, ...], words: str
) -> None:
    session = seen("current", steps, *plant)
    assert len(session.faults) == 1 and words in session.faults[0]
    assert session.as_dict()["ok"] is False


@pytest.mark.parametrize("name", ["demo", "current"])
def test_a_load_that_drives_the_shaft_at_rest_is_named(name: str) -> None:
    """Without torque it comes to 100 rad/s: no run of that may break the estimate."""
    session = seen(name, ("sensors",), DRIVEN)
    assert session.faults == []
    assert any("without torque: a load drives it" in line for line in session.findings)
    assert not session.estimate.parameters["J"].told


def test_noise_of_a_driven_shaft_is_not_its_motion() -> None:
    p = seen("current", ("sensors",), DRIVEN).estimate.parameters["w_noise"]
    assert p.told and p.value == pytest.approx(math.hypot(0.01, 0.01 / math.sqrt(12)), rel=0.15)


def test_a_load_that_acts_all_the_time_is_a_parameter() -> None:
    session = seen("current", ("inertia",), HANGS)
    p: Any = session.estimate.parameters["load"]
    assert p.told and p.low <= 0.15 * 3.6 / (1.5 * 3 * 0.76) <= p.high
    assert any("acts on the shaft all the time" in line for line in session.estimate.findings)


@pytest.mark.long
def test_a_supply_that_limits_is_ridden_through_with_wider_intervals() -> None:
    """60 V of 540 V: most ticks are limited and left out; the rest tells the motor, and B_f is refused."""
    session = seen("demo", ("standstill", "inertia"), NO_LOAD, LOW, own=FEW_VOLTS)
    full = seen("demo", ("standstill", "inertia"), NO_LOAD)
    assert session.faults == []
    assert any("at its limit, of supply or current, in 8" in line for line in session.findings)
    found = session.estimate.parameters
    true = {"R_s": 3.45, "L_d": 0.0297, "L_q": 0.0297, "psi_f": 0.76, "J": 0.01265}
    for key, value in true.items():
        p = found[key]
        assert p.told and p.low <= value <= p.high, key
        assert p.value == pytest.approx(value, rel=0.02), key
    wider = [found[key].half / full.estimate.parameters[key].half for key in ("J", "coulomb", "R_s")]
    assert min(wider) > 1.0 and np.isfinite(wider).all()
    b_f = found["B_f"]
    assert not b_f.told and "friction falls with speed" in b_f.why and session.motor.B_f_n_m_s == 2e-4


@pytest.mark.long
def test_an_echo_that_lags_is_named_and_told_in_ticks() -> None:
    """The ticks of a drive that echoes each command a period after it has taken it."""
    config = load_toml(CONFIGS / "demo.toml", RunConfig, ())
    session = Session(CONFIGS / "demo.toml", config, config.motor)
    (step,) = planned(session, ("standstill",))
    ticks = simulate_ticks(setup_for(session, step), [NO_LOAD])
    session.note(step, ticks)
    p = session.estimate.parameters
    assert (p["echo_lag"].value, p["delay"].value) == (0.0, 1.0) and p["echo_lag"].told
    assert not any("echo" in line for line in session.estimate.findings)
    late = Session(CONFIGS / "demo.toml", config, config.motor)
    for name in ("ua_q", "ua_d"):
        ticks[name] = np.append(0.0, ticks[name][:-1])
    late.note(step, ticks)
    p = late.estimate.parameters
    assert (p["echo_lag"].value, p["delay"].value) == (1.0, 1.0) and p["echo_lag"].told
    assert any("the echo of the commands lags" in line for line in late.estimate.findings)


def test_a_saturating_l_q_is_named_and_told_at_several_currents() -> None:
    session = seen("demo", ("standstill",), NO_LOAD, SALIENT)
    p, rows = session.estimate.parameters, session.estimate.saturation
    assert session.faults == [] and any("L_q saturates" in line for line in session.estimate.findings)
    assert p["L_q"].value == pytest.approx(0.04, rel=0.02) and p["L_d"].value == pytest.approx(
        0.0297, rel=0.02
    )
    assert p["R_s"].value == pytest.approx(3.45, rel=0.02)
    assert p["L_q_saturation"].value == pytest.approx(8.0, rel=0.05)
    assert [row["told"] for row in rows] == [True] * 3
    assert rows[2]["i_q_a"] > 3.0 and rows[2]["high"] < rows[1]["low"] < rows[1]["high"] < rows[0]["low"]
    for row in rows[1:]:  # i_q = phi + phi^3 / 4^2, psi_q = L_q phi
        phi = 0.04**-1 * row["value"] * row["i_q_a"]
        assert phi + phi**3 / 16.0 == pytest.approx(row["i_q_a"], rel=0.02)
