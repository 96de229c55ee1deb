"""Regeneration limits: the bound on the braking current against the balance of powers itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hil.config.design import law_spec
from hil.config.showable import check_limits
from hil.config.tables import RunConfig, load_toml
from hil.control.law import (
    LAW_NEUTRAL,
    LAW_PARAMS,
    LAW_STATE,
    SPEED,
    ask,
    command,
    design_law,
    is_saturated,
    new_law_state,
    observe,
)
from hil.control.regen import allowed_power, braked
from hil.errors import ConfigError
from tests.conftest import CONFIGS

LINK = ("limits.v_dc_regen_from_v=480.0", "limits.v_dc_regen_max_v=580.0")


def law(path: str, *settings: str) -> tuple[Any, Any]:
    config = load_toml(CONFIGS / path, RunConfig, settings)
    return design_law(law_spec(config), 1e-3)[0], new_law_state()[0]


def limited(power: float, coupling: int = 1) -> tuple[Any, Any]:
    p, s = np.zeros(1, LAW_PARAMS)[0], np.zeros(1, LAW_STATE)[0]
    own = {"k_t": 3.6, "n_p": 3, "R_s": 2.875, "L_d": 0.033, "L_q": 0.066, "regen": 1, "p_regen": power}
    for name, value in (own | {"coupling": coupling}).items():
        p[name] = value
    return p, s


def power_in(p: Any, s: Any, w: float, i_d: float, i_q: float) -> float:
    """1.5 (u_d i_d + u_q i_q) of the voltage equations in steady state, d_hat included: L di/dt = 0."""
    psi_f = p["k_t"] / (1.5 * p["n_p"])
    u_d = p["R_s"] * i_d - w * p["L_q"] * i_q - p["L_d"] * s["d_hat"][2]
    u_q = p["R_s"] * i_q + w * (psi_f + p["L_d"] * i_d) - p["L_q"] * s["d_hat"][1]
    return float(1.5 * (u_d * i_d + u_q * i_q))


def test_what_is_given_back_is_the_limit_or_less_and_the_bound_is_exact() -> None:
    rng, cut = np.random.default_rng(16), 0
    for _ in range(3000):
        p, s = limited(float(rng.choice([0.0, 5.0, 80.0, 400.0])))
        s["d_hat"][1:] = rng.normal(0.0, 150.0, 2)
        w, i_d, asked = rng.uniform(-400.0, 400.0), rng.uniform(-10.0, 2.0), rng.uniform(-15.0, 15.0)
        if power_in(p, s, w, i_d, 0.0) < -p["p_regen"]:
            continue  # i_d alone gives back more: nothing that i_q could do by being less
        i_q = braked(p, s, w, i_d, asked)
        found = power_in(p, s, w, i_d, i_q)
        assert found >= -p["p_regen"] - 1e-9 * (1.0 + abs(w) * 15.0)
        assert bool(s["capped"]) == (i_q != asked)
        if i_q != asked:
            cut += 1
            assert i_q * asked >= 0.0 and abs(i_q) < abs(asked)
            assert found == pytest.approx(-p["p_regen"], abs=1e-9 * (1.0 + abs(w) * 15.0))
            least = min(power_in(p, s, w, i_d, i_q * part) for part in np.linspace(0.0, 1.0, 50))
            assert least >= found - 1e-9 * (1.0 + abs(w) * 15.0)  # and on the way there from 0
    assert cut > 500


def test_what_motors_and_what_no_current_makes_too_much_is_left_alone() -> None:
    p, s = limited(80.0)
    assert braked(p, s, 300.0, -4.0, 15.0) == 15.0 and braked(p, s, -300.0, -4.0, -15.0) == -15.0
    slow = 2.0 * math.sqrt(p["R_s"] * 80.0 / 1.5) / 0.8  # g^2 = 4 R_s c: there the most that any i_q gives
    assert braked(p, s, 0.999 * slow, 0.0, -15.0) == -15.0
    assert not s["capped"]
    assert braked(p, s, 1.001 * slow, 0.0, -15.0) == pytest.approx(-math.sqrt(80.0 / 1.5 / 2.875), rel=0.1)
    assert s["capped"]


def test_nothing_goes_back_where_nothing_may_but_what_the_d_current_burns() -> None:
    p, s = limited(0.0)
    assert braked(p, s, 240.0, 0.0, -5.0) == 0.0
    assert power_in(p, s, 240.0, -6.0, braked(p, s, 240.0, -6.0, -5.0)) == pytest.approx(0.0, abs=1e-9)
    assert braked(p, s, 240.0, -6.0, -5.0) < -0.3


def test_without_known_coupling_the_estimates_hold_it_and_correct_nothing() -> None:
    p, s = limited(80.0, coupling=0)
    before = braked(p, s, 300.0, -4.0, -15.0)
    s["d_hat"][1:] = 300.0, 300.0
    assert braked(p, s, 300.0, -4.0, -15.0) == before


@pytest.mark.parametrize(
    ("v_dc", "power"),
    [
        (479.0, 300.0), (480.0, 300.0), (530.0, 150.0), (580.0, 0.0), (600.0, 0.0),
        (math.nan, 300.0), (0.0, 300.0),
    ],
)  # fmt: skip
def test_the_power_falls_with_the_measured_link(v_dc: float, power: float) -> None:
    p, _ = law("salient.toml", "limits.p_regen_max_w=300.0", *LINK)
    assert allowed_power(p, v_dc) == pytest.approx(power)
    only, _ = law("salient.toml", "limits.p_regen_max_w=300.0")
    assert allowed_power(only, v_dc) == 300.0


VOLTAGE = (
    'controller={kind="cascade", speed_pole_rad_s=80.0}',
    'controller={kind="deadbeat", speed_pole_rad_s=80.0}',
    'controller={kind="lq", speed_weight=1.0}',
    'controller={kind="pi", speed_gain_as_rad=1.0, speed_integral_a_rad=9.0, '
    "current_gain_v_a=8.0, current_integral_v_as=900.0}",
    'controller={kind="fac", speed_pole_rad_s=80.0}',
    "controller.speed_pole_rad_s=80.0",
    'controller={kind="identify", q=[5.0], d=[0.0], w_rad_s=[50.0], slew_a_s=[1e9], for_s=[1.0], '
    "w_most_rad_s=900.0, w_run_rad_s=70.0, i_brake_a=15.0}",
)


@pytest.mark.parametrize("controller", VOLTAGE)
def test_each_law_of_a_voltage_drive_brakes_within_the_limit(controller: str) -> None:
    """From 70 rad/s to 0 each asks for all it may; with the limit the operating point gives back 100 W."""
    kept = []
    for more in ((), ("limits.p_regen_max_w=100.0",)):
        p, s = law("salient.toml", controller, *more)
        observe(p, s, 70.0, 0.0, 0.0, True, 1)
        command(p, s, 0.0, 0.0, -15.0, 180.0)
        kept.append(s["i_q_ref"])
        ask(p, s, 0.0, 0.0, -15.0, 180.0)
    assert kept[0] < -8.0 and is_saturated(p, s, 1e9)
    found = power_in(p, s, 3.0 * s["x_p"][0], s["i_d_ref"], s["i_q_ref"])
    assert found == pytest.approx(-100.0, rel=1e-2)  # the PI and a table go by the measured speed


@pytest.mark.parametrize(
    "controller",
    [
        "controller.speed_pole_rad_s=30.0",
        'controller={kind="torque", torque_n_m=[-15.0], for_s=[9.0], slew_n_m_s=1e9}',
    ],
)
def test_a_drive_with_a_current_loop_is_commanded_no_more(controller: str) -> None:
    p, s = law("current.toml", controller, "limits.p_regen_max_w=100.0")
    observe(p, s, 80.0, 0.0, 0.0, True, 1)
    ask(p, s, 0.0, 0.0, 0.0, 15.0)
    assert p["kind"] == SPEED and s["u"][1] == s["i_q_ref"] * p["u_i"] and is_saturated(p, s, 1e9)
    assert power_in(p, s, 240.0, 0.0, s["i_q_ref"]) == pytest.approx(-100.0, rel=1e-3)
    free, state = law("current.toml", controller)
    observe(free, state, 80.0, 0.0, 0.0, True, 1)
    ask(free, state, 0.0, 0.0, 0.0, 15.0)
    assert state["u"][1] < 2.0 * s["u"][1] < 0.0


def test_without_a_limit_the_parameters_are_neutral() -> None:
    for path in ("demo.toml", "current.toml", "salient.toml"):
        p, _ = law(path)
        names = ("regen", "p_regen", "v_regen", "g_regen")
        assert all(p[name] == LAW_NEUTRAL[name] == 0.0 for name in names)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (LINK, "v_dc_regen_max_v needs p_regen_max_w"),
        (("limits.p_regen_max_w=300.0", LINK[0]), "belong together"),
        (("limits.p_regen_max_w=300.0", LINK[1]), "belong together"),
        (("limits.p_regen_max_w=300.0", LINK[0], "limits.v_dc_regen_max_v=650.0"), "must hold"),
        (("limits.p_regen_max_w=300.0", LINK[1], "limits.v_dc_regen_from_v=580.0"), "must hold"),
        (("limits.p_regen_max_w=-1.0",), "p_regen_max_w"),
        (("limits.p_regen_w=1.0",), "unknown key; did you mean 'p_regen_max_w'"),
    ],
)
def test_limits_that_mean_nothing_are_refused(settings: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_toml(CONFIGS / "salient.toml", RunConfig, settings)


@pytest.mark.parametrize(
    ("spans", "said"),
    [({}, "the drive has no v_dc"), ({"v_dc": (0.0, 500.0)}, "v_dc shows no more than 500")],
)
def test_a_link_that_no_frame_tells_is_refused(spans: dict[str, tuple[float, float]], said: str) -> None:
    config = load_toml(CONFIGS / "salient.toml", RunConfig, ("limits.p_regen_max_w=300.0", *LINK))
    with pytest.raises(ConfigError, match=f"v_dc_regen_max_v: {said}"):
        check_limits("salient.toml", config.limits, spans)
