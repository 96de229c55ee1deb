"""Vector's ASC, line by line: times absolute or relative, what was sent apart from what was only asked for.

Read here, since python-can 4.6.1 takes relative times for absolute ones, a transmit request (TxRq) for a
second frame, and an empty CAN FD frame for a remote one. The distances of relative times run from line to
line, of whatever kind. Where a comment of our own export says an error's class and the start to the
microsecond, they are taken from there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from hil.exchange.readers.recorded import (
    BUS_ERROR,
    ERROR,
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    hexadecimal,
    identifier,
    local_date_ns,
    nanoseconds,
)

ERROR_COMMENT: Final = "// error frame "
START_COMMENT: Final = "// first frame at "
_HEAD: Final = re.compile(r"(date|base|begin\s+triggerblock|end\s+triggerblock|//|(no\s+)?internal)", re.I)
_BASE: Final = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.I)
_DATE: Final = re.compile(r"(?:date|begin\s+triggerblock)\s+(.+)", re.I)
_STAMPED: Final = re.compile(r"(-?\d+[.,]\d+)\s+(.*)")
_CLASSIC: Final = re.compile(r"(\d+)\s+(\S+)\s+(Rx|TxRq|Tx)\s+([dr])\b\s*(.*)", re.I)
_LIKE_CLASSIC: Final = re.compile(r"\d+\s+\S+\s+(Rx|Tx)", re.I)
_ERROR: Final = re.compile(r"(?:CANFD\s+)?(\d+)\s+(?:(?:Rx|Tx)\s+)?ErrorFrame\b", re.I)
_FD: Final = re.compile(
    r"CANFD\s+(\d+)\s+(Rx|TxRq|Tx)\s+(\S+)\s+(?:[^\s01]\S*\s+|[01]\S+\s+)?([01])\s+([01])\s+([0-9a-f])\s+(\d+)\b(.*)",
    re.I,
)
_FD_FORMAT, _FD_REMOTE = 0x1000, 0x10


class _Line(NamedTuple):
    """A frame's line without its time."""

    channel: str
    can_id: int
    way: str
    fd: bool
    data: bytes


