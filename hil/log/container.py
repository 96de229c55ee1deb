"""MCAP, writing side: records, chunks, indexes and summary. Knows nothing of what the messages mean.

The mcap package's own writer works message by message in Python (5 to 10 us each); here the messages of a
chunk come as arrays, so that a whole block of ticks costs about as much as its compression. A record is
appended whole or not at all: after a failed write the file is cut back to its last whole record. The disk
space of summary and footer is taken before each chunk is written, so that a full disk leaves a complete file.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Final

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

Integers = npt.NDArray[np.int64]

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "hil-drive"
ZSTD_LEVEL: Final = 1  # twice the speed of level 3 on ticks, and 6 % larger
MESSAGE_HEAD: Final = [
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"),
    ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8"),
]  # fmt: skip
HEAD_BYTES: Final = 31
FIXED_BYTES: Final = 22
"""Bytes of a message record that its length counts besides the data."""
_INDEX: Final = np.dtype([("time", "<u8"), ("offset", "<u8")])
SUMMARY_BYTES: Final = 32 * 1024
"""Room for the last metadata, the summary without its chunks, and the footer."""
CHUNK_INDEX_BYTES: Final = 256
"""At most what a chunk adds to the summary."""
ROOM_STEP: Final = 64 * 1024
KEEP_SIZE: Final = 1  # FALLOC_FL_KEEP_SIZE, linux/falloc.h
NOT_THERE: Final = (errno.EOPNOTSUPP, errno.ENOSYS)
_fallocate: Final = ctypes.CDLL(None, use_errno=True).fallocate64
_fallocate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]


def take_room(fd: int, at: int, size: int) -> None:
    """Take disk space beyond a file's end; its size stays. Without effect where the file system can't.

    Raises OSError when there is not that much. Source: fallocate(2).
    """
    if _fallocate(fd, KEEP_SIZE, at, size) != 0 and (number := ctypes.get_errno()) not in NOT_THERE:
        raise OSError(number, os.strerror(number))


def encode(record: McapRecord) -> bytes:
    """One record's bytes."""
    builder = RecordBuilder()
    record.write(builder)
    raw: bytes = builder.end()  # type: ignore[no-untyped-call] # the package annotates no return
    return raw


def compressor(name: str) -> Callable[[bytes], bytes]:
    """What compresses a chunk: ``zstd``, or ``lz4``, quicker and larger."""
    known: dict[str, Callable[[bytes], bytes]] = {
        "zstd": zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress,
        "lz4": lz4.frame.compress,
    }
    return known[name]


class Block:
    """Messages of one chunk in the making."""

    def __init__(self) -> None:
        self.size = self.count = 0
        self._parts: list[bytes] = []
        self._rows: list[tuple[Integers, Integers, Integers]] = []

    def add(self, channels: Integers, times: Integers, lengths: Integers, raw: bytes) -> None:
        """Append message records: their channels, log times, lengths in all and bytes."""
        offsets = self.size + np.cumsum(lengths) - lengths
        self._rows.append((channels, times.copy(), offsets))  # the caller may fill his array again
        self._parts.append(raw)
        self.size += len(raw)
        self.count += len(times)

    def content(self) -> bytes:
        """All records, one after the other."""
        return b"".join(self._parts)

    def rows(self) -> tuple[Integers, Integers, Integers]:
        """Channel, log time and offset of each message."""
        channels, times, offsets = (np.concatenate(column) for column in zip(*self._rows, strict=True))
        return channels, times, offsets


