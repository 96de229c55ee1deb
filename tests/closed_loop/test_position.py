"""The law position in whole simulated runs: a move through a load step, replays, reports, encoder faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.check.angle import angle_rows
from hil.check.checks import speed_filter_rows
from hil.errors import HilError
from hil.replay import replay
from hil.replay.whatif import what_if
from hil.report.build import build
from hil.report.collect import collect
from hil.report.criteria import figures
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import INPUTS, DriveState, Reason, Request, RxFlag, TickArray
from hil.sim.simulate import simulate, simulate_ticks
from tests.conftest import CONFIGS

pytestmark = pytest.mark.compiled
PATH = CONFIGS / "position.toml"
SHORT = ("loop.duration_s=3.0", "reference.target_turns=20.0", "reference.rate_rad_s2=400.0")
EARLY = ('load=[{kind="brake",torque_n_m=5.4,at_s=1.2,until_s=1.6}]',)


def setup_of(*settings: str) -> Setup:
    return load_setup(PATH, Overrides(settings=(*SHORT, *settings)))


@pytest.fixture(scope="module")
def ticks() -> TickArray:
    return simulate_ticks(setup_of(), list(EARLY))


def at(ticks: TickArray, t: float) -> Any:
    return ticks[round(t * 1000)]


def test_a_move_goes_through_a_load_step_to_its_target(ticks: TickArray) -> None:
    assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
    own = operating(ticks)
    error = np.abs(own["theta_error"])
    assert 0.02 < error.max() < 0.06, "5.4 N m at 80 rad/s"
    t = own["t_ns"] * 1e-9
    assert error[(t > 1.35) & (t < 1.6)].max() < 0.003, "the load is on, and no angle is left"
    assert error[t < 1.2].max() < 0.005, "on the way: feed-forward"
    way = 2.0 * math.pi * 20.0
    assert own["theta_ref"][-1] == pytest.approx(way, abs=1e-12)
    assert abs(own["theta_turned"][-1] - way) <= 2.0 * math.pi / 4096
    assert np.isfinite(own["theta_turned"]).all() and own["theta_ref"][0] == 0.0


def test_nothing_jumps_at_arming(ticks: TickArray) -> None:
    first = ticks[ticks["state"] == int(DriveState.OPERATION_ENABLED)][:100]
    assert np.abs(first["u_q"]).max() < 0.5 and np.abs(first["theta_error"]).max() <= 2.0 * math.pi / 4096
    before = ticks[ticks["state"] != int(DriveState.OPERATION_ENABLED)]
    assert (before["theta_error"][before["reason"] == 0] == 0.0).all()


def test_an_arming_at_any_angle_is_where_the_reference_begins(ticks: TickArray) -> None:
    """The plant's angle begins elsewhere, its counter at its end: the same run but for rounding."""
    machine, setup = setup_of().machine.fresh(), setup_of()
    lsb = 2.0 * math.pi / 4096
    span = 2.0**32 * lsb
    for row in range(600):
        now = _inputs(ticks, row)
        now["theta"] = np.rint(now["theta"] / lsb + 2.0**31 - 40) * lsb
        now["theta"] -= span * (now["theta"] >= 0.5 * span)
        machine.step(now)
        if ticks["state"][row] == int(DriveState.OPERATION_ENABLED):
            assert now["theta_error"][0] == pytest.approx(ticks["theta_error"][row], abs=1e-8)
            assert now["u_q"][0] == pytest.approx(ticks["u_q"][row], abs=1e-9)
    assert setup.machine.law["theta_span"][0] == 0.0, "whole turns"


def _inputs(ticks: TickArray, row: int) -> TickArray:
    now = ticks[row : row + 1].copy()
    for name in now.dtype.names or ():
        if not name.startswith("_") and name not in INPUTS:
            now[name] = 0
    return now


def test_what_a_lost_measurement_leaves_out_is_no_following_error(ticks: TickArray) -> None:
    """At 80 rad/s the shaft goes 80 mrad in a tick; it is known to have."""
    machine, lost = setup_of().machine.fresh(), range(700, 703)
    for row in range(710):
        now = _inputs(ticks, row)
        if row in lost:
            now["rx_flags"] ^= int(RxFlag.FRESH)
            now["theta"], now["w"] = ticks["theta"][699], ticks["w"][699]
        machine.step(now)
        if row in lost:
            assert abs(now["theta_error"][0]) < 5e-3
            assert now["theta_turned"][0] == pytest.approx(ticks["theta_turned"][row], abs=2e-3)
    assert ticks["theta_turned"][702] - ticks["theta_turned"][699] > 0.2


def ended(ticks: TickArray, change: Callable[[Any, int], None], *settings: str) -> tuple[Reason, int]:
    """Reason and row of the stop, with measurements changed from row 800 on."""
    machine = setup_of(*settings).machine.fresh()
    for row in range(len(ticks)):
        now = _inputs(ticks, row)
        if row >= 800:
            change(now, row)
        machine.step(now)
        if now["reason"][0] and now["request"][0] != Request.STOP:
            assert now["u_q"][0] == 0.0
            return Reason(int(now["reason"][0])), row
    return Reason.NONE, len(ticks)


def set_angle(of: Callable[[float, int], float]) -> Callable[[Any, int], None]:
    def change(now: Any, row: int) -> None:
        now["theta"] = of(float(now["theta"][0]), row)

    return change


