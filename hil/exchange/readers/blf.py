"""BLF, Vector's binary log: every frame in it, whoever wrote it, and how much of the file can't be read.

A header, then objects; most of them are containers, whose unpacked bytes one after another are objects again.
Layouts: T. Lorenz, Vector BLF 2.4 (``CanMessage.h`` and its neighbours), as of Vector's ``binlog_objects.h``.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from datetime import UTC, datetime
from typing import IO, Any, Final, NamedTuple

from hil.exchange.readers.recorded import (
    BUS_ERROR,
    EXTENDED,
    ID_MASK,
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    identifier,
)

_HEADER: Final = struct.Struct("<4sL8BQQLL8H8H")
"""Signature, own size, program, sizes packed and unpacked, counts of objects, start and end (SYSTEMTIME)."""
_OBJECT: Final = struct.Struct("<4sHHLL")
"""Signature, size of the header, its version, size of the object, type."""
_PACKED: Final = struct.Struct("<H6xL4x")
_STAMPS: Final = {1: struct.Struct("<LHHQ"), 2: struct.Struct("<LBxHQ")}
_TEN_MICROSECONDS: Final = 1
_CONTAINER, _STORED, _DEFLATED = 10, 0, 2
_NEAR: Final = 8
"""Objects are padded, each kind in its way: the next one begins within so many bytes."""
_REQUESTED: Final = 2


class _One(NamedTuple):
    """A frame without its stamp; ``way``: 0 received, 1 sent, 2 asked to be sent."""

    channel: int
    number: int
    way: int
    remote: bool
    error: bool
    fd: bool
    data: bytes


_MESSAGE: Final = struct.Struct("<HBBL8s")
_ERROR: Final = struct.Struct("<H")
_ERROR_EXT: Final = struct.Struct("<HHLBBBxLLH2x8s")
_FD: Final = struct.Struct("<HBBLLBBB5x")
_FD_64: Final = struct.Struct("<BBBBLLLLLLLHBBL")


def _message(whole: bytes, at: int) -> _One:
    channel, flags, dlc, number, data = _MESSAGE.unpack_from(whole, at)
    remote, size = bool(flags & 0x80), min(dlc, 8)
    return _One(channel, number, flags & 0xF, remote, False, False, bytes(size) if remote else data[:size])


def _bus_error(channel: int) -> _One:
    """An error frame of which the file says no more than that it was there."""
    return _One(channel, BUS_ERROR, 0, False, True, False, bytes(8))


def _error(whole: bytes, at: int) -> _One:
    return _bus_error(*_ERROR.unpack_from(whole, at))


def _error_ext(whole: bytes, at: int) -> _One:
    """With the controller's registers, identifier and data are those of the frame that was disturbed.

    python-can fills in no register, and puts SocketCAN's class and data there.
    """
    channel, _, registers, _, _, dlc, _, number, _, data = _ERROR_EXT.unpack_from(whole, at)
    if registers:
        return _bus_error(channel)
    return _One(channel, number & ID_MASK, 0, False, True, False, data[: min(dlc, 8)])


def _fd(whole: bytes, at: int) -> _One:
    channel, flags, dlc, number, _, _, fd, size = _FD.unpack_from(whole, at)
    data = whole[at + _FD.size :]
    return _of_fd(channel, number, flags & 0xF, bool(flags & 0x80), bool(fd & 1), dlc, size, data)


def _fd_64(whole: bytes, at: int) -> _One:
    channel, dlc, size, _, number, _, flags, *_, way, end, _ = _FD_64.unpack_from(whole, at)
    data = whole[at + _FD_64.size : end or None]
    return _of_fd(channel, number, way, bool(flags & 0x10), bool(flags & 0x1000), dlc, size, data)


def _of_fd(
    channel: int, number: int, way: int, remote: bool, fd: bool, dlc: int, size: int, data: bytes
) -> _One:
    """Data that are not stored are zeros, as Vector's own reader has them."""
    data = bytes(min(dlc, 8)) if remote else data[:size].ljust(size, b"\0")
    return _One(channel, number, way, remote, False, fd and not remote, data)


def _fd_error(whole: bytes, at: int) -> _One:
    return _bus_error(whole[at])


FRAMES: Final[dict[int, Callable[[bytes, int], _One]]] = {
    1: _message,
    2: _error,
    73: _error_ext,
    86: _message,
    100: _fd,
    101: _fd_64,
    104: _fd_error,
}
"""Types of objects that are frames; 2 and 104 are those that python-can 4.6.1 leaves out."""
NO_FRAMES: Final = {3: "overload frames left out", 31: "driver errors left out", 74: "driver errors left out"}
REQUESTS: Final = "transmit requests (TxRq) left out: what was sent is there as Tx"


def read(file: IO[bytes], found: Found) -> Iterator[Recorded]:
    """Frames of a BLF file, up to where it can be read. Raises NotThisFormatError."""
    found.unit = "frames"
    head = _head(file)
    missing = _missing(file, head)
    tail = b""
    try:
        for block in _blocks(file, head[1], found):
            tail = yield from _objects(tail + block, _start_ns(head), found)
    except UnreadableError as error:
        missing = missing or f"{error}: the rest from byte {file.tell()} on can't be read"
    if tail and not missing:
        missing = f"{len(tail)} bytes at the end are no whole object"
    if missing:
        found.cut = f"after frame {found.places}: {missing}"


