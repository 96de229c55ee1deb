"""A soft coupling in the emulated drive: against expm and scipy, energy, resonances, sticking, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from firmware_model.config import PlantConfig, Wire, build_params, new_sample, new_state
from firmware_model.coupling import FASTEST_RAD_S
from firmware_model.drive import on_sync
from firmware_model.faulty_plant import PlantFaults
from firmware_model.kernels import Kernels
from firmware_model.plant import ANGLE, LOAD_SPEED, TWIST, State
from firmware_model.registry import PlantError
from firmware_model.rub import friction_torque
from firmware_model.shaft import refuse_uncoupled

J, B_F = 0.011, 2e-3
MOTOR = {
    "R_s_ohm": 2.0, "L_d_h": 0.02, "L_q_h": 0.033, "psi_f_wb": 0.7, "n_p": 3, "J_kg_m2": J, "B_f_n_m_s": B_F
}  # fmt: skip
WIRE = Wire(0.0, math.inf, 0.0, math.inf, 0.0, math.inf)
FREE = {"i_trip_a": 1e3, "w_trip_rad_s": 1e4, "temperature_trip_c": 1e3}
EVEN = {"inertia_ratio": 1.0, "resonance_hz": 80.0}
HEAVY = {"inertia_ratio": 4.0, "resonance_hz": 400.0, "damping_ratio": 0.05}


def plant(coupling: dict[str, float] | None, **more: Any) -> tuple[Any, Any, Callable[[int], None]]:
    """Parameters, state, and what moves it on by so many ns."""
    tables = {"dbc": "none", "motor": MOTOR, "firmware": FREE, "coupling": coupling} | more
    p = build_params(PlantConfig.model_validate(tables), WIRE)
    kernels = Kernels(p, new_state(p, 15), new_sample())
    return kernels.params, kernels.state, lambda ns: kernels.advance(ns)  # which keeps the records alive


def shaft(s: Any) -> list[float]:
    """w, w_l and twist."""
    return [float(s["x"][0]), float(s["series"][LOAD_SPEED, 0]), float(s["series"][TWIST, 0])]


def put(s: Any, w: float, w_l: float, twist: float) -> None:
    s["x"][0], s["series"][LOAD_SPEED, 0], s["series"][TWIST, 0] = w, w_l, twist


def matrix(p: Any) -> Any:
    """d/dt (w, w_l, twist, 1) under 1.5 N m with the gates off, written out a second time."""
    J_m, J_l, c, d = (float(p[name]) for name in ("J", "J_load", "stiffness", "damping"))
    return np.array([
        [-(d + B_F) / J_m, d / J_m, -c / J_m, 0.0],
        [d / J_l, -d / J_l, c / J_l, -1.5 / J_l],
        [1.0, -1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
    ])  # fmt: skip


@pytest.mark.parametrize("coupling", [EVEN, HEAVY, {**EVEN, "resonance_hz": 3000.0}])
def test_the_free_shaft_is_the_matrix_exponential(coupling: dict[str, float]) -> None:
    p, s, advance = plant(coupling, load=[{"kind": "constant", "torque_n_m": 1.5}])
    put(s, 7.0, -3.0, 0.01)
    for _ in range(200):
        advance(1_000_000)
    exact = expm(matrix(p) * 0.2) @ [7.0, -3.0, 0.01, 1.0]
    assert np.abs(exact[:3] - shaft(s)).max() < 1e-9


def test_under_current_a_fan_cogging_and_the_angle_it_is_scipys() -> None:
    """The fan turns with the load, cogging with the motor; all of it salient and at changing speed."""
    loads = [
        {"kind": "fan", "k_n_m_s2": 8e-4},
        {"kind": "cogging", "torque_n_m": 0.4, "order": 24, "phase_rad": 0.3},
        {"kind": "constant", "torque_n_m": -0.6},
    ]
    p, s, advance = plant(HEAVY, load=loads)
    s["state"], s["started"], s["u_q"], s["u_d"] = int(State.OPERATION_ENABLED), 1, 60.0, -4.0
    put(s, 20.0, 19.0, 2e-4)
    J_m, J_l, c, d = (float(p[name]) for name in ("J", "J_load", "stiffness", "damping"))

    def rate(_: float, x: Any) -> list[float]:
        w, q, i_d, w_l, twist, angle = x
        T = 1.5 * 3 * (0.7 * q + (0.02 - 0.033) * i_d * q)
        T_k = c * twist + d * (w - w_l)
        return [
            (T - B_F * w - T_k - 0.4 * math.sin(24 * angle + 0.3)) / J_m,
            (60.0 - 2.0 * q - 3 * w * (0.02 * i_d + 0.7)) / 0.033,
            (-4.0 - 2.0 * i_d + 3 * w * 0.033 * q) / 0.02,
            (T_k - 8e-4 * w_l * abs(w_l) + 0.6) / J_l,
            w - w_l,
            w,
        ]

    true = solve_ivp(rate, (0, 0.1), [20.0, 0, 0, 19.0, 2e-4, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    for _ in range(100):
        advance(1_000_000)
    got = [*s["x"], *shaft(s)[1:], s["series"][ANGLE, 0]]
    assert np.abs(true - got).max() < 1e-8


def test_an_undamped_shaft_keeps_its_energy_and_its_momentum() -> None:
    p, s, advance = plant({**EVEN, "damping_ratio": 0.0}, motor={**MOTOR, "B_f_n_m_s": 0.0})
    put(s, 5.0, -5.0, 0.02)
    before = energy(p, s)
    for _ in range(2000):
        advance(1_000_000)
    assert abs(energy(p, s) / before - 1) < 1e-8  # 5000 steps, each of (r h)^9 / 9! = 1e-12
    w, w_l, _ = shaft(s)
    assert abs(p["J"] * w + p["J_load"] * w_l) < 1e-12


def energy(p: Any, s: Any) -> float:
    w, w_l, twist = shaft(s)
    return float(0.5 * (p["J"] * w * w + p["J_load"] * w_l * w_l + p["stiffness"] * twist * twist))


def test_damping_takes_what_the_energy_loses() -> None:
    p, s, advance = plant({**EVEN, "damping_ratio": 0.03}, motor={**MOTOR, "B_f_n_m_s": 0.0})
    put(s, 5.0, -5.0, 0.0)
    before, slips = energy(p, s), [10.0]
    for _ in range(4000):
        advance(10_000)
        w, w_l, _ = shaft(s)
        slips.append(w - w_l)
    loss = p["damping"] * np.trapezoid(np.square(slips), dx=1e-5)
    assert 0.5 * before < loss and abs(before - energy(p, s) - loss) < 1e-5 * before


@pytest.mark.parametrize(("ratio", "hz"), [(1.0, 80.0), (4.0, 120.0)])
def test_the_response_has_the_resonance_and_the_anti_resonance(ratio: float, hz: float) -> None:
    """w after a kick of the motor: the peak at (c (1/J_m + 1/J_l))^1/2, the hole at (c / J_l)^1/2."""
    coupling = {"inertia_ratio": ratio, "resonance_hz": hz, "damping_ratio": 0.01}
    _, s, advance = plant(coupling, motor={**MOTOR, "B_f_n_m_s": 0.0})
    put(s, 1.0, 0.0, 0.0)
    w = [1.0]
    for _ in range(6000):
        advance(400_000)
        w.append(float(s["x"][0]))
    f = np.arange(0.3 * hz, 1.2 * hz, 0.1)
    rigid, dt = 1 / (1 + ratio), 4e-4  # where the speed settles; the transform of that is rigid / (i w)
    kernel = np.exp(-2j * np.pi * np.outer(f, np.arange(len(w)) * dt)) * dt
    kernel[:, 0] /= 2
    spectrum = np.abs(kernel @ (np.array(w) - rigid) + rigid / (2j * np.pi * f))
    low = f < 0.8 * hz
    assert abs(f[np.argmax(spectrum)] - hz) < 0.15
    assert abs(f[low][np.argmin(spectrum[low])] - hz / math.sqrt(1 + ratio)) < 0.2


def test_a_motor_that_sticks_holds_its_end_and_breaks_away_as_scipys() -> None:
    """The load swings up on the held shaft until the coupling's torque is the static one; then both move."""
    friction = {"coulomb_n_m": 0.4, "static_n_m": 0.9, "stribeck_rad_s": 1.5}
    p, s, advance = plant(EVEN, friction=friction, load=[{"kind": "constant", "torque_n_m": -0.55}])
    J_m, J_l, c, d = (float(p[name]) for name in ("J", "J_load", "stiffness", "damping"))

    def rate(_: float, x: Any, slides: float) -> list[float]:
        w, w_l, twist = x
        T_k = c * twist + d * (w - w_l)
        T_f = 0.4 + 0.5 * math.exp(-abs(w) / 1.5)
        return [slides * (-T_k - B_F * w - T_f) / J_m, (T_k + 0.55) / J_l, w - w_l]

    def breaks(_: float, x: Any, __: float) -> float:
        return float(-c * x[2] - d * (x[0] - x[1]) - 0.9)

    breaks.terminal = True  # type: ignore[attr-defined]
    exact: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14}
    stuck = solve_ivp(rate, (0, 1), [0.0, 0.0, 0.0], events=breaks, args=(0.0,), **exact)
    away = float(stuck.t_events[0][0])
    while int(s["t_ns"]) + 500_000 <= away * 1e9:
        advance(500_000)
        assert s["x"][0] == 0.0
        assert friction_torque(p, s, 0.0) == pytest.approx(-(p["stiffness"] * shaft(s)[2] - d * shaft(s)[1]))
    assert abs(shaft(s)[1]) > 0.1
    end = away + 2e-3
    advance(round(end * 1e9) - int(s["t_ns"]))
    slid = solve_ivp(rate, (0, int(s["t_ns"]) * 1e-9 - away), stuck.y[:, -1], args=(1.0,), **exact)
    assert s["x"][0] > 0.01 and np.abs(slid.y[:, -1] - shaft(s)).max() < 1e-7


