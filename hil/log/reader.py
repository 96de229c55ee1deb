"""A tolerant reader: everything that a log holds, around and up to its damage, and what is missing.

:func:`read_blocks` goes through a file of any length with bounded memory; :func:`open_log` keeps what it
yields. A chunk that is damaged is left out and named, and reading goes on behind it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Metadata, Schema, Statistics

from hil.log.container import FIXED_BYTES, LIBRARY
from hil.log.errors import DamagedError, LogError, UnknownCompressionError
from hil.log.layouts import FORMAT
from hil.log.mcapfile import MESSAGE
from hil.log.scan import Raw, chunk_content, chunk_rows, gathered, parse, parse_attachment, raw_records
from hil.log.schema import (
    FRAME_HEAD,
    FRAME_MESSAGE,
    TOPICS,
    Records,
    file_descriptor_set,
    frames_from_messages,
    message_layout,
    node_topic,
    unpack_event,
)
from hil.log.summary import later
from hil.log.ticks import Ticks, form_of, without
from hil.signals import TICK, TickArray, new_ticks

__all__ = ["Frame", "Log", "LogError", "Source", "new_log", "open_log", "read_blocks"]

Rows = npt.NDArray[np.int64]
_OWN: Final = file_descriptor_set().SerializeToString()
Source = Path | Sequence[Path]
"""A log: one file, or the parts of a split run in order."""
MEMORY_SHARE: Final = 0.5
SLAB_TICKS: Final = 1 << 17  # 48 MB, above the size up to which malloc keeps freed memory
_WHOLE: Final = np.dtype(f"V{TICK.itemsize}")  # copied at once, where TICK is copied field by field
EVENTS_MOST: Final = 100_000
"""A run of a day has some thousands."""
EVENT_TEXT_MOST: Final = 4096
FRAME_OBJECT_RATIO: Final = 4  # a Frame object over its 78-byte record


class Frame(NamedTuple):
    """A logged CAN frame."""

    received: bool
    t_ns: int
    can_id: int
    data: bytes


class Block(NamedTuple):
    """What one chunk brought: tick records, or FRAME records in the order of the file."""

    kind: Literal["ticks", "frames"]
    records: Records


def nodes_named(metadata: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
    """Names of the nodes of a run with several, the first first; none for a run with one."""
    return tuple(filter(None, metadata.get("nodes", {}).get("names", "").split(",")))


def result_of(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """The run's result; empty for a run cut short."""
    try:
        out = json.loads(metadata.get("result", {}).get("result", "{}"))
    except ValueError:
        return {}
    return out if isinstance(out, dict) else {}


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
    bytes_lost: int = 0
    tick_count: int = 0
    event_count: int = 0
    """Events in the file; of very many the first are in ``events``."""
    last_t_ns: int | None = None
    parts: tuple[Path, ...] = ()
    """The files of a run that was split, in order; none for a run in one file."""
    absent: frozenset[str] = frozenset()
    """Fields of today's ticks that the log lacks; what stands in their place was not logged."""
    unknown: tuple[str, ...] = ()
    """Fields of its ticks that this version does not know and passes by."""
    node: str = ""
    """Of a run with several nodes the one whose ticks and controller these are; empty: the first."""

    @property
    def result(self) -> dict[str, Any]:
        """The run's result, of a node after the first with what is its own; empty for a run cut short."""
        out = result_of(self.metadata)
        nodes = out.get("nodes")
        own = nodes.get(self.node) if self.node and isinstance(nodes, dict) else None
        return out | own if isinstance(own, dict) else out

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes of a run with several, the first first; none for a run with one."""
        return nodes_named(self.metadata)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is held open; the block only shows how long the log is used."""

    def to_numpy(self) -> TickArray:
        """The ticks as a plain structured array: the named fields that the log has, exact."""
        return without(self.ticks, self.absent)

    def to_pandas(self, *, names: bool = False) -> Any:
        """The ticks as a DataFrame indexed by the time since the first [s]; units in ``df.attrs["units"]``.

        ``names``: states, reasons and requests as categories with their names instead of numbers.
        Raises LogError when pandas is not installed.
        """
        from hil.log.frame import data_frame

        return data_frame(self, names=names)

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """(k, missing): ticks that the log lacks although the loop ran them; skipped periods are no gaps."""
        if len(self.ticks) == 0:
            return []
        k = self.ticks["k"].astype(np.int64)
        missing = np.diff(k, prepend=k[0] - self.ticks["gap"][0]) - self.ticks["gap"]
        at = np.nonzero(missing)[0]
        return [(int(k[i]), int(missing[i])) for i in at]


