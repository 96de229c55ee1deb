"""What python-can reads well, its own CSV and SQLite; and how its messages become frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import can

from hil.exchange.readers.recorded import (
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    identifier,
)


def of_messages(messages: Iterable[Any], found: Found) -> Iterator[Recorded]:
    """python-can's messages as frames; one that no bus can carry is counted as lost."""
    found.unit = "frames"
    for message in messages:
        found.places += 1
        try:
            yield of_message(message)
        except UnreadableError as error:
            found.lose(f"frame {found.places}", error)


def of_message(message: Any) -> Recorded:
    """A message as a frame. Raises UnreadableError."""
    remote, error = message.is_remote_frame and not message.is_error_frame, message.is_error_frame
    can_id = identifier(message.arbitration_id, extended=message.is_extended_id, remote=remote, error=error)
    data = bytes(min(message.dlc, 8)) if remote else bytes(message.data)
    fd = bool(message.is_fd) and not (remote or error)
    return frame(stamp_ns(message.timestamp), str(message.channel), can_id, bool(message.is_rx), fd, data)


def stamp_ns(seconds: float) -> int:
    """A stamp [s] in ns, to the microsecond, which is what a float of today's date resolves.

    Raises UnreadableError. One before a file's own start is negative.
    """
    if not math.isfinite(seconds) or not -4e9 < seconds < 4e9:
        raise UnreadableError(f"the stamp {seconds:g} s is no time")
    return round(seconds * 1e6) * 1000


def read_table(path: Path, found: Found) -> Iterator[Recorded]:
    """Frames of python-can's own CSV or SQLite file."""
    try:
        with can.LogReader(path) as reader:
            yield from of_messages(reader, found)
    except Exception as error:
        if not found.places:
            raise NotThisFormatError(f"not a recording of python-can: {error}") from error
        found.cut = f"the rest can't be read after frame {found.places}: {error or type(error).__name__}"
