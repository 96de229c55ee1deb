"""Dip and recovery where nobody tells the true load, and scales that end with the stop."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.report.build import build
from hil.report.collect import collect
from hil.report.criteria import figures, judge, notes
from hil.report.curves import CURVES, values_of
from hil.report.excursions import Excursions
from hil.runtime.setup import Overrides, load_setup
from hil.signals import TickArray
from hil.sim.simulate import simulate, simulate_ticks
from tests.conftest import ROOT


def ticks_of(*settings: str) -> TickArray:
    return simulate_ticks(load_setup(ROOT / "configs/demo.toml", Overrides(settings=settings)))


@pytest.mark.parametrize("block", [1, 7, 1000, 100_000])
def test_dip_and_recovery_are_those_of_the_true_step(block: int) -> None:
    ticks = ticks_of()
    told = simulate(load_setup(ROOT / "configs/demo.toml", Overrides()), [], log=False)
    ticks["T_L_true"] = np.nan
    if block == 1:
        ticks = ticks[2000:3500]
    found, t = Excursions(), ticks["t_ns"] * 1e-9
    for at in range(0, len(ticks), block):
        found.feed(t[at : at + block], ticks[at : at + block])
    assert not found.truth and not found.unfinished
    assert found.dip == pytest.approx(told["dip_rad_s"], abs=0.05)
    assert found.recovery_s == pytest.approx(told["recovery_s"], abs=0.01)
    assert found.load_span == pytest.approx(5.4, abs=1.0)


def test_a_speed_that_stays_off_never_recovers() -> None:
    ticks = ticks_of()[:4000]
    ticks["T_L_true"] = np.nan
    ticks["w"][3900:] -= 2.0
    found = Excursions()
    found.feed(ticks["t_ns"] * 1e-9, ticks)
    assert found.unfinished and found.dip is not None


def test_a_log_without_truth_can_pass_and_says_where_its_figures_come_from(tmp_path: Path) -> None:
    own = (f'log.folder="{tmp_path}"', 'log.name="real"')
    simulate(load_setup(ROOT / "configs/demo.toml", Overrides(settings=own)), [])
    told = collect(tmp_path / "real.mcap")
    assert notes(told) == {}
    untold = collect(tmp_path / "real.mcap", verify=False)
    untold.excursions.truth = False
    assert set(notes(untold)) == {"dip_rad_s", "recovery_s"}
    assert figures(untold)["dip_rad_s"] == pytest.approx(figures(told)["dip_rad_s"])
    checks = {check.name: check for check in judge(untold)}
    for name in ("worst dip after a load step", "slowest recovery to 0.5 rad/s"):
        assert checks[name].outcome == "pass" and "from estimate and reference" in checks[name].found
    report = build([tmp_path / "real.mcap"], tmp_path / "r.html").as_dict()
    assert report["runs"][0]["notes"] == {} and report["runs"][0]["end"]["reason"] == "stop_requested"
    json.dumps(report, allow_nan=False)


def test_ticks_after_the_stop_set_no_scale(tmp_path: Path) -> None:
    own = (f'log.folder="{tmp_path}"', 'log.name="trip"', "limits.w_max_rad_s=60.0")
    simulate(load_setup(ROOT / "configs/demo.toml", Overrides(settings=own)), [])
    ticks = open_log(tmp_path / "trip.mcap").ticks.copy()
    after = ticks["reason"] != 0
    assert after.any()
    for name in ("T_L_hat", "d_hat_w", "d_hat_q", "d_hat_d", "lateness_ns", "sent_ns"):
        ticks[name][after] = 10**6
    values = values_of(ticks)
    for row, curve in enumerate(CURVES):
        if curve.key in ("T_L_hat", "d_hat_w", "d_hat_q", "d_hat_d", "lateness_ns", "sent_ns"):
            assert not np.isfinite(values[row][after]).any() and np.isfinite(values[row][~after]).all()


def test_simulate_tells_tracking_dip_and_recovery() -> None:
    found = simulate(load_setup(ROOT / "configs/demo.toml", Overrides()), [], log=False)
    assert 0.0 < found["tracking_rms_rad_s"] < 1.0
    assert 1.0 < found["dip_rad_s"] < 6.5 and 0.0 < found["recovery_s"] < 0.15
