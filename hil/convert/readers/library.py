"""What python-can reads well: BLF, its own CSV and SQLite; here the flags, and whether a file is cut off."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, cast

import can
from can.io.blf import BLFParseError

from hil.convert.readers.recorded import (
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    identifier,
)

_HEADER: Final = struct.Struct("<4sL8BQ")
_OBJECT: Final = struct.Struct("<4sHHLL")


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


def read_blf(file: IO[bytes], found: Found) -> Iterator[Recorded]:
    """Frames of a BLF file, up to where it can be read. Raises NotThisFormatError."""
    found.cut = missing_of_blf(file)
    file.seek(0)
    try:
        yield from of_messages(can.BLFReader(cast("BinaryIO", file)), found)
    except (BLFParseError, struct.error, ValueError, OverflowError, MemoryError) as error:
        left = found.cut or f"the rest can't be read: {error or type(error).__name__}"
        found.cut = f"after frame {found.places}: {left}"


def missing_of_blf(file: IO[bytes]) -> str:
    """What a BLF file lacks by its own header and by the sizes of its objects, in words; empty for none.

    python-can 4.6.1 ends quietly where the bytes end. Raises NotThisFormatError.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size or head[:4] != b"LOGG":
        raise NotThisFormatError("empty" if not size else f"not a BLF file: it begins with {head[:4]!r}")
    fields = _HEADER.unpack(head)
    told, at = fields[-1], fields[1]
    while at + _OBJECT.size <= size:
        file.seek(at)
        signature, _, _, length, _ = _OBJECT.unpack(file.read(_OBJECT.size))
        if signature != b"LOBJ" or length < _OBJECT.size:
            return f"no object where one should begin: {size - at} of {size} bytes can't be read"
        at += length + length % 4
    missing = max(told - size, at - size if at > size + 3 else 0)
    return f"cut off: at least {missing} of {size + missing} bytes are missing" if missing > 0 else ""


def read_table(path: Path, found: Found) -> Iterator[Recorded]:
    """Frames of python-can's own CSV or SQLite file."""
    try:
        with can.LogReader(path) as reader:
            yield from of_messages(reader, found)
    except Exception as error:
        if not found.places:
            raise NotThisFormatError(f"not a recording of python-can: {error}") from error
        found.cut = f"the rest can't be read after frame {found.places}: {error or type(error).__name__}"
