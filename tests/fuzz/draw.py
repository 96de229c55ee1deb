"""Values read from an input's bytes, so that one target serves random inputs and those a fuzzer evolves."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")
LEAST_NORMAL = 2.2250738585072014e-308
EXTREME = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -5e-324, LEAST_NORMAL, -LEAST_NORMAL / 2)
FACTORS = (1.0, 1.0 - 2**-53, 1.0 + 2**-52, 1.0 + 1e-9, 1.0 - 1e-9, 1.00002, 1.001, 2.0, 0.5, math.sqrt(0.5))


class Draw:
    """Reads an input from its beginning; past its end everything is 0, the first choice."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def rest(self) -> bool:
        """True while there is something to read."""
        return self._at < len(self._data)

    def bytes(self, count: int) -> bytes:
        got = self._data[self._at : self._at + count]
        self._at += count
        return got.ljust(count, b"\0")

    def below(self, limit: int) -> int:
        """A whole number in 0..limit-1, of two bytes where one is not enough."""
        return int.from_bytes(self.bytes(1 if limit <= 256 else 2), "little") % limit

    def pick(self, choices: Sequence[T]) -> T:
        return choices[self.below(len(choices))]

    def one_in(self, count: int) -> bool:
        return self.below(count) == count - 1

    def number(self, *near: float) -> float:
        """A float64: mostly beside one of the limits ``near``, or within; else an extreme one, or any."""
        kind = self.below(8)
        if kind < 3 and near:
            return self.pick((1.0, -1.0)) * self.pick(near) * self.pick(FACTORS)
        if kind < 6 and near:
            return self.pick(near) * (self.below(1 << 16) - (1 << 15)) / (1 << 15)
        if kind == 6:
            return self.pick(EXTREME)
        any_bits: float = struct.unpack("<d", self.bytes(8))[0]
        return any_bits if self.below(2) else 0.0
