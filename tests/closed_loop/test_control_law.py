"""The drive laws in closed loop: a plain dq motor of the tests' own, one tick late, wire resolution."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pytest

from hil.control.errors import ControlDesignError
from hil.control.law import (
    N_MAX,
    ChannelSpec,
    LawSpec,
    MotorModel,
    apply,
    command,
    design_law,
    new_law_state,
    observe,
    reset,
    sampled_model,
)

pytestmark = pytest.mark.slow

T_S = 1e-3
N_W = 12
U_LIMIT = 300.0
MOTOR = MotorModel(R_s=2.875, L_d=0.033, L_q=0.033, psi_f=0.8, n_p=3, J=0.011, B_f=2e-4)
SALIENT = replace(MOTOR, L_d=0.022)
LOAD = 5.4  # N m


def spec(
    kind: Literal["cascade", "fac"] = "cascade", motor: MotorModel = MOTOR, coupling: bool = True
) -> LawSpec:
    return LawSpec(
        kind=kind,
        motor=motor,
        speed=ChannelSpec("ftdob", 25.0, 58.0, N_W * T_S),
        current=ChannelSpec("ftdob", 30.0, 70.0, 10e-3),
        speed_pole=30.0,
        current_pole=250.0,
        current_d_pole=250.0,
        i_max=15.0,
        T_L_max=50.0,
        coupling=coupling,
    )


def slopes(m: MotorModel, x: np.ndarray, T_L: float, u: np.ndarray) -> np.ndarray:
    """Full dq model (32), written out anew with the right sign of the torque."""
    w, i_q, i_d = x
    we = m.n_p * w
    torque = 1.5 * m.n_p * (m.psi_f + (m.L_d - m.L_q) * i_d) * i_q
    return np.array(
        [
            (torque - T_L - m.B_f * w) / m.J,
            (u[0] - m.R_s * i_q - we * (m.L_d * i_d + m.psi_f)) / m.L_q,
            (u[1] - m.R_s * i_d + we * m.L_q * i_q) / m.L_d,
        ]
    )


def motor_period(
    m: MotorModel, x: np.ndarray, T_L: float, u: np.ndarray, substeps: int = 4, T_s: float = T_S
) -> np.ndarray:
    """One tick of RK4."""
    h = T_s / substeps
    for _ in range(substeps):
        k1 = slopes(m, x, T_L, u)
        k2 = slopes(m, x + h / 2 * k1, T_L, u)
        k3 = slopes(m, x + h / 2 * k2, T_L, u)
        k4 = slopes(m, x + h * k3, T_L, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


@dataclass
class Trace:
    x: np.ndarray
    d_hat: np.ndarray
    i_q_ref: np.ndarray
    filled: np.ndarray


def hold_speed(
    law: LawSpec, motor: MotorModel, ticks: int, step_at: int, lsb: bool = True, w_ref: float = 80.0
) -> Trace:
    """Hold w_ref from rest at w_ref; LOAD from step_at on; commands act one tick late."""
    p, s = design_law(law, T_S)[0], new_law_state()[0]
    x, ua, late = np.array([w_ref, 0.0, 0.0]), np.zeros(2), np.array([MOTOR.n_p * MOTOR.psi_f * w_ref, 0.0])
    out = Trace(*(np.zeros((ticks, n)) for n in (3, 3)), np.zeros(ticks), np.zeros(ticks))
    for k in range(ticks):
        measured = np.rint(x / [0.01, 0.001, 0.01]) * [0.01, 0.001, 0.01] if lsb else x
        observe(p, s, measured[0], measured[1], measured[2], True, 1)
        ua = late
        apply(s, 0.0, ua[0], ua[1])
        command(p, s, w_ref, 0.0, 0.0, U_LIMIT)
        late = np.rint(s["u"][1:] / 0.01) * 0.01 if lsb else s["u"][1:].copy()
        out.x[k], out.d_hat[k], out.i_q_ref[k], out.filled[k] = x, s["d_hat"], s["i_q_ref"], s["filled"]
        x = motor_period(motor, x, LOAD if k >= step_at else 0.0, ua)
    return out


def test_load_step_with_the_believed_motor() -> None:
    """Effect: dip and recovery. Cause: the estimate is the load, and the current is what carries it."""
    trace = hold_speed(spec(), MOTOR, 900, 400)
    error = np.abs(trace.x[400:, 0] - 80.0)
    back = int(np.nonzero(error > 0.5)[0][-1]) + 1
    assert error.max() < 4.0
    assert back < 90
    assert np.abs(trace.x[390, 0] - 80.0) < 0.1
    assert -MOTOR.J * trace.d_hat[-1, 0] == pytest.approx(LOAD, abs=0.05)
    assert trace.x[-1, 1] == pytest.approx((LOAD + MOTOR.B_f * 80) / MOTOR.k_t, abs=0.02)
    assert np.abs(trace.x[-100:, 2]).max() < 0.03


@pytest.mark.parametrize("corner", list(itertools.product([0.7, 1.3], repeat=4)))
def test_stable_in_every_corner(corner: tuple[float, float, float, float]) -> None:
    """The motor off by 30 % in J, psi, R and L: it dips further, but comes back and stays."""
    J, psi, R, L = corner
    motor = replace(
        MOTOR, J=J * MOTOR.J, psi_f=psi * MOTOR.psi_f, R_s=R * MOTOR.R_s, L_d=L * MOTOR.L_d, L_q=L * MOTOR.L_q
    )
    trace = hold_speed(spec(), motor, 1400, 700)
    error = np.abs(trace.x[700:, 0] - 80.0)
    assert error.max() < 7.5
    assert error[-200:].max() < 0.2
    assert np.abs(trace.x[600:700, 0] - 80.0).max() < 0.2


def test_the_current_limit_holds_and_does_not_wind_up() -> None:
    """A limit below the load: the speed sinks, i_q* stays at the limit, and the return has no overshoot."""
    law = replace(spec(), i_max=3.0)
    p, s = design_law(law, T_S)[0], new_law_state()[0]
    x, late = np.array([0.0, 0.0, 0.0]), np.zeros(2)
    speeds, asked = [], []
    for _ in range(1200):
        observe(p, s, x[0], x[1], x[2], True, 1)
        ua = late
        apply(s, 0.0, ua[0], ua[1])
        command(p, s, 80.0, 0.0, 0.0, U_LIMIT)
        late = s["u"][1:].copy()
        assert np.hypot(*late) <= U_LIMIT * (1 + 1e-12)
        x = motor_period(MOTOR, x, 0.0, ua)
        speeds.append(x[0])
        asked.append(s["i_q_ref"])
    assert max(asked) == 3.0
    assert np.abs(asked).max() <= 3.0
    assert max(speeds) < 80.5
    assert speeds[-1] == pytest.approx(80.0, abs=1e-3)


@pytest.mark.parametrize("u_limit", [20.0, 50.0])
def test_the_voltage_circle_gives_u_d_first(u_limit: float) -> None:
    p, s = design_law(spec(), T_S)[0], new_law_state()[0]
    observe(p, s, 100.0, 8.0, 9.0, True, 1)
    command(p, s, 150.0, 0.0, 0.0, 1e4)
    free_d = float(s["u"][2])
    assert 20.0 < abs(free_d) < 50.0
    command(p, s, 150.0, 0.0, 0.0, u_limit)
    assert s["u"][2] == pytest.approx(math.copysign(min(abs(free_d), u_limit), free_d), rel=1e-12)
    assert math.hypot(s["u"][1], s["u"][2]) == pytest.approx(u_limit, rel=1e-12)


def linear_run(
    kind: Literal["cascade", "fac"], lost: frozenset[int] = frozenset(), ticks: int = 400, step_at: int = 200
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The exact linear model (33) in closed loop, no resolution; returns x, d_hat (ticks, 3) and d after."""
    p, s = design_law(spec(kind, coupling=False), T_S)[0], new_law_state()[0]
    model = sampled_model(MOTOR, T_S)
    before, after = np.array([3.0, -20.0, 10.0]), np.array([-LOAD / MOTOR.J, 40.0, -30.0])
    x, late = np.array([10.0, 0.5, -0.2]), np.zeros(3)
    xs, d_hats = np.zeros((ticks, 3)), np.zeros((ticks, 3))
    for k in range(ticks):
        observe(p, s, x[0], x[1], x[2], k not in lost, 1)
        ua = late
        apply(s, ua[0], ua[1], ua[2])
        if k not in lost:
            command(p, s, 12.0, 0.0, 1.5, U_LIMIT)
            late = s["u"].copy()
        else:
            late = late * 0.9  # the input goes on changing inside the gap
        xs[k], d_hats[k] = x, s["d_hat"]
        x = model.Ad @ x + model.Bd @ ua + model.Ed @ (after if k >= step_at else before)
    return xs, d_hats, after


