"""The summary of an MCAP file: what is in it and where, without reading it.

A file of another program may hold metadata and attachments anywhere, also behind its messages; :func:`later`
finds them by the summary's index, or from record to record where that does not name them all.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Footer,
    McapRecord,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from hil.log.container import MAGIC
from hil.log.errors import DamagedError
from hil.log.scan import HEAD, MALFORMED, MAX_RECORD, Raw, parse, read_record

_FOOTER_BYTES: Final = HEAD.size + 20
_KINDS: Final[dict[int, Any]] = {
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
}
_NAMED: Final = (Opcode.ATTACHMENT, Opcode.METADATA)


def record_at(stream: IO[bytes], at: int, size: int) -> Raw:
    """The record at ``at`` of a file of ``size`` bytes. Raises DamagedError."""
    if not 0 < at < size:
        raise DamagedError("an index points out of the file")
    stream.seek(at)
    return read_record(stream, at, size)


def summary(stream: IO[bytes], size: int) -> Iterator[McapRecord]:
    """Records that say what is in the file. Raises DamagedError.

    The chunks' own, a few a second, are passed by.
    """
    end = size - _FOOTER_BYTES - len(MAGIC)
    raw = record_at(stream, end, size)
    footer = parse(raw.opcode, raw.content)
    if not isinstance(footer, Footer) or stream.read(len(MAGIC)) != MAGIC:
        raise DamagedError("there is no footer")
    if not 0 < footer.summary_start < end or end - footer.summary_start > MAX_RECORD:
        raise DamagedError("there is no summary")
    yield from _wanted(stream, footer, end)


def _wanted(stream: IO[bytes], footer: Footer, end: int) -> Iterator[McapRecord]:
    start, offsets = footer.summary_start, footer.summary_offset_start
    if offsets == 0:  # a writer may leave them out
        yield from _records(stream, start, end)
        return
    for group in _records(stream, offsets, end):
        if isinstance(group, SummaryOffset) and group.group_opcode in _KINDS:
            if not start <= group.group_start <= offsets - group.group_length:
                raise DamagedError("an offset points out of the summary")
            yield from _records(stream, group.group_start, group.group_start + group.group_length)


def _records(stream: IO[bytes], start: int, end: int) -> list[McapRecord]:
    """Records of the kinds in ``_KINDS`` between two places."""
    out, at = [], start
    stream.seek(start)
    while at < end:
        raw = read_record(stream, at, end)
        at += HEAD.size + len(raw.content)
        parser = _KINDS.get(raw.opcode)
        if parser is not None:
            try:
                out.append(parser.read(ReadDataStream(io.BytesIO(raw.content))))
            except MALFORMED as error:
                raise DamagedError(f"a malformed {parser.__name__} record") from error
    return out


def all_indexed(records: list[McapRecord]) -> bool:
    """Whether the summary names every metadata record and attachment of the file."""
    counted = [record for record in records if isinstance(record, Statistics)]
    named = [sum(isinstance(record, kind) for record in records) for kind in (MetadataIndex, AttachmentIndex)]
    return bool(counted) and named == [counted[0].metadata_count, counted[0].attachment_count]


def later(path: Path, at: int) -> Iterator[Raw]:
    """Metadata and attachments that begin at byte ``at`` or behind it, up to the file's damage."""
    with contextlib.suppress(DamagedError, struct.error), path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        places = _indexed(stream, size)
        for place in _walked(stream, at, size) if places is None else places:
            if place >= at and (raw := record_at(stream, place, size)).opcode in _NAMED:
                yield raw


def _indexed(stream: IO[bytes], size: int) -> list[int] | None:
    """Where the summary says that they are; None where it does not say it of all."""
    try:
        records = list(summary(stream, size))
    except DamagedError:
        return None
    if not all_indexed(records):
        return None
    return [record.offset for record in records if isinstance(record, (MetadataIndex, AttachmentIndex))]


def _walked(stream: IO[bytes], at: int, size: int) -> Iterator[int]:
    """Where they are, from one record's head to the next."""
    opcode = 0
    while opcode != Opcode.DATA_END and at < size:
        stream.seek(at)
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        if opcode in _NAMED:
            yield at
        at += HEAD.size + length
