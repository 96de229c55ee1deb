"""Frames by a DBC file: cantools parses it, this module compiles each message once, at start.

A frame is applied whole or not at all; a value that does not fit raises.
"""

from __future__ import annotations

import copy
import logging
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import cantools

from drivers.compiled import Reader, Writer, make_protection, make_reader, make_writer
from drivers.errors import DatabaseError, DecodeError, EncodeError
from drivers.local import EFF_FLAG
from drivers.signal import Signal, compile_signal

MAX_DBC_BYTES = 4 << 20
FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
_NODE_BITS = 0x7F
logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of (messages twice) is refused here
_WRITERS_KEPT = 64


class Message:
    """One message compiled: identifier, length, protection and signals. Raises DatabaseError."""

    def __init__(self, parsed: Any, can_id: int, where: str) -> None:
        where = f"{where}: {parsed.name}"
        self.name: str = parsed.name
        self.can_id = can_id
        self.length: int = parsed.length
        self.extended = bool(parsed.is_extended_frame)
        self.cycle_ms = int(parsed.cycle_time or 0)
        self.fd = bool(getattr(parsed, "is_fd", False)) or self.length > 8
        if self.length not in FD_LENGTHS:
            raise DatabaseError(
                f"{where}: no CAN frame has {self.length} bytes; use 0..8, 12, 16, 20, 24, 32, 48, 64"
            )
        self.signals = _signals(parsed, self.length, where)
        self.profile, self.data_ids = _protection(parsed, where)
        if self.profile and self.length < 3:
            raise DatabaseError(f"{where}: {self.length} bytes leave no room for E2E profile {self.profile}")
        self.valid, self._protect = make_protection(self.profile, self.length, self.data_ids)
        self._writers: dict[tuple[str, ...], Writer] = {}

    def with_signals(self, signals: Mapping[str, Signal]) -> Message:
        """The same message with some signals in other units."""
        other = copy.copy(self)
        other.signals, other._writers = {**self.signals, **signals}, {}
        return other

    @property
    def send_id(self) -> int:
        """The identifier as it stands in a frame: extended ones carry SocketCAN's flag."""
        return self.can_id | (EFF_FLAG if self.extended else 0)

    @property
    def counter_modulus(self) -> int:
        """Number of values of the frame counter."""
        return 16 if self.profile == 2 else 256

    def encode(self, values: Mapping[str, float]) -> bytes:
        """Encode; signals not given are 0. The CRC is filled in. Raises EncodeError."""
        names = tuple(values)
        writer = self._writers.get(names)
        if writer is None:
            if len(self._writers) >= _WRITERS_KEPT:
                self._writers.clear()
            writer = self._writers[names] = self.writer(*names)
        return writer(*values.values())

    def writer(self, *names: str) -> Writer:
        """A fast function from physical values of ``names`` to the frame's bytes. Raises EncodeError."""
        signals = [self._known(name) for name in names]

        def refuse(*values: float) -> bytes:
            for signal, value in zip(signals, values, strict=True):
                signal.to_bits(value)
            raise EncodeError(f"{self.name}: {dict(zip(names, values, strict=True))} can't be sent")

        return make_writer(self.length, signals, self._protect, refuse)

    def _known(self, name: str) -> Signal:
        signal = self.signals.get(name)
        if signal is None:
            raise EncodeError(f"{self.name} has no signal {name}")
        return signal

    def protect(self, data: bytearray) -> None:
        """Fill in the CRC of the message's E2E profile."""
        data[:] = self._protect(bytes(data))

    def decode(self, data: bytes) -> dict[str, float]:
        """All signals as physical values. Raises DecodeError for a wrong length or CRC."""
        if len(data) != self.length:
            raise DecodeError(f"{self.name}: {len(data)} bytes instead of {self.length}")
        if not self.valid(data):
            raise DecodeError(f"{self.name}: wrong CRC")
        names = tuple(self.signals)
        return dict(zip(names, self.reader(*names)(data), strict=True))

    def reader(self, *names: str, whole: Collection[str] = ()) -> Reader:
        """A fast function from bytes of the right length to values of ``names``; ``whole`` ones as int."""
        return make_reader(self.length, [self.signals[name] for name in names], [n in whole for n in names])