@pytest.mark.parametrize("kind", ["cascade", "fac"])
@pytest.mark.parametrize("lost", [(), (205,), tuple(range(201, 207))], ids=["all", "one lost", "six lost"])
def test_exact_in_the_linear_model(kind: Literal["cascade", "fac"], lost: tuple[int, ...]) -> None:
    """d_hat_w is exact N ticks after the load step, not one tick sooner, lost frames or not."""
    _, d_hat, d = linear_run(kind, frozenset(lost))
    assert np.abs(d_hat[200 + N_W :, 0] - d[0]).max() < 1e-9 * abs(d[0])
    assert np.abs(d_hat[200 + N_W :, 1:] - d[1:]).max() < 1e-9 * np.abs(d).max()
    assert abs(d_hat[200 + N_W - 1, 0] - d[0]) > 1e-3 * abs(d[0])


def test_fac_follows_its_poles_exactly() -> None:
    """After N ticks the error of x against (w*, i_q*, 0) shrinks by e^{Upsilon T_s} a tick, whatever d."""
    xs, _, _ = linear_run("fac", step_at=0, ticks=120)
    error = xs - np.array([12.0, 1.5, 0.0])
    decay = np.exp(-np.array([30.0, 250.0, 250.0]) * T_S)
    np.testing.assert_allclose(error[21:40], error[20:39] * decay, rtol=1e-6, atol=1e-9)