class Container:
    """One MCAP file being written. Every method raises OSError when it can't; the file stays readable."""

    def __init__(self, path: Path, compression: str = "zstd") -> None:
        self.compression, self._compress = compression, compressor(compression)
        self._fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
        self._own = os.fstat(self._fd)
        self.size = self._room = 0
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunks: list[McapRecord] = []
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []
        self._counts: dict[int, int] = defaultdict(int)
        self._start: int | None = None
        self._end = 0
        self._append(MAGIC + encode(Header(profile="", library=LIBRARY)))

    def _append(self, data: bytes) -> int:
        """Append all of ``data`` or nothing; return where it begins."""
        at, rest = self.size, memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            os.ftruncate(self._fd, at)
            os.lseek(self._fd, at, os.SEEK_SET)
            raise
        self.size += len(data)
        return at

    def _make_room(self, size: int) -> None:
        """Take the disk space of ``size`` bytes and of all that :meth:`finish` will write after them."""
        needed = self.size + size + SUMMARY_BYTES + CHUNK_INDEX_BYTES * (len(self._chunks) + 1)
        if needed > self._room:
            take_room(self._fd, self._room, needed + ROOM_STEP - self._room)
            self._room = needed + ROOM_STEP

    def add_schema(self, name: str, data: bytes) -> int:
        """Write a protobuf schema; return its id."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding="protobuf", data=data)
        self._append(encode(schema))
        self._schemas.append(schema)
        return schema.id

    def add_channel(self, topic: str, schema_id: int) -> int:
        """Write a channel; return its id."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="protobuf",
            metadata={},
            schema_id=schema_id,
        )
        self._append(encode(channel))
        self._channels.append(channel)
        return channel.id

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        raw = encode(Metadata(name=name, metadata=values))
        self._metadata.append(MetadataIndex(offset=self._append(raw), length=len(raw), name=name))

    def add_attachment(self, name: str, data: bytes) -> None:
        """Write an attachment."""
        raw = encode(Attachment(create_time=0, log_time=0, name=name, media_type="text/plain", data=data))
        index = AttachmentIndex(
            offset=self._append(raw),
            length=len(raw),
            log_time=0,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type="text/plain",
        )
        self._attachments.append(index)

    def add_chunk(self, block: Block) -> None:
        """Compress and write a block with its message indexes."""
        raw = block.content()
        channels, times, offsets = block.rows()
        start, end = int(times.min()), int(times.max())
        chunk = Chunk(
            compression=self.compression,
            data=self._compress(raw),
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=len(raw),
        )
        record = encode(chunk)
        indexes, places = self._indexes(channels, times, offsets)
        self._make_room(len(record) + len(indexes))
        at = self._append(record + indexes)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=at,
                compression=self.compression,
                compressed_size=len(chunk.data),
                message_end_time=end,
                message_index_length=len(indexes),
                message_index_offsets={number: at + len(record) + place for number, place in places.items()},
                message_start_time=start,
                uncompressed_size=len(raw),
            )
        )
        for number in places:
            self._counts[number] += int((channels == number).sum())
        self._start = start if self._start is None else min(self._start, start)
        self._end = max(self._end, end)

    @staticmethod
    def _indexes(channels: Integers, times: Integers, offsets: Integers) -> tuple[bytes, dict[int, int]]:
        """MessageIndex records of a chunk, and where in them each channel's begins."""
        out, places = bytearray(), {}
        for number in np.unique(channels).tolist():
            of_channel = channels == number
            pairs = np.empty(int(of_channel.sum()), _INDEX)
            pairs["time"], pairs["offset"] = times[of_channel], offsets[of_channel]
            places[number] = len(out)
            out += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + pairs.nbytes, number, pairs.nbytes)
            out += pairs.tobytes()
        return bytes(out), places

    def finish(self) -> None:
        """Write summary and footer; the file is complete and closed when this returns."""
        end = encode(DataEnd(data_section_crc=0))
        summary_start = self.size + len(end)
        summary, offsets = self._summary(summary_start)
        offset_start = summary_start + len(summary)
        summary += offsets
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        footer = Footer(
            summary_start=summary_start,
            summary_offset_start=offset_start,
            summary_crc=zlib.crc32(head, zlib.crc32(summary)),
        )
        self._append(end + summary + encode(footer) + MAGIC)
        self.close()

    def _summary(self, start: int) -> tuple[bytes, bytes]:
        """Summary section that begins at ``start``, and its offsets section."""
        groups = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        out, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            raw = b"".join(map(encode, records))
            if raw:
                place = SummaryOffset(
                    group_opcode=opcode, group_start=start + len(out), group_length=len(raw)
                )
                offsets += encode(place)
            out += raw
        return bytes(out), bytes(offsets)

    def _statistics(self) -> McapRecord:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self._start or 0,
            message_end_time=self._end,
            schema_count=len(self._schemas),
        )

    def check_place(self, path: Path) -> None:
        """Raise OSError when this is no longer the file of that name: deleted or moved, or its folder."""
        try:
            found: os.stat_result | None = path.stat()
        except OSError:
            found = None
        if found is None or not os.path.samestat(found, self._own):
            raise FileNotFoundError(errno.ENOENT, f"{path} was deleted or moved")

    def close(self) -> None:
        """Close the file as it is, give back the space it did not need; closing twice is harmless."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size)
            os.close(self._fd)
            self._fd = -1
