"""The drive law's kernels and design one by one, without a plant: poles, limits, refusals, odd inputs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from hil.control.composite import continuous_gain
from hil.control.errors import ControlDesignError
from hil.control.law import (
    ChannelSpec,
    LawSpec,
    MotorModel,
    apply,
    command,
    design_law,
    known_terms,
    new_law_state,
    observe,
    sampled_model,
)
from hil.control.observer import conventional_dob, ftdob

T_S = 1e-3
MOTOR = MotorModel(R_s=2.875, L_d=0.022, L_q=0.033, psi_f=0.8, n_p=3, J=0.011, B_f=2e-4)
CHANNEL = ChannelSpec("ftdob", 25.0, 58.0, 10e-3)


def spec(kind: Literal["cascade", "fac"] = "cascade", **more: Any) -> LawSpec:
    return replace(LawSpec(kind, MOTOR, CHANNEL, CHANNEL, 30.0, 250.0, 400.0, 15.0, 1e3, False), **more)


def commanded(law: LawSpec, x: tuple[float, float, float], i_q_ref: float = 1.0) -> tuple[Any, np.ndarray]:
    """The state after a first command at x, and the linear model's state two ticks on."""
    p, s, model = design_law(law, T_S)[0], new_law_state()[0], sampled_model(MOTOR, T_S)
    observe(p, s, *x, True, 1)
    apply(s, 0.5, 10.0, -5.0)
    command(p, s, 20.0, 0.0, i_q_ref, 1e6)
    one = model.Ad @ np.array(x) + model.Bd @ np.array([0.5, 10.0, -5.0])
    return s, model.Ad @ one + model.Bd @ np.array(s["u"])


def test_printed_pi_of_section_6_with_the_sign_of_errata_3() -> None:
    motor = replace(MOTOR, L_d=0.033)
    Pi = continuous_gain(motor.A()[:2, :2], motor.B()[:2, :2], -np.diag([0.3, 0.4]), np.eye(2))
    np.testing.assert_allclose(Pi, [[0.0031, 3.6], [2.4, 2.8618]], atol=1e-12)


def test_the_believed_motor_is_open_loop_stable() -> None:
    """Errata 3: torque accelerates, so the motor is -43.6 +- 148j and not unstable."""
    poles = np.linalg.eigvals(replace(MOTOR, L_d=0.033).A()[:2, :2])
    np.testing.assert_allclose(poles.real, -43.57, atol=0.01)
    np.testing.assert_allclose(np.abs(poles.imag), 148.0, atol=0.5)


def test_every_current_axis_of_the_cascade_has_its_own_pole() -> None:
    s, two = commanded(spec(), (20.0, 4.0, 3.0))
    _, i_q, i_d = s["x_p"]
    assert two[1] - s["i_q_ref"] == pytest.approx((i_q - s["i_q_ref"]) * math.exp(-0.25), rel=1e-9)
    assert two[2] == pytest.approx(i_d * math.exp(-0.4), rel=1e-9)


def test_every_state_of_fac_has_its_own_pole() -> None:
    s, two = commanded(spec("fac"), (19.0, 4.0, 3.0))
    error = (s["x_p"] - [20.0, 1.0, 0.0]) * np.exp([-0.03, -0.25, -0.4])
    np.testing.assert_allclose(two - [20.0, 1.0, 0.0], error, rtol=1e-8)


@pytest.mark.parametrize(("asked", "given"), [(99.0, 15.0), (-99.0, -15.0), (3.0, 3.0)])
def test_fac_limits_the_current_that_it_is_asked_for(asked: float, given: float) -> None:
    s, two = commanded(spec("fac"), (20.0, 4.0, 0.0), asked)
    assert s["i_q_ref"] == given
    assert two[1] - given == pytest.approx((s["x_p"][1] - given) * math.exp(-0.25), rel=1e-9)


@pytest.mark.parametrize("periods", [0, -1, -100])
def test_no_period_is_no_measurement_of_a_period(periods: int) -> None:
    """A count that a damaged log may hold must not index the gap inverses from their end, or before them."""
    p, s = design_law(spec(), T_S)[0], new_law_state()[0]
    for _ in range(3):
        observe(p, s, 1.0, 0.0, 0.0, True, 1)
    observe(p, s, 500.0, 9.0, 9.0, True, periods)
    assert (s["started"], s["filled"], s["gap"]) == (1, 0, 0)
    assert s["d_hat"].tolist() == [0.0] * 3
    assert s["x"].tolist() == [500.0, 9.0, 9.0]


