"""The folder of a campaign: what it is, the files that its cases read, and its rows as Parquet parts.

A part is whole or not there: it is written beside and renamed. So whatever ends a campaign, the rows that
were written stay, and ``--resume`` goes on with the others. Rows stand in the order in which they were done;
``case`` tells which is which.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from hil.campaign.engine import MISSING, Row, Span
from hil.campaign.identity import Identity, differences, identity
from hil.campaign.values import toml
from hil.errors import HilError
from hil.runtime.clock import RealClock

Kind = Literal["i8", "f8", "bool", "text"]
Schema = dict[str, Kind]
ABOUT: Final = "campaign.json"
INPUTS: Final = "inputs"
ROWS: Final = "rows"
PART_ROWS: Final = 4096
MERGED_ROWS: Final = 65_536
"""Rows of a part at the end of a campaign, about 40 MB while they are merged."""
PART_NS: Final = 1_000_000_000
"""A part is written when so many rows wait, or after so long: what a power failure may take."""


def kind_of(values: Sequence[Any]) -> Kind:
    """The kind of column that holds all values."""
    if all(isinstance(v, bool) for v in values):
        return "bool"
    if all(isinstance(v, int) and not isinstance(v, bool) for v in values):
        return "i8"
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return "f8"
    return "text"


def arrow() -> Any:
    """pyarrow, or a HilError that says what to install."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise HilError(MISSING) from error
    return pyarrow


class Folder:
    """A campaign's folder, open for its rows."""

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        self.path, self.about = path, about
        self.schema: Schema = about["schema"]
        self.count: int = about["count"]
        self._waiting: list[Row] = []
        self._clock = RealClock()
        self._written_ns = self._clock.now_ns()
        numbers = [int(part.stem[5:]) for part in self.parts() if part.stem[5:].isdecimal()]
        self._number = max(numbers, default=-1) + 1  # one that was removed leaves a hole, not a place

    def parts(self) -> list[Path]:
        """The files of rows."""
        return sorted((self.path / ROWS).glob("part-*.parquet"))

    def add(self, rows: list[Row]) -> None:
        """Take rows; written when enough wait or some time has passed. Raises HilError."""
        self._waiting += rows
        late = self._clock.now_ns() - self._written_ns > PART_NS
        if len(self._waiting) >= PART_ROWS or late:
            self.flush()

    def flush(self) -> None:
        """Write what waits. Raises HilError for a disk that is full, with nothing half-written."""
        if not self._waiting:
            return
        target = self.path / ROWS / f"part-{self._number:06d}.parquet"
        try:
            write_part(target, self._waiting, self.schema)
        except OSError as error:
            raise HilError(full(target, error)) from error
        self._number += 1
        self._waiting, self._written_ns = [], self._clock.now_ns()

    def merge(self) -> None:
        """Make few parts of many: each is opened for every column, which took the report most of its time.

        A crash meanwhile leaves rows twice, of which one counts; a disk that is full, the parts as they are.
        """
        pa = arrow()
        with contextlib.suppress(OSError, pa.ArrowException):
            for group in _groups(self.parts()):
                merged = self.path / ROWS / f"part-{self._number:06d}.parquet"
                _write_table(merged, pa.concat_tables(pa.parquet.read_table(part) for part in group))
                self._number += 1
                for part in group:
                    part.unlink()

    def columns(self, *names: str) -> dict[str, npt.NDArray[Any]]:
        """Some columns of all rows in the order of their cases; text as objects, no number as NaN."""
        return columns(self.parts(), names)

    def rows(self, cases: Sequence[int]) -> dict[int, Row]:
        """The rows of some cases by their number, in the memory of a part, valued as by :meth:`columns`."""
        out: dict[int, Row] = {}
        for part in self.parts():
            places = np.flatnonzero(np.isin(read_columns(part, ["case"])["case"], cases))
            if len(places):
                found = read_columns(part, list(self.schema), places)
                values = (column.tolist() for column in found.values())
                rows = (dict(zip(found, row, strict=True)) for row in zip(*values, strict=True))
                out |= {row["case"]: row for row in rows}
        return out

    def done(self) -> npt.NDArray[np.bool_]:
        """Which cases have a row."""
        out = np.zeros(self.count, np.bool_)
        for part in self.parts():
            out[read_columns(part, ["case"])["case"]] = True
        return out

    def open_spans(self) -> Iterator[Span]:
        """The cases without a row, as spans."""
        edges = np.flatnonzero(np.diff(~self.done(), prepend=False, append=False))
        return ((int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True))


def full(path: Path, error: OSError) -> str:
    """What a part that could not be written says."""
    what = (
        "no room left on the disk"
        if error.errno in (errno.ENOSPC, errno.EDQUOT)
        else error.strerror or str(error)
    )
    return f"{path.parent.parent}: {what}; the rows before are kept: mend it and go on with --resume"


