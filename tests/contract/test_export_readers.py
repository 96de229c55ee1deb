"""Exported logs in other people's readers: pyarrow, pandas, scipy, asammdf, python-can; equal to the bit."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

import hil
from hil.cli import main
from hil.exchange import export as module
from hil.exchange.export import export
from hil.exchange.recording import Recording
from hil.log.errors import LogError
from hil.log.frame import MissingPackage, need
from hil.log.mcapfile import RunFile
from hil.log.schema import Records
from hil.signals import FIELDS, DriveState
from tests.logfiles import HEADER, some_frames, some_ticks, write_log

NAMES = [field.name for field in FIELDS]


def odd_ticks() -> Any:
    """Ticks with every value that a format likes to spoil."""
    ticks = some_ticks(500)
    ticks["w"][:6] = [np.nan, np.inf, -np.inf, -0.0, 5e-324, 0.1 + 0.2]
    ticks["k"][-1] = ticks["k"][-2] + 2**53
    ticks["t_ns"] += 2**60 + 1
    ticks["state"] = 4
    return ticks


def valid_frames() -> Records:
    """Frames whose lengths a bus can carry; some extended, some remote; more than a millisecond apart."""
    frames = some_frames(2000)
    frames["size"] = np.array([0, 1, 7, 8, 12, 64])[np.arange(2000) % 6]
    frames["data"] = np.where(np.arange(64)[None, :] < frames["size"][:, None], frames["data"], 0)
    frames["can_id"][::5] |= 0x80000000 | 0x12340000
    return frames


TICKS, FRAMES = odd_ticks(), valid_frames()


@pytest.fixture(params=[10, 1 << 16], ids=["many slabs", "one slab"])
def path(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(module, "SLAB", request.param)
    write_log(tmp_path / "run.mcap", TICKS, FRAMES)
    return tmp_path / "run.mcap"


def same_bits(found: Any, name: str) -> bool:
    """Values and kind of a column are those of the log; NaN is NaN."""
    own = np.ascontiguousarray(TICKS[name])
    return found.dtype == own.dtype and found.tobytes() == own.tobytes()


def test_parquet(path: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    assert export(path, tmp_path / "a.parquet").records == len(TICKS)
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.column_names == NAMES
    assert all(same_bits(table[name].to_numpy(), name) for name in NAMES)
    assert table.schema.field("w").metadata[b"unit"] == b"rad/s"
    assert pq.ParquetFile(tmp_path / "a.parquet").num_row_groups == (10 if module.SLAB == 10 else 1)


def test_csv_round_trips_every_number(path: Path, tmp_path: Path) -> None:
    export(path, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        head, *rows = csv.reader(stream)
    assert head[NAMES.index("T_L_hat")] == "T_L_hat [N m]" and head[0] == "k"
    for field, column in zip(FIELDS, zip(*rows, strict=True), strict=True):
        kind = float if field.kind == "f8" else int
        assert same_bits(np.array([kind(text) for text in column], f"<{field.kind}"), field.name)


def test_mat(path: Path, tmp_path: Path) -> None:
    from scipy.io import loadmat

    export(path, tmp_path / "a.mat")
    found = loadmat(tmp_path / "a.mat", squeeze_me=True)
    assert all(same_bits(found[name], name) for name in NAMES)
    assert str(found["units"]["i_q"]) == "A" and str(found["run"]["clock"]) == "lockstep"


def test_mat_is_what_scipy_writes_at_once(path: Path, tmp_path: Path) -> None:
    """Variable by variable or all in one call: the same bytes behind the header, which has the date."""
    from scipy.io import savemat

    export(path, tmp_path / "a.mat")
    whole: dict[str, Any] = {name: np.ascontiguousarray(TICKS[name]) for name in NAMES}
    whole["units"] = {field.name: field.unit for field in FIELDS}
    whole["meanings"] = {field.name: field.doc for field in FIELDS}
    whole["run"] = hil.open_log(str(path)).metadata["run"]
    savemat(tmp_path / "b.mat", whole, do_compression=True, oned_as="column", long_field_names=True)
    assert (tmp_path / "a.mat").read_bytes()[128:] == (tmp_path / "b.mat").read_bytes()[128:]


def test_mat_refuses_more_ticks_than_a_variable_holds(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("hil.exchange.tables.MAT_TICKS", 499)
    assert main(["export", str(path), "-o", str(tmp_path / "a.mat")]) == 2
    assert "at most 499 ticks; take .parquet or .mf4" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.filterwarnings("ignore:The inplace keyword")  # asammdf's use of pandas
def test_mf4(path: Path, tmp_path: Path) -> None:
    from asammdf import MDF

    export(path, tmp_path / "a.mf4")
    with MDF(tmp_path / "a.mf4") as file:
        for field in FIELDS:
            signal = file.get(field.name)
            assert same_bits(signal.samples, field.name) and signal.unit == field.unit
        assert np.array_equal(file.get("w").timestamps, (TICKS["t_ns"] - TICKS["t_ns"][0]) * 1e-9)
        wanted = {DriveState.OPERATION_ENABLED.name.encode()}
        assert set(file.get("state_name").samples) == wanted, "a name beside its number"
        frame = file.to_dataframe()
    assert frame["state"].tolist() == [4] * len(TICKS) and set(frame["state_name"]) == wanted


def test_mf4_of_ticks_and_of_frames_start_when_the_run_did(tmp_path: Path) -> None:
    """To the microsecond, with milliseconds below 100 and whatever the zone of this machine."""
    from asammdf import MDF

    run = {**HEADER, "metadata": {**HEADER["metadata"], "started": "2026-03-01T23:59:58.045678+05:30"}}
    with RunFile(tmp_path / "run.mcap", run) as file:
        file.add_ticks(TICKS)
        file.add_frames(FRAMES)
        file.finish({"ended": "stop_requested", "ticks": len(TICKS)})
    started = datetime(2026, 3, 1, 18, 29, 58, 45678, tzinfo=UTC)
    for name, frames in (("t.mf4", False), ("f.mf4", True)):
        export(tmp_path / "run.mcap", tmp_path / name, frames=frames)
        with MDF(tmp_path / name) as found:
            assert found.header.start_time == started
    export(tmp_path / "run.mcap", tmp_path / "a.asc")
    local = started.astimezone()
    head = (tmp_path / "a.asc").read_text().splitlines()
    assert head[0].endswith(f"{local:%H:%M:%S}.045 2026") and head[0].split()[2] == "Mar"
    with can.ASCReader(tmp_path / "a.asc", relative_timestamp=False) as reader:
        assert abs(next(iter(reader)).timestamp - started.timestamp()) < 1.1e-3
    for name in ("f.mf4", "a.asc"):
        assert Recording(tmp_path / name).start_ns == 1_772_389_798_045_678_000


READERS: dict[str, Callable[[Path], Any]] = {
    ".log": can.CanutilsLogReader,
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".mf4": can.MF4Reader,
}


@pytest.mark.parametrize("ending", list(READERS))
def test_recordings_hold_every_frame_in_order(path: Path, tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"a{ending}"
    assert export(path, out, frames=True).holds == "frames"
    with READERS[ending](out) as reader:
        seen = list(reader)
    assert len(seen) == len(FRAMES)
    for frame, message in zip(FRAMES, seen, strict=True):
        number, extended = int(frame["can_id"]) & 0x1FFFFFFF, bool(frame["can_id"] & 0x80000000)
        assert (message.arbitration_id, message.is_extended_id) == (number, extended)
        assert bytes(message.data) == bytes(frame["data"][: frame["size"]])
        assert message.is_rx == bool(frame["received"]) and message.is_fd == (frame["size"] > 8)
    passed = np.array([message.timestamp for message in seen]) - seen[0].timestamp
    assert np.abs(passed - (FRAMES["t_ns"] - FRAMES["t_ns"][0]) * 1e-9).max() < 2e-6


def test_data_frame_in_two_lines(path: Path) -> None:
    with hil.open_log(str(path)) as log:
        frame = log.to_pandas()
        named = log.to_pandas(names=True)
        plain = log.to_numpy()
    assert all(same_bits(frame[name].to_numpy(), name) and same_bits(plain[name], name) for name in NAMES)
    assert frame.attrs["units"]["w"] == "rad/s" and frame.index[1] == pytest.approx(1e-3)
    assert set(named["state"]) == {DriveState.OPERATION_ENABLED.name} and plain.dtype.names == tuple(NAMES)


def test_nothing_is_replaced_without_force(path: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "a.csv"
    out.write_text("mine")
    assert main(["export", str(path), "-o", str(out)]) == 2 and "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert main(["export", str(path), "-o", str(out), "--force"]) == 0 and out.stat().st_size > 1000


@pytest.mark.parametrize("ending", list(module.FORMATS))
def test_what_fails_leaves_nothing_behind(tmp_path: Path, ending: str) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    with pytest.raises(LogError):
        export(tmp_path / "bad.mcap", tmp_path / f"a{ending}")
    assert [p.name for p in tmp_path.iterdir()] == ["bad.mcap"]


@pytest.mark.corners
@pytest.mark.parametrize("ending", list(module.FORMATS))
@pytest.mark.parametrize("room", [2_000, 20_000])
def test_a_full_disk_is_one_clear_line(path: Path, tmp_path: Path, ending: str, room: int) -> None:
    """A limit on the size of files stands in for the full disk: the same write fails, by the kernel.

    A column of ticks fits into 20,000 bytes, but no file does.
    """
    out = tmp_path / f"a{ending}"
    code = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, ROOM));"
        "from hil.cli import main; sys.exit(main(sys.argv[1:]))"
    ).replace("ROOM", str(room))
    done = subprocess.run(
        [sys.executable, "-c", code, "export", str(path), "-o", str(out)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 2 and "can't be written" in done.stderr, done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("ending", list(module.FORMATS))
def test_ctrl_c_leaves_nothing_behind(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    whole = module._slabs

    def interrupted(*arguments: Any) -> Iterator[Records]:
        yield next(whole(*arguments))
        raise KeyboardInterrupt

    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(module, "_slabs", interrupted)
    assert main(["export", str(path), "-o", str(tmp_path / f"a{ending}")]) == 130
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["run.mcap", "tmp"]


def test_what_a_killed_export_left_is_replaced(path: Path, tmp_path: Path) -> None:
    (tmp_path / ".a.csv.part.csv").write_text("half of")
    assert export(path, tmp_path / "a.csv").records == len(TICKS)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "run.mcap"]


@pytest.mark.parametrize("ending", list(module.FORMATS))
def test_an_export_has_the_rights_that_the_users_umask_gives(path: Path, tmp_path: Path, ending: str) -> None:
    before = os.umask(0o027)
    try:
        export(path, tmp_path / f"a{ending}")
    finally:
        os.umask(before)
    assert (tmp_path / f"a{ending}").stat().st_mode & 0o777 == 0o640
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.long
@pytest.mark.slow
def test_memory_of_mat_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Four times the ticks, 200 MB more of them, take less than a quarter of that more."""
    code = (
        "import re, sys; from pathlib import Path; from hil.cli import main; main(sys.argv[1:]);"
        "print('peak', re.findall(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[0])"
    )
    peaks = []
    for count in (150_000, 600_000):
        log = tmp_path / f"{count}.mcap"
        write_log(log, some_ticks(count), FRAMES[:0], block=2000)
        words = [sys.executable, "-c", code, "export", str(log), "-o", str(log.with_suffix(".mat"))]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
        peaks.append(int(done.stdout.rpartition("peak")[2]) / 1e3)
    assert peaks[1] - peaks[0] < 50, peaks


def test_a_log_cut_off_is_exported_as_far_as_it_goes(path: Path, tmp_path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = export(path, tmp_path / "a.csv")
    assert 0 < found.records < len(TICKS) and found.damage is not None


def test_other_endings_and_missing_packages_are_named(path: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"\.parquet"):
        export(path, tmp_path / "a.xyz")
    with pytest.raises(MissingPackage, match=r"pip install 'hil-drive\[export\]'"):
        need("no_such_package.part", "This")


def test_import_hil_stays_light() -> None:
    code = "import hil, sys; print(sorted({'numpy', 'numba', 'pandas', 'pyarrow', 'can'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
