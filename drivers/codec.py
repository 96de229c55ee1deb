"""Frames by a DBC file: cantools parses it, this module makes a message of each once it is asked for.

A frame is applied whole or not at all; a value that does not fit raises.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from drivers.dbc import Block, Parsed, Statements, parse, read_text
from drivers.e2e import crc_of
from drivers.errors import DatabaseError, DecodeError, EncodeError
from drivers.local import EFF_FLAG
from drivers.node import NodeRule
from drivers.signal import Signal, compile_signal

STANDARD_MOST: Final = 0x7FF
FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
CRC_BYTES: Final = {0: 0, 2: 1, 5: 2}
"""Bytes at the begin of a frame that its E2E profile fills in."""
logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of (messages twice) is refused here
_NAMES_SHOWN = 30
Reader = Callable[[bytes], tuple[float, ...]]


class Message:
    """One message compiled: identifier, length, protection and signals. Raises DatabaseError.

    ``odd``: why a signal can't be used, by its name. ``behind``: multiplexer and values of those that are in
    some frames only. ``start``: raw start values of those that the DBC gives one. ``fixed``: the identifier
    is no one's that a node id moves.
    """

    def __init__(self, block: Block, statements: Statements, node: NodeRule, path: str) -> None:
        where, raw_id = f"{path}: {block.name}", block.raw_id
        parsed = parse(block, where)
        self.name = block.name
        self.extended = bool(raw_id & EFF_FLAG)
        self.can_id, self.fixed = node.moved(raw_id & ~EFF_FLAG, self.extended)
        self.extended = self.extended or self.can_id > STANDARD_MOST
        self.length = int(parsed.message.length)
        self.cycle_ms = max(statements.number("GenMsgCycleTime", raw_id) or 0.0, 0.0)
        self.fd = statements.is_fd(raw_id) or self.length > 8
        if self.length not in FD_LENGTHS:
            raise DatabaseError(
                f"{where}: no CAN frame has {self.length} bytes; use 0..8, 12, 16, 20, 24, 32, 48, 64"
            )
        self.signals, self.odd, self.behind = _signals(parsed, self.length, where, statements, raw_id)
        self.start = _starts(parsed, statements, raw_id)
        self.unwatched = statements.attribute("Unwatched", raw_id) or ""
        """Why a drive that is commanded by it does not miss its master; empty where it does."""
        self.set_by = statements.attribute("SetBy", raw_id) or ""
        """The drive's own parameter of how often it sends it [ms]."""
        self.profile, self.data_ids = _protection(statements, raw_id, where)
        if self.profile and self.length < 3:
            raise DatabaseError(f"{where}: {self.length} bytes leave no room for E2E profile {self.profile}")

    def with_signals(self, signals: Mapping[str, Signal]) -> Message:
        """The same message with some signals in other units."""
        other = copy.copy(self)
        other.signals = {**self.signals, **signals}
        return other

    def sent_every(self, cycle_ms: float) -> Message:
        """The same message with another cycle time than the DBC's."""
        other = copy.copy(self)
        other.cycle_ms = cycle_ms
        return other

    @property
    def send_id(self) -> int:
        """The identifier as it stands in a frame: extended ones carry SocketCAN's flag."""
        return self.can_id | (EFF_FLAG if self.extended else 0)

    @property
    def counter_modulus(self) -> int:
        """Number of values of the house protocol's frame counter, which begins at 0."""
        counter = self.signals.get("Counter")
        return counter.raw_range()[1] + 1 if counter else 16 if self.profile == 2 else 256

    def encode(self, values: Mapping[str, float], under: bytes = b"") -> bytes:
        """Encode; bits of signals not given are those of ``under``, or 0. Raises EncodeError.

        The CRC is filled in.
        """
        frame = int.from_bytes(under, "little")
        for name, value in values.items():
            signal = self._known(name)
            frame |= signal.placed(signal.to_bits(value), self.length)
        return self._protected(frame.to_bytes(self.length, "little"))

    def _known(self, name: str) -> Signal:
        signal = self.signals.get(name)
        if signal is None:
            raise EncodeError(f"{self.name} has no signal {name}")
        return signal

    def valid(self, data: bytes) -> bool:
        """Is the CRC of a frame of the right length right?"""
        size = CRC_BYTES[self.profile]
        return not size or data[:size] == crc_of(self.profile, data, self.data_ids)

    def protect(self, data: bytearray) -> None:
        """Fill in the CRC of the message's E2E profile."""
        data[:] = self._protected(bytes(data))

    def _protected(self, data: bytes) -> bytes:
        size = CRC_BYTES[self.profile]
        return crc_of(self.profile, data, self.data_ids) + data[size:] if size else data

    def decode(self, data: bytes) -> dict[str, float]:
        """All signals of this frame as physical values. Raises DecodeError for a wrong length or CRC."""
        if len(data) != self.length:
            raise DecodeError(f"{self.name}: {len(data)} bytes instead of {self.length}")
        if not self.valid(data):
            raise DecodeError(f"{self.name}: wrong CRC")
        values = {name: signal.of_frame(data) for name, signal in self.signals.items()}
        if not self.behind:
            return values
        return {name: value for name, value in values.items() if self._has(name, values)}

    def _has(self, name: str, values: Mapping[str, float]) -> bool:
        """Is a signal in the frame whose multiplexers have these values?"""
        selector, wanted = self.behind.get(name, ("", ()))
        return not selector or values.get(selector) in wanted

    def reader(self, *names: str) -> Reader:
        """A function from bytes of the right length to the values of ``names``."""
        signals = [self.signals[name] for name in names]
        return lambda data: tuple(signal.of_frame(data) for signal in signals)