def _head(file: IO[bytes]) -> tuple[Any, ...]:
    """The file's header. Raises NotThisFormatError."""
    file.seek(0)
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size or head[:4] != b"LOGG":
        raise NotThisFormatError(f"not a BLF file: it begins with {head[:4]!r}" if head else "empty")
    return _HEADER.unpack(head)


def _start_ns(head: tuple[Any, ...]) -> int:
    """When the file starts [ns since 1970]; 0 of a logger without a clock, which writes zeros."""
    year, month, _, day, hour, minute, second, ms = head[14:22]
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    return max(round(start.timestamp()), 0) * 1_000_000_000 + int(ms) * 1_000_000


def _missing(file: IO[bytes], head: tuple[Any, ...]) -> str:
    """What the file lacks by its own header and by the sizes of its objects, in words; empty for none."""
    size, at = file.seek(0, os.SEEK_END), head[1]
    while at + _OBJECT.size <= size:
        file.seek(at)
        signature, _, _, length, _ = _OBJECT.unpack(file.read(_OBJECT.size))
        if signature != b"LOBJ" or length < _OBJECT.size:
            return f"no object where one should begin: {size - at} of {size} bytes can't be read"
        at += length + length % 4
    missing = max(head[10] - size, at - size if at > size + 3 else 0)
    return f"cut off: at least {missing} of {size + missing} bytes are missing" if missing > 0 else ""


def _blocks(file: IO[bytes], at: int, found: Found) -> Iterator[bytes]:
    """The bytes of the objects: of each container unpacked, of an object outside of one as it is."""
    file.seek(at)
    while len(head := file.read(_OBJECT.size)) == _OBJECT.size:
        signature, _, _, length, kind = _OBJECT.unpack(head)
        if signature != b"LOBJ" or length < _OBJECT.size:
            return
        body, padding = file.read(length - _OBJECT.size), file.read(length % 4)
        if kind != _CONTAINER:
            yield head + body + padding
        elif len(body) >= _PACKED.size:
            yield _unpacked(body, found)


def _unpacked(body: bytes, found: Found) -> bytes:
    """A container's bytes, as many as there are."""
    method, _ = _PACKED.unpack_from(body)
    packed = body[_PACKED.size :]
    if method == _DEFLATED:
        return zlib.decompressobj().decompress(packed)
    if method == _STORED:
        return packed
    found.lose(f"after frame {found.places}", f"{len(packed)} bytes packed by the unknown method {method}")
    found.places += 1
    return b""


def _objects(data: bytes, start_ns: int, found: Found) -> Generator[Recorded, None, bytes]:
    """Frames of whole objects; returns the bytes of one that goes on in the next block.

    Raises UnreadableError where no object begins.
    """
    at = 0
    while at + _OBJECT.size <= len(data):
        begin = data.find(b"LOBJ", at, at + _NEAR)
        if begin < 0:
            raise UnreadableError("no object where one should begin")
        if begin + _OBJECT.size > len(data):
            break
        _, head, version, length, kind = _OBJECT.unpack_from(data, begin)
        if length < _OBJECT.size:
            raise UnreadableError(f"an object of {length} bytes")
        if begin + length > len(data):
            break
        yield from _frame(data[begin : begin + length], head, version, kind, start_ns, found)
        at = begin + length
    rest = data[at:]
    return rest if rest.strip(b"\0") else b""


def _frame(
    whole: bytes, head: int, version: int, kind: int, start_ns: int, found: Found
) -> Iterator[Recorded]:
    """The frame of an object; none of an object that is no frame."""
    if kind in NO_FRAMES:
        found.notes[NO_FRAMES[kind]] += 1
    if kind not in FRAMES:
        return
    found.places += 1
    try:
        one, t_ns = FRAMES[kind](whole, head), start_ns + _since_start_ns(whole, version)
        if one.way == _REQUESTED:
            found.notes[REQUESTS] += 1
            return
        can_id = identifier(
            one.number & ID_MASK,
            extended=bool(one.number & EXTENDED),
            remote=one.remote,
            error=one.error,
        )
        yield frame(t_ns, str(one.channel - 1), can_id, not one.way, one.fd, one.data)
    except UnreadableError as error:
        found.lose(f"frame {found.places}", error)
    except (struct.error, IndexError):
        found.lose(f"frame {found.places}", f"its object of {len(whole)} bytes is too short")


def _since_start_ns(whole: bytes, version: int) -> int:
    """Time since the file's start, to the microsecond. Raises UnreadableError."""
    if version not in _STAMPS:
        raise UnreadableError(f"its header has the unknown version {version}")
    flags, _, _, stamp = _STAMPS[version].unpack_from(whole, _OBJECT.size)
    return int(stamp) * 10_000 if flags == _TEN_MICROSECONDS else (int(stamp) + 500) // 1000 * 1000
