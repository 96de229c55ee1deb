"""Records of parameters and states as JSON by name, exact to the bit, and back into today's records.

A log outlives the layout of the records that it was written from: what it lacks takes a declared neutral
value, and the reader says which. Logs of format 1 hold bare bytes, read by :data:`hil.log.layouts.FORMAT_1`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.log.layouts import FORMAT_1

Record = npt.NDArray[np.void]
Named = dict[str, npt.NDArray[Any]]


def to_named(record: Record) -> dict[str, Any]:
    """Every field of the first record by name: a number, or nested lists of them."""
    return {name: _plain(record[name][0].tolist()) for name in record.dtype.names or ()}


def _plain(value: Any) -> Any:
    """JSON has neither infinity nor NaN: they become text, a NaN with its bits."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return f"nan:{struct.pack('>d', value).hex()}" if math.isnan(value) else str(value)
    return value


def _number(value: Any) -> Any:
    """Inverse of :func:`_plain`. Raises ValueError or TypeError."""
    if isinstance(value, list):
        return [_number(item) for item in value]
    if isinstance(value, str):
        head, _, bits = value.partition(":")
        if head == "nan" and bits:
            return struct.unpack(">d", bytes.fromhex(bits))[0]
        return {"inf": math.inf, "-inf": -math.inf}[value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r:.40} is no number")
    return value


def read_named(kind: str, given: Any) -> Named:
    """The fields of a logged record: by name, or the bytes of format 1. Raises ValueError."""
    if isinstance(given, str):
        raw, layout = bytes.fromhex(given), FORMAT_1[kind]
        if len(raw) != layout.itemsize:
            raise ValueError(f"{kind} has {len(raw)} bytes, in format 1 it has {layout.itemsize}")
        record = np.frombuffer(raw, layout)
        return {name: record[name][0] for name in layout.names or ()}
    if not isinstance(given, Mapping):
        raise ValueError(f"{kind} is neither fields by name nor the bytes of format 1")
    return {str(name): _array(f"{kind}.{name}", value) for name, value in given.items()}


def _array(name: str, value: Any) -> npt.NDArray[Any]:
    try:
        out = np.array(_number(value))
    except (ValueError, TypeError, KeyError, OverflowError, struct.error) as error:
        raise ValueError(f"{name} is no number or array of numbers") from error
    if out.dtype.kind not in "if":
        raise ValueError(f"{name} is no number or array of numbers")
    return out


def fill(record: Record, given: Named, neutral: Mapping[str, float] | None = None) -> list[str]:
    """Set a record's fields from a log's, in place; the names of those that the log lacks.

    A field that it lacks takes its ``neutral`` value; for a state (None) it stays as it was before the first
    tick, as does the end of a row that has grown since. Raises ValueError for what has no place here.
    """
    fields: Any = record.dtype.fields
    if unknown := [name for name in given if name not in fields]:
        raise ValueError(f"{', '.join(unknown[:5])}: not known to this version; a newer one wrote the log")
    lacking = [name for name in fields if name not in given]
    for name in lacking:
        if neutral is not None:
            if name not in neutral:
                raise ValueError(f"the log lacks {name}, which no version left out")
            record[name] = neutral[name]
    for name, value in given.items():
        _set(record[name][0] if record[name][0].ndim else record[name], name, value, grown=neutral is None)
    return lacking


def _set(place: npt.NDArray[Any], name: str, value: npt.NDArray[Any], *, grown: bool) -> None:
    """Write one field, kind and shape checked."""
    if place.dtype.kind == "i" and value.dtype.kind != "i":
        raise ValueError(f"{name} must be of whole numbers")
    if value.ndim == 0:
        value = value.reshape(1)
    if grown and place.ndim == value.ndim == 1 and len(value) < len(place):
        place = place[: len(value)]
    if place.shape != value.shape:
        raise ValueError(f"{name} has the shape {value.shape}, here {place.shape}")
    place[...] = value