class _Pass:
    """One pass over a file: fills in a log and yields blocks."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, str] = {}
        self._named: dict[int, str] = {}
        self._tick_channel = -1
        self._form: Ticks | None = None
        self.ours = self.complete = False
        self.problems: list[str] = []
        self.messages_seen = 0
        self._begun = False
        self._owned: set[tuple[int, str]] = set()
        """Attachments and metadata of the node that is read."""
        self._tick_topic = node_topic(log.node) if log.node else "/tick"
        self.unreadable = ""
        """Why no chunk could be read at all."""

    def take(self, raw: Raw) -> Iterator[Block]:
        """What a record of the file brings; one that is damaged is named and left out."""
        if raw.opcode in (Opcode.CHUNK, MESSAGE) and not self._begun:
            self._begun = True
            self._look_ahead(raw.offset)
        try:
            if raw.opcode == Opcode.ATTACHMENT:
                name, data = parse_attachment(raw.content)
                self._keep(self.log.attachments, name, data.decode(errors="replace"))
            elif raw.opcode == MESSAGE:
                yield from self._chunk(raw.content)
            else:
                record = parse(raw.opcode, raw.content)
                if isinstance(record, Chunk):
                    yield from self._chunk(chunk_content(record))
                elif record is not None:
                    self._define(record)
        except DamagedError as error:
            self.problems.append(f"{error} (at byte {raw.offset})")
            self.log.bytes_lost += len(raw.content)
            if isinstance(error, UnknownCompressionError) and not self.messages_seen:
                self.unreadable = str(error)

    def _look_ahead(self, at: int) -> None:
        """Learn what other programs write behind the messages: without it these can't be understood.

        What stands before them goes first; what is damaged is named when the pass comes to it.
        """
        for raw in later(self.log.path, at):
            with contextlib.suppress(DamagedError):
                if raw.opcode == Opcode.ATTACHMENT:
                    name, data = parse_attachment(raw.content)
                    self._keep(self.log.attachments, name, data.decode(errors="replace"), again=False)
                elif isinstance(record := parse(raw.opcode, raw.content), Metadata):
                    self._keep(self.log.metadata, record.name, dict(record.metadata), again=False)

    def _keep(self, kept: dict[str, Any], name: str, value: Any, *, again: bool = True) -> None:
        """Keep an attachment or metadata; what is there stays unless ``again``.

        What a node calls its own stands in the place of the first node's, whichever comes first.
        """
        own = name.removesuffix(f" of {self.log.node}") if self.log.node else name
        if own != name:
            self._owned.add((id(kept), own))
        elif (id(kept), own) in self._owned:
            return
        if again or own != name or own not in kept:
            kept[own] = value

    def _define(self, record: McapRecord) -> None:
        if isinstance(record, Header):
            self.ours = record.library.startswith(LIBRARY)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channel(record)
        elif isinstance(record, Metadata):
            self._keep(self.log.metadata, record.name, dict(record.metadata))
            if record.name == "run":
                check_format(self.log.path, record.metadata)
        elif isinstance(record, Statistics):
            self._compare(record.message_count)
        elif isinstance(record, Footer):
            self.complete = True

    def _compare(self, count: int) -> None:
        """The summary's count: the last word on whether a record was overlooked."""
        if self._tick_channel < 0:
            self.problems.append("it has no channel for ticks")
        if count != self.messages_seen and not self.problems:
            self.problems.append(f"its summary counts {count} messages, {self.messages_seen} are there")

    def _channel(self, channel: Channel) -> None:
        """Learn a channel; a topic of ours with another schema is another program's or version's."""
        if self._named.setdefault(channel.id, channel.topic) != channel.topic:
            self.problems.append(f"channel {channel.id} has two topics")
        topic = "/tick" if channel.topic == self._tick_topic else channel.topic
        name, schema = TOPICS.get(topic), self._schemas.get(channel.schema_id)
        if name is None or (self.log.node and channel.topic == "/tick"):
            return
        if schema is None or schema.name != name or channel.message_encoding != "protobuf":
            raise LogError(
                f"{self.log.path}: topic {channel.topic} has not the schema {name}; not a log of hil"
            )
        if topic == "/tick":
            self._learn(schema, channel.id)
        elif name != "hil.Stats" and message_layout(schema.data, name) != message_layout(_OWN, name):
            raise LogError(
                f"{self.log.path}: {name} has another layout than format {FORMAT}; not a log of hil"
            )
        self._topics[channel.id] = topic

    def _learn(self, schema: Schema, channel: int) -> None:
        """How this file's ticks are laid out."""
        try:
            form = form_of(message_layout(schema.data, "hil.Tick") or [])
        except LogError as error:
            raise LogError(f"{self.log.path}: {error}; another version's log, or none of hil") from error
        if self._form is not None and self._form.form.shape != form.shape:
            raise LogError(f"{self.log.path}: has two channels of ticks that differ; not a log of hil")
        self._form, self._tick_channel = Ticks(form), channel
        self.log.absent, self.log.unknown = form.absent, form.unknown

    def _chunk(self, data: bytes) -> Iterator[Block]:
        ticks = self._uniform(data)
        if ticks is not None:
            self.messages_seen += len(ticks)
            yield self._ticks(ticks)
            return
        rows = chunk_rows(data)
        for opcode, start, length in rows[
            (rows[:, 0] == Opcode.SCHEMA) | (rows[:, 0] == Opcode.CHANNEL)
        ].tolist():
            record = parse(opcode, data[start : start + length])
            assert record is not None  # noqa: S101 - both kinds are parsed
            self._define(record)
        messages = rows[rows[:, 0] == MESSAGE]
        self.messages_seen += len(messages)
        if (messages[:, 2] < FIXED_BYTES).any():
            raise DamagedError("a message is too short")
        raw = np.frombuffer(data, np.uint8)
        channel = raw[messages[:, 1]].astype(np.int64) | raw[messages[:, 1] + 1].astype(np.int64) << 8
        ways = {n: topic == "/can/rx" for n, topic in self._topics.items() if topic in ("/can/rx", "/can/tx")}
        is_frame = np.isin(channel, list(ways))
        for number in np.unique(channel[~is_frame]).tolist():
            yield from self._messages(self._topics.get(number, ""), data, messages[channel == number])
        if is_frame.any():
            received = np.isin(channel[is_frame], [number for number, rx in ways.items() if rx])
            yield self._frames(data, messages[is_frame], received)

    def _uniform(self, data: bytes) -> TickArray | None:
        """The ticks of a chunk that holds nothing else, as this program writes it; None for any other."""
        if self._form is None or not data or len(data) % self._form.form.message.itemsize:
            return None
        layout = self._form.form.layout
        messages = np.frombuffer(data, self._form.form.message)
        same = (messages["opcode"] == MESSAGE) & (messages["channel"] == self._tick_channel)
        if not (same & (messages["length"] == FIXED_BYTES + layout.itemsize)).all():
            return None
        records = np.ascontiguousarray(messages["data"]).view(layout)
        return self._form.today(records) if self._form.fits(records) else None

    def _messages(self, topic: str, data: bytes, rows: Rows) -> Iterator[Block]:
        """The messages of one channel of a chunk."""
        starts, lengths = rows[:, 1] + FIXED_BYTES, rows[:, 2] - FIXED_BYTES
        if topic == "/tick":
            yield self._ticks(self._ticks_at(data, starts, lengths))
        elif topic == "/event":
            for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
                self._event(data[start : start + length])

    def _ticks_at(self, data: bytes, starts: Rows, lengths: Rows) -> TickArray:
        assert self._form is not None  # noqa: S101 - the topic is known by its channel alone
        if (lengths == self._form.form.layout.itemsize).all():
            records = _gather(data, starts, self._form.form.layout)
            if self._form.fits(records):
                return self._form.today(records)
        ends = zip(starts.tolist(), (starts + lengths).tolist(), strict=True)
        try:
            return self._form.spelled([data[start:end] for start, end in ends])
        except DamagedError as error:
            if (lengths == self._form.form.layout.itemsize).all():
                raise
            size = self._form.form.layout.itemsize
            raise LogError(f"{self.log.path}: tick records of another length than {size} bytes") from error

    def _frames(self, data: bytes, rows: Rows, received: npt.NDArray[np.bool_]) -> Block:
        """The frames of a chunk, both ways, in the order in which they passed the loop."""
        lengths = rows[:, 2] - FIXED_BYTES
        if (lengths < FRAME_HEAD).any():
            raise DamagedError("a frame message is too short")
        try:
            messages = _gather(data, rows[:, 1] + FIXED_BYTES, FRAME_MESSAGE)
            return Block("frames", frames_from_messages(messages, lengths, received))
        except ValueError as error:
            raise DamagedError(str(error)) from error

    def _event(self, raw: bytes) -> None:
        try:
            t_ns, k, kind, text = unpack_event(raw)
        except ValueError as error:
            raise DamagedError(str(error)) from error
        self.log.event_count += 1
        if len(self.log.events) < EVENTS_MOST:
            kept = {"kind": kind[:EVENT_TEXT_MOST], "text": text[:EVENT_TEXT_MOST]}
            self.log.events.append({"t_ns": t_ns, "k": k} | kept)
        elif self.log.event_count == EVENTS_MOST + 1:
            self.problems.append(f"it has more than {EVENTS_MOST} events; the rest is left out")

    def _ticks(self, ticks: TickArray) -> Block:
        """Count ticks."""
        self.log.tick_count += len(ticks)
        self.log.last_t_ns = int(ticks["t_ns"][-1])
        return Block("ticks", ticks)