def test_fac_limits_the_load_torque() -> None:
    p, s = design_law(replace(spec("fac"), T_L_max=2.0), T_S)[0], new_law_state()[0]
    observe(p, s, 0.0, 0.0, 0.0, True, 1)
    command(p, s, 100.0, 0.0, 1.0, U_LIMIT)
    assert s["u"][0] == -2.0


@pytest.mark.parametrize("motor", [MOTOR, SALIENT], ids=["round", "salient"])
def test_known_terms_leave_nothing_for_the_estimate(motor: MotorModel) -> None:
    """Cross-coupling and reluctance torque belong to the model: with them on d_hat_d is only the rest."""
    on = hold_speed(spec(motor=motor), motor, 500, 100, lsb=False).d_hat[-1]
    off = hold_speed(spec(motor=motor, coupling=False), motor, 500, 100, lsb=False).d_hat[-1]
    coupling = MOTOR.n_p * 80 * MOTOR.L_q / motor.L_d * LOAD / MOTOR.k_t
    assert abs(off[2]) == pytest.approx(coupling, rel=0.02)
    assert abs(on[2]) < 2e-3 * coupling


def test_ramp_is_followed_by_feed_forward() -> None:
    """dw* is known: a ramp leaves no standing error."""
    p, s = design_law(spec(), T_S)[0], new_law_state()[0]
    x, late = np.zeros(3), np.zeros(2)
    for k in range(600):
        observe(p, s, x[0], x[1], x[2], True, 1)
        ua = late
        apply(s, 0.0, ua[0], ua[1])
        command(p, s, 100.0 * k * T_S, 100.0, 0.0, U_LIMIT)
        late = s["u"][1:].copy()
        x_before, x = x, motor_period(MOTOR, x, 0.0, ua)
    assert x_before[0] == pytest.approx(100.0 * 599 * T_S, abs=0.05)


def test_start_is_bumpless_and_counts_what_fills() -> None:
    trace = hold_speed(spec(), MOTOR, 30, 30, lsb=False)
    assert trace.filled[:4].tolist() == [0, 1, 2, 3]
    assert trace.filled[-1] == N_W
    assert np.abs(trace.x[:, 0] - 80.0).max() < 0.05
    assert np.abs(trace.i_q_ref).max() < 0.5


