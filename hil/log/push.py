"""Records into a ring as one compiled call: :meth:`hil.log.ring.Ring.push_many` for records that stay.

Between two ticks the caches go cold, and then each line of Python that is not run counts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.control.jit import COMPILED, array_at, entry, jit, numba_types, place_of
from hil.log.ring import (
    CAPACITY_AT,
    DROPPED_AT,
    HEAD_AT,
    HEADER_BYTES,
    HIGH_AT,
    SIZE_AT,
    TAIL_AT,
    Ring,
    RingError,
)
from hil.signals import TickArray

HEADER, MEMORY, RECORD = range(3)
ADDRESS = 0
_word = numba_types.uintp
_memcpy = numba_types.ExternalFunction("memcpy", _word(_word, _word, _word))
I8, U1 = np.dtype(np.int64), np.dtype(np.uint8)
NOWHERE: Final = (
    (np.zeros(HIGH_AT + 1, np.int64), I8),
    (np.zeros(1, np.uint8), U1),
    (np.zeros(1, np.uint8), U1),
)
"""A ring without room."""


def pusher(ring: Ring, record: TickArray) -> Callable[[], int]:
    """A call that stores ``record``; 0 when it was dropped. Ring and record must outlive it.

    Raises RingError for a record of another size than the ring's.
    """
    raw = record.view(U1)
    if len(raw) != ring.record_size:
        raise RingError(f"a record of {len(raw)} bytes in a ring for {ring.record_size}")
    if not COMPILED:
        return partial(ring.push, raw.data)
    places = ring_places(ring, raw)
    return partial(entry(push, np.array([place_of(*one) for one in NOWHERE]), 1), places, 1)


def ring_places(ring: Ring, raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """What :func:`push` stores records of the ring's size by, whose bytes are given; both must outlive it."""
    return np.array((_seen(ring.header, I8), _seen(ring.memory, U1), place_of(raw, U1)))


def _seen(memory: memoryview, dtype: Any) -> tuple[int, int]:
    """The place of a ring's memory; no array of it stays, which would keep the ring from being closed."""
    return place_of(np.frombuffer(memory, dtype), dtype)


@jit
def push(places: Any, count: int) -> Any:
    """Store the first ``count`` records, then publish them by the head; return how many there was room for.

    The newest that a full ring has no room for are dropped and counted.
    """
    header = array_at(places, HEADER, I8)
    head, capacity, size = header[HEAD_AT], header[CAPACITY_AT], header[SIZE_AT]
    room = capacity - head + header[TAIL_AT]
    if count > room:
        header[DROPPED_AT] += count - room
        count = room
    if count <= 0:
        return 0
    first = head % capacity
    cut = min(count, capacity - first)
    start, source = places[MEMORY, ADDRESS] + HEADER_BYTES, places[RECORD, ADDRESS]
    _memcpy(start + first * size, source, cut * size)
    if cut < count:
        _memcpy(start, source + cut * size, (count - cut) * size)
    header[HEAD_AT] = head + count
    return count