def test_an_encoder_that_fails_stops_the_run(ticks: TickArray) -> None:
    nothing = set_angle(lambda theta, row: theta)
    assert ended(ticks, nothing)[0] in (Reason.NONE, Reason.STOP_REQUESTED)
    assert ended(ticks, set_angle(lambda theta, row: math.nan)) == (Reason.NOT_A_NUMBER, 800)
    assert ended(ticks, set_angle(lambda theta, row: 1e300)) == (Reason.NOT_A_NUMBER, 800)
    assert ended(ticks, set_angle(lambda theta, row: theta + 1.0)) == (Reason.ANGLE_JUMP, 800)
    frozen = float(ticks["theta"][800])
    reason, row = ended(ticks, set_angle(lambda theta, row: frozen))
    assert reason == Reason.ANGLE_JUMP and row < 812
    wrong_way = set_angle(lambda theta, row: 2.0 * frozen - theta)
    assert ended(ticks, wrong_way)[0] == Reason.ANGLE_JUMP


def test_a_soft_start_catches_up_without_a_jump() -> None:
    run = operating(simulate_ticks(setup_of("limits.soft_start_s=1.0"), ["load=[]"]))
    assert run["reason"][-1] == 0 or Reason(int(run["reason"][-1])) == Reason.STOP_REQUESTED
    assert np.abs(np.diff(run["u_q"])).max() < 3.0 and np.abs(run["theta_error"]).max() < 0.1
    assert abs(run["theta_error"][-1]) <= 2.0 * math.pi / 4096


def test_a_lost_frame_is_no_jump(ticks: TickArray) -> None:
    def lost(now: Any, row: int) -> None:
        if row % 50 < 20:
            now["rx_flags"], now["theta"] = 0, ticks["theta"][row - row % 50 - 1]

    assert ended(ticks, lost)[0] in (Reason.NONE, Reason.STOP_REQUESTED)


def test_a_following_error_stops_by_its_own_reason() -> None:
    tight = ("limits.following_error_rad=0.01", "limits.following_error_s=0.005")
    run = simulate_ticks(setup_of(*tight), list(EARLY))
    assert Reason(int(run["reason"][-1])) == Reason.ANGLE_ERROR
    first = int(np.argmax(run["reason"] != 0))
    assert 1200 < run["k"][first] < 1230 and run["theta_error"][first] > 0.01
    assert (run["u_q"][first:] == 0.0).all()


def test_a_stop_on_the_way_ramps_down_and_holds_the_angle() -> None:
    run = simulate_ticks(setup_of("loop.duration_s=1.0"), ["load=[]"])
    assert Reason(int(run["reason"][-1])) == Reason.STOP_REQUESTED
    ramp = run[run["request"] == int(Request.RAMP_DOWN)]
    assert len(ramp) > 100 and np.abs(ramp["theta_error"]).max() < 0.05
    assert np.abs(np.diff(ramp["theta_ref"])).max() <= 80.1e-3


def test_behind_the_filter_of_an_odrive_the_angle_is_held() -> None:
    """Its speed comes through a PLL of 1000 rad/s, its angle in turns as float32."""
    settings = (
        'drive.signals.angle="Get_Encoder_Estimates.Pos_Estimate"', 'controller={kind="position"}',
        "limits.following_error_rad=0.5", "loop.duration_s=2.5", "reference.rate_rad_s2=400.0",
        "reference.down_at_s=2.2",
    )  # fmt: skip
    run = simulate_ticks(load_setup(CONFIGS / "odrive.toml", Overrides(settings=settings)), list(EARLY))
    assert Reason(int(run["reason"][-1])) == Reason.STOP_REQUESTED
    t, error = run["t_ns"] * 1e-9, np.abs(run["theta_error"])
    assert 0.02 < error[t < 1.5].max() < 0.08 and error[(t > 1.45) & (t < 1.6)].max() < 0.003
    assert run["theta_turned"][-1] > 80.0


def test_it_replays_reports_and_asks_what_if(tmp_path: Path) -> None:
    own = (f'log.folder="{tmp_path}"', 'log.name="move"')
    log = Path(simulate(setup_of(*own), list(EARLY))["log"])
    assert replay(log).verdict == "same"
    found = figures(collect(log, verify=False))
    assert 0.0 < (found["angle_error_rms_rad"] or 0.0) < 0.01
    assert 0.02 < (found["angle_error_peak_rad"] or 0.0) < 0.06
    assert found["angle_settling_s"] is not None and found["angle_settling_s"] < 0.5
    build([log], tmp_path / "move.html")
    page = (tmp_path / "move.html").read_text(encoding="utf-8")
    assert "Following error of the angle" in page and "settling to 0.01 rad" in page
    other = setup_of("controller.position_pole_rad_s=20.0")
    spread = what_if(log, PATH, other.config).spreads["u_q_law"]
    assert spread.count > 1000 and 0.0 < spread.rms < 1.0


def test_a_log_without_an_angle_for_a_reference_is_refused(tmp_path: Path) -> None:
    settings = (f'log.folder="{tmp_path}"', 'log.name="speed"', 'controller={kind="speed"}')
    log = Path(simulate(setup_of(*settings), [])["log"])
    with pytest.raises(HilError, match=r"controller\.kind position follows an angle, and this log is"):
        what_if(log, PATH, setup_of().config)


def test_the_check_says_margins_and_what_holds() -> None:
    setup = setup_of()
    (angle,), (margins,) = angle_rows(setup), speed_filter_rows(setup)
    assert angle.verdict == "pass" and "52.8 N m/rad hold" in angle.found
    assert margins.verdict == "pass" and "Ms 1." in margins.found
    coarse = setup_of("controller.position_pole_rad_s=500.0", "controller.speed_pole_rad_s=800.0")
    (angle,) = angle_rows(coarse)
    assert angle.verdict == "warn" and "finer encoder" in angle.remedy
