"""Operating points of a salient motor against independent minimisations, and the law that follows them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq, minimize, minimize_scalar

from hil.config.design import law_spec
from hil.config.tables import RunConfig, load_toml
from hil.control.cogging import ORDERS
from hil.control.errors import ControlDesignError
from hil.control.law import (
    LAW_PARAMS,
    MTPA,
    command,
    design_law,
    is_saturated,
    new_law_state,
    observe,
    steady_room,
)
from hil.control.mtpa import NEWTON, POINTS, fits, least_current, operating_point, voltage
from hil.errors import ConfigError
from hil.replay.ranges import check_ranges
from hil.tick.kernel import circle
from tests.conftest import CONFIGS
from tests.safety import Guard

pytestmark = pytest.mark.slow

N_P, PSI_F, R_S, I_MAX, U = 3, 0.8, 2.875, 15.0, 165.0
IPM = (0.03, 0.06)
REVERSED = (0.06, 0.03)
ROUND = (0.033, 0.033)


def params(L: tuple[float, float] = IPM, i_max: float = I_MAX) -> Any:
    p = np.zeros(1, LAW_PARAMS)
    p["kind"], p["n_p"], p["k_t"], p["R_s"], p["i_max"] = MTPA, N_P, 1.5 * N_P * PSI_F, R_S, i_max
    p["L_d"], p["L_q"] = L
    return p[0]


def torque(p: Any, i_d: float, i_q: float) -> float:
    return float((PSI_F + (p["L_d"] - p["L_q"]) * i_d) * i_q)


def size(p: Any, w: float, i: Any) -> float:
    """|u| [V], written down anew."""
    u_d = R_S * i[0] - w * p["L_q"] * i[1]
    u_q = R_S * i[1] + w * (PSI_F + p["L_d"] * i[0])
    return math.hypot(u_d, u_q)


def best(p: Any, w: float, goal: Callable[[Any], float], *rules: Callable[[Any], float]) -> Any:
    """The current of least ``goal`` within voltage and current by SLSQP from several starts; rules: = 0."""
    own: list[Any] = [
        {"type": "ineq", "fun": lambda i: 1.0 - size(p, w, i) ** 2 / U**2},
        {"type": "ineq", "fun": lambda i: 1.0 - i @ i / I_MAX**2},
        *({"type": "eq", "fun": rule} for rule in rules),
    ]
    starts = [(i_d, i_q) for i_d in (-13.0, -8.0, -1.0) for i_q in (-3.0, 3.0)]
    options = {"ftol": 1e-15, "maxiter": 300}
    found = [minimize(goal, start, constraints=own, method="SLSQP", options=options) for start in starts]
    sound = [one for one in found if all(rule["fun"](one.x) > -1e-9 for rule in own)]
    return min(sound, key=lambda one: one.fun).x


def best_torque(p: Any, w: float, sign: float) -> float:
    i = best(p, w, lambda i: -sign * torque(p, i[0], i[1]))
    return sign * torque(p, i[0], i[1])


@pytest.mark.parametrize("L", [IPM, REVERSED, ROUND, (0.01, 0.4)])
@pytest.mark.parametrize("tau", [1e-9, 0.3, -2.0, 7.0, -40.0])
def test_least_current_is_that_of_a_minimisation(L: tuple[float, float], tau: float) -> None:
    s = L[1] - L[0]
    i_d, i_q = least_current(PSI_F, s, tau)
    assert (PSI_F - s * i_d) * i_q == pytest.approx(tau, rel=1e-14)
    top = math.copysign(50.0, s)  # i_d is against the sign of L_q - L_d
    found = minimize_scalar(
        lambda x: x * x + (tau / (PSI_F - s * x)) ** 2,
        bounds=sorted((-top, min(0.5 * PSI_F / abs(s), 50.0) * math.copysign(1.0, s) if s else top)),
        method="bounded",
        options={"xatol": 1e-12},
    )
    assert math.hypot(i_d, i_q) == pytest.approx(math.sqrt(found.fun), rel=1e-9, abs=1e-6)
    assert math.hypot(i_d, i_q) <= math.sqrt(found.fun) * (1 + 1e-12) + 1e-12
    assert i_d * s <= 0.0 and (i_d != 0.0) == (s != 0.0)
    i_d_of_i_q = -2 * s * i_q**2 / (PSI_F + math.sqrt(PSI_F**2 + 4 * s**2 * i_q**2))
    assert i_d == pytest.approx(i_d_of_i_q, rel=1e-13, abs=1e-300)


def test_newton_has_the_last_bits_after_its_steps() -> None:
    """For every saliency: y (1 + y)^3 = m within rounding, m from 1e-12 to 1e12."""
    for m in np.logspace(-12, 12, 481):
        y = -least_current(1.0, 1.0, math.sqrt(m))[0]  # i_d = -s i_q^2 / f and f = 1 + y, so -i_d = y
        assert y * (1 + y) ** 3 == pytest.approx(m, rel=2e-14), (m, NEWTON)


@pytest.mark.corners
@pytest.mark.parametrize("L", [IPM, REVERSED, ROUND])
@pytest.mark.parametrize("w", [0.0, 225.0, -300.0, 390.0])
@pytest.mark.parametrize("share", [0.0, 0.3, -0.6, 0.97])
def test_a_point_is_that_of_a_minimisation(L: tuple[float, float], w: float, share: float) -> None:
    p = params(L)
    tau = share * best_torque(p, w, -1.0 if share < 0 else 1.0)
    least = float(np.hypot(*best(p, w, lambda i: i @ i, lambda i: torque(p, i[0], i[1]) - tau)))
    i_d, i_q, capped = operating_point(p, tau, w, U)
    assert not capped
    assert torque(p, i_d, i_q) == pytest.approx(tau, rel=1e-12, abs=1e-12)
    assert size(p, w, (i_d, i_q)) <= U * (1 + 1e-12) and math.hypot(i_d, i_q) <= I_MAX * (1 + 1e-12)
    assert math.hypot(i_d, i_q) == pytest.approx(least, rel=2e-6, abs=1e-5)


@pytest.mark.parametrize("L", [IPM, REVERSED, ROUND])
@pytest.mark.parametrize("w", [0.0, 200.0, -200.0, 390.0, -390.0])
@pytest.mark.parametrize("asked", [100.0, -1e9])
def test_what_nothing_gives_is_capped_at_the_most_torque(
    L: tuple[float, float], w: float, asked: float
) -> None:
    p = params(L)
    i_d, i_q, capped = operating_point(p, asked, w, U)
    assert capped
    sign = math.copysign(1.0, asked)
    assert sign * torque(p, i_d, i_q) == pytest.approx(best_torque(p, w, sign), rel=1e-6)
    assert size(p, w, (i_d, i_q)) <= U * (1 + 1e-9) and math.hypot(i_d, i_q) <= I_MAX * (1 + 1e-9)


def test_most_torque_per_volt_where_the_current_would_allow_more() -> None:
    """With i_max past psi_f / L_d the best i_d is inside the circle: its own stationary point."""
    p = params(IPM, i_max=60.0)
    w = 1500.0
    i_d, i_q, capped = operating_point(p, 100.0, w, U)
    assert capped and math.hypot(i_d, i_q) < 40.0
    for other in (i_d - 1e-4, i_d + 1e-4):
        i_other = brentq(lambda q, i_d=other: size(p, w, (i_d, q)) - U, 0.0, 60.0)
        assert torque(p, other, i_other) < torque(p, i_d, i_q)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_past_every_voltage_it_asks_for_no_torque_and_the_least_voltage(sign: float) -> None:
    p, w = params(), 900.0
    i_d, i_q, capped = operating_point(p, sign * 3.0, sign * w, U)
    assert capped and i_q == 0.0 and not fits(p, w, U, i_d, i_q)
    assert i_d == pytest.approx(-I_MAX, rel=1e-12)
    assert operating_point(p, 0.0, 0.0, 0.0) == (0.0, 0.0, False)
    assert operating_point(p, 1.0, 0.0, 0.0)[1:] == (0.0, True)


def test_the_point_moves_steadily_through_base_speed_and_zero_torque() -> None:
    p = params()
    for tau in (-1.0, 0.0, 2.0):
        i_d = [operating_point(p, tau, w, U)[0] for w in np.linspace(-400.0, 400.0, 401)]
        assert np.abs(np.diff(i_d)).max() < 1.0
    i_d = [operating_point(p, tau, 350.0, U)[0] for tau in np.linspace(-3.0, 3.0, 121)]
    assert np.abs(np.diff(i_d)).max() < 0.5 and max(i_d) < -4.0


def test_voltage_is_the_steady_state() -> None:
    p = params()
    u_d, u_q = voltage(p, 300.0, -5.0, 4.0)
    assert u_d == pytest.approx(R_S * -5.0 - 300.0 * 0.06 * 4.0)
    assert u_q == pytest.approx(R_S * 4.0 + 300.0 * (0.8 - 0.15))
    assert fits(p, 300.0, math.hypot(u_d, u_q) * (1 + 1e-12), -5.0, 4.0)
    assert not fits(p, 300.0, math.hypot(u_d, u_q) * (1 - 1e-12), -5.0, 4.0)


@pytest.mark.parametrize(
    ("kind", "v_dc", "radius"),
    [
        (MTPA, 270.0, 270.0 / math.sqrt(3.0)),
        (MTPA, 600.0, 300.0),
        (MTPA, math.nan, 300.0),
        (MTPA, 0.0, 0.0),
        (0, 270.0, 300.0),
    ],
)
def test_the_circle_is_that_of_the_measured_link(kind: int, v_dc: float, radius: float) -> None:
    p, guard = params(), Guard()
    p["kind"], guard.t["v_dc"] = kind, v_dc
    assert circle(guard.p[0], guard.s[0], p, guard.t) == radius


def law(*settings: str) -> tuple[Any, Any]:
    config = load_toml(CONFIGS / "salient.toml", RunConfig, settings)
    return design_law(law_spec(config), 1e-3)[0], new_law_state()[0]


def test_the_currents_go_to_both_references_by_their_poles() -> None:
    p, s = law("controller.compensate_coupling=false", "controller.current_d_pole_rad_s=400.0")
    observe(p, s, 110.0, 2.0, -3.0, True, 1)
    command(p, s, 112.0, 0.0, 0.0, 1e9)
    two = p["Ad"] @ s["x_p"] + p["Bd"] @ s["u"]
    assert s["i_d_ref"] < 0.0
    for c, goal, pole in ((1, s["i_q_ref"], 250.0), (2, s["i_d_ref"], 400.0)):
        assert two[c] - goal == pytest.approx((s["x_p"][c] - goal) * math.exp(-pole * 1e-3), rel=1e-9)


@pytest.mark.parametrize("coupling", ["true", "false"])
def test_the_torque_asked_for_is_that_of_the_speed_law(coupling: str) -> None:
    """J (w*+ + lam (w - w*) - a w - e (d - c)) / e, with or without the reluctance torque as a known term."""
    p, s = law(f"controller.compensate_coupling={coupling}")
    observe(p, s, 30.0, 6.0, -2.0, True, 1)
    command(p, s, 31.0, 0.0, 0.0, 1e9)
    w, i_q, i_d = s["x_p"]
    reluctance = 4.5 * (p["L_d"] - p["L_q"]) * i_d * i_q
    d = 0.0 if coupling == "true" else -reluctance / p["J"]
    wanted = 31.0 + p["lam_w"] * (w - 31.0) - p["a_w"] * w - p["e_w"] * d
    assert 4.5 * (0.8 - 0.033 * s["i_d_ref"]) * s["i_q_ref"] == pytest.approx(
        p["J"] * wanted / p["e_w"], rel=1e-9
    )
    assert not s["capped"] and not is_saturated(p, s, 1e9)
    command(p, s, 300.0, 0.0, 0.0, 1e9)
    assert s["capped"] and is_saturated(p, s, 1e9)


@pytest.mark.parametrize("d_hat", [(0.0, 0.0), (400.0, -300.0), (-400.0, 500.0)])
def test_the_room_is_the_share_less_what_the_point_takes_more_than_the_model(
    d_hat: tuple[float, float],
) -> None:
    p, s = law()
    s["i_d_ref"], s["i_q_ref"], s["d_hat"][1:] = -6.0, 3.0, d_hat
    u_d, u_q = 2.875 * -6.0 - 300.0 * 0.066 * 3.0, 2.875 * 3.0 + 300.0 * (0.8 - 0.033 * 6.0)
    real = math.hypot(u_d - 0.033 * d_hat[1], u_q - 0.066 * d_hat[0])
    assert steady_room(p, s, 300.0, 180.0) == pytest.approx(0.92 * 180.0 - real + math.hypot(u_d, u_q))
    assert steady_room(p, s, 300.0, 0.0) >= 0.0
    p["coupling"] = 0  # then the coupling is in d_hat too
    assert steady_room(p, s, 300.0, 180.0) == pytest.approx(0.92 * 180.0)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("controller.voltage_share=1.01", "voltage_share"),
        ("controller.voltage_share=0.0", "voltage_share"),
        ("controller.voltage_shares=0.9", "unknown key; did you mean 'voltage_share'"),
        ("motor.psi_f_wb=0.0", "psi_f_wb"),
    ],
)
def test_what_can_not_be_is_refused(setting: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_toml(CONFIGS / "salient.toml", RunConfig, [setting])


def test_a_log_may_name_the_law_and_none_past_it() -> None:
    record = np.zeros(1, LAW_PARAMS)
    record["kind"], record["max_gap"] = MTPA, 1
    check_ranges("law", record)
    record["kind"] = MTPA + 1
    with pytest.raises(ValueError, match=r"law\.kind is 6, not within 0 to 5"):
        check_ranges("law", record)


@pytest.mark.parametrize(("name", "most"), [("points", POINTS), ("cogs", ORDERS)])
def test_a_log_names_no_row_past_a_table(name: str, most: int) -> None:
    record = np.zeros(1, LAW_PARAMS)
    record["max_gap"], record[name] = 1, most
    check_ranges("law", record)
    record[name] = most + 1
    with pytest.raises(ValueError, match=rf"law\.{name} is {most + 1}, not within 0 to {most}"):
        check_ranges("law", record)


I_Q, I_D = (0.0, 3.0, 7.0, 12.0), (0.0, -0.5, -4.0, -5.0)


def tabled(i_q: tuple[float, ...] = I_Q, i_d: tuple[float, ...] = I_D, i_max: float = I_MAX) -> Any:
    p = params(i_max=i_max)
    p["points"], p["i_q_at"][: len(i_q)], p["i_d_at"][: len(i_d)] = len(i_q), i_q, i_d
    return p


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_table_gives_the_torque_exactly_at_its_interpolated_i_d(sign: float) -> None:
    p = tabled()
    for tau in sign * np.linspace(0.0, 11.0, 45):
        i_d, i_q, capped = operating_point(p, tau, 20.0, 1e3)
        assert not capped and torque(p, i_d, i_q) == pytest.approx(tau, rel=1e-13, abs=1e-13)
        assert i_d == pytest.approx(np.interp(abs(i_q), I_Q, I_D), rel=1e-12, abs=1e-13)
    nodes = [operating_point(p, sign * torque(p, d, q), 0.0, 1e3)[:2] for q, d in zip(I_Q, I_D, strict=True)]
    assert np.allclose(nodes, [(d, sign * q) for q, d in zip(I_Q, I_D, strict=True)], rtol=1e-13, atol=1e-13)


def test_a_table_of_the_least_current_is_the_closed_form_between_its_points_too() -> None:
    plain, taus = params(), np.linspace(0.0, 14.0, POINTS)
    nodes = [least_current(PSI_F, 0.03, tau) for tau in taus]
    p = tabled(tuple(q for _, q in nodes), tuple(d for d, _ in nodes))
    for tau in np.linspace(-13.0, 13.0, 100):
        one, other = (operating_point(each, tau, 10.0, 1e3)[:2] for each in (p, plain))
        assert math.hypot(*one) == pytest.approx(math.hypot(*other), rel=1e-3, abs=1e-9)


def test_current_and_voltage_come_before_the_table() -> None:
    """Where a row takes more than i_max the least current is taken; past base speed the field is weakened."""
    p, plain = tabled(i_d=(0.0, -6.0, -12.0, -14.0)), params()
    assert operating_point(p, 13.0, 10.0, 1e3) == operating_point(plain, 13.0, 10.0, 1e3)
    assert operating_point(p, 1e3, 10.0, 1e3) == operating_point(plain, 1e3, 10.0, 1e3)
    i_d, i_q, capped = operating_point(tabled(), 3.0, 300.0, U)
    assert not capped and i_d < -0.5 and fits(p, 300.0, U * (1 + 1e-9), i_d, i_q)
    assert torque(p, i_d, i_q) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("i_q_a=[0.0, 1.0, 1.0], i_d_a=[0.0, 0.0, 0.0]", "i_q_a must ascend from 0; sort the rows"),
        ("i_q_a=[1.0, 2.0], i_d_a=[0.0, 0.0]", "i_q_a must ascend from 0"),
        ("i_q_a=[0.0, 2.0, 3.0], i_d_a=[0.0, 0.0]", "i_q_a has 3 entries and i_d_a 2; give one i_d an i_q"),
        ("i_q_a=[0.0], i_d_a=[0.0]", "i_q_a"),
        ("i_q_a=[0.0, 1.0], i_d_a=[0.0, nan]", "i_d_a"),
        ("i_q_a=[0.0, -1.0], i_d_a=[0.0, 0.0]", "i_q_a"),
        ("i_q_a=[0.0, 1.0]", "i_d_a"),
        (f"i_q_a={list(map(float, range(33)))}, i_d_a={[0.0] * 33}", "i_q_a"),
        ("i_q=[0.0, 1.0], i_d_a=[0.0, 0.0]", "i_q"),
    ],
)
def test_a_table_that_is_none_is_refused(table: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_toml(CONFIGS / "salient.toml", RunConfig, [f"controller.i_d_table={{{table}}}"])
    with pytest.raises(ConfigError, match="i_d_table"):
        load_toml(CONFIGS / "salient.toml", RunConfig, ['controller.i_d_table="nowhere.toml"'])
    with pytest.raises(ConfigError, match="unknown key"):
        load_toml(CONFIGS / "demo.toml", RunConfig, [f"controller.i_d_table={{{table}}}"])


def test_a_table_whose_torque_falls_is_refused() -> None:
    given = "controller.i_d_table={i_q_a=[0.0, 3.0, 6.0], i_d_a=[0.0, 0.0, 15.0]}"
    with pytest.raises(
        ControlDesignError, match="up to i_q_a = 6 the torque does not rise with i_q; correct"
    ):
        design_law(law_spec(load_toml(CONFIGS / "salient.toml", RunConfig, [given])), 1e-3)


def test_a_drive_that_takes_a_current_weakens_its_field_itself() -> None:
    with pytest.raises(
        ControlDesignError, match="mtpa asks for voltage, the drive takes a current or a torque"
    ):
        design_law(
            law_spec(load_toml(CONFIGS / "current.toml", RunConfig, ['controller={kind="mtpa"}'])), 1e-3
        )
