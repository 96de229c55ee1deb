"""Writing MCAP: channels, schemas, metadata and attachments of a run, over the mcap package's writer."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType, Writer

from hil.log.schema import TOPICS, file_descriptor_set, meanings, pack_event, pack_stats, units
from hil.signals import TickArray

CHUNK_BYTES = 256 * 1024
LIBRARY = "hil-drive"


class RunFile:
    """One MCAP file of a run."""

    def __init__(self, path: Path, header: dict[str, Any], chunk_bytes: int = CHUNK_BYTES) -> None:
        fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        self._file: IO[bytes] = os.fdopen(fd, "wb")
        self._writer = Writer(self._file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=LIBRARY)
        descriptors = file_descriptor_set().SerializeToString()
        schemas = {
            name: self._writer.register_schema(name=name, encoding="protobuf", data=descriptors)
            for name in sorted(set(TOPICS.values()))
        }
        self._channels = {
            topic: self._writer.register_channel(topic=topic, message_encoding="protobuf", schema_id=schemas[name])
            for topic, name in TOPICS.items()
        }
        self._describe(header)
        self.ticks = self.frames = 0
        self.flush()

    def _describe(self, header: dict[str, Any]) -> None:
        """Metadata ``run``, ``units``, ``meanings`` and the attachments of the run."""
        self._writer.add_metadata("run", {str(k): str(v) for k, v in header.get("metadata", {}).items()})
        self._writer.add_metadata("units", units())
        self._writer.add_metadata("meanings", meanings())
        for name, text in header.get("attachments", {}).items():
            self._writer.add_attachment(0, 0, name, "text/plain", text.encode())

    def add_ticks(self, ticks: TickArray) -> None:
        """Append tick records."""
        channel, add, size = self._channels["/tick"], self._writer.add_message, ticks.itemsize
        raw = ticks.tobytes()
        rows = zip(ticks["k"].tolist(), ticks["t_ns"].tolist(), range(0, len(raw), size), strict=True)
        for k, t_ns, at in rows:
            add(channel, t_ns, raw[at : at + size], t_ns, k & 0xFFFFFFFF)
        self.ticks += len(ticks)

    def add_frame(self, received: bool, t_ns: int, raw: bytes, sequence: int) -> None:
        """Append one encoded CAN frame."""
        self._writer.add_message(self._channels["/can/rx" if received else "/can/tx"], t_ns, raw, t_ns, sequence)
        self.frames += 1

    def add_event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Append one event."""
        self._writer.add_message(self._channels["/event"], t_ns, pack_event(t_ns, k, kind, text), t_ns)

    def add_stats(self, t_ns: int, dropped: int, high_water: int) -> None:
        """Append the writer's own figures."""
        raw = pack_stats(t_ns, self.ticks, dropped, high_water, self.frames)
        self._writer.add_message(self._channels["/stats"], t_ns, raw, t_ns)

    def flush(self) -> None:
        """Hand closed chunks to the operating system."""
        self._file.flush()

    def finish(self, result: dict[str, Any]) -> None:
        """Write result, summary and footer; close."""
        try:
            self._writer.add_metadata("result", {"result": json.dumps(result, allow_nan=True)})
            self._writer.finish()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close what can't be written any more; what was buffered is lost."""
        with contextlib.suppress(OSError):
            self._file.close()
