"""The ramp before a stop and the live set-point: closed forms, bounds, and what they leave as it was."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.app import Overrides, load_setup
from hil.control.errors import ControlDesignError
from hil.design import Machine
from hil.setpoint_design import acceleration_max, setpoint_params, stop_rate
from hil.signals import DriveState, Request, new_ticks
from hil.simulate import simulate_ticks
from tests.conftest import CONFIGS

OPERATING = int(DriveState.OPERATION_ENABLED)


class Bench:
    """Prepares ticks of the demo's controller in operation; the drive's speed is what the test says."""

    def __init__(self, *settings: str, name: str = "demo.toml", state: int = OPERATING) -> None:
        self.machine: Machine = load_setup(CONFIGS / name, Overrides(settings=settings)).machine.fresh()
        self.p = self.machine.setpoint[0]
        self.ticks = new_ticks()
        self.t: Any = self.ticks[0]
        self.machine.safety_state["state"] = state

    def tick(
        self, request: int, w: float = 0.0, gap: int = 1, run_ticks: int = 3000
    ) -> tuple[float, float, int]:
        self.machine.safety_state["run_ticks"] = run_ticks
        self.t["request"], self.t["w"], self.t["gap"] = int(request), w, gap
        self.machine.prepare(self.ticks)
        return float(self.t["w_ref"]), float(self.t["dw_ref"]), int(self.t["request"])

    def until_stop(self, most: int, w: float | None = None) -> list[tuple[float, float, int]]:
        """Ask for a stop until it is one; the drive follows its reference unless ``w`` is given."""
        out = []
        follows = float(self.t["w_ref"])
        for _ in range(most):
            out.append(self.tick(Request.STOP, follows if w is None else w))
            follows = out[-1][0]
            if out[-1][2] == Request.STOP:
                return out
        raise AssertionError("the ramp does not end")


def test_the_ramp_is_the_closed_form_and_ends_in_a_stop() -> None:
    bench = Bench()
    assert bench.tick(Request.ARM, 80.0) == (80.0, 0.0, Request.ARM)
    rate, T_s = float(bench.p["stop_rate"]), 1e-3
    ticks = bench.until_stop(2000)
    for k, (w, dw, request) in enumerate(ticks[:-1]):
        assert w == max(80.0 - rate * T_s * k, 0.0) and request == Request.RAMP_DOWN
        assert dw == (-rate if w > 0.0 else 0.0)
    assert ticks[-1] == (0.0, 0.0, Request.STOP)
    assert len(ticks) == math.ceil(80.0 / (rate * T_s)) + 1


def test_skipped_periods_do_not_stretch_the_ramp() -> None:
    bench = Bench()
    bench.tick(Request.ARM, 80.0)
    bench.tick(Request.STOP, 80.0)
    assert bench.tick(Request.STOP, 80.0, gap=20)[0] == 80.0 - float(bench.p["stop_rate"]) * 1e-3 * 20


@pytest.mark.parametrize("measured", [30.0, -5.0, math.nan])
def test_a_stop_never_accelerates_the_drive(measured: float) -> None:
    bench = Bench()
    bench.tick(Request.ARM, 30.0)
    first = bench.tick(Request.STOP, measured)[0]
    assert first == {30.0: 30.0, -5.0: 0.0}.get(measured, 80.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ramp_goes_to_zero_from_either_side(sign: float) -> None:
    bench = Bench(f"reference.w_rad_s={sign * 80.0}")
    bench.tick(Request.ARM, sign * 80.0)
    ramp = [w for w, _, _ in bench.until_stop(2000)]
    assert ramp[0] == sign * 80.0 and ramp[-1] == 0.0
    assert (np.diff(np.abs(ramp)) <= 0.0).all() and (np.array(ramp) * sign >= 0.0).all()


@pytest.mark.parametrize("w", [80.0, -80.0, math.nan, math.inf])
def test_it_ends_in_bounded_time_whatever_the_drive_does(w: float) -> None:
    bench = Bench("stop.ramp_max_s=1.0", "stop.ramp_rad_s2=150.0")
    bench.tick(Request.ARM, 80.0)
    assert len(bench.until_stop(10_000, w)) <= 1001


def test_at_rest_and_before_operation_a_stop_is_a_stop_at_once() -> None:
    assert Bench().tick(Request.STOP, 0.0, run_ticks=0)[2] == Request.STOP
    for state in DriveState:
        if state != DriveState.OPERATION_ENABLED:
            assert Bench(state=int(state)).tick(Request.STOP, 80.0)[2] == Request.STOP


@pytest.mark.parametrize("settings", [("stop.ramp_rad_s2=0.0",), ("loop.shadow=true",)])
def test_without_a_ramp_a_stop_is_a_stop_at_once(settings: tuple[str, ...]) -> None:
    bench = Bench(*settings)
    bench.tick(Request.ARM, 80.0)
    assert bench.tick(Request.STOP, 80.0) == (80.0, 0.0, Request.STOP)


def test_a_quick_stop_cuts_the_ramp_and_a_dead_mans_switch_has_none() -> None:
    bench = Bench()
    bench.tick(Request.ARM, 80.0)
    assert bench.tick(Request.STOP, 80.0)[2] == Request.RAMP_DOWN
    assert bench.tick(Request.QUICK_STOP, 80.0)[2] == Request.QUICK_STOP
    bench = Bench()
    bench.machine = bench.machine.at_once()
    bench.tick(Request.ARM, 80.0)
    assert bench.tick(Request.STOP, 80.0)[2] == Request.STOP


def test_the_rate_follows_from_the_machine_and_is_refused_out_of_reach() -> None:
    setup = load_setup(CONFIGS / "demo.toml", Overrides())
    config = setup.config
    assert acceleration_max(config) == pytest.approx(1.5 * 3 * 0.8 * 15.0 / 0.011)
    assert stop_rate(config) == 150.0
    heavy = config.model_copy(update={"motor": config.motor.model_copy(update={"J_kg_m2": 1.1})})
    assert stop_rate(heavy) == pytest.approx(0.5 * 1.5 * 3 * 0.8 * 15.0 / 1.1)
    for setting, said in (
        ("stop.ramp_rad_s2=1e5", "the torque at i_max_a gives"),
        ("stop.ramp_rad_s2=1.0", "takes longer than stop.ramp_max_s"),
        ("setpoint.w_max_rad_s=151.0", "beyond the limit"),
        ("setpoint.w_min_rad_s=-151.0", "beyond the limit"),
        ("setpoint.w_min_rad_s=140.0", "is above"),
        ("setpoint.rate_rad_s2=1e5", "the torque at i_max_a gives"),
        ("setpoint.i_q_max_a=16.0", "beyond the limit"),
    ):
        with pytest.raises(ControlDesignError, match=said):
            load_setup(CONFIGS / "demo.toml", Overrides(settings=(setting,)))


def test_a_live_set_point_moves_at_its_rate_from_where_the_reference_is() -> None:
    bench = Bench("setpoint.rate_rad_s2=50.0")
    bench.tick(Request.ARM, 80.0)
    state = bench.machine.setpoint_state
    state["live_w"], state["w_target"] = 1, 79.9
    assert bench.tick(Request.ARM) == (79.95, -50.0, Request.ARM)
    w, dw, _ = bench.tick(Request.ARM)
    assert (w, dw) == (79.9, 0.0)
    state["w_target"] = 90.0
    assert bench.tick(Request.ARM, gap=4)[0] == pytest.approx(80.1, abs=1e-12)


def test_a_simulated_run_ends_at_rest_and_without_a_ramp_as_it_always_did() -> None:
    settings = ("loop.duration_s=2.0",)
    ramped = simulate_ticks(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)))
    cut = simulate_ticks(
        load_setup(CONFIGS / "demo.toml", Overrides(settings=(*settings, "stop.ramp_rad_s2=0.0")))
    )
    assert ramped[:2000].tobytes() == cut[:2000].tobytes()
    assert abs(cut["w"][cut["reason"] != 0][0]) > 79.0
    ended = ramped[ramped["reason"] != 0]
    assert abs(ended["w"][0]) < 1.5 and int(ended["k"][0]) == pytest.approx(2533, abs=40)
    down = ramped[ramped["request"] == Request.RAMP_DOWN]
    assert (np.abs(down["w"] - down["w_ref"]) < 6.0).all() and (down["state"] == OPERATING).all()


def test_parameters_are_of_the_config_alone() -> None:
    setup = load_setup(CONFIGS / "demo.toml", Overrides())
    assert setpoint_params(setup.config).tobytes() == setup.machine.setpoint.tobytes()
    assert replace(setup.machine).at_once().setpoint["stop_ticks"] == 0
    assert setup.machine.setpoint["stop_ticks"] == 5000
