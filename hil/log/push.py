"""A tick's push into the ring as one compiled call: :meth:`hil.log.ring.Ring.push` for a record that stays.

Between two ticks the caches go cold, and then each line of Python that is not run counts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from hil.control.jit import COMPILED, array_at, entry, jit, numba_types, place_of
from hil.log.ring import CAPACITY_AT, DROPPED_AT, HEAD_AT, HEADER_BYTES, HIGH_AT, TAIL_AT, Ring, RingError
from hil.signals import TickArray

HEADER, MEMORY, RECORD = range(3)
ADDRESS, LENGTH = range(2)
_word = numba_types.uintp
_memcpy = numba_types.ExternalFunction("memcpy", _word(_word, _word, _word))
I8, U1 = np.dtype(np.int64), np.dtype(np.uint8)
NOWHERE: Final = (
    (np.zeros(HIGH_AT + 1, np.int64), I8),
    (np.zeros(1, np.uint8), U1),
    (np.zeros(1, np.uint8), U1),
)
"""A ring without room."""


def pusher(ring: Ring, record: TickArray) -> Callable[[], bool]:
    """A call that stores ``record``; False when it was dropped. Ring and record must outlive it.

    Raises RingError for a record of another size than the ring's.
    """
    raw = record.view(U1)
    if len(raw) != ring.record_size:
        raise RingError(f"a record of {len(raw)} bytes in a ring for {ring.record_size}")
    if not COMPILED:
        return partial(ring.push, raw.data)
    places = (_seen(ring.header, I8), _seen(ring.memory, U1), place_of(raw, U1))
    return partial(entry(push, np.array([place_of(*one) for one in NOWHERE])), np.array(places))


def _seen(memory: memoryview, dtype: Any) -> tuple[int, int]:
    """The place of a ring's memory; no array of it stays, which would keep the ring from being closed."""
    return place_of(np.frombuffer(memory, dtype), dtype)


@jit
def push(places: Any) -> Any:
    """Store the record, then publish it by the head; a full ring drops it and counts it."""
    header, size = array_at(places, HEADER, I8), places[RECORD, LENGTH]
    head, capacity = header[HEAD_AT], header[CAPACITY_AT]
    if head - header[TAIL_AT] >= capacity:
        header[DROPPED_AT] += 1
        return False
    at = HEADER_BYTES + head % capacity * size
    _memcpy(places[MEMORY, ADDRESS] + at, places[RECORD, ADDRESS], size)
    header[HEAD_AT] = head + 1
    return True
