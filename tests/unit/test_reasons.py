"""Every end gives value, limit, time and remedy; the table of all reasons is the docs page."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.report.collect import collect
from hil.report.criteria import ending
from hil.runtime.setup import Overrides, load_setup
from hil.signals import GuardFlag, Reason, new_ticks
from hil.sim.simulate import simulate
from hil.tick.reasons import CAUSES, explain, page, remedy_of
from hil.tick.supervisor import is_fault
from tests.conftest import ROOT
from tests.safety import Guard

pytestmark = pytest.mark.slow


def test_the_page_is_the_table() -> None:
    written = (ROOT / "docs/stop-reasons.md").read_text(encoding="utf-8")
    assert written == page(), "write it anew: python -m hil.tick.reasons > docs/stop-reasons.md"


def test_every_reason_is_explained_and_says_what_to_do() -> None:
    assert set(CAUSES) == set(Reason) - {Reason.NONE}
    for reason, cause in CAUSES.items():
        assert cause.what and cause.remedy and remedy_of(reason.name.lower()) == cause.remedy
        assert cause.fault is bool(is_fault(int(reason)))
    assert remedy_of("controller died") == remedy_of("none") == ""


@pytest.mark.parametrize("reason", list(CAUSES), ids=lambda reason: reason.name)
def test_every_reason_can_be_said_with_and_without_the_state(reason: Reason) -> None:
    guard, ticks = Guard(), new_ticks()
    ticks["reason"], ticks["k"], ticks["drive_state"] = int(reason), 1500, 7
    for state in (guard.s, None):
        end = explain(guard.p, state, ticks[0])
        assert end is not None and end.t_s == 1.5 and end.text.endswith("at 1.500 s")
        json.dumps(end.as_dict(), allow_nan=False)


ENDS: tuple[tuple[tuple[str, ...], tuple[str, ...], str, float, str], ...] = (
    (("limits.w_max_rad_s=60.0",), (), "over_speed", 60.0, "rad/s"),
    (("limits.v_dc_min_v=545.0",), (), "dc_link_under_voltage", 545.0, "V"),
    (("limits.temperature_max_c=24.0",), (), "over_temperature", 24.0, "degC"),
    (("limits.i_continuous_a=1.0", "limits.i2t_max_a2s=0.5"), (), "i2t", 0.5, "A2s"),
    (("limits.energy_max_j=5.0",), (), "energy", 5.0, "J"),
    (("limits.i_max_a=1.1", "limits.i_trip_a=3.0"), (), "following_error", 20.0, "rad/s"),
    ((), ("firmware.status_every=1000",), "stale_status", 0.13, "s"),
)


@pytest.mark.parametrize(("settings", "plant", "reason", "limit", "unit"), ENDS, ids=[e[2] for e in ENDS])
def test_a_simulated_trip_says_value_limit_time_and_remedy(
    settings: tuple[str, ...], plant: tuple[str, ...], reason: str, limit: float, unit: str, tmp_path: Path
) -> None:
    own = (*settings, f'log.folder="{tmp_path}"', 'log.name="end"')
    found = simulate(load_setup(ROOT / "configs/demo.toml", Overrides(settings=own)), list(plant))
    end: dict[str, Any] = found["end"]
    assert (found["ended"], end["reason"], end["unit"]) == (reason, reason, unit)
    assert end["limit"] == pytest.approx(limit)
    past = end["value"] < limit if "under" in reason else end["value"] > limit
    assert past and end["remedy"] and f"{end['t_s']:.3f} s" in end["text"]
    log = open_log(tmp_path / "end.mcap")
    first = log.ticks[int(np.argmax(log.ticks["reason"] != 0))]
    assert end["t_s"] == pytest.approx((int(first["t_ns"]) - int(log.ticks["t_ns"][0])) * 1e-9)
    assert log.result["end"] == end
    run = collect(tmp_path / "end.mcap")
    assert run.verdict.verdict == "same" and end["text"] in ending(run) and end["remedy"] in ending(run)


def test_a_log_that_does_not_say_is_explained_from_its_ticks(tmp_path: Path) -> None:
    own = ("limits.w_max_rad_s=60.0", f'log.folder="{tmp_path}"', 'log.name="end"')
    simulate(load_setup(ROOT / "configs/demo.toml", Overrides(settings=own)), [])
    run = collect(tmp_path / "end.mcap")
    said = run.end
    run.log.metadata["result"] = {"result": json.dumps({"ended": "over_speed"})}
    assert run.end == said and said is not None and said["value"] > 60.0


def test_the_flags_of_a_persistent_excess_are_named() -> None:
    guard, ticks = Guard(), new_ticks()
    ticks["reason"], ticks["guard_flags"] = int(Reason.GUARD_PERSISTENT), int(GuardFlag.VOLTAGE_STEP)
    end = explain(guard.p, guard.s, ticks[0])
    assert end is not None and end.detail == "voltage step"


def test_what_is_no_number_is_named() -> None:
    guard, ticks = Guard(), new_ticks()
    ticks["reason"], ticks["v_dc"], ticks["temperature_motor"] = int(Reason.NOT_A_NUMBER), math.nan, 30.0
    ticks["temperature_inverter"] = math.inf
    end = explain(guard.p, guard.s, ticks[0])
    assert end is not None and end.detail == "v_dc is nan, temperature_inverter is inf"
    guard.p["theta_jump"], ticks["theta"] = 0.5, math.nan
    followed = explain(guard.p, guard.s, ticks[0])
    assert followed is not None and followed.detail.endswith("is inf, theta is nan")


def test_the_command_line_says_why(configs: Path) -> None:
    command = [sys.executable, "-m", "hil.cli", "simulate", str(configs / "demo.toml"), "--no-log"]
    done = subprocess.run(
        [*command, "--set", "limits.w_max_rad_s=60.0"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    for part in ("too fast", "limit limits.w_max_rad_s = 60 rad/s", "lower the reference"):
        assert part in done.stdout
