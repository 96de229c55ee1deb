"""PEAK's TRC, versions 1.0 to 2.1, line by line.

Read here, since python-can 4.6.1 leaves out every error frame of a trace without a word.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from typing import Final

from hil.exchange.readers.recorded import (
    BUS_ERROR,
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    hexadecimal,
    identifier,
    nanoseconds,
)

COLUMNS: Final = {"1.0": "NOILD", "1.1": "NOdILD", "1.2": "NOBdILD", "1.3": "NOBdIRLD"}
"""Columns of the versions whose header does not name them: number, time, bus, direction, identifier, ..."""
_NO_FRAME: Final = frozenset(("ST", "EC", "EV", "Warng", "Warning"))
_FD_TYPES: Final = frozenset(("FD", "FB", "FE", "BI"))
_PROTOCOL: Final = 0x08
_KINDS: Final = {1: 1, 2: 2, 4: 4}
"""Bit, form and stuff error: PEAK's number and that of SocketCAN's third byte."""
_DAY_1970: Final = (datetime(1970, 1, 1, tzinfo=UTC) - datetime(1899, 12, 30, tzinfo=UTC)).days


class Reader:
    """What the header says, and the frames by its columns."""

    def __init__(self, found: Found) -> None:
        self._found, self._columns, self._start_ns = found, COLUMNS["1.0"], 0
        self._whole = False

    def read(self, lines: Iterable[str]) -> Iterator[Recorded]:
        """Frames of the lines. Raises NotThisFormatError when it is something else."""
        for number, line in enumerate(lines, start=1):
            text = line.strip()
            if not text or text.startswith(";"):
                self._head(text)
                continue
            self._found.places += 1
            if self._found.places == 1 and not re.match(r"\d+\)?\s+\d", text):
                raise NotThisFormatError(f"not a trace of PEAK: it begins with {text[:40]!r}")
            try:
                if (one := self._frame(text)) is not None:
                    yield one
            except UnreadableError as error:
                self._found.lose(f"line {number}", error)

    def _head(self, text: str) -> None:
        name, _, value = text.partition("=")
        if name == ";$FILEVERSION":
            self._columns = COLUMNS.get(value.strip(), self._columns)
        elif name == ";$COLUMNS":
            self._columns = value.replace(",", "").strip()
        elif name == ";$STARTTIME":
            try:
                days = Decimal(value.strip()) - _DAY_1970
                self._start_ns = max(0, round(days * 86_400_000_000)) * 1000
            except (InvalidOperation, ValueError, OverflowError):
                self._found.notes["start time that can't be read"] += 1

    def _frame(self, text: str) -> Recorded | None:
        """A line's frame; None for a state of the bus. Raises UnreadableError."""
        words = text.split(maxsplit=len(self._columns) - 1)
        of = dict(zip(self._columns, words, strict=False))
        kind = of.get("T", of.get("d", ""))
        if kind in _NO_FRAME or of.get("I") == "FFFFFFFF":
            return None
        if not {"N", "O", "I"} <= of.keys() or not {"L", "l"} & of.keys():
            raise UnreadableError(f"{text[:60]!r} is no frame")
        t_ns = self._start_ns + nanoseconds(of["O"], 6)
        bus, received = of.get("B", "1"), of.get("d", "Rx") != "Tx"
        if kind in ("ER", "Error"):
            return frame(t_ns, bus, *self._an_error(of.get("D", "")))
        remote = kind == "RR" or of.get("D", "")[:3].upper() == "RTR"
        fd = kind in _FD_TYPES
        data = bytes(self._length(of)) if remote else self._data(of, fd)
        number = re.fullmatch(r"([0-9A-Fa-f]{1,8})h?", of["I"])
        if number is None:
            raise UnreadableError(f"{of['I'][:20]!r} is no identifier")
        can_id = identifier(int(number[1], 16), extended=len(number[1]) > 4, remote=remote)
        return frame(t_ns, bus, can_id, received, fd, data)

    def _length(self, of: dict[str, str]) -> int:
        text = of.get("l", of.get("L", ""))
        if not text.isdigit():
            raise UnreadableError(f"{text[:20]!r} is no length")
        return min(int(text), 8)

    def _data(self, of: dict[str, str], fd: bool) -> bytes:
        """Data; a length in bytes (l, and L of version 1) or a DLC (L of version 2) must agree with them."""
        data, text = hexadecimal(of.get("D", "")), of.get("l", of.get("L", ""))
        if not text.isdigit():
            raise UnreadableError(f"{text[:20]!r} is no length")
        size = int(text)
        if "l" not in of and size > 8:
            size = (12, 16, 20, 24, 32, 48, 64)[min(size, 15) - 9] if fd else 8
        if len(data) != size:
            raise UnreadableError(f"{len(data)} of {size} bytes are there")
        return data

    def _an_error(self, text: str) -> tuple[int, bool, bool, bytes]:
        """Class, direction, format and data as SocketCAN has them: kind of the error and the two counters."""
        raw = hexadecimal(text)
        told = bytearray(8)
        if len(raw) >= 4:
            told[2] = _KINDS.get(raw[0], 0)
            told[6], told[7] = raw[-1], raw[-2]
        return identifier(BUS_ERROR | _PROTOCOL, extended=False, error=True), True, False, bytes(told)


def read(lines: Iterable[str], found: Found) -> Iterator[Recorded]:
    """Frames of the lines. Raises NotThisFormatError when it is something else."""
    return Reader(found).read(lines)