def _gather(data: bytes, starts: Rows, dtype: np.dtype[np.void]) -> Records:
    """Records of ``dtype`` that begin at ``starts``; beyond the end of the data they read zeros."""
    padded = np.frombuffer(data + bytes(dtype.itemsize), np.uint8)
    index = starts[:, None] + np.arange(dtype.itemsize)[None, :]
    return np.ascontiguousarray(padded[index]).view(dtype)[:, 0]


def check_format(path: Path, run: Mapping[str, str]) -> None:
    """Refuse a log of a later format than this version knows. Raises LogError."""
    number = run.get("format", "1")
    if not number.isdecimal() or not 1 <= int(number[:9]) <= FORMAT:
        by = f"hil-drive {run.get('version hil-drive', 'unknown')}"
        raise LogError(
            f"{path}: is of format {number:.20}, written by {by:.60}; this version reads 1 to {FORMAT}; "
            "take a later one"
        )


def read_blocks(log: Log) -> Generator[Block, None, None]:
    """Go through a log chunk by chunk; metadata, events and damage gather in ``log`` on the way.

    Raises LogError for what is no log of hil at all, or one of another version.
    """
    return _read_parts(log) if len(log.parts) > 1 else _read_file(log)


def _read_parts(log: Log) -> Generator[Block, None, None]:
    """The files of a split run as one: header and kept state are the first part's, the result the last's."""
    damages = []
    for number, path in enumerate(log.parts):
        part = Log(path, new_ticks(0), events=log.events, event_count=log.event_count)
        if number == 0:
            part.metadata, part.attachments = log.metadata, log.attachments
        for block in _read_file(part):
            log.absent, log.unknown = log.absent | part.absent, part.unknown
            log.last_t_ns = part.last_t_ns if part.last_t_ns is not None else log.last_t_ns
            log.tick_count += len(block.records) if block.kind == "ticks" else 0
            yield block
        log.bytes_lost, log.event_count = log.bytes_lost + part.bytes_lost, part.event_count
        log.metadata.pop("result", None) if "result" not in part.metadata else log.metadata.update(
            result=part.metadata["result"]
        )
        damages += [f"{path.name}: {part.damage}"] if part.damage else []
    log.damage = "; ".join(damages) or None