def test_the_first_innovation_is_the_estimate() -> None:
    """The memory starts filled, so a d that stands since before the start is known after one period."""
    p, s = design_law(spec(coupling=False), T_S)[0], new_law_state()[0]
    model, d, x = sampled_model(MOTOR, T_S), np.array([-400.0, 30.0, -20.0]), np.array([10.0, 1.0, 0.5])
    observe(p, s, x[0], x[1], x[2], True, 1)
    x = model.Ad @ x + model.Ed @ d
    observe(p, s, x[0], x[1], x[2], True, 1)
    np.testing.assert_allclose(s["d_hat"], d, rtol=1e-9)


def residual(T_s: float) -> np.ndarray:
    """v of one period of the full motor without voltage or anything unknown, currents changing fast."""
    p, s = design_law(spec(motor=SALIENT), T_s)[0], new_law_state()[0]
    x = np.array([80.0, 6.0, -4.0])
    observe(p, s, x[0], x[1], x[2], True, 1)
    x = motor_period(SALIENT, x, 0.0, np.zeros(2), substeps=20, T_s=T_s)
    observe(p, s, x[0], x[1], x[2], True, 1)
    return np.array(s["v"])


def test_known_terms_are_second_order_exact() -> None:
    """A quarter of the period leaves a sixteenth of the residual."""
    np.testing.assert_allclose(residual(1e-4) / residual(2.5e-5), 16.0, rtol=0.2)


def test_fac_follows_a_ramp() -> None:
    """The known derivative of w* leaves no error on a ramp in the linear model."""
    p, s = design_law(spec("fac", coupling=False), T_S)[0], new_law_state()[0]
    model, x, late = sampled_model(MOTOR, T_S), np.zeros(3), np.zeros(3)
    for k in range(500):
        observe(p, s, x[0], x[1], x[2], True, 1)
        ua = late
        apply(s, ua[0], ua[1], ua[2])
        command(p, s, 50.0 * k * T_S, 50.0, 1.5, U_LIMIT)
        late = s["u"].copy()
        before, x = x, model.Ad @ x + model.Bd @ ua
    assert before[0] == pytest.approx(50.0 * 499 * T_S, abs=1e-4)


def test_a_gap_that_is_too_long_starts_anew() -> None:
    p, s = design_law(spec(), T_S)[0], new_law_state()[0]
    for k in range(20):
        observe(p, s, 0.1 * k, 0.0, 0.0, True, 1)
    assert (s["started"], s["filled"]) == (1, N_W)
    observe(p, s, 0.0, 0.0, 0.0, False, p["max_gap"])
    assert (s["started"], s["gap"]) == (1, p["max_gap"])
    observe(p, s, 5.0, 0.0, 0.0, True, 1)
    assert (s["started"], s["filled"], s["d_hat"].tolist()) == (1, 0, [0.0] * 3)
    observe(p, s, 5.0, 0.0, 0.0, False, 10_000_000)
    assert s["started"] == 0


def test_reset_forgets_but_keeps_what_is_applied() -> None:
    p, s = design_law(spec(), T_S)[0], new_law_state()[0]
    apply(s, 1.0, 2.0, 3.0)
    for w in (0.0, 1.0, 2.0):
        observe(p, s, w, 0.0, 0.0, True, 1)
    reset(s)
    assert (s["started"], s["filled"], s["gap"]) == (0, 0, 0)
    assert s["d_hat"].tolist() == [0.0] * 3
    assert s["ua"].tolist() == [1.0, 2.0, 3.0]


def test_a_window_longer_than_the_memory_is_refused() -> None:
    longest = replace(spec(), speed=ChannelSpec("ftdob", 1.0, 2.0, (N_MAX - 1) * T_S))
    assert design_law(longest, T_S)["N"][0, 0] == N_MAX - 1
    with pytest.raises(ControlDesignError, match="1024 ticks is longer than the 1023 kept"):
        design_law(replace(spec(), speed=ChannelSpec("ftdob", 1.0, 2.0, N_MAX * T_S)), T_S)


def test_a_conventional_dob_is_not_exact() -> None:
    """The same law on the DOB (31): it runs, and its estimate is still off N ticks after the step."""
    dob = ChannelSpec("dob", 100.0)
    trace = hold_speed(replace(spec(), speed=dob, current=dob), MOTOR, 800, 300, lsb=False)
    assert abs(trace.d_hat[300 + N_W, 0] + LOAD / MOTOR.J) > 0.1 * LOAD / MOTOR.J
    assert trace.x[-1, 0] == pytest.approx(80.0, abs=0.05)
