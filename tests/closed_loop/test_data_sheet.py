"""The tuned loop of an identified motor keeps its prediction; a data sheet that is 30 % off does not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data_sheet import draws, holds, identified, prepared, tuned
from benchmarks.motors import MOTORS, NAMES, WRONG


@pytest.mark.long
@pytest.mark.compiled
def test_the_dip_is_as_predicted_with_the_identified_motor_alone(tmp_path: Path) -> None:
    """22 kW: the data sheet has psi_f too large and J too small, so the commands are too weak."""
    true = dict(zip(NAMES, MOTORS["22 kW interior"], strict=True))
    file = tmp_path / "identified.toml"
    file.write_text(identified(tmp_path / "demo.toml", true), encoding="utf-8")
    found = tuned(prepared(tmp_path, true, WRONG), file, true, 0.03)
    assert holds(found), found
    weak = np.array([0.7, 0.7, 0.7, 1.3, 1.0, 0.7, 1.0])
    sheet = tuned(prepared(tmp_path, true, weak), None, true, 0.03)
    assert sheet["ms"] is not None and math.isfinite(sheet["dip"])
    assert sheet["ratio"] > 1.15


def test_data_sheets_are_30_percent_off_by_the_seed() -> None:
    first, again = draws(19, 3), draws(19, 3)
    assert all((one == other).all() for one, other in zip(first, again, strict=True))
    for off in first:
        assert off[4] == off[6] == 1.0 and off[1] == off[2]
        assert np.abs(off[[0, 1, 3, 5]] - 1.0) == pytest.approx(0.3)
