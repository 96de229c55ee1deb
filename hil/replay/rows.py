"""Ticks as rows of bytes: ranges of them copied and compared at once; field by field it takes longer."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from hil.signals import FIELDS, TICK, TickArray

TAG_MOST: Final = 2
"""Bytes of a field's tag, the same in every tick; a field has four at least."""
_PLACES: Final = {field.name: TICK.fields[field.name][1] for field in FIELDS}  # type: ignore[index]


@cache
def ranges_of(names: frozenset[str]) -> tuple[slice, ...]:
    """The bytes that these fields take of a tick, of neighbours with the tag between them."""
    ranges: list[slice] = []
    for at, size in sorted((_PLACES[name], TICK[name].itemsize) for name in names):
        joined = ranges and at - ranges[-1].stop <= TAG_MOST
        ranges.append(slice(ranges.pop().start if joined else at, at + size))
    return tuple(ranges)


def rows_of(ticks: TickArray) -> npt.NDArray[np.uint8]:
    """A row of bytes for each tick; not copied where the ticks lie side by side."""
    return np.ascontiguousarray(ticks).view(np.uint8).reshape(len(ticks), TICK.itemsize)


def copy_fields(source: TickArray, target: TickArray, names: frozenset[str]) -> None:
    """Copy some fields of each tick into ``target``, whose ticks lie side by side."""
    here, there = rows_of(source), target.view(np.uint8).reshape(len(target), TICK.itemsize)
    for part in ranges_of(names):
        there[:, part] = here[:, part]


def unequal_row(a: TickArray, b: TickArray, names: Iterable[str]) -> int | None:
    """The first tick in which some fields differ by a bit; None when there is none."""
    one, other = rows_of(a), rows_of(b)
    parts = [(one[:, part], other[:, part]) for part in ranges_of(frozenset(names))]
    rows = [int((x != y).any(axis=1).argmax()) for x, y in parts if not np.array_equal(x, y)]
    return min(rows, default=None)