def write_part(target: Path, rows: Sequence[Row], schema: Schema) -> None:
    """Write rows as one file, whole or not at all. Raises OSError."""
    pa = arrow()
    types = {"i8": pa.int64(), "f8": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
    arrays = [
        pa.array([_cell(row.get(name), kind) for row in rows], types[kind]) for name, kind in schema.items()
    ]
    _write_table(target, pa.table(arrays, names=list(schema)))


def _write_table(target: Path, table: Any) -> None:
    """Write a table as one file, whole or not at all. Raises OSError."""
    beside = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        arrow().parquet.write_table(table, beside, compression="zstd")
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


def _groups(parts: Sequence[Path]) -> Iterator[list[Path]]:
    """Parts that follow one another and have :data:`MERGED_ROWS` together, two or more of them."""
    pa, group, rows = arrow(), list[Path](), 0
    for part in parts:
        more = pa.parquet.read_metadata(part).num_rows
        if group and rows + more > MERGED_ROWS:
            if len(group) > 1:
                yield group
            group, rows = [], 0
        group, rows = [*group, part], rows + more
    if len(group) > 1:
        yield group


def _cell(value: Any, kind: Kind) -> Any:
    if value is None or kind == "bool":
        return value
    if kind == "text":
        return value if isinstance(value, str) else toml(value)
    return float(value) if kind == "f8" else int(value)


def read_columns(part: Path, names: Sequence[str], places: Any = None) -> dict[str, Any]:
    """Columns of one part as arrays; ``places``: of these rows alone. Raises HilError."""
    pa = arrow()
    try:
        table = pa.parquet.read_table(part, columns=list(names))
    except (OSError, pa.ArrowException) as error:
        raise HilError(f"{part}: is no part of a campaign: {error}; remove it and --resume") from error
    table = table if places is None else table.take(places)
    return {name: _array(table[name]) for name in names}


def _array(column: Any) -> Any:
    """A column as numpy has it, without pandas: numbers with NaN for none, text as objects."""
    pa = arrow()
    if pa.types.is_floating(column.type):
        return column.fill_null(float("nan")).to_numpy()
    if column.null_count or pa.types.is_string(column.type):
        return np.array(column.to_pylist(), object)
    return column.to_numpy()


def columns(parts: Sequence[Path], names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Columns of all parts in the order of the cases."""
    wanted = list(dict.fromkeys(["case", *names]))
    read = [read_columns(part, wanted) for part in parts]
    found = {name: np.concatenate([one[name] for one in read]) for name in wanted} if read else {}
    if not found:
        return {name: np.empty(0) for name in wanted}
    _, rows = np.unique(found["case"], return_index=True)
    return {name: values[rows] for name, values in found.items()}


def make(path: Path, about: dict[str, Any], files: Sequence[tuple[str, bytes]], *, resume: bool) -> Folder:
    """The folder of a campaign, new or gone on with. Raises HilError."""
    held = path / ABOUT
    about |= {"made_by": identity()}
    if held.is_file():
        before = open_folder(path)
        if not resume:
            done = int(before.done().sum())
            raise HilError(
                f"{path}: holds a campaign, {done} of {before.count} cases done; go on with --resume, "
                "or name another folder"
            )
        _same(path, before.about, about)
        return before
    if path.is_dir() and any(path.iterdir()):
        raise HilError(f"{path}: is not empty and holds no campaign; name another folder")
    try:
        (path / ROWS).mkdir(parents=True, exist_ok=True)
        for name, content in files:
            copy = path / INPUTS / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)
        beside = held.with_suffix(".new")
        beside.write_text(json.dumps(about, indent=1), encoding="utf-8")
        beside.replace(held)
    except OSError as error:
        raise HilError(f"{path}: can't be written: {error.strerror or error}; name another folder") from error
    return Folder(path, about)


def open_folder(path: Path) -> Folder:
    """The folder of a campaign that was begun. Raises HilError."""
    try:
        about = json.loads((path / ABOUT).read_text(encoding="utf-8"))
        return Folder(path, about)
    except OSError as error:
        raise HilError(f"{path}: holds no campaign (no {ABOUT}); name the folder of one") from error
    except (ValueError, KeyError, TypeError) as error:
        raise HilError(
            f"{path / ABOUT}: can't be read ({error}); this folder is no campaign any more"
        ) from error


def _same(path: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with another plan, other files or another version. Raises HilError."""
    other: Identity = before.get("made_by", {})
    if text := differences(now["made_by"], other):
        raise HilError(f"{path}: was begun with {text}; go on with that version, or name another folder")
    if (
        before.get("plan") != now["plan"]
        or before["schema"] != now["schema"]
        or before["count"] != now["count"]
    ):
        raise HilError(
            f"{path}: holds the campaign of another plan{_which(before, now)}; name another folder"
        )
    changed = [name for name, digest in now["files"].items() if before["files"].get(name) != digest]
    if changed:
        raise HilError(f"{path}: was begun with another {', '.join(changed)}; name another folder")


def _which(before: dict[str, Any], now: dict[str, Any]) -> str:
    """The tables of the plan that differ."""
    try:
        old, new = json.loads(before["plan"]), json.loads(now["plan"])
        names = [name for name in new if new[name] != old.get(name)]
    except (ValueError, KeyError, TypeError, AttributeError):
        return ""
    return f": {', '.join(names)} differ{'s' if len(names) == 1 else ''}" if names else ""
