"""What judges the instructions of a tick, without the machine that counts them."""

from __future__ import annotations

from typing import Any

import pytest

from tests.vm import instructions
from tests.vm.instructions import budget_text, excess

BUS: dict[str, Any] = {
    "runs": [100_000.0, 100_400.0],
    "phases": {"loop": 60_000.0, "send": 40_000.0},
    "bare": 5e4,
}


@pytest.fixture
def allowed(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A budget that was written for :data:`BUS`."""
    path = tmp_path / "budget.toml"
    path.write_text(budget_text({"buses": {"vcan": BUS}}))
    monkeypatch.setattr(instructions, "BUDGET", path)


@pytest.mark.usefixtures("allowed")
def test_three_percent_more_are_allowed_and_no_more() -> None:
    assert excess("vcan", BUS | {"runs": [103_000.0]}) == ""
    assert excess("vcan", BUS | {"runs": [103_001.0]}) != ""


@pytest.mark.usefixtures("allowed")
def test_a_failure_says_by_how_much_and_which_phase_grew() -> None:
    worse = BUS | {"runs": [113_300.0], "phases": {"loop": 60_000.0, "send": 53_000.0}}
    said = excess("vcan", worse)
    assert "10300 (10.0 %) over the budget of 103000" in said
    assert "53000   was 40000, +13000" in said and "60000   was 60000, +0" in said
