"""A tolerant reader: everything that a file holds up to its damage, and what is missing.

Works chunk by chunk with bounded memory. Sizes are checked before anything is allocated, so that a file from
a stranger is refused instead of exhausting memory.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader

from hil.control.jit import jit
from hil.log.recorder import LogError
from hil.log.schema import TOPICS, file_descriptor_set, unpack_can_frame
from hil.signals import TICK, TickArray, new_ticks

MAX_CHUNK: Final = 64 << 20
MAX_RECORD: Final = 64 << 20
MESSAGE_HEADER: Final = 31
_DAMAGE = (McapError, EOFError, ValueError, struct.error, zstandard.ZstdError, KeyError, UnicodeDecodeError)


class Frame(NamedTuple):
    """A logged CAN frame."""

    received: bool
    t_ns: int
    can_id: int
    data: bytes


@dataclass(slots=True)
class Log:
    """A run's log as far as it can be read. ``damage`` is None for a complete file."""

    path: Path
    ticks: TickArray
    frames: list[Frame] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, str] = field(default_factory=dict)
    damage: str | None = None

    @property
    def result(self) -> dict[str, Any]:
        """The run's result, empty when the run did not end properly."""
        out: dict[str, Any] = json.loads(self.metadata.get("result", {}).get("result", "{}"))
        return out

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """(k, missing): ticks that the log lacks although the loop ran them; skipped periods are no gaps."""
        if len(self.ticks) == 0:
            return []
        k = self.ticks["k"].astype(np.int64)
        missing = np.diff(k, prepend=k[0] - self.ticks["gap"][0]) - self.ticks["gap"]
        at = np.nonzero(missing)[0]
        return [(int(k[i]), int(missing[i])) for i in at]


@jit
def scan(data: npt.NDArray[np.uint8], out: npt.NDArray[np.int64]) -> int:
    """Find the records of a chunk: rows of (opcode, start of content, length); return how many are whole."""
    at, count, size = 0, 0, data.shape[0]
    while at + 9 <= size and count < out.shape[0]:
        length = 0
        for byte in range(8):
            length |= np.int64(data[at + 1 + byte]) << (8 * byte)
        if length < 0 or at + 9 + length > size:
            break
        out[count, 0], out[count, 1], out[count, 2] = data[at], at + 9, length
        count += 1
        at += 9 + length
    return count


def _content(chunk: Chunk) -> bytes:
    """Uncompressed content of a chunk, its size and CRC checked."""
    if chunk.uncompressed_size > MAX_CHUNK:
        raise LogError(f"a chunk claims {chunk.uncompressed_size} bytes; this is no log of hil")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise LogError(f"compression {chunk.compression!r} is not one of a log of hil")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("chunk size does not fit")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("chunk CRC does not fit")
    return data


