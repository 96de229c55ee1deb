"""The estimator: exact model, no bias where least squares has one, intervals that cover, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from firmware_model.config import PlantConfig, Wire, build_params, new_sample, new_state
from firmware_model.kernels import Kernels
from firmware_model.plant import State
from hil.control.law import MotorModel
from hil.control.linalg import Array, halvings_of, integral_exponential
from hil.identify.data import Samples
from hil.identify.fit import Shaft, fit
from hil.identify.model import COULOMB, L_D, L_Q, PSI_F, R_S, J, outputs, responses, sampled
from hil.identify.shaft import calm, rough

pytestmark = pytest.mark.slow

T = 1e-3
TRUE = MotorModel(R_s=3.45, L_d=0.0297, L_q=0.036, psi_f=0.76, n_p=3, J=0.01265, B_f=4e-3)
GUESS = MotorModel(R_s=2.6, L_d=0.037, L_q=0.028, psi_f=0.9, n_p=3, J=0.009, B_f=1e-4)
COULOMB_TRUE, LOAD_TRUE = 0.2, 0.05


def vector(motor: MotorModel, coulomb: float = COULOMB_TRUE, load: float = LOAD_TRUE) -> Array:
    """The model's vector, of a rigid shaft."""
    m = motor
    return np.array([m.R_s, m.L_d, m.L_q, m.psi_f, m.J, m.B_f, coulomb, load, 0.0, m.n_p, 0.0, 0.0, 0.0])


