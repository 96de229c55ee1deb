"""Ticks into tables: Parquet, CSV, MAT and MF4, each with the units of its columns."""

from __future__ import annotations

import tempfile
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from hil.exchange.recordings import start_s
from hil.log.errors import LogError
from hil.log.frame import ENUMS, named, need, title
from hil.log.reader import Log
from hil.signals import FIELDS, TickArray

MAT_TICKS: Final = 2**28 - 2**10
"""A variable of MATLAB 5 is below 2^31 bytes: 74 hours at 1 kHz."""


def _columns(ticks: TickArray) -> list[Any]:
    """The named fields of ticks, each contiguous."""
    return [np.ascontiguousarray(ticks[field.name]) for field in FIELDS]


class ParquetTable:
    """Parquet through pyarrow, one row group a slab; unit and meaning in each column's metadata."""

    def __init__(self, path: Path, log: Log) -> None:
        self._pa = need("pyarrow", "Parquet")
        parquet = need("pyarrow.parquet", "Parquet")
        kinds = {"f8": "float64", "u8": "uint64", "i8": "int64", "u4": "uint32", "i4": "int32"}
        fields = [
            self._pa.field(f.name, getattr(self._pa, kinds[f.kind])(), False, {"unit": f.unit, "doc": f.doc})
            for f in FIELDS
        ]
        self._schema = self._pa.schema(fields, {"hil.run": str(log.metadata.get("run", {}))})
        self._writer = parquet.ParquetWriter(path, self._schema, compression="zstd")

    def add(self, ticks: TickArray) -> None:
        """Append ticks as a row group."""
        arrays = [self._pa.array(column) for column in _columns(ticks)]
        self._writer.write_batch(self._pa.record_batch(arrays, schema=self._schema))

    def close(self, *, whole: bool) -> None:
        """Write the footer."""
        self._writer.close()


class CsvTable:
    """CSV through pyarrow: titles with units, the shortest digits that read back to the same bits."""

    def __init__(self, path: Path, log: Log) -> None:
        self._pa, self._csv = need("pyarrow", "CSV"), need("pyarrow.csv", "CSV")
        self._titles = [title(field) for field in FIELDS]
        schema = self._batch(log.ticks[:0]).schema
        self._writer = self._csv.CSVWriter(str(path), schema)

    def _batch(self, ticks: TickArray) -> Any:
        return self._pa.record_batch([self._pa.array(column) for column in _columns(ticks)], self._titles)

    def add(self, ticks: TickArray) -> None:
        """Append ticks as lines."""
        self._writer.write_batch(self._batch(ticks))

    def close(self, *, whole: bool) -> None:
        """Flush and close."""
        self._writer.close()


class Mf4Table:
    """MF4 through asammdf: one group whose signals have units; time since the first tick [s] as master.

    The file starts when the run did. Numbers that have names stay numbers, and the names are text beside them
    (``state_name``): of a value table readers give text alone, and nothing for a number without a name.
    """

    def __init__(self, path: Path, log: Log) -> None:
        self._asammdf = need("asammdf", "MF4")
        self._path, self._file = path, self._asammdf.MDF(version="4.10")
        self._file.header.start_time = datetime.fromtimestamp(start_s(log)).astimezone()
        self._first: int | None = None

    def add(self, ticks: TickArray) -> None:
        """Append ticks; asammdf keeps them in a temporary file."""
        columns, t = _columns(ticks), np.ascontiguousarray(ticks["t_ns"])
        names = {name: named(name, ticks[name]) for name in ENUMS}
        if self._first is None:
            self._first = int(t[0])
            seconds = (t - self._first) * 1e-9
            signals = [
                self._asammdf.Signal(samples, seconds, unit=field.unit, name=field.name, comment=field.doc)
                for field, samples in zip(FIELDS, columns, strict=True)
            ]
            signals += [
                self._asammdf.Signal(texts, seconds, name=f"{name}_name", encoding="utf-8")
                for name, texts in names.items()
            ]
            self._file.append(signals, acq_name="hil ticks", common_timebase=True)
        else:
            every = ((t - self._first) * 1e-9, *columns, *names.values())
            self._file.extend(0, [(column, None) for column in every])

    def close(self, *, whole: bool) -> None:
        """Write the file, when it is whole; let go of the temporary one."""
        try:
            if whole:
                self._file.save(self._path, overwrite=True)
        finally:
            self._file.close()


class MatTable:
    """MATLAB 5 file: a compressed vector a field, structs ``units``, ``meanings`` and ``run``.

    The format wants a variable whole behind its length, so each column waits in a nameless file in the folder
    of the target, which the system removes with this process, however it ends. Memory holds one column.
    """

    def __init__(self, path: Path, log: Log) -> None:
        self._savemat = need("scipy.io", "MAT").savemat
        self._path, self._log, self._count = path, log, 0
        self._columns = [tempfile.TemporaryFile(dir=path.parent) for _ in FIELDS]  # noqa: SIM115 - until close

    def add(self, ticks: TickArray) -> None:
        """Append ticks to the columns. Raises LogError for more than a variable can hold."""
        self._count += len(ticks)
        if self._count > MAT_TICKS:
            raise LogError(
                f"{self._log.path}: a variable of a MAT file holds at most {MAT_TICKS} ticks; "
                "take .parquet or .mf4"
            )
        for file, column in zip(self._columns, _columns(ticks), strict=True):
            file.write(column.data)

    def close(self, *, whole: bool) -> None:
        """Write the file, when it is whole; let go of the columns."""
        try:
            if whole:
                self._write()
        finally:
            for file in self._columns:
                file.close()

    def _write(self) -> None:
        """Variable by variable: scipy writes the header at the start of a file alone."""
        run = self._log.metadata["run"].items()
        with self._path.open("wb") as stream:
            for field, file in zip(FIELDS, self._columns, strict=True):
                file.seek(0)
                self._put(stream, field.name, np.fromfile(file, f"<{field.kind}"))
                file.close()  # gives its room on the disk back
            self._put(stream, "units", {f.name: f.unit for f in FIELDS})
            self._put(stream, "meanings", {f.name: f.doc for f in FIELDS})
            self._put(stream, "run", {name.replace(" ", "_").replace("-", "_"): text for name, text in run})

    def _put(self, stream: IO[bytes], name: str, value: Any) -> None:
        options = {"do_compression": True, "oned_as": "column", "long_field_names": True}
        self._savemat(stream, {name: value}, **options)
