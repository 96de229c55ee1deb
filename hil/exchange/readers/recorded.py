"""A frame as another tool recorded it, and what its reader found besides: what is unreadable or missing."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime
from typing import Final, NamedTuple

EXTENDED, REMOTE, ERROR, ID_MASK = 0x80000000, 0x40000000, 0x20000000, 0x1FFFFFFF
NOT_DATA: Final = REMOTE | ERROR
"""A frame with one of these bits carries no data for a drive, whatever its identifier reads like."""
BUS_ERROR: Final = 0x80
"""SocketCAN's error class for an error frame of which a format keeps no more than that it was there."""
FD_SIZES: Final = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
LATEST_NS: Final = 2**62
"""Stamps from 1970 to the year 2116 fit below, with room for what is added to them."""


class Recorded(NamedTuple):
    """One frame; ``t_ns`` since 1970, or since the logger's start where it has no clock.

    ``can_id`` carries SocketCAN's flag bits; ``data`` of a remote frame are as many zeros as it asks for.
    """

    t_ns: int
    channel: str
    can_id: int
    received: bool
    fd: bool
    data: bytes


class UnreadableError(ValueError):
    """A line or an object is no frame that a bus can carry; the message says why."""


class NotThisFormatError(ValueError):
    """The file is something else altogether; the message says what."""


@dataclass(slots=True)
class Found:
    """What a reader found besides frames. ``lost``: places that can't be read, of ``places`` in all."""

    unit: str = "lines"
    places: int = 0
    lost: int = 0
    first_lost: str = ""
    cut: str = ""
    notes: Counter[str] = field(default_factory=Counter)

    def lose(self, where: str, why: object) -> None:
        """A place that can't be read."""
        self.lost += 1
        self.first_lost = self.first_lost or f"{where}: {why}"

    @property
    def damage(self) -> str | None:
        """How much is missing and where, in words; None for a whole recording."""
        lost = (
            f"{self.lost} of {self.places} {self.unit} can't be read ({self.first_lost})" if self.lost else ""
        )
        return "; ".join(filter(None, (lost, self.cut))) or None


def identifier(number: int, *, extended: bool, remote: bool = False, error: bool = False) -> int:
    """Identifier with SocketCAN's flags; an error frame has its class alone. Raises UnreadableError."""
    if not 0 <= number <= (ID_MASK if extended or error else 0x7FF):
        raise UnreadableError(f"{number:X} is no {'29' if extended else '11'}-bit identifier")
    if error:
        return number | ERROR
    return number | (EXTENDED if extended else 0) | (REMOTE if remote else 0)


def frame(t_ns: int, channel: str, can_id: int, received: bool, fd: bool, data: bytes) -> Recorded:
    """A frame that a bus can carry. Raises UnreadableError for a stamp or a length that is none.

    A length that CAN FD alone has makes a CAN FD frame, for recorders that do not write the flag.
    """
    if not 0 <= t_ns < LATEST_NS:
        raise UnreadableError(f"the stamp {t_ns * 1e-9:g} s is no time")
    if len(data) not in FD_SIZES or (len(data) > 8 and can_id & NOT_DATA):
        raise UnreadableError(f"no frame holds {len(data)} bytes")
    return Recorded(t_ns, channel, can_id, received, fd or len(data) > 8, data)


_DECIMAL: Final = re.compile(r"(\d{1,12})(?:[.,](\d+))?")


def nanoseconds(text: str, unit_digits: int = 9) -> int:
    """A decimal number of seconds in ns, exactly; of ms with ``unit_digits`` 6. Raises UnreadableError."""
    found = _DECIMAL.fullmatch(text)
    if found is None:
        raise UnreadableError(f"the stamp {text[:40]!r} is no time")
    fraction = (found[2] or "")[:unit_digits].ljust(unit_digits, "0")
    return int(found[1] + fraction)


def hexadecimal(text: str) -> bytes:
    """Bytes of hexadecimal digits, blanks between them or not. Raises UnreadableError."""
    try:
        return bytes.fromhex(text)
    except ValueError as error:
        raise UnreadableError(f"{text[:40]!r} are no bytes") from error


_MONTHS: Final = (
    ("jan",), ("feb",), ("mar", "mär", "mrz"), ("apr",), ("may", "mai"), ("jun",),
    ("jul",), ("aug",), ("sep",), ("oct", "okt"), ("nov",), ("dec", "dez"),
)  # fmt: skip
_MONTH: Final = {name: number for number, names in enumerate(_MONTHS, start=1) for name in names}
_DATE: Final = re.compile(
    r"\w+\.?\s+(?P<month>\w+)\.?\s+(?P<day>\d+)\s+(?P<h>\d+):(?P<m>\d+):(?P<s>\d+)(?:\.(?P<ms>\d+))?"
    r"\s*(?P<half>[ap]m)?\s+(?P<year>\d{4})",
    re.IGNORECASE,
)


def local_date_ns(text: str) -> int | None:
    """``Fri Nov 27 08:26:00.045 am 2026``, local time, English or German, in ns since 1970, or None."""
    found = _DATE.match(text)
    month = _MONTH.get(found["month"].lower()) if found else None
    if found is None or month is None:
        return None
    hour = int(found["h"])
    if found["half"]:
        hour = hour % 12 + 12 * (found["half"].lower() == "pm")
    try:
        date = datetime(int(found["year"]), month, int(found["day"]), hour, int(found["m"]), int(found["s"]))
    except ValueError:
        return None
    fraction = int((found["ms"] or "0")[:9].ljust(9, "0"))
    return int(date.astimezone().timestamp()) * 1_000_000_000 + fraction