def test_it_comes_to_rest_under_friction_with_its_twist_held() -> None:
    load = [{"kind": "constant", "torque_n_m": 0.3}]
    p, s, advance = plant({**EVEN, "damping_ratio": 0.1}, friction={"coulomb_n_m": 0.5}, load=load)
    put(s, 3.0, 3.0, 0.0)
    for _ in range(1000):
        advance(1_000_000)
    w, w_l, twist = shaft(s)
    assert w == 0.0 and abs(w_l) < 1e-9 and twist == pytest.approx(0.3 / float(p["stiffness"]))
    out = new_sample()[0]
    on_sync(p, s, out)
    assert out["T_L_true"] == pytest.approx(0.0, abs=1e-6), "what friction holds and the load cancel"


def test_the_load_that_is_reported_turns_with_the_loads_speed() -> None:
    p, s, _ = plant(EVEN, load=[{"kind": "fan", "k_n_m_s2": 1e-3}])
    put(s, 10.0, 40.0, 0.0)
    s["started"], out = 1, new_sample()[0]
    on_sync(p, s, out)
    assert out["T_L_true"] == pytest.approx(1.6) and out["w_true"] == 10.0


def test_a_stiff_coupling_is_the_rigid_shaft() -> None:
    load = [{"kind": "step", "torque_n_m": 2.0, "at_s": 0.01}]
    soft, rigid = (plant(one, load=load) for one in ({"inertia_ratio": 1.0, "resonance_hz": 3e3}, None))
    for _, s, advance in (soft, rigid):
        s["state"], s["started"], s["u_q"] = int(State.OPERATION_ENABLED), 1, 40.0
        for _ in range(100):
            advance(1_000_000)
    assert abs(soft[1]["x"][0] - rigid[1]["x"][0]) < 0.01 and soft[1]["x"][0] > 3.0


