"""The ramp before a stop and the live set-point: closed forms, bounds, and what they leave as it was."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.config.design import Machine
from hil.config.setpoint_design import acceleration_max, setpoint_params, stop_rate
from hil.control.errors import ControlDesignError
from hil.control.law import FAC
from hil.control.references import reference, reference_at, turned_at
from hil.control.speed import FOLLOWS, LEADS
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request, new_ticks
from hil.sim.simulate import simulate_ticks
from hil.tick.setpoint import (
    begin_ramp,
    follow,
    new_setpoint_state,
    no_setpoint,
    ramp_over,
    ramped,
    stepped,
    turned,
)
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


def rule(**values: float) -> tuple[Any, Any]:
    """Parameters and state with these numbers, all others 0, T_s = 0.5 s."""
    p, g = no_setpoint(), new_setpoint_state()
    assert len(p) == len(g) == 1
    p["T_s"] = 0.5
    for name, value in values.items():
        (p if name in (p.dtype.names or ()) else g)[name] = value
    return p[0], g[0]


def test_a_step_is_bounded_on_either_side() -> None:
    assert [stepped(1.0, target, 0.25) for target in (9.0, 1.125, 1.0, 0.875, -9.0)] == [
        1.25, 1.125, 1.0, 0.875, 0.75,
    ]  # fmt: skip


def test_live_set_points_go_at_their_rate_times_the_periods() -> None:
    p, g = rule(w_rate=4.0, i_q_rate=2.0, w=10.0, i_q=1.0, w_target=99.0, i_q_target=9.0)
    assert follow(p, g, 7.0, 0.5, 3.0, 2) == (7.0, 0.5, 3.0)
    g["live_w"] = 1
    assert follow(p, g, 7.0, 0.5, 3.0, 3) == (16.0, 4.0, 3.0)
    g["w_target"] = -99.0
    assert follow(p, g, 7.0, 0.5, 3.0, 1) == (8.0, -4.0, 3.0)
    g["w_target"] = 10.0
    assert follow(p, g, 7.0, 0.5, 3.0, 1) == (10.0, 0.0, 3.0)
    g["w_target"] = 12.5
    assert follow(p, g, 7.0, 0.5, 3.0, 1) == (12.0, 4.0, 3.0)
    g["w_target"] = 7.5
    assert follow(p, g, 7.0, 0.5, 3.0, 1) == (8.0, -4.0, 3.0)
    g["live_w"], g["live_i_q"] = 0, 1
    assert follow(p, g, 7.0, 0.5, 3.0, 3) == (7.0, 0.5, 4.0)
    g["i_q_target"] = -9.0
    assert follow(p, g, 7.0, 0.5, 3.0, 1) == (7.0, 0.5, 0.0)


@pytest.mark.parametrize(
    ("w", "measured", "start"),
    [(5.0, 3.0, 3.0), (5.0, 7.0, 5.0), (5.0, -1.0, 0.0), (0.0, 3.0, 0.0), (-5.0, -3.0, -3.0),
     (-5.0, -7.0, -5.0), (-5.0, 1.0, 0.0), (5.0, math.nan, 5.0), (5.0, -math.inf, 5.0),
     (-5.0, math.inf, -5.0), (0.5, 0.25, 0.25), (-0.5, -0.25, -0.25)],
)  # fmt: skip
def test_a_ramp_begins_between_rest_and_the_reference(w: float, measured: float, start: float) -> None:
    _, g = rule(ticks=9, at_zero=9, i_q_from=9.0)
    begin_ramp(g, w, 2.5, measured)
    assert (g["ramping"], g["ticks"], g["at_zero"], g["w_from"], g["i_q_from"]) == (1, 0, 0, start, 2.5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_current_shrinks_with_the_speed_of_the_ramp(sign: float) -> None:
    p, g = rule(stop_rate=4.0, w_from=sign * 10.0, i_q_from=5.0)
    assert ramped(p, g) == (sign * 10.0, -sign * 4.0, 5.0)
    g["ticks"] = 3
    assert ramped(p, g) == (sign * 4.0, -sign * 4.0, 2.0)
    g["ticks"] = 5
    assert ramped(p, g) == (0.0, 0.0, 0.0)
    p["stop_rate"], g["w_from"], g["ticks"] = 0.25, sign * 0.75, 2
    assert ramped(p, g) == (sign * 0.5, -sign * 0.25, 5.0 * 0.5 / 0.75)


def test_a_ramp_is_over_at_rest_after_settling_or_in_the_end() -> None:
    p, g = rule(w_still=0.5, settle_ticks=6, stop_ticks=20, ticks=19)
    assert not ramp_over(p, g, 0.25, 0.0, 1) and g["at_zero"] == 0
    assert [ramp_over(p, g, 0.0, measured, 1) for measured in (0.5, -0.5, 0.75, -0.75)] == [1, 1, 0, 0]
    assert g["at_zero"] == 4 and not ramp_over(p, g, 0.0, 9.0, 2) and ramp_over(p, g, 0.0, 9.0, 1)
    assert not ramp_over(p, g, 0.25, 0.0, 3) and g["at_zero"] == 0
    g["ticks"] = 20
    assert ramp_over(p, g, 0.25, 0.0, 1)


def test_a_current_of_the_profile_is_asked_for_by_the_law_fac_alone() -> None:
    bench = Bench()
    bench.machine.reference["i_q"] = 2.0
    bench.tick(Request.ARM, 80.0)
    assert bench.t["i_q_ref_in"] == 0.0
    bench.machine.law["kind"] = FAC
    bench.tick(Request.ARM, 80.0)
    assert bench.t["i_q_ref_in"] == 2.0
    state = bench.machine.setpoint_state[0]
    assert (state["w"], state["i_q"]) == (80.0, 2.0)


def test_the_profile_runs_with_the_time_in_operation() -> None:
    bench = Bench()
    for run_ticks in (0, 100, 300, 600):
        w, dw = reference_at(bench.machine.reference[0], run_ticks * 1e-3)
        assert bench.tick(Request.ARM, 0.0, run_ticks=run_ticks)[:2] == (w, dw)
    assert 0.0 < w < 80.0 and dw > 0.0


def test_skipped_periods_do_not_stretch_the_profile() -> None:
    """Periods in operation count, with a tick or without; those before and after do not."""
    bench = Bench()
    of = bench.machine.reference[0]
    bench.tick(Request.ARM, 0.0, gap=9, run_ticks=0)
    for run_ticks, gap, periods in ((700, 1, 700), (701, 3, 703), (702, 1, 704), (703, 2, 706)):
        assert (
            bench.tick(Request.ARM, 0.0, gap=gap, run_ticks=run_ticks)[0]
            == reference_at(of, periods * 1e-3)[0]
        )
    bench.machine.safety_state["state"] = DriveState.FAULT
    bench.tick(Request.ARM, 0.0, gap=2, run_ticks=704)
    assert bench.machine.setpoint_state[0]["skipped"] == 3
    bench.tick(Request.ARM, 0.0, gap=2, run_ticks=0)
    assert bench.machine.setpoint_state[0]["skipped"] == 0


def test_the_reference_angle_is_the_profiles_own_and_elsewhere_trapezoids() -> None:
    """By hand, T_s = 0.5 s, a ramp of 4 rad/s2: theta* = 2 t^2 where the profile goes on."""
    rp, p, g = reference("ramp", w=80.0, rate=4.0)[0], no_setpoint()[0], new_setpoint_state()[0]
    p["T_s"], g["theta"], g["w"] = 0.5, 10.0, 3.0
    assert turned(rp, p, g, 1.0, 4.0, 2) == 10.0 + 3.5, "the way there is a trapezoid"
    assert turned(rp, p, g, 1.5, 99.0, 7) == 13.5 + 2.5, "and then the profile's"
    g["live_w"], g["w"] = 1, 4.0
    assert turned(rp, p, g, 2.0, 5.0, 3) == 16.0 + 6.75
    assert turned(rp, p, g, 2.5, 6.0, 1) == 22.75 + 2.5
    g["live_w"], g["ramping"] = 0, 1
    assert turned(rp, p, g, 3.0, 0.0, 1) == 25.25 + 1.0
    g["ramping"] = 0
    assert turned(rp, p, g, 3.5, 2.0, 1) == 26.25 + 1.5
    assert turned(rp, p, g, 4.0, 99.0, 9) == 27.75 + 7.5


def test_an_angle_is_given_to_the_law_that_follows_one() -> None:
    bench = Bench(name="position.toml")
    of, time = bench.machine.reference[0], 1.5
    bench.tick(Request.ARM, run_ticks=1499)
    before = float(bench.t["theta_ref"])
    w, _, _ = bench.tick(Request.ARM, run_ticks=1500, gap=1)
    assert float(bench.t["theta_ref"]) - before == pytest.approx(turned_at(of, time) - turned_at(of, 1.499))
    assert 0.0 < w * 0.9e-3 < float(bench.t["theta_ref"]) - before < w * 1.1e-3
    other = Bench()
    other.t["theta_ref"] = 7.0
    other.tick(Request.ARM)
    assert other.t["theta_ref"] == 7.0


def test_a_ramp_of_one_tick_is_one() -> None:
    bench = Bench()
    bench.machine.setpoint["stop_ticks"] = 1
    bench.tick(Request.ARM, 80.0)
    assert [bench.tick(Request.STOP, 80.0)[2] for _ in range(2)] == [Request.RAMP_DOWN, Request.STOP]


def test_the_ramp_counts_from_the_tick_after_its_first() -> None:
    bench = Bench()
    bench.tick(Request.ARM, 80.0)
    bench.tick(Request.STOP, 80.0, gap=7)
    state = bench.machine.setpoint_state[0]
    assert (state["ramping"], state["ticks"]) == (1, 0)
    bench.tick(Request.ARM, 80.0, gap=3)  # nobody takes a stop back
    assert state["ticks"] == 3 and bench.t["request"] == Request.ARM


def test_parameters_are_of_the_config_alone() -> None:
    setup = load_setup(CONFIGS / "demo.toml", Overrides())
    assert setpoint_params(setup.config).tobytes() == setup.machine.setpoint.tobytes()
    assert replace(setup.machine).at_once().setpoint["stop_ticks"] == 0
    assert setup.machine.setpoint["stop_ticks"] == 5000


@pytest.mark.parametrize(("pair", "i_q"), [(0, 0.0), (LEADS, 2.5), (FOLLOWS, 7.0)])
def test_the_current_that_is_asked_for_goes_by_the_part_in_a_pair(pair: int, i_q: float) -> None:
    """The profile's where the law commands both nodes; what the other has written where it follows."""
    bench = Bench()
    bench.machine.reference["i_q"], bench.machine.law["pair"], bench.t["i_q_ref_in"] = 2.5, pair, 7.0
    bench.tick(Request.ARM, 80.0)
    assert bench.t["i_q_ref_in"] == i_q
