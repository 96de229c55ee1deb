"""The check that each logged tick carries over its own fields, so that a changed bit is found and placed.

    check = sum over the other fields f of low_f c_f + high_f e_f  (mod 2^64)

where low_f and high_f are the halves of 32 bits of the field's bits as a whole number, c_f and e_f odd
numbers made from the field's. A change within a half, however small, always changes the sum, any other change
but for a chance of 2^-64; of one bit the field follows from the difference. Whoever first writes a record
into a file sets it; one that has one keeps it, so that copying a log does not hide what happened to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hil.log.schema import Records
from hil.signals import FIELDS, TickArray

NAME: Final = "check"
_MASK: Final = (1 << 64) - 1
_HALF: Final = (1 << 32) - 1
Sums = npt.NDArray[np.uint64]


def weights(number: int) -> tuple[int, int]:
    """c_f and e_f: the first outputs of SplitMix64 from twice the field's number and the next, made odd."""
    return _odd(2 * number), _odd(2 * number + 1)


def _odd(seed: int) -> int:
    z = (seed * 0x9E3779B97F4A7C15) & _MASK
    z = ((z ^ z >> 30) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ z >> 27) * 0x94D049BB133111EB) & _MASK
    return (z ^ z >> 31) | 1


_FIELDS: Final = {field.name: field for field in FIELDS if field.name != NAME}


@cache
def _halves(layout: np.dtype[np.void], names: frozenset[str]) -> tuple[np.dtype[np.void], Sums]:
    """A view of the records as the halves of their fields, and the weight of each."""
    offsets: list[int] = []
    own: list[int] = []
    for name in names:
        kind, offset = layout.fields[name][:2]  # type: ignore[index]
        count = kind.itemsize // 4
        offsets += [offset, offset + 4][:count]
        own += weights(_FIELDS[name].number)[:count]
    halves: Any = {
        "names": [str(number) for number in range(len(offsets))],
        "formats": ["<u4"] * len(offsets),
        "offsets": offsets,
        "itemsize": layout.itemsize,
    }
    return np.dtype(halves), np.array(own, np.uint64)


def share(values: npt.NDArray[Any], number: int) -> Sums:
    """What field ``number`` adds to the sums."""
    low, high = (np.uint64(weight) for weight in weights(number))
    whole = values.view(f"<u{values.itemsize}").astype(np.uint64)
    out: Sums = (whole & np.uint64(0xFFFFFFFF)) * low + (whole >> np.uint64(32)) * high
    return out


def sums(ticks: Records, absent: Iterable[str] = ()) -> Sums:
    """The checks that the records should carry; fields that are ``absent`` are left out."""
    layout, own = _halves(ticks.dtype, frozenset(_FIELDS) - frozenset(absent))
    halves, total = ticks.view(layout), np.zeros(len(ticks), np.uint64)
    for number, weight in enumerate(own):
        total += halves[str(number)] * weight
    total[total == 0] = 1  # 0 says that there is none
    return total


def seal(records: Records, absent: Iterable[str] = ()) -> None:
    """Give each record that has none its check, in place."""
    bare = records[NAME] == 0
    if bare.any():
        records[NAME] = np.where(bare, sums(records, absent), records[NAME])


class Broken(NamedTuple):
    """A tick that is not what was written: its row, and the field with both values when one bit tells."""

    row: int
    field: str
    logged: float
    written: float


def first_broken(ticks: TickArray, absent: frozenset[str]) -> Broken | None:
    """The first tick whose check does not fit. A log without checks has none that is broken."""
    if NAME in absent:
        return None
    right = sums(ticks, absent)
    rows = np.nonzero(ticks[NAME] != right)[0]
    return None if not len(rows) else _placed(ticks, int(rows[0]), int(right[rows[0]]), absent)


def _placed(ticks: TickArray, row: int, right: int, absent: frozenset[str]) -> Broken:
    """The field of which one changed bit explains the difference; else the check itself is named."""
    stored = int(ticks[NAME][row])
    difference = (stored - right) & _MASK
    for name, field in _FIELDS.items():
        value = ticks[name][row : row + 1].copy()
        bits = value.view(f"<u{value.itemsize}")
        for half, weight in enumerate(weights(field.number)[: value.itemsize // 4]):
            was, now = _changed(int(bits[0]) >> 32 * half & _HALF, difference, weight)
            if name not in absent and (was ^ now).bit_count() == 1 and was <= _HALF:
                logged = float(value[0])
                bits[0] ^= (was ^ now) << 32 * half
                return Broken(row, name, logged, float(value[0]))
    return Broken(row, NAME, float(stored), float(right))


def _changed(now: int, difference: int, weight: int) -> tuple[int, int]:
    """What a half must have been for the difference, and what it is."""
    return (now + difference * pow(weight, -1, 1 << 64)) & _MASK, now
