"""Frames by a DBC file: cantools parses it, this module compiles it to shifts, scales and checks.

phys = raw * scale + offset in float64, raw = rint((phys - offset) / scale). A frame is applied whole or not
at all; a value that does not fit raises.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cantools

from drivers.e2e import crc_profile_2, crc_profile_5
from drivers.errors import DatabaseError, DecodeError, EncodeError

MAX_DBC_BYTES = 4 << 20
_FLOATS = {16: ("<H", "<e"), 32: ("<I", "<f"), 64: ("<Q", "<d")}
_BROADCAST_TOP = 0x7F


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal compiled: where its bits are and what they mean."""

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

    @property
    def top(self) -> float:
        """Largest magnitude that the bits and the DBC's range allow, symmetric about 0."""
        return min(self.maximum, -self.minimum) if self.minimum < 0 else self.maximum

    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw integer."""
        half = 1 << (self.length - 1)
        return (-half, half - 1) if self.signed else (0, 2 * half - 1)

    def to_phys(self, bits: int) -> float:
        """Physical value of the signal's bits."""
        if self.is_float:
            integer, real = _FLOATS[self.length]
            value = float(struct.unpack(real, struct.pack(integer, bits))[0])
        else:
            value = bits - (1 << self.length) if self.signed and bits >> (self.length - 1) else bits
        return value * self.scale + self.offset

    def to_bits(self, phys: float) -> int:
        """Bits of a physical value. Raises EncodeError for what is not finite or out of range."""
        if not math.isfinite(phys):
            raise EncodeError(f"{self.name}: {phys} can't be sent")
        value = (phys - self.offset) / self.scale
        if self.is_float:
            integer, real = _FLOATS[self.length]
            return int(struct.unpack(integer, struct.pack(real, value))[0])
        raw = round(value)
        low, high = self.raw_range()
        if not (low <= raw <= high):
            raise EncodeError(
                f"{self.name}: {phys} {self.unit} does not fit {low * self.scale + self.offset} .. "
                f"{high * self.scale + self.offset}"
            )
        return raw & ((1 << self.length) - 1)


class Message:
    """One message compiled: identifier, length, protection and signals."""

    def __init__(self, parsed: Any, can_id: int, where: str) -> None:
        self.name: str = parsed.name
        self.can_id = can_id
        self.length: int = parsed.length
        self.fd = bool(getattr(parsed, "is_fd", False)) or self.length > 8
        self.extended = bool(parsed.is_extended_frame)
        self.cycle_ms: int | None = parsed.cycle_time
        self.signals = {s.name: _signal(s, self.length, where, parsed) for s in parsed.signals}
        self.profile, self._ids = _protection(parsed, where)

    @property
    def counter_modulus(self) -> int:
        """Number of values of the frame counter."""
        return 16 if self.profile == 2 else 256

    def encode(self, values: Mapping[str, float]) -> bytes:
        """Encode; signals not given are 0. The CRC is filled in. Raises EncodeError."""
        little = big = 0
        for name, phys in values.items():
            signal = self.signals.get(name)
            if signal is None:
                raise EncodeError(f"{self.name} has no signal {name}")
            bits = signal.to_bits(phys) << signal.shift
            if signal.big_endian:
                big |= bits
            else:
                little |= bits
        data = bytearray(little.to_bytes(self.length, "little"))
        if big:
            for index, byte in enumerate(big.to_bytes(self.length, "big")):
                data[index] |= byte
        self.protect(data)
        return bytes(data)

    def protect(self, data: bytearray) -> None:
        """Fill in the CRC of the message's E2E profile."""
        if self.profile == 2:
            data[0] = crc_profile_2(bytes(data), self._ids)
        elif self.profile == 5:
            data[0:2] = crc_profile_5(bytes(data), int.from_bytes(self._ids, "big")).to_bytes(2, "little")

    def valid(self, data: bytes) -> bool:
        """True when the CRC fits; the length must fit already."""
        if self.profile == 2:
            return data[0] == crc_profile_2(data, self._ids)
        if self.profile == 5:
            return data[0] | data[1] << 8 == crc_profile_5(data, int.from_bytes(self._ids, "big"))
        return True

    def decode(self, data: bytes) -> dict[str, float]:
        """All signals as physical values. Raises DecodeError for a wrong length or CRC."""
        if len(data) != self.length:
            raise DecodeError(f"{self.name}: {len(data)} bytes instead of {self.length}")
        if not self.valid(data):
            raise DecodeError(f"{self.name}: wrong CRC")
        names = tuple(self.signals)
        return dict(zip(names, self.reader(*names)(data), strict=True))

    def reader(self, *names: str) -> Callable[[bytes], tuple[float, ...]]:
        """Return a fast function from a frame's bytes to the physical values of ``names``."""
        signals = [self.signals[name] for name in names]
        plan = [(s.big_endian, s.shift, (1 << s.length) - 1, s.to_phys) for s in signals]
        any_big = any(s.big_endian for s in signals)

        def read(data: bytes) -> tuple[float, ...]:
            little = int.from_bytes(data, "little")
            big = int.from_bytes(data, "big") if any_big else 0
            return tuple(phys((big if b else little) >> shift & mask) for b, shift, mask, phys in plan)

        return read


