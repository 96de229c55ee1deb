"""MCAP, reading side: records and chunks of a file that may be cut off, damaged or hostile.

Every size is checked against what is really there before anything is allocated, and nothing is believed
that a checksum contradicts. Raises DamagedError where the good part of the file ends.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Metadata, Schema, Statistics

from hil.log.container import MAGIC
from hil.log.errors import DamagedError, UnknownCompressionError

MAX_CHUNK: Final = 32 << 20
MAX_RECORD: Final = 64 << 20
GATHERED: Final = 256 << 10
"""Bytes of messages outside of chunks that are read at once."""
HEAD: Final = struct.Struct("<BQ")
_LENGTH: Final = struct.Struct("<Q")
_HEAD_ARRAY: Final = np.dtype([("opcode", "u1"), ("length", "<i8")])
_PARSERS: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
    Opcode.FOOTER: Footer,
}
# a length of 2^63 or more is an OverflowError of the stream that it is read from
MALFORMED: Final = (McapError, EOFError, ValueError, OverflowError, struct.error, zstandard.ZstdError)


class Raw(NamedTuple):
    """One record of a file: its opcode, where it begins, its content."""

    opcode: int
    offset: int
    content: bytes


def raw_records(path: Path) -> Iterator[Raw]:
    """All records up to the footer. Raises DamagedError where the file breaks off."""
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if stream.read(len(MAGIC)) != MAGIC:
            raise DamagedError("it does not begin as an MCAP file")
        at, opcode = len(MAGIC), 0
        while opcode != Opcode.FOOTER:
            raw = read_record(stream, at, size)
            yield raw
            at, opcode = at + HEAD.size + len(raw.content), raw.opcode
        if stream.read(len(MAGIC)) != MAGIC:
            raise DamagedError("the end mark is missing")


def gathered(records: Iterable[Raw]) -> Iterator[Raw]:
    """The records, but messages that stand outside of chunks together, as the content of a chunk would be."""
    held: list[bytes] = []
    at = size = 0
    try:
        for raw in records:
            if held and (raw.opcode != Opcode.MESSAGE or size > GATHERED):
                yield Raw(Opcode.MESSAGE, at, b"".join(held))
                held, size = [], 0
            if raw.opcode != Opcode.MESSAGE:
                yield raw
                continue
            at = at if held else raw.offset
            held += (HEAD.pack(raw.opcode, len(raw.content)), raw.content)
            size += len(raw.content)
    except DamagedError:
        if held:
            yield Raw(Opcode.MESSAGE, at, b"".join(held))
        raise


def read_record(stream: IO[bytes], at: int, size: int) -> Raw:
    """The record at ``at``, where ``stream`` stands, of a file of ``size`` bytes."""
    head = stream.read(HEAD.size)
    if not head:
        raise DamagedError(f"it breaks off after byte {at}")
    if len(head) < HEAD.size:
        raise DamagedError(f"it breaks off in a record at byte {at}")
    opcode, length = HEAD.unpack(head)
    if length > size - at - HEAD.size:
        raise DamagedError(f"the record at byte {at} runs over the end of the file")
    if length > MAX_RECORD:
        raise DamagedError(f"the record at byte {at} claims {length} bytes")
    return Raw(opcode, at, stream.read(length))


def parse(opcode: int, content: bytes) -> McapRecord | None:
    """A record's fields; None for kinds that a log is read without. Raises DamagedError."""
    parser = _PARSERS.get(opcode)
    if parser is None:
        return None
    try:
        # lengths inside the content can't reach beyond it: a BytesIO returns no more than it has
        record: McapRecord = parser.read(ReadDataStream(io.BytesIO(content)))
    except MALFORMED as error:
        raise DamagedError(f"a malformed {parser.__name__} record") from error
    return record


def parse_attachment(content: bytes) -> tuple[str, bytes]:
    """Name and data of an attachment, its checksum verified. Raises DamagedError."""
    stream = ReadDataStream(io.BytesIO(content))
    try:
        stream.read(16)
        name, _, data = (
            stream.read_prefixed_string(),
            stream.read_prefixed_string(),
            stream.read(stream.read8()),
        )
        crc = stream.read4()
    except MALFORMED as error:
        raise DamagedError("a malformed attachment") from error
    if crc and crc != zlib.crc32(content[:-4]):
        raise DamagedError(f"attachment {name}: its checksum does not fit")
    return name, data


def chunk_content(chunk: Chunk) -> bytes:
    """Uncompressed content of a chunk. Raises DamagedError when size or checksum do not fit."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK:
        raise DamagedError(f"a chunk claims {size} bytes")
    if chunk.compression == "zstd":
        data = _decompress(chunk.data, size)
    elif chunk.compression == "lz4":
        data = _decompress_lz4(chunk.data, size)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise UnknownCompressionError(f"compression {chunk.compression!r:.40} is not known here")
    if len(data) != size:
        raise DamagedError("a chunk has another size than it says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamagedError("the checksum of a chunk does not fit")
    return data


def _decompress(data: bytes, size: int) -> bytes:
    """At most ``size`` bytes, whatever the compressed frame claims."""
    try:
        claimed = zstandard.frame_content_size(data)
        if claimed not in (-1, size):
            raise DamagedError("a chunk has another size than it says")
        out: bytes = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK).decompress(
            data, max_output_size=size
        )
    except zstandard.ZstdError as error:
        raise DamagedError("a chunk can't be decompressed") from error
    return out


def _decompress_lz4(data: bytes, size: int) -> bytes:
    """At most a byte more than ``size``, whatever the compressed frame claims."""
    try:
        out: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError) as error:
        raise DamagedError("a chunk can't be decompressed") from error
    return out


def chunk_rows(data: bytes) -> npt.NDArray[np.int64]:
    """Records of a chunk's content as rows of (opcode, start of content, length). Raises DamagedError."""
    starts, at, size = array("q"), 0, len(data)
    keep, length_at, head = starts.append, _LENGTH.unpack_from, HEAD.size
    try:
        while at < size:
            keep(at)
            at += head + length_at(data, at + 1)[0]
    except struct.error as error:
        raise DamagedError("a chunk ends inside a record") from error
    if at > size:
        raise DamagedError("a record runs over the end of its chunk")
    if not starts:
        return np.empty((0, 3), np.int64)
    at_all = np.frombuffer(starts, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), head)
    heads = windows[at_all].view(_HEAD_ARRAY)[:, 0]
    return np.stack([heads["opcode"], at_all + head, heads["length"]], axis=1)
