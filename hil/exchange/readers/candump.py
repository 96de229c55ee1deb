"""can-utils' log format (``candump -l`` and ``-L``), line by line.

Read here, since python-can 4.6.1 knows an error frame by its class's bit 0x80 alone, and then drops its
class, its data and its channel; any other error frame it takes for a data frame, which a player would send.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

from hil.exchange.readers.recorded import (
    ERROR,
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    hexadecimal,
    identifier,
    nanoseconds,
)

_LINE: Final = re.compile(
    r"\(([^()\s]*)\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)(?:\s+([RTrt])(?:X|x)?(?:\s+[-BE]\s*[-BE])?)?"
)
_RAW_DLC: Final = re.compile(r"_([9A-Fa-f])$")
_SCREEN: Final = re.compile(r"(\([^()]*\)\s+)?\S+\s+(?:[RT]X\s+\S\s+\S\s+)?[0-9A-F]{3,8}\s+\[\d+\]")
OTHERS: Final = (
    (re.compile(r"\*+\s*BUSMASTER"), "a log of BUSMASTER"),
    (_SCREEN, "what candump prints on the screen"),
    (re.compile(r"date\s|base\s+(hex|dec)", re.IGNORECASE), "an ASC file: name it .asc"),
    (re.compile(r";\$FILEVERSION"), "a trace of PEAK: name it .trc"),
)
"""What else is met under the ending .log."""


def read(lines: Iterable[str], found: Found) -> Iterator[Recorded]:
    """Frames of the lines. Raises NotThisFormatError when it is something else."""
    directed, sizes = False, dict[int, int]()
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        found.places += 1
        if found.places == 1:
            _check(text)
        try:
            one, direction = _frame(text, found)
            if not line.endswith("\n") and (
                (directed and not direction) or len(one.data) < sizes.get(one.can_id, 0)
            ):
                raise UnreadableError("the last line is cut off")
        except UnreadableError as error:
            found.lose(f"line {number}", error)
            continue
        directed, sizes[one.can_id] = directed or direction, len(one.data)
        yield one


def _check(text: str) -> None:
    """Raise NotThisFormatError for the first line of another format."""
    for looks, what in OTHERS:
        if looks.match(text):
            raise NotThisFormatError(f"not a candump -l log but {what}; record with candump -l")
    if not text.startswith("("):
        raise NotThisFormatError(f"not a candump -l log: it begins {text[:40]!r}; record with candump -l")


def _frame(text: str, found: Found) -> tuple[Recorded, bool]:
    """A line's frame, and whether it says the direction. Raises UnreadableError."""
    parts = _LINE.fullmatch(text)
    if parts is None:
        raise UnreadableError(f"{text[:60]!r} is no line of candump -l")
    stamp, channel, number, body, way = parts.groups()
    value = int(number, 16)
    error, fd, remote = len(number) == 8 and bool(value & ERROR), body[:1] == "#", body[:1] in ("R", "r")
    can_id = identifier(
        value ^ ERROR if error else value, extended=len(number) == 8, remote=remote, error=error
    )
    if (error and (fd or remote)) or (fd and body[1:2].upper() not in [*"0123456789ABCDEF"]):
        raise UnreadableError(f"{text[:60]!r} is no line of candump -l")
    plain = _RAW_DLC.sub("", body)
    if plain != body:
        found.notes["frames with a raw DLC over 8, of which their 8 bytes are kept"] += 1
    data = bytes(_asked(plain[1:])) if remote else hexadecimal(plain[2 if fd else 0 :].replace(".", ""))
    if len(data) > 8 and not fd:
        found.notes["frames longer than 8 bytes without the flag of CAN FD, taken as CAN FD"] += 1
    received = way is None or way in "Rr"
    return frame(nanoseconds(stamp), channel, can_id, received, fd, data), way is not None


def _asked(text: str) -> int:
    """How many bytes a remote frame asks for."""
    if text not in [*"", "", *"012345678"]:
        raise UnreadableError(f"R{text[:20]} asks for no length")
    return int(text or 0)
