"""What is in a log, from its summary and metadata alone: milliseconds, whatever its length."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.records import AttachmentIndex, Channel, Metadata, MetadataIndex, Statistics

from hil.log.errors import DamagedError, LogError
from hil.log.reader import Log, check_format, nodes_named, read_blocks, result_of
from hil.log.scan import parse
from hil.log.schema import node_topic
from hil.log.summary import all_indexed, record_at, summary
from hil.signals import new_ticks


@dataclass(slots=True)
class Info:
    """A log at a glance. ``counts`` is messages a topic; ``damage`` is None for a complete file."""

    path: Path
    size: int
    counts: dict[str, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, int] = field(default_factory=dict)
    damage: str | None = None

    @property
    def format(self) -> int:
        """The log's format; one without a number is of the first."""
        return int(self.metadata.get("run", {}).get("format", "1"))

    @property
    def nodes(self) -> dict[str, dict[str, Any]]:
        """Of a run with several nodes each one's ticks and how it ended, by its name; else empty."""
        names = nodes_named(self.metadata)
        ends = result_of(self.metadata).get("nodes")
        own = ends if isinstance(ends, dict) else {}
        topics = {name: node_topic(name) if place else "/tick" for place, name in enumerate(names)}
        return {
            name: {"ticks": self.counts.get(topic, 0)} | dict(own.get(name, {}))
            for name, topic in topics.items()
        }

    @property
    def written_by(self) -> str:
        """Version and commit of the writer."""
        run = self.metadata.get("run", {})
        return f"hil-drive {run.get('version hil-drive', 'unknown')}, {run.get('commit', 'unknown')}"

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "log": str(self.path),
            "format": self.format,
            "written_by": self.written_by,
            "bytes": self.size,
            "counts": self.counts,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "run": self.metadata.get("run", {}),
            "result": self.metadata.get("result", {}),
            "attachments": self.attachments,
            "damage": self.damage,
        } | ({"nodes": self.nodes} if self.nodes else {})


def info_of(paths: Sequence[Path]) -> Info:
    """Several parts of one run as one: counts and bytes in all. Raises LogError as :func:`info`."""
    infos = [info(path) for path in paths]
    first, last = infos[0], infos[-1]
    topics = dict.fromkeys(topic for one in infos for topic in one.counts)
    damages = [f"{one.path.name}: {one.damage}" for one in infos if one.damage]
    result = {name: text for name, text in last.metadata.items() if name == "result"}
    return Info(
        path=first.path,
        size=sum(one.size for one in infos),
        counts={topic: sum(one.counts.get(topic, 0) for one in infos) for topic in topics},
        start_ns=first.start_ns,
        end_ns=last.end_ns,
        metadata={name: text for name, text in first.metadata.items() if name != "result"} | result,
        attachments=first.attachments,
        damage="; ".join(damages) or None,
    )


def info(path: Path) -> Info:
    """Read the summary; a log without one is read whole. Raises LogError for what is no log of hil."""
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            return _from_summary(path, stream)
    except DamagedError:
        return _from_blocks(path)
    except OSError as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{path}: can't be read: {error.strerror}") from error


def _from_summary(path: Path, stream: IO[bytes]) -> Info:
    size = os.fstat(stream.fileno()).st_size
    out, records = Info(path, size), list(summary(stream, size))
    if not all_indexed(records):  # what is not counted is not 0, and what is not named is not absent
        raise DamagedError("the summary does not name all")
    topics: dict[int, str] = {}
    counts: dict[int, int] = {}
    for record in records:
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Statistics):
            counts = record.channel_message_counts
            out.start_ns, out.end_ns = record.message_start_time, record.message_end_time
        elif isinstance(record, AttachmentIndex):
            out.attachments[record.name] = record.data_size
        elif isinstance(record, MetadataIndex):
            raw = record_at(stream, record.offset, size)
            if isinstance(found := parse(raw.opcode, raw.content), Metadata):
                out.metadata[found.name] = dict(found.metadata)
    out.counts = {topic: counts.get(number, 0) for number, topic in topics.items()}
    if "run" not in out.metadata:
        raise LogError(f"{path}: is no log of hil (it has no run metadata)")
    check_format(path, out.metadata["run"])
    return out


def _from_blocks(path: Path) -> Info:
    """Count by reading everything, for a log without summary."""
    log, counts, start_ns = Log(path, new_ticks(0)), {"/tick": 0, "/can/rx": 0, "/can/tx": 0}, None
    for kind, records in read_blocks(log):
        if kind == "ticks":
            counts["/tick"] += len(records)
            start_ns = int(records["t_ns"][0]) if start_ns is None else start_ns
        else:
            received = int((records["received"] != 0).sum())
            counts["/can/rx"] += received
            counts["/can/tx"] += len(records) - received
    for node in log.nodes[1:]:
        blocks = read_blocks(Log(path, new_ticks(0), node=node))
        counts[node_topic(node)] = sum(len(block.records) for block in blocks if block.kind == "ticks")
    counts["/event"] = log.event_count
    return Info(
        path=path,
        size=path.stat().st_size,
        counts=counts,
        start_ns=start_ns,
        end_ns=log.last_t_ns,
        metadata=log.metadata,
        attachments={name: len(text) for name, text in log.attachments.items()},
        damage=log.damage,
    )