def test_both_ways_of_saying_it_say_the_same() -> None:
    first = PlantConfig.model_validate({"dbc": "none", "motor": MOTOR, "coupling": HEAVY}).masses
    said = {"J_load_kg_m2": first.J_l, "stiffness_n_m_rad": first.c, "damping_n_m_s_rad": first.d}
    other = PlantConfig.model_validate({"dbc": "none", "motor": MOTOR, "coupling": said}).masses
    assert (other.J_m, other.J_l, other.c, other.d) == pytest.approx((J / 5, 4 * J / 5, first.c, first.d))
    assert other.resonance_rad_s == pytest.approx(2 * math.pi * 400)


def test_without_a_coupling_there_is_one_inertia_and_the_substep_is_as_given() -> None:
    p, s, advance = plant(None)
    assert (p["J"], p["J_load"], p["varying"], p["substep_ns"]) == (J, 0.0, 0, 500_000)
    s["x"][0] = 5.0
    advance(1_000_000)
    assert shaft(s)[1:] == [0.0, 0.0]


def test_the_substep_is_short_enough_for_the_resonance() -> None:
    p, _, _ = plant({"inertia_ratio": 1.0, "resonance_hz": 400.0})
    assert p["substep_ns"] == math.floor(0.2 / (2 * math.pi * 400) * 1e9)
    p, _, _ = plant({"inertia_ratio": 1.0, "resonance_hz": 5.0})
    assert p["substep_ns"] == 500_000


