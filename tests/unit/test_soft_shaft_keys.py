"""A soft coupling from the command line: its keys as settings and axes, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hil.cli import main

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


def test_keys_of_the_coupling_are_settings_and_axes_as_any(
    configs: Path, capsys: pytest.CaptureFixture[str]
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
