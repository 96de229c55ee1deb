"""Drift over a fleet of logs: told from what the intervals leave open, in the order of the runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.config.tables import RunConfig, load_toml
from hil.identify.estimate import Estimate
from hil.identify.fromlogs import Logged, drift
from hil.signals import new_ticks
from tests.conftest import CONFIGS


def runs(*values: float, half: float, why: str = "") -> list[Logged]:
    """Runs that tell this psi_f, all but the first for ``why`` not."""
    config, out = load_toml(CONFIGS / "demo.toml", RunConfig), []
    for number, value in enumerate(values):
        found = Estimate()
        found.put("psi_f", value, half, why if number else "")
        out.append(Logged(Path(f"{number}.mcap"), str(number), config, new_ticks(), found))
    return out


def test_a_magnet_that_fades_drifts_though_no_two_neighbours_part() -> None:
    """0.76, 0.74, 0.72 Wb +- 0.01: widened by half, first and last part by 0.01."""
    row = drift(runs(0.76, 0.74, 0.72, half=0.01))["psi_f"]
    assert row["runs"] == 3 and row["drifts"] is True
    assert row["change"] == pytest.approx(-0.04)
    assert row["change_percent"] == pytest.approx(-100.0 * 0.04 / 0.76)
    assert drift(runs(0.76, 0.74, half=0.01))["psi_f"]["drifts"] is False


def test_one_run_or_one_that_tells_has_no_drift() -> None:
    assert drift(runs(0.76, half=0.01)) == {}
    assert drift(runs(0.76, 0.5, half=0.01, why="no motion")) == {}