class Reader:
    """What the lines so far have said."""

    def __init__(self, found: Found) -> None:
        self._found = found
        self._base, self._relative, self._headed = 16, False, False
        self._start_ns: int | None = None
        self._exact = self._opened = self._closed = False
        self._t_ns = 0
        self._error = ""

    def read(self, lines: Iterable[str]) -> Iterator[Recorded]:
        """Frames of the lines. Raises NotThisFormatError when it is something else."""
        line = "\n"
        for number, line in enumerate(lines, start=1):
            text = line.strip()
            if text:
                self._found.places += 1
                try:
                    yield from self._take(text)
                except UnreadableError as error:
                    self._found.lose(f"line {number}", error)
        if not self._closed and not line.endswith("\n"):
            self._found.cut = "the file ends in the middle of a line, before its End TriggerBlock"
        elif self._opened and not self._closed:
            self._found.notes["Begin TriggerBlock without its end: the file may be cut off"] += 1

    def _take(self, text: str) -> Iterator[Recorded]:
        stamped = _STAMPED.match(text)
        if stamped is None:
            self._head(text)
            return
        if not self._headed:
            raise NotThisFormatError("not an ASC file: it has no line 'base hex' or 'base dec'")
        stamp_ns = nanoseconds(stamped[1])
        self._t_ns = self._t_ns + stamp_ns if self._relative else stamp_ns
        one = self._frame(stamped[2])
        if one is None:
            return
        if one.way.lower() == "txrq":
            self._found.notes["transmit requests (TxRq) left out: what was sent is there as Tx"] += 1
            return
        t_ns = (self._start_ns or 0) + self._t_ns
        yield frame(t_ns, one.channel, one.can_id, one.way.lower() != "tx", one.fd, one.data)

    def _head(self, text: str) -> None:
        """A line without a time: what it says of those that have one."""
        if base := _BASE.match(text):
            self._base = 16 if base[1].lower() == "hex" else 10
            self._relative = (base[2] or "").lower() == "relative"
            self._headed = True
        elif (date := _DATE.match(text)) and not self._exact:
            start_ns = local_date_ns(date[1])
            if start_ns is None and self._start_ns is None:
                self._found.notes[f"date that can't be read: {date[1][:40]!r}"] += 1
            self._start_ns = start_ns if start_ns is not None else self._start_ns
        elif text.startswith(START_COMMENT):
            self._start_ns, self._exact = nanoseconds(text[len(START_COMMENT) :].split()[0]), True
        elif text.startswith(ERROR_COMMENT):
            self._error = text[len(ERROR_COMMENT) :]
        elif not text.isprintable() and not _HEAD.match(text):
            raise UnreadableError("no text")
        low = text.lower()
        self._opened = self._opened or low.startswith("begin trigger")
        self._closed = self._closed or low.startswith("end trigger")

    def _frame(self, text: str) -> _Line | None:
        """What follows a time; None for any other event. Raises UnreadableError."""
        if found := _ERROR.match(text):
            return self._an_error(_channel(found[1]))
        if text[:5].lower() == "canfd":
            return self._fd(text)
        if found := _CLASSIC.match(text):
            return self._classic(*found.groups())
        if _LIKE_CLASSIC.match(text):
            raise UnreadableError(f"{text[:60]!r} is no frame")
        return None

    def _an_error(self, channel: str) -> _Line:
        text, self._error = self._error, ""
        number, _, data = text.partition("#")
        known = re.fullmatch(r"2[0-9A-F]{7}", number) is not None
        can_id = int(number, 16) if known else ERROR | BUS_ERROR
        return _Line(channel, can_id, "Rx", False, hexadecimal(data) if known else bytes(8))

    def _classic(self, channel: str, number: str, way: str, kind: str, rest: str) -> _Line:
        words = rest.split()
        remote = kind.lower() == "r"
        length = min(self._int(words[0]), 8) if words and (not remote or words[0].isalnum()) else 0
        if not remote and not words:
            raise UnreadableError("it has no length")
        data = bytes(length) if remote else self._bytes(words[1 : 1 + length], length)
        return _Line(_channel(channel), self._identifier(number, remote), way, False, data)

    def _fd(self, text: str) -> _Line:
        found = _FD.match(text)
        if found is None:
            raise UnreadableError(f"{text[:60]!r} is no frame")
        channel, way, number, _, _, dlc, length, rest = found.groups()
        size, words = int(length), rest.split()
        tail = words[size + 2 : size + 3]
        flags = int(tail[0], 16) if tail and re.fullmatch(r"[0-9A-Fa-f]+", tail[0]) else None
        remote = size == 0 and dlc != "0" if flags is None else bool(flags & _FD_REMOTE)
        fd = not remote and (flags is None or bool(flags & _FD_FORMAT))
        data = bytes(min(int(dlc, 16), 8)) if remote else self._bytes(words[:size], size)
        return _Line(_channel(channel), self._identifier(number, remote), way, fd, data)

    def _identifier(self, text: str, remote: bool) -> int:
        extended = text[-1:] in "xX"
        return identifier(self._int(text[:-1] if extended else text), extended=extended, remote=remote)

    def _bytes(self, words: list[str], size: int) -> bytes:
        if len(words) < size:
            raise UnreadableError(f"{len(words)} of {size} bytes are there")
        values = [self._int(word) for word in words]
        return bytes(values) if max(values, default=0) < 256 else hexadecimal("?")

    def _int(self, text: str) -> int:
        try:
            return int(text, self._base)
        except ValueError as error:
            raise UnreadableError(f"{text[:40]!r} is no number of base {self._base}") from error


def _channel(text: str) -> str:
    """Counted from 0, as python-can does and as the channels of a BLF file are."""
    return str(int(text) - 1)


def read(lines: Iterable[str], found: Found) -> Iterator[Recorded]:
    """Frames of the lines. Raises NotThisFormatError when it is something else."""
    return Reader(found).read(lines)
