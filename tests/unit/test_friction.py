"""Friction and DC link of the emulated drive: against scipy to the event, sticking, energy, edges."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from firmware_model.config import Inverter, PlantConfig, Wire, build_params, new_state
from firmware_model.drive import advance
from firmware_model.friction import dry_above
from firmware_model.plant import ORDER, ErrorCode, State
from firmware_model.rub import friction_torque
from firmware_model.series import LOOKS, evaluate, first_crossing, stays_clear

MOTOR = {
    "R_s_ohm": 2.875, "L_d_h": 0.033, "L_q_h": 0.033, "psi_f_wb": 0.8, "n_p": 3, "J_kg_m2": 0.011,
    "B_f_n_m_s": 2e-4,
}  # fmt: skip
WIRE = Wire(0.0, math.inf, 0.0, math.inf, 0.0, math.inf)
STRIBECK = {"coulomb_n_m": 0.4, "static_n_m": 0.9, "stribeck_rad_s": 1.5}


def plant(**more: Any) -> tuple[Any, Any]:
    config = PlantConfig.model_validate({"dbc": "none", "motor": MOTOR, **more})
    p = build_params(config, WIRE)
    return p[0], new_state(p, 15)[0]


def enabled(s: Any, u_q: float = 0.0, w: float = 0.0, i_q: float = 0.0) -> None:
    s["state"], s["started"], s["u_q"] = int(State.OPERATION_ENABLED), 1, u_q
    s["x"][0], s["x"][1] = w, i_q


def rate(p: Any, direction: float, on: bool = True) -> Any:
    """dx/dt for a shaft that slides the given way, or sticks (0)."""

    def of(_: float, x: Any, u_q: float) -> list[float]:
        w, q, d = x
        T_e = 1.5 * p["n_p"] * p["psi_f"] * q - p["B_f"] * w
        size = p["coulomb"] + (p["static"] - p["coulomb"]) * math.exp(-abs(w) / p["stribeck"])
        dw = (T_e - direction * size) / p["J"] if direction else 0.0
        dq = (u_q - p["R_s"] * q - p["n_p"] * w * (p["L_d"] * d + p["psi_f"])) / p["L_q"]
        if not on:
            return [dw, 0.0, 0.0]
        return [dw, dq, (-p["R_s"] * d + p["n_p"] * w * p["L_q"] * q) / p["L_d"]]

    return of


def stopped(p: Any, x: list[float], on: bool = True) -> Any:
    """scipy's way to w = 0 from x, with the event there; with the gates off there is no current."""

    def rest(_: float, now: Any, __: float) -> float:
        return float(now[0])

    rest.terminal = True  # type: ignore[attr-defined]
    of = rate(p, 1.0, on)
    return solve_ivp(of, (0, 1), x, "DOP853", events=rest, args=(0.0,), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("coulomb", [0.1, 0.3, 0.4, 0.499, 1.0, 3.0])
def test_far_from_rest_friction_is_coulombs_to_the_bit(coulomb: float) -> None:
    """And a torque of Stribeck's that is too large beside Coulomb's to be lost is never left out."""
    for extra in (0.0, 0.2 * coulomb, 1.74 * coulomb, 1.76 * coulomb, 1e6 * coulomb):
        friction = {"coulomb_n_m": coulomb, "static_n_m": coulomb + extra, "stribeck_rad_s": 1.5}
        p, _ = plant(friction=friction)
        far = dry_above(p, p["coulomb"])
        assert far == (0.0 if extra == 0.0 else 57.0 if extra < 1.75 * coulomb else math.inf)
        if far < math.inf:
            assert coulomb + extra * math.exp(-far / 1.5) == coulomb


def test_a_shaft_that_coasts_stops_in_time_and_rests_to_the_bit() -> None:
    p, s = plant(friction=STRIBECK)
    s["x"][0] = 5.0
    true = stopped(p, [5.0, 0.0, 0.0], on=False)
    stops = float(true.t_events[0][0])
    for _ in range(int(stops / 5e-4)):
        advance(p, s, 500_000)
    t = int(s["t_ns"]) * 1e-9
    dense = solve_ivp(
        rate(p, 1.0, on=False), (0, t), [5.0, 0.0, 0.0], "DOP853", args=(0.0,), rtol=1e-12, atol=1e-13
    )
    assert abs(dense.y[0, -1] - s["x"][0]) < 1e-9 and s["x"][0] > 0.0
    advance(p, s, 500_000)
    assert s["x"][0] == 0.0
    for _ in range(200):
        advance(p, s, 500_000)
        assert s["x"][0] == 0.0


def test_a_shaft_that_is_pulled_through_zero_slides_back_as_scipys() -> None:
    """The braking current is above the static torque at w = 0: friction turns its sign there, at once."""
    p, s = plant(friction=STRIBECK)
    enabled(s, w=5.0)
    true = stopped(p, [5.0, 0.0, 0.0])
    stops = float(true.t_events[0][0])
    back = solve_ivp(
        rate(p, -1.0), (0, 2e-3), [0.0, *true.y[1:, -1]], "DOP853", args=(0.0,), rtol=1e-12, atol=1e-13,
        dense_output=True,
    )  # fmt: skip
    while int(s["t_ns"]) * 1e-9 < stops + 1e-3:
        advance(p, s, 500_000)
    assert s["x"][0] < -0.05
    assert np.abs(back.sol(int(s["t_ns"]) * 1e-9 - stops) - s["x"]).max() < 1e-8


def test_a_shaft_breaks_away_at_the_static_torque_and_slides_as_scipys() -> None:
    p, s = plant(friction=STRIBECK)
    u_q = 1.3 * STRIBECK["static_n_m"] / (1.5 * 3 * 0.8) * MOTOR["R_s_ohm"]
    enabled(s, u_q)

    def breaks(_: float, x: Any, __: float) -> float:
        return float(1.5 * p["n_p"] * p["psi_f"] * x[1] - p["static"])

    breaks.terminal = True  # type: ignore[attr-defined]
    kwargs: dict[str, Any] = {"args": (u_q,), "rtol": 1e-12, "atol": 1e-13}
    stuck = solve_ivp(rate(p, 0.0), (0, 1), [0.0, 0.0, 0.0], "DOP853", events=breaks, **kwargs)
    away = float(stuck.t_events[0][0])
    for _ in range(80):
        advance(p, s, 500_000)
        if s["x"][0] == 0.0:
            assert int(s["t_ns"]) * 1e-9 <= away
    assert s["x"][0] > 0.1
    slides = solve_ivp(rate(p, 1.0), (0, 0.04 - away), stuck.y[:, -1], "DOP853", **kwargs)
    assert np.abs(slides.y[:, -1] - s["x"]).max() < 1e-6  # the corner at the event amplifies its rounding


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_below_the_static_torque_it_sticks_for_good(direction: float) -> None:
    p, s = plant(friction=STRIBECK, load=[{"kind": "constant", "torque_n_m": 0.89 * direction}])
    for _ in range(1000):
        advance(p, s, 1_000_000)
    assert s["x"][0] == 0.0
    assert friction_torque(p, s, 1.0) == pytest.approx(-0.89 * direction)
    p, s = plant(friction=STRIBECK, load=[{"kind": "constant", "torque_n_m": 0.91 * direction}])
    advance(p, s, 100_000_000)
    assert -s["x"][0] * direction > 0.1


def test_a_brake_holds_and_never_drives() -> None:
    brake = {"kind": "brake", "torque_n_m": 5.4, "at_s": 0.0105, "until_s": 0.5}
    p, s = plant(load=[brake])
    enabled(s, w=20.0)
    s["state"] = int(State.SWITCH_ON_DISABLED)
    advance(p, s, 10_500_000)
    assert s["x"][0] == pytest.approx(20.0 * math.exp(-2e-4 / 0.011 * 0.0105), rel=1e-12)
    advance(p, s, 5_000_000)
    assert s["x"][0] == pytest.approx(20.0 - 5.4 / 0.011 * 5e-3, rel=1e-3)
    advance(p, s, 900_000_000)
    assert s["x"][0] == 0.0


def test_without_friction_and_link_nothing_is_other_than_before() -> None:
    """The old path, bit for bit: the new one with no friction only agrees to its accuracy."""
    p, s = plant()
    assert (p["rubs"], p["capacitance"]) == (0, 0.0)
    enabled(s, 40.0, w=3.0)
    q, other = plant(inverter={"capacitance_f": 1e-3})
    enabled(other, 40.0, w=3.0)
    for _ in range(50):
        advance(p, s, 1_000_000)
        advance(q, other, 1_000_000)
    assert s["x"].tobytes() == other["x"].tobytes() and s["v_dc"] == 540.0


LINK = {
    "capacitance_f": 1e-3,
    "rectifier_ohm": 0.5,
    "brake_ohm": 50.0,
    "brake_on_v": 620.0,
    "brake_off_v": 600.0,
}


@pytest.mark.parametrize("inverter", [{}, LINK, LINK | {"capacitance_f": 2e-5}])
@pytest.mark.parametrize("static", [0.4, 0.9])
def test_series_as_tuples_and_in_their_room_give_the_same_bits(static: float, inverter: Any) -> None:
    """A plant whose loads are said to vary, and do not, takes the way of those that do."""
    friction = STRIBECK | {"static_n_m": static}
    brake = {"kind": "brake", "torque_n_m": 0.3, "at_s": 0.1}
    p, s = plant(friction=friction, load=[brake], inverter=inverter, seed=1)
    general, other = plant(friction=friction, load=[brake], inverter=inverter, seed=1)
    general["varying"] = 1
    s["x"][0] = other["x"][0] = 75.0
    far, near = dry_above(p, p["coulomb"]), 0
    assert far == 38.0 * 1.5 if static == 0.9 else far == 0.0
    signs, links = set(), set()
    for k in range(300):  # to and fro and at rest, the gates off at times; often enough to brake
        u_q = (40.0, 2.6, 90.0, 1.0, -60.0, -2.0, 3.0, 120.0, -120.0, 0.0)[k // 30]
        for record in (s, other):
            if k == 270:
                record["x"] = 0.3, 0.0, 0.0  # it comes to rest
            enabled(record, u_q, record["x"][0], record["x"][1])
            record["state"] = int(State.SWITCH_ON_DISABLED if k % 30 > 27 else State.OPERATION_ENABLED)
            record["u_d"], record["T_commanded"], record["error"] = -0.1 * u_q, 0.05, 0
        advance(p, s, 1_000_000)
        advance(general, other, 1_000_000)
        assert s["x"].tobytes() == other["x"].tobytes(), k
        assert (s["v_dc"], s["braking"]) == (other["v_dc"], other["braking"]), k
        near += abs(s["x"][0]) <= far
        signs.add(float(np.sign(s["x"][0])))
        links.add((float(s["v_dc"]), int(s["braking"])))
    assert signs == {-1.0, 0.0, 1.0}
    assert 0 < near < 300, "with Stribeck's part, and where it is lost"
    brakes = inverter.get("capacitance_f") == 2e-5
    assert len(links) > 100 if inverter else len(links) == 1
    assert {braking for _, braking in links} == ({0, 1} if brakes else {0})


def test_what_the_motor_gives_back_is_in_the_capacitor_to_the_joule() -> None:
    """0.5 C (v^2 - v_0^2) = -int P dt while neither rectifier nor chopper conducts."""
    p, s = plant(inverter={"capacitance_f": 1e-3})
    enabled(s, u_q=100.0, w=80.0, i_q=-5.0)
    given = 0.0
    for _ in range(400):
        q_before = float(s["x"][1])
        advance(p, s, 50_000)
        given += -1.5 * 100.0 * 0.5 * (q_before + float(s["x"][1])) * 50e-6
    assert given > 10.0
    stored = 0.5e-3 * (float(s["v_dc"]) ** 2 - 540.0**2)
    assert stored == pytest.approx(given, rel=1e-4)


def test_the_chopper_bounds_the_link_and_rests_again() -> None:
    p, s = plant(inverter=LINK)
    enabled(s, u_q=150.0, w=80.0, i_q=-12.0)
    seen = []
    for _ in range(3000):
        s["x"][0], s["x"][1], s["x"][2] = 80.0, -12.0, 0.0  # a load that drives the motor for good
        advance(p, s, 100_000)
        seen.append(float(s["v_dc"]))
    assert min(seen[1500:]) >= 600.0 and max(seen) <= 620.0 + 1e-9
    edges = np.diff(np.sign(np.diff(seen)))
    assert (edges != 0).sum() > 4
    s["state"] = int(State.SWITCH_ON_DISABLED)
    s["u_q"] = s["x"][0] = s["x"][1] = 0.0
    s["braking"] = 1
    advance(p, s, 500_000_000)
    assert s["v_dc"] == pytest.approx(600.0) and s["braking"] == 0


def test_motoring_lowers_the_link_by_the_rectifiers_resistance_and_rest_leaves_it_alone() -> None:
    p, s = plant(inverter=LINK)
    advance(p, s, 100_000_000)
    assert s["v_dc"] == 540.0
    enabled(s, u_q=200.0, w=60.0, i_q=8.0)
    for _ in range(200):
        s["x"][0], s["x"][1], s["x"][2] = 60.0, 8.0, 0.0
        advance(p, s, 100_000)
    power, v = 1.5 * 200.0 * 8.0, float(s["v_dc"])
    assert (540.0 - v) / 0.5 * v == pytest.approx(power, rel=2e-2)


def test_too_much_of_it_trips_the_drive() -> None:
    p, s = plant(inverter={"capacitance_f": 1e-4, "v_dc_trip_v": 560.0})
    enabled(s, u_q=150.0, w=80.0, i_q=-12.0)
    advance(p, s, 5_000_000)
    assert (s["state"], s["error"]) == (int(State.FAULT), int(ErrorCode.DC_LINK_OVER_VOLTAGE))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"brake_ohm": 10.0, "brake_on_v": 620.0, "brake_off_v": 600.0}, "need capacitance_f"),
        ({"capacitance_f": 1e-3, "brake_ohm": 10.0}, "belong together"),
        ({**LINK, "brake_off_v": 630.0}, "v_dc_v < brake_off_v < brake_on_v"),
    ],
)
def test_half_a_link_is_refused(table: dict[str, float], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Inverter.model_validate(table)


def test_a_series_that_cannot_reach_a_value_crosses_it_nowhere_and_one_that_does_is_searched() -> None:
    random = np.random.default_rng(7)
    clear = crossed = 0
    for _ in range(3000):
        a, h = (
            random.normal(size=ORDER + 1) * 10.0 ** random.integers(-3, 4, ORDER + 1),
            10.0 ** random.uniform(-4, 0),
        )
        value = a[0] + random.choice([0.0, 1.0, -1.0]) * 10.0 ** random.uniform(-14, 3)
        sides = {np.sign(evaluate(a, h * n / LOOKS) - value) for n in range(LOOKS + 1)} - {0.0}
        assert (first_crossing(a, value, h) < math.inf) == (len(sides) == 2)
        assert not (stays_clear(a, value, h) and len(sides) != 1)
        clear, crossed = clear + stays_clear(a, value, h), crossed + (len(sides) == 2)
    assert min(clear, crossed) > 300


def test_what_is_no_number_and_what_begins_at_the_value_are_searched() -> None:
    a = np.zeros(ORDER + 1)
    assert not stays_clear(a, 0.0, 1e-3)  # at rest, at the value
    a[1] = math.nan
    assert not stays_clear(a, 1.0, 1e-3)
    a[:3] = 0.0, 1.0, -2.0  # passes 0 again at 0.5
    assert not stays_clear(a, 0.0, 1.0) and first_crossing(a, 0.0, 1.0) == pytest.approx(0.5)
