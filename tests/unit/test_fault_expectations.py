"""`hil faults my.toml` judges by what that configuration expects."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.errors import ConfigError
from hil.faults.matrix import load_matrix

ROW = "DC-link sag: 300 V"


def own(configs: Path, text: str) -> Path:
    path = configs / "mine.toml"
    path.write_text((configs / "demo.toml").read_text() + text)
    return path


def test_a_configurations_expectation_takes_the_place_of_the_shipped_one(configs: Path) -> None:
    shipped, _ = load_matrix(configs / "demo.toml", configs / "faults.toml")
    path = own(configs, f'[faults.expect]\n"{ROW}" = {{ reaction = "ride through", w_error_rad_s = 3.0 }}\n')
    matrix, run = load_matrix(path, configs / "faults.toml")
    assert run == path and [row.name for row in matrix.row] == [row.name for row in shipped.row]
    changed = {row.name: row.expect for row in matrix.row if row not in shipped.row}
    assert set(changed) == {ROW} and changed[ROW].w_error_rad_s == 3.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('"no such row" = { reaction = "ride through" }', "there is no row 'no such row'"),
        (f'"{ROW}" = {{ reaction = "stop" }}', "a stop needs reason and within_ms"),
        (f'"{ROW}" = {{ reaction = "stop", reason = ["magic"], within_ms = 5.0 }}', "magic"),
    ],
)
def test_mistakes_are_refused(configs: Path, text: str, said: str) -> None:
    path = own(configs, f"[faults.expect]\n{text}\n")
    with pytest.raises(ConfigError, match=said):
        load_matrix(path, configs / "faults.toml")