@pytest.mark.parametrize("name", ["R_s", "L_d", "L_q", "psi_f", "n_p", "J"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_a_motor_that_is_none_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ControlDesignError, match=f"^{name} must be positive"):
        design_law(spec(motor=replace(MOTOR, **{name: value})), T_S)


def test_all_mistakes_are_named_at_once() -> None:
    with pytest.raises(ControlDesignError, match=r"^J, i_max, B_f, T_L_max must"):
        design_law(spec(motor=replace(MOTOR, J=0.0, B_f=-1.0), i_max=math.nan, T_L_max=-1.0), T_S)
    assert design_law(spec(motor=replace(MOTOR, B_f=0.0), T_L_max=0.0), T_S)["T_L_max"][0] == 0.0


@pytest.mark.parametrize("pole", ["speed_pole", "current_pole", "current_d_pole"])
@pytest.mark.parametrize("value", [0.0, -30.0, math.nan])
def test_poles_must_be_stable(pole: str, value: float) -> None:
    with pytest.raises(ControlDesignError, match="must be finite" if math.isnan(value) else "Hurwitz"):
        design_law(spec(**{pole: value}), T_S)


@pytest.mark.parametrize("T_s", [0.0, -1e-3, math.nan, math.inf])
def test_windows_need_a_tick(T_s: float) -> None:
    for design in (lambda: ftdob(1.0, 2.0, 0.1, T_s), lambda: conventional_dob(np.ones(1), T_s)):
        with pytest.raises(ControlDesignError, match="T_s must be positive"):
            design()


@pytest.mark.parametrize("delay", [math.inf, math.nan])
def test_a_window_must_end(delay: float) -> None:
    with pytest.raises(ControlDesignError, match="D must be finite"):
        ftdob(1.0, 2.0, delay, T_S)


@pytest.mark.parametrize("kind", ["cascade", "fac"])
def test_voltages_keep_to_any_circle(kind: Literal["cascade", "fac"]) -> None:
    """Random states, references and radii, zero too: |u| never passes the radius, T_L never its limit."""
    seed = 4
    rng, p, s = np.random.default_rng(seed), design_law(spec(kind, coupling=True), T_S)[0], new_law_state()[0]
    for k in range(300):
        observe(p, s, *(rng.normal(size=3) * [100, 10, 10]), True, 1)
        radius = 0.0 if k % 10 == 0 else float(10.0 ** rng.uniform(-2, 4))
        command(p, s, float(rng.normal() * 100), float(rng.normal() * 1e3), float(rng.normal() * 20), radius)
        assert math.hypot(s["u"][1], s["u"][2]) <= radius * (1 + 1e-12), f"seed {seed}, tick {k}"
        assert abs(s["u"][0]) <= 1e3, f"seed {seed}, tick {k}"
        assert abs(s["i_q_ref"]) <= 15.0, f"seed {seed}, tick {k}"
        apply(s, s["u"][0], s["u"][1], s["u"][2])


def coupling_by_hand(x: np.ndarray) -> np.ndarray:
    """What (32) has over the linear model, written out with this motor's numbers."""
    w, i_q, i_d = x
    torque = 1.5 * 3 * (0.022 - 0.033) * i_d * i_q
    return np.array([torque / 0.011, -3 * w * 0.022 * i_d / 0.033, 3 * w * 0.033 * i_q / 0.022])


def test_known_terms_by_hand() -> None:
    x, c = np.array([80.0, 6.0, -4.0]), np.empty(3)
    known_terms(design_law(spec(coupling=True), T_S)[0], x, c)
    np.testing.assert_allclose(c, coupling_by_hand(x), rtol=1e-12)
    assert c[0] > 0  # L_d < L_q: a negative i_d adds torque
    known_terms(design_law(spec(), T_S)[0], x, c)
    assert c.tolist() == [0.0] * 3


def test_known_terms_are_the_mean_of_both_ends() -> None:
    """Also over a gap: what the model explains by (c(start) + c(end)) / 2 is not left to the estimate."""
    p, model = design_law(spec(coupling=True), T_S)[0], sampled_model(MOTOR, T_S)
    ua, d, end = np.array([0.5, 40.0, -20.0]), np.array([-300.0, 50.0, 20.0]), np.array([81.0, 6.5, -2.0])
    for m in (1, 3):
        x = np.array([80.0, 6.0, -4.0])
        for _ in range(60):  # start such that the end is reached exactly: c depends on both
            forward = x
            for _ in range(m):
                mean = (coupling_by_hand(x) + coupling_by_hand(end)) / 2
                forward = model.Ad @ forward + model.Bd @ ua + model.Ed @ (d + mean)
            x = x + np.linalg.solve(np.linalg.matrix_power(model.Ad, m), end - forward) * 0.8
        np.testing.assert_allclose(forward, end, rtol=1e-9)
        s = new_law_state()[0]
        apply(s, *ua)
        observe(p, s, *x, True, 1)
        observe(p, s, *end, True, m)
        np.testing.assert_allclose(s["v"], d, rtol=1e-6)