def _signals(
    parsed: Parsed, length: int, where: str, statements: Statements, raw_id: int
) -> tuple[dict[str, Signal], dict[str, str], dict[str, tuple[str, frozenset[int]]]]:
    """(usable signals, why the others are not, those that are in some frames only)."""
    usable: dict[str, Signal] = {}
    odd: dict[str, str] = {}
    behind: dict[str, tuple[str, frozenset[int]]] = {}
    long = {one.name: _long(one.name, statements, raw_id) for one in parsed.message.signals}
    for one in parsed.message.signals:
        name = long[one.name]
        try:
            selector = _selector(one, parsed, f"{where}.{name}")
            if name in usable:
                raise DatabaseError(f"{where}.{name} is there more than once; leave one")
            usable[name] = compile_signal(one, name, length, where)
            if selector:
                behind[name] = long[selector], frozenset(one.multiplexer_ids)
        except DatabaseError as error:
            odd[name] = str(error)
            usable.pop(name, None)
    return usable, odd, behind


def _long(name: str, statements: Statements, raw_id: int) -> str:
    """The name of a signal, which stands in an attribute when it is over 32 characters long."""
    return statements.attribute("SystemSignalLongSymbol", raw_id, name, default=False) or name


def _selector(one: Any, parsed: Parsed, where: str) -> str:
    """The multiplexer of a signal, empty for none. Raises DatabaseError for one behind another."""
    mark = parsed.marks.get(one.name, "M")
    if mark == "M":
        return ""
    selector = one.multiplexer_signal
    if not one.multiplexer_ids or selector is None or parsed.marks.get(selector) != "M" or mark.endswith("M"):
        raise DatabaseError(
            f"{where} is multiplexed by more than one value; map one behind a single multiplexer"
        )
    return str(selector)


def _starts(parsed: Parsed, statements: Statements, raw_id: int) -> dict[str, float]:
    """Raw start value of each signal by GenSigStartValue: its own, or the file's where that is not 0.

    That default stands in nearly every file as 0 and then says nothing about the signal.
    """
    out = {}
    for one in parsed.message.signals:
        own = statements.number("GenSigStartValue", raw_id, one.name, default=False)
        value = own if own is not None else statements.number("GenSigStartValue", raw_id, one.name)
        if own is not None or value:
            out[_long(one.name, statements, raw_id)] = value or 0.0
    return out


def _protection(statements: Statements, raw_id: int, where: str) -> tuple[int, bytes]:
    """E2E profile and data ids from the message's attributes E2EProfile and E2EDataIDs (hex)."""
    text = statements.attribute("E2EProfile", raw_id) or ""
    found = re.fullmatch(r"(?:e2e)?[ _]*(?:p|profile)?[ _]*0*(\d+)(?:\.0*)?", text.lower())
    profile = 0 if text.lower() in ("", "none", "no", "off") else int(found[1]) if found else -1
    if profile == 0:
        return 0, b""
    expected = {2: 16, 5: 2}.get(profile)
    if expected is None:
        raise DatabaseError(f"{where}: E2EProfile {text} is not one of 0, 2, 5")
    try:
        ids = bytes.fromhex(statements.attribute("E2EDataIDs", raw_id) or "")
    except ValueError:
        ids = b""
    if len(ids) != expected:
        raise DatabaseError(f"{where}: E2EDataIDs must be {expected} bytes in hex for profile {profile}")
    return profile, ids


