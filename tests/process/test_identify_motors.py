"""`hil identify` over the bus: motors that nobody told, one with cogging, one on a soft coupling.

All twelve: `python -m benchmarks.identified`, and in simulation tests/closed_loop/test_identify_motors.py.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.identified import GOALS, misses, one_motor
from benchmarks.motors import MORE

pytestmark = [pytest.mark.process, pytest.mark.beside, pytest.mark.slow]


@pytest.mark.long
@pytest.mark.parametrize("name", [*MORE, "50 W surface", "100 kW interior"])
def test_a_motor_is_found_over_the_bus_and_no_frame_is_beyond_its_limits(tmp_path: Path, name: str) -> None:
    row = one_motor(name, tmp_path, lockstep=True)
    assert misses(row) == [], row
    assert row["off"].keys() == GOALS.keys() and max(map(abs, row["off"].values())) < 0.1
    assert 0.3 < row["peaks"]["i_max"] < 0.7 and 0.3 < row["peaks"]["w_max"] < 0.95
    assert [step["ended"] for step in row["steps"]] == ["stop_requested"] * 5