class _Pass:
    """One pass over a file: dispatches records, keeps what is wanted."""

    def __init__(self, log: Log, frames: bool) -> None:
        self.log, self._frames = log, frames
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, str] = {}
        self.blocks: list[TickArray] = []
        self.complete = False

    def take(self, record: Any) -> None:
        if isinstance(record, Chunk):
            self._chunk(_content(record))
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channel(record)
        elif isinstance(record, Metadata):
            self.log.metadata[record.name] = dict(record.metadata)
        elif isinstance(record, Attachment):
            self.log.attachments[record.name] = record.data.decode()
        elif isinstance(record, (DataEnd, Statistics)):
            self.complete = True

    def _channel(self, channel: Channel) -> None:
        """Learn a channel; a topic of ours with another schema is another program's or version's."""
        schema = self._schemas.get(channel.schema_id)
        wanted = TOPICS.get(channel.topic)
        if wanted is not None and (schema is None or schema.name != wanted):
            raise LogError(f"{self.log.path}: topic {channel.topic} has not the schema {wanted}")
        if channel.topic == "/tick" and schema is not None and not _fits(schema.data):
            raise LogError(f"{self.log.path}: written by another version of the tick's layout")
        self._topics[channel.id] = channel.topic

    def _chunk(self, data: bytes) -> None:
        array = np.frombuffer(data, np.uint8)
        rows = np.empty((len(data) // 9 + 1, 3), np.int64)
        rows = rows[: scan(array, rows)]
        for opcode, start, length in rows[(rows[:, 0] == 3) | (rows[:, 0] == 4)].tolist():
            self._definition(opcode, data[start : start + length])
        messages = rows[rows[:, 0] == 5]
        if len(messages) == 0:
            return
        at = messages[:, 1]
        channel = array[at].astype(np.int64) | array[at + 1].astype(np.int64) << 8
        for number in np.unique(channel).tolist():
            self._messages(self._topics.get(number, ""), data, array, messages[channel == number])

    def _definition(self, opcode: int, content: bytes) -> None:
        """A schema or channel inside a chunk, as the writer puts them before their first message."""
        raw = bytes((opcode,)) + struct.pack("<Q", len(content)) + content
        from io import BytesIO

        for record in _one(StreamReader(BytesIO(raw), skip_magic=True)):
            self.take(record)

    def _messages(self, topic: str, data: bytes, array: npt.NDArray[np.uint8], rows: npt.NDArray[np.int64]) -> None:
        if topic == "/tick":
            size = TICK.itemsize
            if not (rows[:, 2] == size + 22).all():
                raise LogError(f"{self.log.path}: tick records of another length than {size}")
            index = (rows[:, 1] + 22)[:, None] + np.arange(size)[None, :]
            self.blocks.append(array[index].view(TICK)[:, 0])
        elif topic in ("/can/rx", "/can/tx") and self._frames:
            received = topic == "/can/rx"
            for start, length in rows[:, 1:].tolist():
                self.log.frames.append(Frame(received, *unpack_can_frame(data[start + 22 : start + length])))
        elif topic == "/event":
            for start, length in rows[:, 1:].tolist():
                self.log.events.append(_event(data[start + 22 : start + length]))


def _one(reader: StreamReader) -> Iterator[Any]:
    """The first record of a stream that holds one."""
    for record in reader.records:
        yield record
        return


def _fits(descriptors: bytes) -> bool:
    """True when the file's descriptors are those of this version."""
    return descriptors == file_descriptor_set().SerializeToString()


def _event(raw: bytes) -> dict[str, Any]:
    """An event message as a dict."""
    _, t_ns, _, k = struct.unpack_from("<BqBQ", raw)
    texts, at = [], 18
    while at < len(raw):
        size, at = raw[at + 1], at + 2
        if size & 0x80:
            size, at = size & 0x7F | raw[at] << 7, at + 1
        texts.append(raw[at : at + size].decode(errors="replace"))
        at += size
    return {"t_ns": t_ns, "k": k, "kind": texts[0] if texts else "", "text": texts[1] if len(texts) > 1 else ""}


def records_of(path: Path) -> Iterator[Any]:
    """Records of a file, chunks whole; raises what damages it."""
    with path.open("rb") as stream:
        yield from StreamReader(stream, emit_chunks=True, record_size_limit=MAX_RECORD).records


def open_log(path: Path, *, frames: bool = True) -> Log:
    """Read a log up to its damage. Raises LogError for what is no log of hil at all."""
    log = Log(path, new_ticks(0))
    one = _Pass(log, frames)
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    try:
        for record in records_of(path):
            one.take(record)
    except LogError:
        raise
    except _DAMAGE as error:
        log.damage = str(error) or type(error).__name__
    except OSError as error:
        raise LogError(f"{path}: can't be read: {error.strerror}") from error
    if "run" not in log.metadata:
        raise LogError(f"{path}: is no log of hil ({log.damage or 'it has no run metadata'})")
    if log.damage is None and not one.complete:
        log.damage = "the file ends early"
    if log.damage is not None:
        log.damage = f"damaged after {sum(map(len, one.blocks))} ticks: {log.damage}"
    if one.blocks:
        log.ticks = np.concatenate(one.blocks)
    return log