def test_a_supply_that_fails_leaves_the_shaft_as_it_is() -> None:
    tables = {"dbc": "none", "motor": MOTOR, "coupling": EVEN}
    tables |= {"fault": [{"kind": "brown-out", "at_s": 0.0, "for_s": 0.01}]}
    config = PlantConfig.model_validate(tables)
    params = build_params(config, WIRE)
    s = new_state(params, 15)[0]
    put(s, 5.0, 4.0, 0.01)
    s["series"][ANGLE, 0], s["u_q"] = 2.5, 3.0
    PlantFaults(config.fault, params, 15).before(s)
    assert shaft(s) == [5.0, 4.0, 0.01] and s["series"][ANGLE, 0] == 2.5 and s["u_q"] == 0.0


def test_a_state_that_is_no_number_trips_and_is_none_afterwards() -> None:
    _, s, advance = plant(EVEN)
    put(s, 1.0, math.nan, 0.0)
    for _ in range(2):
        advance(1_000_000)
    assert s["state"] == int(State.FAULT) and np.isfinite(shaft(s)).all()


FASTEST_HZ = FASTEST_RAD_S / (2 * math.pi)
REFUSED = [
    ({"inertia_ratio": 1.0, "stiffness_n_m_rad": -1.0}, "stiffness_n_m_rad"),
    ({"J_load_kg_m2": 0.0, "resonance_hz": 80.0}, "J_load_kg_m2"),
    ({"J_load_kg_m2": J, "resonance_hz": 80.0}, "must be less than motor.J_kg_m2 = 0.011"),
    ({"resonance_hz": 80.0}, "give one of J_load_kg_m2 and inertia_ratio"),
    ({"inertia_ratio": 1.0}, "give one of stiffness_n_m_rad and resonance_hz"),
    ({**EVEN, "stiffness_n_m_rad": 1.0}, "give one of stiffness_n_m_rad and resonance_hz"),
    ({**EVEN, "damping_ratio": 0.1, "damping_n_m_s_rad": 0.1}, "damping_n_m_s_rad and damping_ratio"),
    ({**EVEN, "damping_ratio": -0.1}, "damping_ratio"),
    ({**EVEN, "resonance_hz": FASTEST_HZ * 1.01}, f"above {FASTEST_HZ:.0f} Hz a shaft counts as rigid"),
    ({"inertia_ratio": 1.0, "stiffness_n_m_rad": 1e9}, f"above {FASTEST_HZ:.0f} Hz a shaft counts as rigid"),
    ({**EVEN, "damping_ratio": 100.0}, "above 20000 1/s a shaft counts as rigid"),
]


@pytest.mark.parametrize(("coupling", "why"), REFUSED)
def test_what_can_not_be_is_refused(coupling: dict[str, float], why: str) -> None:
    with pytest.raises(ValidationError) as caught:
        PlantConfig.model_validate({"dbc": "none", "motor": MOTOR, "coupling": coupling})
    assert len(caught.value.errors()) == 1 and why in str(caught.value)


def test_two_motors_on_one_shaft_have_no_coupling() -> None:
    one = PlantConfig.model_validate({"dbc": "none", "motor": MOTOR, "coupling": EVEN})
    with pytest.raises(PlantError, match="plant of load: coupling: not on a shaft of two motors"):
        refuse_uncoupled({"load": one})