def _signals(parsed: Any, length: int, where: str) -> dict[str, Signal]:
    """Compile the signals; a multiplexed message is refused, since a frame must apply whole."""
    for signal in parsed.signals:
        if signal.is_multiplexer or signal.multiplexer_ids:
            raise DatabaseError(f"{where}.{signal.name} is multiplexed; map a message of plain signals")
    return {signal.name: compile_signal(signal, length, where) for signal in parsed.signals}


def _protection(parsed: Any, where: str) -> tuple[int, bytes]:
    """E2E profile and data ids from the message's attributes E2EProfile and E2EDataIDs (hex)."""
    attributes = parsed.dbc.attributes if parsed.dbc else {}
    profile = int(attributes["E2EProfile"].value) if "E2EProfile" in attributes else 0
    if profile == 0:
        return 0, b""
    expected = {2: 16, 5: 2}.get(profile)
    if expected is None:
        raise DatabaseError(f"{where}: E2EProfile {profile} is not one of 0, 2, 5")
    text = str(attributes["E2EDataIDs"].value) if "E2EDataIDs" in attributes else ""
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        ids = b""
    if len(ids) != expected:
        raise DatabaseError(f"{where}: E2EDataIDs must be {expected} bytes in hex for profile {profile}")
    return profile, ids


class Database:
    """A DBC file compiled for one node: CANopen identifiers of the file's node 1 move to ``node_id``.

    A message that can't be used (multiplexed, odd floats) is an error only when it is asked for, since a
    third-party file holds many that no one maps. ``messages`` holds the usable ones.
    """

    def __init__(self, path: Path, node_id: int = 1) -> None:
        self.path = path
        self.text = _read(path)
        try:
            parsed: Any = cantools.database.load_string(self.text, database_format="dbc", strict=True)
        except Exception as error:
            raise DatabaseError(f"{path}: is no usable DBC: {_first_line(error)}") from error
        _refuse_twice(path, parsed.messages)
        self.messages: dict[str, Message] = {}
        self.unusable: dict[str, str] = {}
        for one in parsed.messages:
            try:
                self.messages[one.name] = Message(one, _identifier(one, node_id), str(path))
            except DatabaseError as error:
                self.unusable[one.name] = str(error)

    def message(self, name: str, *signals: str) -> Message:
        """The message ``name``, which must have ``signals``. Raises DatabaseError."""
        if name in self.unusable:
            raise DatabaseError(self.unusable[name])
        found = self.messages.get(name)
        if found is None:
            has = ", ".join(sorted(self.messages))
            raise DatabaseError(f"{self.path}: has no message {name}; it has {has}")
        for signal in signals:
            if signal not in found.signals:
                raise DatabaseError(
                    f"{self.path}: message {name} has no signal {signal}; it has {', '.join(found.signals)}"
                )
        return found

    def optional(self, name: str) -> Message | None:
        """The message ``name`` or None; one that is there and can't be used raises DatabaseError."""
        return self.message(name) if name in self.messages or name in self.unusable else None


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_DBC_BYTES:
            raise DatabaseError(f"{path}: larger than {MAX_DBC_BYTES} bytes; this is no DBC")
        return path.read_text(encoding="cp1252")
    except (OSError, UnicodeDecodeError) as error:
        raise DatabaseError(f"{path}: can't be read: {error}") from error


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def _refuse_twice(path: Path, parsed: Any) -> None:
    """A name or an identifier that two messages have says nothing certain. Raises DatabaseError."""
    names = Counter(one.name for one in parsed)
    ids = Counter((one.frame_id, one.is_extended_frame) for one in parsed)
    twice = [f"message {name} is there {count} times" for name, count in names.items() if count > 1]
    for (can_id, extended), count in ids.items():
        both = {one.name for one in parsed if (one.frame_id, one.is_extended_frame) == (can_id, extended)}
        if count > 1 and len(both) > 1:
            twice.append(f"identifier 0x{can_id:X} is that of {' and '.join(sorted(both))}")
    if twice:
        raise DatabaseError(f"{path}: {'; '.join(twice)}; leave one of each")


def _identifier(parsed: Any, node_id: int) -> int:
    """CANopen: the low seven of eleven bits are the node; 0 there (SYNC) is for all and stays."""
    frame_id = int(parsed.frame_id)
    if parsed.is_extended_frame or frame_id & _NODE_BITS == 0:
        return frame_id
    return frame_id - 1 + node_id