def simulated(seed: int, count: int = 1200, noise: tuple[float, float] = (0.02, 0.01)) -> Samples:
    """Forward and backward stretches under random steps of voltage, by scipy's integrator; measured w, i."""
    random = np.random.default_rng(seed)
    y, u, m = np.zeros((count, 3)), np.zeros((count, 2)), TRUE
    begins = np.arange(count) % 150 == 0
    for first in np.flatnonzero(begins):
        way = 1.0 if (first // 150) % 2 == 0 else -1.0
        x = np.array([way * 40.0, 0.0, 0.0])
        y[first] = x
        for k in range(first + 1, min(first + 150, count)):
            if (k - first) % 15 == 1:
                step = random.uniform(-8.0, 8.0, 2)
            u[k] = step + np.array([m.n_p * m.psi_f * x[0], 0.0])
            x = tick(x, u[k], way)
            y[k] = x
    y += random.normal(size=y.shape) * [noise[0], noise[1], noise[1]]
    t, run = np.arange(count) * T, np.zeros(count)
    return Samples(T, t, y, u, begins, np.ones(count, bool), run)


def tick(x: Array, u: Array, way: float) -> Array:
    """A period of the full nonlinear motor, to 1e-9."""
    m = TRUE

    def slope(_: float, x: Array) -> list[float]:
        w, q, d = x
        torque = 1.5 * m.n_p * (m.psi_f + (m.L_d - m.L_q) * d) * q
        return [
            (torque - m.B_f * w - COULOMB_TRUE * way - LOAD_TRUE) / m.J,
            (u[0] - m.R_s * q - m.n_p * w * (m.L_d * d + m.psi_f)) / m.L_q,
            (u[1] - m.R_s * d + m.n_p * w * m.L_q * q) / m.L_d,
        ]

    out: Array = solve_ivp(slope, (0.0, T), x, rtol=1e-9, atol=1e-9).y[:, -1]
    return out


@pytest.fixture(scope="module")
def clean() -> Samples:
    return simulated(0, noise=(0.0, 0.0))


def noisy(clean: Samples, seed: int, w: float = 0.02, i: float = 0.01, step: float = 0.0) -> Samples:
    """The same motion measured with noise, rounded to ``step``."""
    y = clean.y + np.random.default_rng(seed).normal(size=clean.y.shape) * [w, i, i]
    return replace(clean, y=np.rint(y / step) * step if step else y)


def test_the_sampled_model_is_that_of_the_controller() -> None:
    A = np.random.default_rng(0).normal(size=(3, 3)) * 900
    E, I, work = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))  # noqa: E741
    sampled(A, T, E, I, work)
    decay, integral = integral_exponential(A, T, halvings_of(A, T))
    np.testing.assert_allclose(E, decay, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(I, integral, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("free", [True, False])
def test_the_predictor_is_the_motor(clean: Samples, free: bool) -> None:
    samples = replace(clean, free=np.full(len(clean), free))
    z, out = np.empty((len(samples), 4, 3)), np.empty((len(samples), 3))
    responses(vector(TRUE), T, samples.y, samples.u, samples.begins, samples.free, z)
    outputs(samples.y, z, samples.begins, np.ones(3), out)
    peak = np.abs(samples.y).max(axis=0)
    assert (np.abs(out - samples.y).max(axis=0) < 2e-4 * peak).all()


def test_noiseless_runs_give_the_motor(clean: Samples) -> None:
    found = fit(clean, GUESS, Shaft(0.1))
    np.testing.assert_allclose(found.value[:5], vector(TRUE)[:5], rtol=1e-3)
    np.testing.assert_allclose(found.value[5:], vector(TRUE)[5:8], rtol=2e-2)


def least_squares_R(samples: Samples) -> float:
    """R_s by ordinary least squares over the d axis' difference equation, measured currents as regressors."""
    s, inner = samples, ~samples.begins
    k = np.flatnonzero(inner)
    w, q = 0.5 * (s.y[k, 0] + s.y[k - 1, 0]), 0.5 * (s.y[k, 1] + s.y[k - 1, 1])
    rows = np.stack([s.y[k - 1, 2], s.u[k, 1], w * q], axis=1)
    a, b, _ = np.linalg.lstsq(rows, s.y[k, 2], rcond=None)[0]
    return float((1.0 - a) / b)


def test_noisy_regressors_bias_least_squares_and_not_the_fit(clean: Samples) -> None:
    """Currents with noise of 0.1 A: the regression's R_s is off by many of the fit's half-widths."""
    assert least_squares_R(clean) == pytest.approx(TRUE.R_s, rel=1e-2)
    runs = [noisy(clean, seed, i=0.1, step=0.05) for seed in range(5)]
    fits = [fit(run, GUESS, Shaft(0.1)) for run in runs]
    off = np.mean([least_squares_R(run) for run in runs]) - TRUE.R_s
    ours = np.mean([found.value[R_S] for found in fits]) - TRUE.R_s
    half = np.mean([found.half[R_S] for found in fits])
    assert off > 5.0 * half  # errors in variables: a pole too fast
    assert abs(ours) < half


MOTORS, EACH, SEGMENTS = 200, 20, 16


def some_motor(random: np.random.Generator) -> tuple[MotorModel, float, float, Array]:
    """A motor of 50 W to 60 kW; Coulomb friction, load [N m]; its speed [rad/s], current [A], steps [V]."""
    volts, amps = 10.0 ** random.uniform([1.4, 0.3], [2.5, 2.3])
    n_p, w = int(random.integers(2, 6)), random.uniform(40.0, 300.0)
    R_s, psi_f = random.uniform(0.04, 0.15) * volts / amps, 0.7 * volts / (n_p * w)
    L_d, torque = R_s * 10.0 ** random.uniform(-2.5, -1.7), 1.5 * n_p * psi_f * amps
    J, B_f = torque * 0.06 / w * random.uniform(1.0, 4.0), 0.03 * torque / w
    motor = MotorModel(R_s, L_d, L_d * random.uniform(1.0, 1.8), psi_f, n_p, J, B_f)
    return motor, random.uniform(0.02, 0.1) * torque, 0.02 * torque, np.array([w, amps, R_s * amps])


def emulated(motor: MotorModel, coulomb: float, load: float, scale: Array, random: Any) -> Samples:
    """Short stretches, forward and backward by turns, of the emulator's drive; measured with noise."""
    table = {
        "R_s_ohm": motor.R_s, "L_d_h": motor.L_d, "L_q_h": motor.L_q, "psi_f_wb": motor.psi_f,
        "n_p": motor.n_p, "J_kg_m2": motor.J, "B_f_n_m_s": motor.B_f,
    }  # fmt: skip
    data = {
        "dbc": "none.dbc", "motor": table, "friction": {"coulomb_n_m": coulomb},
        "load": [{"kind": "constant", "torque_n_m": load}],
        "firmware": {"i_trip_a": 1e6, "w_trip_rad_s": 1e6, "temperature_trip_c": 1e6, "watchdog_ms": 0},
    }  # fmt: skip
    p = build_params(PlantConfig.model_validate(data), Wire(1e-3, 1e4, 1e-3, 1e4, 1e-3, 1e4))
    s = new_state(p, 15)
    s["started"], s["state"] = 1, int(State.OPERATION_ENABLED)
    drive, count = Kernels(p, s, new_sample()), EACH * SEGMENTS
    begins = np.arange(count) % EACH == 0
    y, u, step = np.zeros((count, 3)), np.zeros((count, 2)), np.zeros(2)
    for k in range(count):
        if begins[k]:
            s["x"] = scale[0] * (-1.0) ** (k // EACH), 0.0, 0.0
        else:
            step = scale[2] * random.uniform(-1.0, 1.0, 2) if k % EACH % 12 == 1 else step
            u[k] = step[0] + motor.n_p * motor.psi_f * s["x"][0, 0], step[1]
            s["u_q"], s["u_d"] = u[k]
            drive.advance(1_000_000)
        y[k] = s["x"][0]
    y += random.normal(size=y.shape) * scale[[0, 1, 1]] * [5e-4, 2e-3, 2e-3]
    return Samples(T, np.arange(count) * T, y, u, begins, np.ones(count, bool), np.zeros(count))


@pytest.mark.long
def test_intervals_cover_over_two_hundred_emulated_motors() -> None:
    """95 % intervals of 8 parameters hold the truth in 95 % of the motors, and are no wider than it takes."""
    off = np.empty((MOTORS, 8))
    for number in range(MOTORS):
        random = np.random.default_rng(number)
        motor, coulomb, load, scale = some_motor(random)
        found = fit(emulated(motor, coulomb, load, scale, random), motor, Shaft(coulomb))
        off[number] = (found.value - vector(motor, coulomb, load)[:8]) / found.half
    covered = np.mean(np.abs(off) <= 1.0, axis=0)
    print("share of intervals that hold the truth:", covered, covered.mean())
    assert covered.mean() >= 0.94 and (covered >= 0.9).all(), covered
    size = np.sqrt(np.mean(off**2, axis=0))
    assert (size > 0.35).all(), size  # exact: 1 / 1.96 = 0.51; a wide net would cover, too


def test_residuals_are_white_and_show_what_the_model_lacks(clean: Samples) -> None:
    samples = noisy(clean, 3)
    assert fit(samples, GUESS, Shaft(0.1)).white.min() > 1e-3
    ripple = samples.y.copy()
    ripple[:, 0] += 0.1 * np.sin(np.arange(len(ripple)) * 0.4)
    assert fit(replace(samples, y=ripple), GUESS, Shaft(0.1)).white.min() < 1e-6


def test_what_is_not_excited_is_not_told(clean: Samples) -> None:
    """A motor that only turns, i_d = 0 and no voltage along d that steps: L_d stays open, psi_f does not."""
    rest = replace(clean, y=clean.y * [1.0, 0.0, 0.0], u=np.stack([0 * clean.u[:, 0]] * 2, 1))
    found = fit(noisy(rest, 1), GUESS, Shaft(0.1))
    assert found.told[L_D] < 0.9 and found.half[L_D] > 0.25 * found.value[L_D]
    good = fit(noisy(clean, 1), GUESS, Shaft(0.1))
    assert (good.told > 0.99).all()


def test_a_load_for_a_while_is_left_out(clean: Samples) -> None:
    """A torque of 2 N m in one segment of eight: found, and friction is that of the rest."""
    samples = noisy(clean, 2)
    hit = samples.segment == 2
    y = samples.y.copy()
    since = np.arange(len(y)) - np.flatnonzero(samples.begins)[samples.segment]
    y[hit, 0] -= 2.0 / TRUE.J * since[hit] * T
    disturbed = replace(samples, y=y)
    good = calm(disturbed, GUESS)
    assert not good[2] and good.sum() >= 5
    found = fit(disturbed.segments(good), GUESS, rough(disturbed, GUESS))
    assert abs(found.value[COULOMB] - COULOMB_TRUE) < 2.0 * found.half[COULOMB] < 0.1


def test_one_direction_alone_takes_the_load_for_friction(clean: Samples) -> None:
    """Forward only: T_c + T_0 is what is told, T_0 by itself is not."""
    forward = clean.segments(np.arange(8) % 2 == 0)
    found = fit(noisy(forward, 4), GUESS, Shaft(0.1))
    assert found.value[COULOMB] == pytest.approx(COULOMB_TRUE + LOAD_TRUE, rel=0.1)
    assert found.told[7] < 0.1
    for place, name in ((PSI_F, "psi_f"), (L_Q, "L_q"), (J, "J")):
        assert found.value[place] == pytest.approx(getattr(TRUE, name), rel=0.02)
