"""Every recording of the corpus through import, export and back, compared with the table."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from hil.exchange.export import export
from hil.exchange.importing import import_recording
from hil.exchange.readers.recorded import Recorded
from hil.exchange.recording import ENDINGS, Recording, kinds_of
from hil.log.errors import LogError
from tests.conftest import CONFIGS

HERE = Path(__file__).parent
TABLE: dict[str, Any] = tomllib.loads((HERE / "table.toml").read_text())
BASE = TABLE.pop("base")
FORMATS = (".log", ".asc", ".blf", ".mf4")


def test_every_recording_is_in_the_table() -> None:
    made = {path.name for path in HERE.iterdir() if path.name.endswith(ENDINGS)}
    assert made - {"base.log"} == set(TABLE)
    assert {name.removesuffix(".gz").rpartition(".")[2] for name in made} >= {
        "log",
        "asc",
        "blf",
        "mf4",
        "trc",
    }


def what_a_log_keeps(frames: list[Recorded]) -> list[tuple[int, int, bool, bytes]]:
    """Time from the first [us], identifier and kind, direction, data."""
    return [((one.t_ns - frames[0].t_ns) // 1000, one.can_id, one.received, one.data) for one in frames]


@pytest.mark.parametrize("name", list(TABLE))
def test_through_import_export_and_back(name: str, tmp_path: Path) -> None:
    row = {**BASE, **TABLE[name]}
    kinds = {kind: row[kind] for kind in ("data", "remote", "error")}
    channel = None
    if row.get("others"):
        with pytest.raises(LogError, match="several channels"):
            Recording(HERE / name)
        channel = row["channel"]
    found = Recording(HERE / name, channel)
    first = row["first"].astimezone(UTC) - datetime.fromtimestamp(0, UTC)
    assert kinds_of(found.identifiers) == kinds and found.damage is None
    assert found.start_ns // 1000 == first // timedelta(microseconds=1)
    assert set(found.channels) == {row["channel"], *row.get("others", ())}
    imported = import_recording(HERE / name, tmp_path / "a.mcap", CONFIGS / "demo.toml", channel=channel)
    assert imported.frames == sum(kinds.values()) and imported.ticks > 20
    wanted = what_a_log_keeps(list(found.frames()))
    for ending in FORMATS:
        export(tmp_path / "a.mcap", tmp_path / f"b{ending}", frames=True)
        again = Recording(tmp_path / f"b{ending}")
        assert what_a_log_keeps(list(again.frames())) == wanted, ending
        assert again.start_ns == found.start_ns // 1000 * 1000, ending


def bodies(name: str) -> list[tuple[int, bytes]]:
    """Identifier and data of each frame of a recording."""
    return [
        (one.can_id, one.data)
        for one in Recording(HERE / name, {**BASE, **TABLE.get(name, {})}["channel"]).frames()
    ]


@pytest.mark.parametrize("name", ["candump-l.log", "candump-L-x.log", "candump-L-8.log", "candump-any.log"])
def test_what_candump_wrote_is_all_there(name: str) -> None:
    assert bodies(name) == bodies("base.log")


def test_of_vectors_own_loggers_everything_is_there_but_what_errors_were() -> None:
    assert Recording(HERE / "vector.blf").notes == [
        "61 transmit requests (TxRq) left out: what was sent is there as Tx"
    ]
    wanted = [
        (0x20000080, bytes(8)) if number & 0x20000000 else (number, data)
        for number, data in bodies("base.log")
    ]
    assert bodies("vector.blf") == wanted


@pytest.mark.parametrize("name", ["python-can.blf", "out-of-order.blf", "python-can.mf4"])
def test_what_python_can_wrote_is_all_there(name: str) -> None:
    """Stamps that are the same in both groups of an MF4 file leave the order between them open."""
    frames = [(one.can_id, one.data) for one in Recording(HERE / name).frames()]
    assert sorted(frames) == sorted(bodies("base.log"))
