"""A tick taken back: what it changes of a controller's states is kept before it, and can be put back.

A usual tick (one period after the last, whose measurement had come) writes of each ring only the next entry,
or the newest one, so that the rest of the rings, nearly all of a state, need not be kept. Before any other
tick all is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from hil.control.jit import array_at, jit, place_of
from hil.control.law import LAW_STATE, N_MAX
from hil.control.speedfilter import PAST
from hil.tick.guard import SAFETY_STATE

Record = npt.NDArray[np.void]
Bytes = npt.NDArray[np.uint8]
Rings = Mapping[str, tuple[int, int, int]]
"""By the field's name: kind, entries in the ring, entries that a usual tick may write."""
WHOLE, FIXED, HEAD, PLACE, COUNTER, STARTS = range(6)
"""Of ``starts``: 1 when all was kept, then by the kind of a part the first entry that was."""
FROM, TO, SIZE, COUNT, KIND, ENTRIES, COLUMNS = range(7)
"""Of a part: addresses of the state's and of what is kept of it, bytes of an entry, entries in the ring,
kind, entries that are kept."""
STARTS_AT, SAFETY_AT, LAW_AT, USUAL, ALL = range(5)
"""Of an undo's places: rows of the parts that a usual tick writes, and of all."""
I8: Final = np.dtype(np.int64)
_word: Any = numba.types.uintp
_memcpy: Any = numba.types.ExternalFunction("memcpy", _word(_word, _word, _word))


class Part(NamedTuple):
    """A part of a state as entries of bytes, and what is kept of it."""

    live: Bytes
    kept: Bytes
    kind: int
    entries: int

    def row(self) -> list[int]:
        """For :func:`keep`."""
        count, size = self.live.shape
        return [self.live.ctypes.data, self.kept.ctypes.data, size, count, self.kind, self.entries]


def parts_of(live: Bytes, kept: Bytes, dtype: np.dtype[np.void], rings: Rings) -> Iterator[Part]:
    """A state's rings, and what is between them. A ring may use less entries than it has room for."""
    begin = 0
    for name in (*(name for name in dtype.names or () if name in rings), ""):
        at = dtype.fields[name][1] if name and dtype.fields else dtype.itemsize
        if at > begin:
            yield Part(live[None, begin:at], kept[None, begin:at], FIXED, 1)
        if name:
            kind, count, entries = rings[name]
            field = dtype[name]
            size = field.base.itemsize * int(np.prod(field.shape[1:]))
            begin = at + field.itemsize
            own = slice(at, at + count * size)
            yield Part(live[own].reshape(count, size), kept[own].reshape(count, size), kind, entries)


class Undo:
    """What is kept of one controller's states: of supervisor and guard, of the law, and one without rings."""

    def __init__(self, safety: Record, law: Record, states: tuple[Record, Record, Record]) -> None:
        modulus = int(safety["counter_modulus"][0])
        sent: Rings = dict.fromkeys(("sent_q", "sent_d", "sent_T"), (COUNTER, modulus, 2))
        past: Rings = dict.fromkeys(("past", "past_3"), (HEAD, N_MAX, 1))
        entries = 2 if law["order"][0] else 0  # without a filter nothing goes into these
        heard: Rings = dict.fromkeys(("y", "flow", "bend"), (PLACE, PAST, entries))
        known: list[tuple[np.dtype[np.void], Rings]]
        known = [(SAFETY_STATE, sent), (LAW_STATE, {**past, **heard}), (states[2].dtype, {})]
        live = [state.view(np.uint8) for state in states]
        kept = [one.copy() for one in live]
        self._all = [Part(one[None], own[None], FIXED, 1) for one, own in zip(live, kept, strict=True)]
        self._parts = [
            part
            for one, own, (dtype, rings) in zip(live, kept, known, strict=True)
            for part in parts_of(one, own, dtype, rings)
            if part.entries
        ]
        self._starts = np.zeros(STARTS, np.int64)
        both = (self._parts, self._all)
        self._rows = [np.array([part.row() for part in parts], np.int64).reshape(-1) for parts in both]
        own = [place_of(self._starts, I8), place_of(states[0], SAFETY_STATE), place_of(states[1], LAW_STATE)]
        own += [place_of(rows, I8) for rows in self._rows]
        self.places = np.array(own, np.int64)
        """For :func:`keep`; they must not outlive this."""

    def keep(self) -> None:
        """Keep all, for any tick."""
        self._starts[WHOLE] = 1
        for part in self._all:
            part.kept[:] = part.live

    def restore(self) -> None:
        """Put back what was kept last, here or by :func:`keep`."""
        for part in self._all if self._starts[WHOLE] else self._parts:
            at = (self._starts[part.kind] + np.arange(part.entries)) % len(part.live)
            part.live[at] = part.kept[at]


@jit
def keep(places: Any, gap: int) -> None:
    """Keep what a tick ``gap`` periods after the last may write; ``places``: of an :class:`Undo`."""
    starts = array_at(places, STARTS_AT, I8)
    safety, law = array_at(places, SAFETY_AT, SAFETY_STATE)[0], array_at(places, LAW_AT, LAW_STATE)[0]
    usual = gap == 1 and law["gap"] == 0 and law["filled"] > 0
    starts[WHOLE] = 0 if usual else 1
    starts[HEAD], starts[PLACE], starts[COUNTER] = law["head"] + 1, law["place"], safety["counter"]
    rows = array_at(places, USUAL if usual else ALL, I8)
    for first in range(0, len(rows), COLUMNS):
        size = rows[first + SIZE]
        for step in range(rows[first + ENTRIES]):
            at = (starts[rows[first + KIND]] + step) % rows[first + COUNT] * size
            _memcpy(rows[first + TO] + at, rows[first + FROM] + at, size)
