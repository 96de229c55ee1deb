"""From an unknown motor on a soft coupling to its loop on the lockstep bus: the dip is as `hil tune` said.

All twelve, with the data sheet's start beside them: `python -m benchmarks.data_sheet --bus`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from benchmarks.data_sheet import dip_of, holds, identified, prepared, tuned
from benchmarks.motors import MORE, MOTORS, NAMES, WRONG

pytestmark = [pytest.mark.process, pytest.mark.beside, pytest.mark.slow]
NAME = "5.5 kW interior"


@pytest.mark.long
def test_the_dip_on_a_soft_coupling_is_as_predicted(tmp_path: Path) -> None:
    true, more = dict(zip(NAMES, MOTORS[NAME], strict=True)), MORE[NAME]
    path, file = tmp_path / "demo.toml", tmp_path / "identified.toml"
    file.write_text(identified(path, true, more), encoding="utf-8")
    known = tomllib.loads(file.read_text(encoding="utf-8"))["identified"]
    for key, value in (("resonance_hz", 80.0), ("inertia_ratio", 1.0), ("resonance_damping", 0.01)):
        low, high = known["low"][key], known["high"][key]
        assert low <= value <= high and high - low < 0.2 * value, key
    found = tuned(prepared(tmp_path, true, WRONG, more), file, true, 0.05, bus=True)
    assert holds(found), found
    bus, simulated = found["dip"], dip_of(tmp_path / "tuned.toml")
    assert bus == simulated, "the bus has the bits of the simulation"
    assert found["worst"] >= found["predicted"]