def _signal(parsed: Any, length: int, where: str, message: Any) -> Signal:
    """Compile one signal; multiplexed signals are refused, since a frame must apply whole."""
    if parsed.is_multiplexer or parsed.multiplexer_ids:
        raise DatabaseError(f"{where}: {message.name}.{parsed.name} is multiplexed; use a plain signal")
    big = parsed.byte_order == "big_endian"
    shift = parsed.start
    if big:
        from_top = (parsed.start // 8) * 8 + 7 - parsed.start % 8
        shift = 8 * length - from_top - parsed.length
    if parsed.is_float and parsed.length not in _FLOATS:
        raise DatabaseError(f"{where}: {message.name}.{parsed.name}: a float of {parsed.length} bits")
    scale, offset = float(parsed.scale), float(parsed.offset)
    half = 1 << (parsed.length - 1)
    low, high = (-half, half - 1) if parsed.is_signed else (0, 2 * half - 1)
    minimum = low * scale + offset if parsed.minimum is None else float(parsed.minimum)
    maximum = high * scale + offset if parsed.maximum is None else float(parsed.maximum)
    return Signal(
        parsed.name,
        shift,
        parsed.length,
        big,
        bool(parsed.is_signed),
        bool(parsed.is_float),
        scale,
        offset,
        minimum,
        maximum,
        parsed.unit or "",
    )


def _protection(parsed: Any, where: str) -> tuple[int, bytes]:
    """E2E profile and data ids from the message's attributes E2EProfile and E2EDataIDs (hex)."""
    attributes = parsed.dbc.attributes if parsed.dbc else {}
    profile = int(attributes["E2EProfile"].value) if "E2EProfile" in attributes else 0
    if profile == 0:
        return 0, b""
    expected = {2: 16, 5: 2}.get(profile)
    if expected is None:
        raise DatabaseError(f"{where}: {parsed.name}: E2EProfile {profile} is not one of 0, 2, 5")
    text = str(attributes["E2EDataIDs"].value) if "E2EDataIDs" in attributes else ""
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        ids = b""
    if len(ids) != expected:
        raise DatabaseError(
            f"{where}: {parsed.name}: E2EDataIDs must be {expected} bytes in hex for profile {profile}"
        )
    return profile, ids


class Database:
    """A DBC file compiled for one node: CANopen identifiers of the file's node 1 move to ``node_id``."""

    def __init__(self, path: Path, node_id: int = 1) -> None:
        self.path = path
        self.text = _read(path)
        try:
            parsed: Any = cantools.database.load_string(self.text, database_format="dbc", strict=True)
        except Exception as error:
            raise DatabaseError(f"{path}: is no usable DBC: {_first_line(error)}") from error
        self.messages = {
            m.name: Message(m, _shifted(m.frame_id, node_id), str(path)) for m in parsed.messages
        }

    def message(self, name: str, *signals: str) -> Message:
        """The message ``name``, which must have ``signals``. Raises DatabaseError."""
        found = self.messages.get(name)
        if found is None:
            raise DatabaseError(
                f"{self.path}: has no message {name}; it has {', '.join(sorted(self.messages))}"
            )
        for signal in signals:
            if signal not in found.signals:
                raise DatabaseError(
                    f"{self.path}: message {name} has no signal {signal}; it has {', '.join(found.signals)}"
                )
        return found


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_DBC_BYTES:
            raise DatabaseError(f"{path}: larger than {MAX_DBC_BYTES} bytes; this is no DBC")
        return path.read_text(encoding="cp1252")
    except (OSError, UnicodeDecodeError) as error:
        raise DatabaseError(f"{path}: can't be read: {error}") from error


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def _shifted(frame_id: int, node_id: int) -> int:
    """CANopen: the low seven bits are the node; 0 there (SYNC) is for all and stays."""
    if frame_id > 0x7FF or frame_id & _BROADCAST_TOP == 0:
        return frame_id
    return frame_id - 1 + node_id