class Messages(Mapping[str, Message]):
    """The usable messages of a database by name, each compiled once it is asked for."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def __getitem__(self, name: str) -> Message:
        try:
            return self._database.message(name)
        except DatabaseError as error:
            raise KeyError(name) from error

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._database.names if self._usable(name))

    def _usable(self, name: str) -> bool:
        try:
            self._database.message(name)
        except DatabaseError:
            return False
        return True

    def __len__(self) -> int:
        return sum(1 for _ in self)


class Database:
    """A DBC file for one node: CANopen identifiers of the file's node 1 move to ``node_id``, or by ``rule``.

    A message that can't be used (odd floats, its identifier twice) is an error only when it is asked for,
    since a third-party file holds many that no one maps. ``messages`` holds the usable ones.
    """

    def __init__(self, path: Path, node_id: int = 1, rule: str = "", text: str | None = None) -> None:
        """``text``: what the file holds, where it is known; then ``path`` is but a name in messages."""
        self.path, self.node = path, NodeRule(node_id, rule)
        self.text = read_text(path) if text is None else text
        self._statements = Statements(self.text)
        self._compiled: dict[str, Message | DatabaseError] = {}
        self._names: dict[int, list[str]] = {}
        if not self.names:
            raise DatabaseError(f"{path}: is no usable DBC: there is no message in it")
        for name, blocks in self._statements.blocks.items():
            for block in blocks:
                self._names.setdefault(block.raw_id, []).append(name)
        self.messages: Mapping[str, Message] = Messages(self)

    @property
    def names(self) -> Iterable[str]:
        """Names of all messages of the file."""
        return self._statements.blocks.keys()

    @cached_property
    def by_id(self) -> dict[int, str]:
        """Name by identifier as it stands in a frame; where two meet after moving the first counts."""
        out: dict[int, str] = {}
        for raw_id, names in self._names.items():
            extended = raw_id & EFF_FLAG
            with contextlib.suppress(DatabaseError):  # one that the rule does not fit is none of this drive's
                moved = self.node.moved(raw_id & ~EFF_FLAG, bool(extended))[0]
                out.setdefault(moved | (EFF_FLAG if moved > STANDARD_MOST else extended), names[0])
        return out

    def of_frame(self, send_id: int) -> Message | None:
        """The message of an identifier as it stands in a frame, None when there is none that can be used."""
        name = self.by_id.get(send_id)
        return self.messages.get(name) if name else None

    def message(self, name: str, *signals: str) -> Message:
        """The message ``name``, which must have ``signals``. Raises DatabaseError."""
        if name not in self._compiled:
            self._compiled[name] = self._compile(name)
        found = self._compiled[name]
        if isinstance(found, DatabaseError):
            raise DatabaseError(str(found))
        for signal in signals:
            if signal in found.odd:
                raise DatabaseError(found.odd[signal])
            if signal not in found.signals:
                raise DatabaseError(
                    f"{self.path}: message {name} has no signal {signal}; it has {', '.join(found.signals)}"
                )
        return found

    def _compile(self, name: str) -> Message | DatabaseError:
        blocks = self._statements.blocks.get(name, [])
        try:
            if not blocks:
                return DatabaseError(f"{self.path}: has no message {name}; it has {_shown(self.names)}")
            self._refuse_twice(name, blocks)
            return Message(blocks[0], self._statements, self.node, str(self.path))
        except DatabaseError as error:
            return error

    def _refuse_twice(self, name: str, blocks: list[Block]) -> None:
        """A name or an identifier that two messages have says nothing certain. Raises DatabaseError."""
        if len(blocks) > 1:
            raise DatabaseError(
                f"{self.path}: message {name} is there {len(blocks)} times; leave one of each"
            )
        raw_id = blocks[0].raw_id
        if len(both := self._names[raw_id]) > 1:
            who = " and ".join(sorted(both))
            raise DatabaseError(
                f"{self.path}: identifier 0x{raw_id & ~EFF_FLAG:X} is that of {who}; leave one of each"
            )

    def optional(self, name: str) -> Message | None:
        """The message ``name`` or None; one that is there and can't be used raises DatabaseError."""
        return self.message(name) if name in self.names else None


def _shown(names: Iterable[str]) -> str:
    """Names in their order, the first of many."""
    known = sorted(names)
    more = f" and {len(known) - _NAMES_SHOWN} more" if len(known) > _NAMES_SHOWN else ""
    return ", ".join(known[:_NAMES_SHOWN]) + more
