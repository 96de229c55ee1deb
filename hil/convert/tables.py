"""Ticks into tables: Parquet, CSV, MAT and MF4, each with the units of its columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.convert.frame import need, title
from hil.log.errors import LogError
from hil.log.reader import Log, Source, open_log
from hil.signals import FIELDS, TickArray


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

    def close(self) -> None:
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

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()


class Mf4Table:
    """MF4 through asammdf: one group whose signals have units; time since the first tick [s] as master."""

    def __init__(self, path: Path, log: Log) -> None:
        self._asammdf = need("asammdf", "MF4")
        self._path, self._file = path, self._asammdf.MDF(version="4.10")
        self._first: int | None = None

    def add(self, ticks: TickArray) -> None:
        """Append ticks; asammdf keeps them in a temporary file."""
        columns, t = _columns(ticks), np.ascontiguousarray(ticks["t_ns"])
        if self._first is None:
            self._first = int(t[0])
            seconds = (t - self._first) * 1e-9
            signals = [
                self._asammdf.Signal(samples, seconds, unit=field.unit, name=field.name, comment=field.doc)
                for field, samples in zip(FIELDS, columns, strict=True)
            ]
            self._file.append(signals, acq_name="hil ticks", common_timebase=True)
        else:
            self._file.extend(0, [((t - self._first) * 1e-9, None), *((column, None) for column in columns)])

    def close(self) -> None:
        """Write the file."""
        try:
            self._file.save(self._path, overwrite=True)
        finally:
            self._file.close()


def write_mat(path: Path, source: Source) -> Log:
    """MATLAB 5 file: a vector a field, structs ``units``, ``meanings`` and ``run``.

    Holds all ticks in memory; raises LogError when they do not fit into half of it, and when there are none.
    """
    savemat = need("scipy.io", "MAT").savemat
    log = open_log(source, frames=False)
    if not len(log.ticks):
        raise LogError(f"{log.path}: holds no ticks")
    columns: dict[str, Any] = dict(zip([f.name for f in FIELDS], _columns(log.ticks), strict=True))
    columns["units"] = {f.name: f.unit for f in FIELDS}
    columns["meanings"] = {f.name: f.doc for f in FIELDS}
    columns["run"] = {key.replace(" ", "_").replace("-", "_"): v for key, v in log.metadata["run"].items()}
    savemat(path, columns, do_compression=True, oned_as="column", long_field_names=True)
    return log
