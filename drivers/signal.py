"""One signal of a frame: where its bits are, what they mean, and the exact rules in both directions.

phys = raw * scale + offset in float64, raw = rint((phys - offset) / scale). What a tick sends and receives
goes through the same rules as kernels, :mod:`drivers.wire`; here the error is worded when a value misfits.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from drivers.errors import DatabaseError, EncodeError

FLOAT_FORMATS = {16: ("<H", "<e"), 32: ("<I", "<f"), 64: ("<Q", "<d")}
FLOAT_TOPS = {16: 65504.0, 32: (2.0 - 2.0**-23) * 2.0**127, 64: (2.0 - 2.0**-52) * 2.0**1023}
FLOAT_STEP = 2.0**-10
_ROUNDING = 1e-6  # of a step: a DBC's range is written in decimal digits


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal compiled. ``shift`` counts from the frame's end when big endian, else from its start."""

    name: str
    shift: int
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float
    maximum: float
    unit: str
    _range: tuple[int, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        half = 1 << (self.length - 1)
        low, high = (-half, half - 1) if self.signed else (0, 2 * half - 1)
        ends = sorted((bound - self.offset) / self.scale for bound in (self.minimum, self.maximum))
        limits = max(low, _whole(ends[0], math.ceil, low)), min(high, _whole(ends[1], math.floor, high))
        object.__setattr__(self, "_range", limits)

    @property
    def top(self) -> float:
        """Largest magnitude that the bits and the DBC's range allow, symmetric about 0."""
        low, high = self.span
        return min(high, -low) if low < 0 else high

    @property
    def step(self) -> float:
        """Distance of two values; of a float that of numbers up to 2^13, which 32 bits hold to the bit."""
        return abs(self.scale) * FLOAT_STEP if self.is_float else abs(self.scale)

    @property
    def span(self) -> tuple[float, float]:
        """Smallest and largest value that the bits and the DBC's range can show."""
        if self.is_float:
            ends = sorted(
                end * self.scale + self.offset for end in (-FLOAT_TOPS[self.length], FLOAT_TOPS[self.length])
            )
            return max(self.minimum, ends[0]), min(self.maximum, ends[1])
        low, high = sorted(raw * self.scale + self.offset for raw in self.raw_range())
        return low, high

    def in_unit(self, unit: str, factor: float) -> Signal:
        """The same bits in another unit: one ``self.unit`` is ``factor`` of ``unit``."""
        return replace(
            self,
            unit=unit,
            scale=self.scale * factor,
            offset=self.offset * factor,
            minimum=self.minimum * factor,
            maximum=self.maximum * factor,
        )

    def mask(self, length: int) -> int:
        """Its bits in a frame of ``length`` bytes as one little-endian number."""
        return self.placed((1 << self.length) - 1, length)

    def placed(self, bits: int, length: int) -> int:
        """A frame of ``length`` bytes with these bits alone, as one little-endian number."""
        frame = (bits << self.shift).to_bytes(length, "big" if self.big_endian else "little")
        return int.from_bytes(frame, "little")

    @property
    def raw_bias(self) -> int:
        """What is added to a raw number for the smallest to be 0."""
        return 1 << (self.length - 1) if self.signed else 0

    @property
    def raw_count(self) -> int:
        """How many raw numbers there are."""
        low, high = self.raw_range()
        return high - low + 1

    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw integer that both the bits and the DBC's range allow."""
        return self._range

    def of_frame(self, data: bytes) -> float:
        """Physical value in a frame of its message's length."""
        order: Literal["big", "little"] = "big" if self.big_endian else "little"
        return self.to_phys(int.from_bytes(data, order) >> self.shift & ((1 << self.length) - 1))

    def to_phys(self, bits: int) -> float:
        """Physical value of the signal's bits."""
        if self.is_float:
            integer, real = FLOAT_FORMATS[self.length]
            value = float(struct.unpack(real, struct.pack(integer, bits))[0])
        else:
            value = bits - (1 << self.length) if self.signed and bits >> (self.length - 1) else bits
        return value * self.scale + self.offset

    def to_bits(self, phys: float) -> int:
        """Bits of a physical value. Raises EncodeError for what is not finite or out of range."""
        if (
            isinstance(phys, int)
            and not self.is_float
            and self.scale == 1.0
            and self.offset == round(self.offset)
        ):
            return self._whole_bits(phys, phys - round(self.offset))
        try:
            phys = float(phys)
        except OverflowError:
            phys = math.inf
        if not math.isfinite(phys):
            raise EncodeError(f"{self.name}: {phys} can't be sent")
        value = (phys - self.offset) / self.scale
        if self.is_float:
            return self._float_bits(phys, value)
        return self._whole_bits(phys, round(value) if math.isfinite(value) else 1 << 64)

    def _whole_bits(self, phys: float, raw: int) -> int:
        """Bits of a raw number; an integer of more than 53 bits stays what it is."""
        low, high = self.raw_range()
        if not (low <= raw <= high):
            raise self._misfit(phys, low * self.scale + self.offset, high * self.scale + self.offset)
        return raw & ((1 << self.length) - 1)

    def _float_bits(self, phys: float, value: float) -> int:
        if not self.minimum <= phys <= self.maximum:
            raise self._misfit(phys, self.minimum, self.maximum)
        return self.float_bits(value)

    def float_bits(self, raw: float) -> int:
        """Bits of a raw number of a float. Raises EncodeError for what overflows it."""
        integer, real = FLOAT_FORMATS[self.length]
        try:
            return int(struct.unpack(integer, struct.pack(real, raw))[0])
        except OverflowError as error:
            raise EncodeError(f"{self.name}: {raw:g} overflows a float of {self.length} bits") from error

    def _misfit(self, phys: float, low: float, high: float) -> EncodeError:
        low, high = sorted((low, high))
        return EncodeError(f"{self.name}: {phys} {self.unit} does not fit {low:.12g} .. {high:.12g}")


def _whole(end: float, towards: Any, otherwise: int) -> int:
    """Whole raw number inside a bound; a bound beyond all numbers is none."""
    slack = _ROUNDING if towards is math.floor else -_ROUNDING
    return int(towards(end + slack)) if abs(end) < 2.0**64 else otherwise


def compile_signal(parsed: Any, name: str, length: int, where: str) -> Signal:
    """Compile cantools' signal of a message of ``length`` bytes. Raises DatabaseError."""
    scale, offset = float(parsed.scale), float(parsed.offset)
    if not (math.isfinite(scale) and math.isfinite(offset)) or scale == 0.0:
        raise DatabaseError(f"{where}.{name}: scale {scale:g}, offset {offset:g} mean nothing; correct it")
    if parsed.is_float and parsed.length not in FLOAT_FORMATS:
        raise DatabaseError(f"{where}.{name}: a float of {parsed.length} bits; use 16, 32 or 64")
    if not 1 <= parsed.length <= 64:
        raise DatabaseError(f"{where}.{name}: {parsed.length} bits; use 1 to 64")
    shift = _shift(parsed, length)
    if not 0 <= shift <= 8 * length - parsed.length:
        raise DatabaseError(f"{where}.{name} does not fit into {length} bytes; correct length or start")
    low, high = _bounds(parsed, scale, offset)
    return Signal(
        name,
        shift,
        parsed.length,
        parsed.byte_order == "big_endian",
        bool(parsed.is_signed),
        bool(parsed.is_float),
        scale,
        offset,
        low if parsed.minimum is None else float(parsed.minimum),
        high if parsed.maximum is None else float(parsed.maximum),
        parsed.unit or "",
    )


def _bounds(parsed: Any, scale: float, offset: float) -> tuple[float, float]:
    """Smallest and largest physical value of the bits."""
    if parsed.is_float:
        return -math.inf, math.inf
    half = 1 << (parsed.length - 1)
    ends = (-half, half - 1) if parsed.is_signed else (0, 2 * half - 1)
    low, high = sorted(end * scale + offset for end in ends)
    return low, high


def _shift(parsed: Any, length: int) -> int:
    """Bits below the signal; a big-endian signal's start is its top bit, counted within its byte."""
    if parsed.byte_order != "big_endian":
        return int(parsed.start)
    from_top = (parsed.start // 8) * 8 + 7 - parsed.start % 8
    return int(8 * length - from_top - parsed.length)