def new_log(source: Source, node: str = "") -> Log:
    """A log to be read from one file, or from the parts of a split run; ``node``: see :class:`Log`.

    Raises LogError for none there.
    """
    paths = (source,) if isinstance(source, Path) else tuple(source)
    for path in paths:
        if not path.is_file():
            raise LogError(f"{path}: no such file")
    return Log(paths[0], new_ticks(0), parts=paths if len(paths) > 1 else (), node=node)


def _read_file(log: Log) -> Generator[Block, None, None]:
    """One file."""
    one = _Pass(log)
    try:
        for raw in gathered(raw_records(log.path)):
            yield from one.take(raw)
    except DamagedError as error:
        one.problems.append(str(error))
    except OSError as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{log.path}: can't be read: {error.strerror}") from error
    if not one.ours and "run" not in log.metadata:
        raise LogError(
            f"{log.path}: is no log of hil ({'; '.join(one.problems) or 'it has no run metadata'})"
        )
    if log.node and log.node not in log.nodes:
        raise LogError(f"{log.path}: has no node {log.node!r:.40}; {_named(log.nodes)}")
    if one.unreadable and not one.messages_seen:
        raise LogError(f"{log.path}: {one.unreadable}; rewrite it with zstd, lz4 or none")
    if one.problems:
        log.damage = _damage(log, one)


