"""The emulator's kernels: motor against DOP853, inverter, loads, noise, heat; the same bytes uncompiled."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from firmware_model import drive, load, motor, sensors
from firmware_model.config import PlantConfig, Record, Wire, build_params, new_sample, new_state
from firmware_model.loads.coupler import coupler_torque_max
from firmware_model.plant import ErrorCode, State

pytestmark = pytest.mark.slow

WIRE = Wire(0.01, 327.67, 0.001, 32.767, 0.01, 20.47)
MOTOR = {
    "R_s_ohm": 2.0, "L_d_h": 0.02, "L_q_h": 0.033, "psi_f_wb": 0.7, "n_p": 3,
    "J_kg_m2": 0.011, "B_f_n_m_s": 2e-3
}  # fmt: skip


def plant(**tables: Any) -> tuple[Record, Record]:
    """Parameters and state of a salient motor in OPERATION_ENABLED, started."""
    config = PlantConfig.model_validate({"dbc": "none.dbc", "motor": MOTOR, **tables})
    p = build_params(config, WIRE)
    s = new_state(p, 15)
    s["started"], s["state"] = 1, State.OPERATION_ENABLED.value
    return p, s


def rates(T_L: Any, u_q: float, u_d: float, phi: tuple[float, float] = (0.0, 0.0)) -> Any:
    """(32) written out a second time, from the paper with the right sign; x = (w, i_q, i_d)."""

    def f(t: float, x: Any) -> list[float]:
        w, q, d = x
        T = 1.5 * 3 * (0.7 * q + (0.02 - 0.033) * d * q)
        return [
            (T - T_L(t, w) - 2e-3 * w) / 0.011 + phi[0],
            (u_q - 2.0 * q - 3 * w * (0.02 * d + 0.7)) / 0.033 + phi[1],
            (u_d - 2.0 * d + 3 * w * 0.033 * q) / 0.02,
        ]

    return f


COUPLER = {"kind": "coupler", "torque_at_zero_gap_n_m": 6.0, "gap_mm": 3.0, "decay_length_mm": 6.0}
FREE = {"i_trip_a": 1e3, "w_trip_rad_s": 1e4, "temperature_trip_c": 200.0}


def test_series_follows_dop853_under_every_kind_of_load() -> None:
    loads = [
        {"kind": "sine", "torque_n_m": 2.0, "frequency_hz": 10.0, "phase_rad": 0.3},
        {"kind": "fan", "k_n_m_s2": 1e-4},
        COUPLER | {"slip_at_max_rad_s": 20.0, "other_side_rad_s": 5.0},
    ]
    top = coupler_torque_max(6.0, 3.0, 6.0)

    def T_L(t: float, w: float) -> float:
        slip = (w - 5.0) / 20.0
        return 2 * math.sin(20 * math.pi * t + 0.3) + 1e-4 * w * abs(w) + top * 2 * slip / (1 + slip * slip)

    p, s = plant(load=loads, disturbance={"phi_w_rad_s2": 3.0, "phi_q_a_s": 5.0}, firmware=FREE)
    s["u_q"], s["u_d"] = 60.0, -20.0
    drive.advance(p[0], s[0], 300_000_000)
    f = rates(T_L, 60.0, -20.0, (3.0, 5.0))
    exact = solve_ivp(f, (0.0, 0.3), [0.0, 0.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    assert exact[0] > 10.0 and abs(exact[1]) > 0.1
    np.testing.assert_allclose(s["x"][0], exact, rtol=0, atol=2e-11)


@pytest.mark.parametrize("corner", range(16))
def test_series_is_exact_in_every_corner_of_the_parameters(corner: int) -> None:
    """+-30 % on J, psi, R, L at 300 rad/s: within half of 1e-6 A, the finest resolution on a wire."""
    J, psi, R, L = (1.3 if corner >> bit & 1 else 0.7 for bit in range(4))
    motor_is = {"R_s_ohm": 2.0 * R, "L_d_h": 0.02 * L, "L_q_h": 0.033 * L, "psi_f_wb": 0.7 * psi}
    p, s = plant(motor=motor_is | {"n_p": 3, "J_kg_m2": 0.011 * J, "B_f_n_m_s": 2e-3}, firmware=FREE)
    start = np.array([300.0, 4.0, -1.0])
    s["x"], s["u_q"], s["u_d"] = start, 900.0 * 0.7 * psi, -40.0

    def f(t: float, x: Any) -> list[float]:
        w, q, d = x
        T = 4.5 * (0.7 * psi * q + (0.02 - 0.033) * L * d * q)
        return [
            (T - 2e-3 * w) / (0.011 * J),
            (900.0 * 0.7 * psi - 2.0 * R * q - 3 * w * (0.02 * L * d + 0.7 * psi)) / (0.033 * L),
            (-40.0 - 2.0 * R * d + 3 * w * 0.033 * L * q) / (0.02 * L),
        ]

    drive.advance(p[0], s[0], 20_000_000)
    exact = solve_ivp(f, (0.0, 0.02), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(s["x"][0], exact, rtol=0, atol=5e-7)


def test_a_substep_is_of_eighth_order() -> None:
    f = rates(lambda t, w: 0.0, 60.0, -20.0)
    start = np.array([100.0, 5.0, -2.0])
    exact = solve_ivp(f, (0.0, 0.032), start, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
    error = []
    for substep in (8000, 4000):
        p, s = plant(substep_us=substep, firmware=FREE)
        s["x"], s["u_q"], s["u_d"] = start, 60.0, -20.0
        drive.advance(p[0], s[0], 32_000_000)
        error.append(np.abs(s["x"][0] - exact).max())
    assert 128 < error[0] / error[1] < 1024, error


def test_a_step_of_the_load_inside_a_substep_is_met_to_the_nanosecond() -> None:
    loads = [{"kind": "step", "torque_n_m": 5.0, "at_s": 0.0001234, "until_s": 0.0007}]
    p, s = plant(load=loads, firmware=FREE)
    s["state"] = State.SWITCH_ON_DISABLED.value
    drive.advance(p[0], s[0], 1_000_000)
    fall = -5.0 * (0.0007 - 0.0001234) / 0.011
    assert s["x"][0, 0] == pytest.approx(fall, rel=1e-3) and s["t_ns"][0] == 1_000_000
    assert s["x"][0, 0] != pytest.approx(-5.0 * 0.0006 / 0.011, rel=1e-2)


@pytest.mark.parametrize("on", [True, False])
def test_the_plain_series_is_the_series_to_the_bit(on: bool) -> None:
    p, s = plant(disturbance={"phi_w_rad_s2": 3.0, "phi_q_a_s": 2.0})
    for x in ([100.0, 5.0, -2.0], [-30.0, -9.0, 4.0], [0.0, 0.0, 0.0]):
        s["x"][0] = x
        motor.series(p[0], s["x"][0], s["series"][0], 0.0, 5e-4, 60.0, -20.0, 1.5, on)
        plain = motor.plain_series(p[0], s["x"][0], 1.5, 60.0, -20.0, on)
        assert np.array_equal(np.array(plain), s["series"][0, :3]), x


def slope(**changed: float) -> np.ndarray:
    """dx/dt at standstill, from the first coefficients of the series."""
    p, s = plant()
    at = {"i_q": 0.0, "T_commanded": 0.0} | changed
    s["x"][0, 1] = at["i_q"]
    motor.series(p[0], s["x"][0], s["series"][0], 0.0, 1e-4, 0.0, 0.0, at["T_commanded"], True)
    return s["series"][0, :3, 1]


def test_positive_current_accelerates() -> None:
    assert slope(i_q=1.0)[0] == pytest.approx(3 * 1.5 * 0.7 / 0.011)
    assert slope(T_commanded=1.0)[0] == pytest.approx(-1 / 0.011)


def test_voltage_is_rounded_then_kept_in_the_circle() -> None:
    p, s = plant(inverter={"v_dc_v": 300.0, "resolution_v": 0.5})
    drive.on_command(s[0], 1, 0x0F, 100.3, -50.2)
    drive.latch(p[0], s[0])
    assert (s["u_q"][0], s["u_d"][0], s["limited"][0]) == (100.5, -50.0, 0)
    drive.on_command(s[0], 2, 0x0F, 300.0, -400.0)
    drive.latch(p[0], s[0])
    assert math.hypot(s["u_q"][0], s["u_d"][0]) == pytest.approx(300 / math.sqrt(3))
    assert s["u_q"][0] / s["u_d"][0] == pytest.approx(-0.75) and s["limited"][0] == 1


@pytest.mark.parametrize("state", [s for s in State if s != State.OPERATION_ENABLED])
def test_no_voltage_current_or_commanded_load_outside_operation_enabled(state: State) -> None:
    p, s = plant()
    s["x"], s["state"] = (10.0, 3.0, 1.0), state.value
    drive.on_load_command(s[0], 4.0)
    drive.on_command(s[0], 1, 0x00, 100.0, 100.0)
    drive.on_sync(p[0], s[0], new_sample()[0])
    drive.advance(p[0], s[0], 1_000_000)
    assert not s["x"][0, 1:].any() and s["T_commanded"][0] == 0 == s["u_q"][0]


def test_loads_add_up_and_a_step_has_its_times() -> None:
    step = {"kind": "step", "torque_n_m": 5.0, "at_s": 1.0, "until_s": 2.0}
    p, _ = plant(load=[{"kind": "constant", "torque_n_m": 0.5}, step, {"kind": "fan", "k_n_m_s2": 0.01}])
    for t, w, expected in [(0.9, 0.0, 0.5), (1.0, 0.0, 5.5), (2.0, 0.0, 0.5), (0.0, -10.0, -0.5)]:
        assert load.load_torque(p[0], t, w) == pytest.approx(expected), (t, w)
    with pytest.raises(ValidationError, match="not after at_s"):
        plant(load=[step | {"until_s": 0.5}])


def test_coupler_has_its_maximum_at_its_slip_and_falls_with_the_gap() -> None:
    coupler = {
        "kind": "coupler", "torque_at_zero_gap_n_m": 8.0, "gap_mm": 3.0, "decay_length_mm": 10.0,
        "slip_at_max_rad_s": 20.0, "other_side_rad_s": 5.0,
    }  # fmt: skip
    p, _ = plant(load=[coupler])
    w = np.linspace(-100, 100, 2001)
    T = np.array([load.load_torque(p[0], 0.0, x) for x in w])
    assert w[T.argmax()] == pytest.approx(25.0) and T.max() == pytest.approx(8 * math.exp(-0.6))
    assert load.load_torque(p[0], 0.0, 5.0) == 0.0  # no slip, no torque
    np.testing.assert_allclose(
        T[1050:] + T[1050::-1][: len(T[1050:])], 0, atol=1e-12
    )  # odd about the other side


@pytest.mark.parametrize("seed", [0, 1, 2, 20261124, 2**31 - 1])
def test_noise_is_normal_white_and_its_own_for_each_seed(seed: int) -> None:
    def draw(start: int) -> Any:
        s = new_state(plant(seed=start)[0], 15)
        return np.array([sensors.normal(s[0]) for _ in range(20_000)])

    x, other = draw(seed), draw((seed + 1) % 2**31)
    assert abs(x.mean()) < 5 / math.sqrt(20_000) and abs(x.std() - 1) < 0.025, seed
    for lag in range(1, 20):
        assert abs(np.mean(x[lag:] * x[:-lag])) < 5 / math.sqrt(20_000), (seed, lag)
    assert abs(np.mean(x * other)) < 5 / math.sqrt(20_000), seed
    assert abs(np.mean(np.abs(x) < 1) - 0.6827) < 0.02 and np.abs(x).max() <= 6


@pytest.mark.parametrize("seed", [0, 1, 20261124, 2**31 - 1])
def test_a_normal_number_is_the_sum_of_twelve_uniform_ones_to_the_bit(seed: int) -> None:
    at_once, one_by_one = new_state(plant(seed=seed)[0], 15)[0], new_state(plant(seed=seed)[0], 15)[0]
    for _ in range(200):
        expected = sum(sensors.uniform(one_by_one) for _ in range(12)) - 6.0
        assert (sensors.normal(at_once), at_once["random"]) == (expected, one_by_one["random"]), seed


def test_uniform_bits_are_fair_and_the_period_is_long() -> None:
    p, s = plant()[0], new_state(plant()[0], 15)
    assert p["seed"][0] == 1
    raw = np.array([int(sensors.uniform(s[0]) * 2**31) for _ in range(40_000)])
    for bit in range(8, 31):
        assert abs((raw >> bit & 1).mean() - 0.5) < 5 * 0.5 / 200, bit
    assert len(np.unique(raw)) > 39_900


@pytest.mark.parametrize("value", [1e9, -1e9, 327.67, 80.004, -80.006, 0.004, -0.001])
def test_a_reading_is_what_a_receiver_decodes(value: float) -> None:
    got = sensors.to_wire(value, 0.01, 327.67)
    assert got == round(got / 0.01) * 0.01 + 0.0 and math.copysign(1, got or 1.0) * got == abs(got)
    assert abs(got - min(max(value, -327.67), 327.67)) <= 0.005 + 1e-9


def test_status_saturates() -> None:
    p, s = plant(inverter={"v_dc_v": 1e5}, firmware={"ambient_c": -300.0})
    out = new_sample()
    drive.on_sync(p[0], s[0], out[0])
    assert (out["v_dc"][0], out["temperature_motor"][0]) == (65535 * 0.1, -40.0)


@pytest.mark.parametrize(
    ("error", "x", "firmware"),
    [
        (ErrorCode.OVER_CURRENT, (0.0, 30.0, 30.0), {}),
        (ErrorCode.OVER_SPEED, (-301.0, 0.0, 0.0), {}),
        (ErrorCode.OVER_SPEED, (math.nan, 0.0, 0.0), {}),
        (ErrorCode.OVER_TEMPERATURE_MOTOR, (0.0, 0.0, 0.0), {"ambient_c": 150.0}),
    ],
)
def test_trips_latch_and_are_reported_once(error: ErrorCode, x: Any, firmware: Any) -> None:
    p, s = plant(firmware=firmware)
    s["x"], out = x, new_sample()
    drive.advance(p[0], s[0], 1_000_000)
    assert s["state"][0] == State.FAULT and s["error"][0] == error and not s["x"][0, 1:].any()
    assert np.isfinite(s["x"]).all() and np.isfinite(s["temperature"]).all()
    due = []
    for _ in range(3):
        drive.on_sync(p[0], s[0], out[0])
        due.append(int(out["emcy_due"][0]))
    assert due == [1, 0, 0]


def test_heat_settles_at_loss_times_resistance() -> None:
    p, s = plant(firmware={"thermal_time_s": 0.05, "thermal_resistance_k_w": 1.0})
    s["u_d"] = 10.0  # i_d = 5 A at standstill, no torque: 1.5 * 2 ohm * 25 A2 = 75 W
    drive.advance(p[0], s[0], 600_000_000)
    assert s["temperature"][0] == pytest.approx(25 + 75, abs=0.1)


@pytest.mark.parametrize(("wait_ms", "state"), [(20, State.OPERATION_ENABLED), (21, State.FAULT)])
def test_watchdog_counts_plant_time(wait_ms: int, state: State) -> None:
    p, s = plant()
    drive.on_command(s[0], 1, 0x0F, 0.0, 0.0)
    for _ in range(wait_ms):
        drive.advance(p[0], s[0], 1_000_000)
    assert s["state"][0] == state
    assert s["error"][0] == (ErrorCode.COMMUNICATION_TIMEOUT if state == State.FAULT else 0)


def trace() -> str:
    """Digest of states and samples of a noisy plant through enabling, a load step, saturation and a trip."""
    step = {"kind": "step", "torque_n_m": 3.0, "at_s": 0.1}
    p, s = plant(
        load=[{"kind": "constant", "torque_n_m": 0.1}, step, {"kind": "fan", "k_n_m_s2": 1e-4}],
        sensors={"w_noise_rad_s": 0.05, "i_noise_a": 0.01},
    )
    s["state"], s["started"] = State.SWITCH_ON_DISABLED.value, 0
    out, digest, rng = new_sample(), hashlib.sha256(), np.random.default_rng(5)
    reached = set()
    for k in range(400):
        drive.advance(p[0], s[0], int(rng.integers(1, 1_500_000)))
        drive.on_sync(p[0], s[0], out[0])
        u_q, u_d = (float(u) for u in rng.normal(60, 30, 2) * (8 if k > 380 else 1))
        drive.on_load_command(s[0], float(rng.normal()))
        drive.on_command(s[0], k % 16, (0x06, 0x07, 0x0F)[min(k, 2)], u_q, u_d)
        reached.add(int(s["state"][0]))
        digest.update(s.tobytes() + out.tobytes())
    assert {2, 3, 4, 7} <= reached, reached
    return digest.hexdigest()


def test_compiled_and_interpreted_bytes_are_equal() -> None:
    found = []
    for disable in ("0", "1"):
        environment = os.environ | {
            "NUMBA_DISABLE_JIT": disable,
            "PYTHONPATH": str(Path(__file__).parents[2]),
        }
        done = subprocess.run(
            [sys.executable, "-W", "error", __file__], env=environment, capture_output=True, text=True,
            timeout=240, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        found.append(done.stdout)
    assert found[0] == found[1]


if __name__ == "__main__":
    sys.stdout.write(trace())
