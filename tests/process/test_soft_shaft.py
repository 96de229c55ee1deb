"""A soft coupling from the command line: the demo, simulation and bus alike, a campaign's key, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli import main
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks
from tests.process.test_run import Settings, flags, only_log

SOFT = """
[coupling]
inertia_ratio = 1.0
resonance_hz = 60.0
"""


def soft(configs: Path) -> Path:
    """The demo with a soft shaft in its plant's file."""
    with (configs / "plants" / "demo.toml").open("a", encoding="utf-8") as plant:
        plant.write(SOFT)
    return configs / "demo.toml"


def run(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    """The result of a command that ends well."""
    assert main([*words, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


@pytest.mark.process
def test_the_demo_runs_a_soft_shaft_and_simulation_gives_its_bits(
    configs: Path, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from hil.log.reader import open_log

    own = settings("loop.duration_s=3.0", 'loop.clock="lockstep"')
    rigid = simulate_ticks(load_setup(configs / "demo.toml", Overrides(settings=own)))
    path = soft(configs)
    run(capsys, "demo", str(path), *flags(own))
    log = open_log(only_log(tmp_path))
    assert "resonance_hz = 60.0" in log.attachment("plant.toml")
    bus, ticks = log.ticks, simulate_ticks(load_setup(path, Overrides(settings=own)))
    assert len(bus) == len(ticks) == len(rigid)
    for name in ("w", "i_q", "u_q", "T_L_true", "state"):
        assert (bus[name] == ticks[name]).all(), name
    assert np.abs(rigid["w"] - ticks["w"]).max() > 0.05


def test_keys_of_the_coupling_are_settings_and_axes_as_any(
    configs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = soft(configs)
    plain = run(capsys, "simulate", str(path), "--no-log", "--plant-set", "coupling.resonance_hz=25")
    swept = run(
        capsys, "simulate", str(path), "--no-log", "--plant-sweep", "coupling.resonance_hz=[25, 200.0]"
    )
    assert swept["rows"][0]["dip_rad_s"] == plain["dip_rad_s"] != swept["rows"][1]["dip_rad_s"]


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ("coupling.stiffness_n_m_rad=-1.0", "stiffness_n_m_rad"),
        ("coupling.J_load_kg_m2=0", "J_load_kg_m2"),
        ("coupling.resonance_hz=5e4", "resonance at 50000 Hz: above 3183 Hz"),
        ("coupling.resonance=80", "resonance_hz"),
        ("coupling=80", "coupling"),
    ],
)
def test_what_no_shaft_is_is_one_line(
    configs: Path, capsys: pytest.CaptureFixture[str], setting: str, why: str
) -> None:
    assert main(["simulate", str(soft(configs)), "--no-log", "--plant-set", setting]) == 2
    said = capsys.readouterr().err.strip()
    assert why in said and "Traceback" not in said