def _named(nodes: Sequence[str]) -> str:
    """Which nodes there are."""
    return f"it has {' and '.join(nodes)}" if nodes else "it is of one drive: leave the node out"


def _damage(log: Log, one: _Pass) -> str:
    """One line: what is wrong, how much is good, what is missing."""
    text = "; ".join(one.problems[:3]) + ("; and more" if len(one.problems) > 3 else "")
    last = "" if log.last_t_ns is None else f", the last at t = {log.last_t_ns * 1e-9:.3f} s"
    missing = "" if one.complete else "; the summary is missing"
    ended = "" if "result" in log.metadata else "; the result is missing"
    return f"damaged: {text}; {log.tick_count} ticks are good{last}{missing}{ended}"


class _Kept:
    """Blocks held in memory, refused before they exhaust it.

    Ticks are gathered in slabs so large that the allocator gives each back to the system when it is let go;
    so memory holds the ticks about once, also while they are joined.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._room = int(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") * MEMORY_SHARE)
        self._slabs: list[TickArray] = []
        self._filled = SLAB_TICKS
        self.frames: list[Frame] = []

    def add(self, block: Block) -> None:
        """Keep a block. Raises LogError when the log does not fit."""
        self._room -= block.records.nbytes * (1 if block.kind == "ticks" else FRAME_OBJECT_RATIO)
        if self._room < 0:
            raise LogError(f"{self._path}: does not fit into memory; read it block by block (read_blocks)")
        if block.kind == "ticks":
            self._add_ticks(block.records)
        else:
            self.frames += [
                Frame(bool(received), t_ns, can_id, bytes(data[:size]))
                for t_ns, can_id, received, size, data in block.records.tolist()
            ]

    def _add_ticks(self, ticks: TickArray) -> None:
        ticks = ticks.view(_WHOLE)
        while len(ticks):
            if self._filled == SLAB_TICKS:
                self._slabs.append(np.empty(SLAB_TICKS, _WHOLE))
                self._filled = 0
            part = ticks[: SLAB_TICKS - self._filled]
            self._slabs[-1][self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            ticks = ticks[len(part) :]

    def joined(self) -> TickArray:
        """All ticks; a slab is let go as soon as it is copied."""
        if not self._slabs:
            return new_ticks(0)
        self._slabs[-1] = self._slabs[-1][: self._filled]
        out, at = np.empty(sum(map(len, self._slabs)), _WHOLE), 0
        self._slabs.reverse()
        while self._slabs:
            slab = self._slabs.pop()
            out[at : at + len(slab)] = slab
            at += len(slab)
        return out.view(TICK)


def open_log(source: Source | str, *, frames: bool = True, node: str = "") -> Log:
    """Read a log up to and around its damage. Raises LogError for what is no log of hil at all.

    ``node``: of a run with several nodes the one to read; empty: the first.
    """
    log = new_log(Path(source) if isinstance(source, str) else source, node)
    kept = _Kept(log.path)
    for block in read_blocks(log):
        if block.kind == "ticks" or frames:
            kept.add(block)
    if node and log.nodes[0] == node:  # its ticks are those of /tick
        log = open_log(source, frames=frames)
        log.node = node
        return log
    log.ticks, log.frames = kept.joined(), kept.frames
    return log
