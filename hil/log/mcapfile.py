"""One run as an MCAP file: topics, metadata, attachments. Used by the writer process and by `hil simulate`.

Ticks have chunks of their own, so that they are read and written as one array; frames, events and
statistics share theirs.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from hil.log.check import NAME, seal
from hil.log.container import FIXED_BYTES, HEAD_BYTES, MESSAGE_HEAD, Block, Container, Integers
from hil.log.schema import (
    FRAME,
    FRAME_HEAD,
    FRAME_MESSAGE,
    TOPICS,
    Records,
    file_descriptor_set,
    frame_messages,
    meanings,
    node_topic,
    pack_event,
    pack_stats,
    units,
)
from hil.log.ticks import OWN, form_of, logged_as
from hil.signals import TickArray

Column = npt.NDArray[Any] | int

CHUNK_BYTES: Final = 256 * 1024
MESSAGE: Final = 5
HEAD: Final = np.dtype(MESSAGE_HEAD)
TICK_MESSAGE: Final = form_of(OWN).message
_FRAME_MESSAGE: Final = np.dtype([*MESSAGE_HEAD, ("data", FRAME_MESSAGE)])


class RunFile:
    """A run's file. Raises OSError when it can't be written; what was written before stays readable."""

    def __init__(
        self,
        path: Path,
        header: dict[str, Any],
        chunk_bytes: int = CHUNK_BYTES,
        absent: frozenset[str] = frozenset(),
    ) -> None:
        """``absent``: fields that the ticks to come do not have, since an older log is copied."""
        self._absent = absent
        self._form = form_of([row for row in OWN if row[1] not in absent])
        self._out = Container(path, header.get("compression", "zstd"))
        self._limit = chunk_bytes
        self._nodes: list[str] = header.get("nodes", [])
        self._ticks = {topic: Block() for topic in ("/tick", *map(node_topic, self._nodes))}
        self._others = Block()
        self.ticks = self.frames = 0
        try:
            self._open(header)
        except OSError:
            self._out.close()
            raise

    def _open(self, header: dict[str, Any]) -> None:
        """Schemas and channels, then metadata ``run``, ``units``, ``meanings`` and the run's attachments."""
        descriptors = file_descriptor_set(self._absent).SerializeToString()
        schemas = {name: self._out.add_schema(name, descriptors) for name in sorted(set(TOPICS.values()))}
        self._channels = {
            topic: self._out.add_channel(topic, schemas[name])
            for topic, name in (*TOPICS.items(), *((node_topic(n), TOPICS["/tick"]) for n in self._nodes))
        }
        self._out.add_metadata("run", {str(k): str(v) for k, v in header.get("metadata", {}).items()})
        for name, values in header.get("more", {}).items():
            self._out.add_metadata(name, {str(k): str(v) for k, v in values.items()})
        self._out.add_metadata("units", units())
        self._out.add_metadata("meanings", meanings())
        for name, text in header.get("attachments", {}).items():
            self._out.add_attachment(name, text.encode())

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._out.size

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write metadata of another name."""
        self._out.add_metadata(name, values)

    def add_ticks(self, ticks: TickArray, node: str = "") -> None:
        """Append tick records (any number), of another ``node`` than the first by its name."""
        per_chunk = max(1, self._limit // self._form.message.itemsize)
        for at in range(0, len(ticks), per_chunk):
            self._add_ticks(ticks[at : at + per_chunk], node_topic(node) if node else "/tick")
        self.ticks += 0 if node else len(ticks)

    def _add_ticks(self, ticks: TickArray, topic: str) -> None:
        layout, message = self._form.layout, self._form.message
        messages = np.empty(len(ticks), message)
        self._head(messages, self._channels[topic], ticks["t_ns"], ticks["k"] & 0xFFFFFFFF)
        messages["length"] = FIXED_BYTES + layout.itemsize
        messages["data"] = logged_as(ticks, self._form).view(f"V{layout.itemsize}")
        if NAME not in self._absent:
            seal(messages["data"].view(layout), self._absent)
        lengths = np.full(len(ticks), message.itemsize, np.int64)
        block = self._ticks[topic]
        block.add(messages["channel"].astype(np.int64), ticks["t_ns"], lengths, messages.tobytes())
        if block.size + message.itemsize > self._limit:
            self._ticks[topic] = self._close(block)

    @staticmethod
    def _head(messages: Records, channels: Column, times: Column, sequence: Column) -> None:
        """Fill in what every message has; publish_time is log_time, the deadline or the receive stamp."""
        messages["opcode"] = MESSAGE
        messages["channel"], messages["sequence"] = channels, sequence
        messages["log_time"] = messages["publish_time"] = times

    def add_frames(self, frames: Records) -> None:
        """Append FRAME records (any number)."""
        per_chunk = max(1, self._limit // _FRAME_MESSAGE.itemsize)
        for at in range(0, len(frames), per_chunk):
            self._add_frames(frames[at : at + per_chunk])

    def _add_frames(self, frames: Records) -> None:
        """Messages of full width are made at once, then the bytes after each frame's end are left out."""
        messages = np.empty(len(frames), _FRAME_MESSAGE)
        rx, tx = self._channels["/can/rx"], self._channels["/can/tx"]
        channels = np.where(frames["received"] != 0, rx, tx).astype(np.int64)
        sequence = np.arange(self.frames, self.frames + len(frames)) & 0xFFFFFFFF
        self._head(messages, channels, frames["t_ns"], sequence)
        size = np.minimum(frames["size"], FRAME["data"].shape[0]).astype(np.int64)
        messages["length"] = FIXED_BYTES + FRAME_HEAD + size
        messages["data"] = frame_messages(frames)
        lengths = HEAD_BYTES + FRAME_HEAD + size
        wide = messages.view(np.uint8).reshape(len(frames), -1)
        raw = wide[np.arange(wide.shape[1])[None, :] < lengths[:, None]].tobytes()
        self._add_others(channels, frames["t_ns"], lengths, raw)
        self.frames += len(frames)

    def _add_others(self, channels: Integers, times: Integers, lengths: Integers, raw: bytes) -> None:
        self._others.add(channels, times, lengths, raw)
        if self._others.size > self._limit:
            self._others = self._close(self._others)

    def _add_one(self, topic: str, t_ns: int, data: bytes) -> None:
        head = np.empty(1, HEAD)
        self._head(head, self._channels[topic], t_ns, 0)
        head["length"] = FIXED_BYTES + len(data)
        channel, time, length = (
            np.array([value], np.int64) for value in (self._channels[topic], t_ns, HEAD_BYTES + len(data))
        )
        self._add_others(channel, time, length, head.tobytes() + data)

    def add_event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Append one event."""
        self._add_one("/event", t_ns, pack_event(t_ns, k, kind, text))

    def add_stats(self, t_ns: int, values: dict[str, int]) -> None:
        """Append the writer's own figures, named as in :mod:`hil.log.schema`."""
        self._add_one("/stats", t_ns, pack_stats(t_ns, values))

    def _close(self, block: Block) -> Block:
        """Write a block if there is anything in it; return an empty one."""
        if block.count:
            self._out.add_chunk(block)
        return Block()

    def check_place(self, path: Path) -> None:
        """Raise OSError when the file is no longer at its path, open or finished."""
        self._out.check_place(path)

    def flush(self) -> None:
        """Close the chunks in the making and hand them to the operating system."""
        for topic, block in self._ticks.items():
            self._ticks[topic] = self._close(block)
        self._others = self._close(self._others)

    def finish(self, result: dict[str, Any]) -> None:
        """Write what is left, metadata ``result``, summary and footer; close."""
        try:
            self.flush()
            self._seal(result)
        except OSError:
            self._out.close()
            raise

    def _seal(self, result: dict[str, Any]) -> None:
        self._out.add_metadata("result", {"result": json.dumps(result, allow_nan=True)})
        self._out.finish()

    def abandon(self, why: str) -> None:
        """After a failed write: leave out what couldn't be written, finish the file if that still goes."""
        with contextlib.suppress(OSError):
            self._seal({"ended": why})
        self._out.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        """Leaving through an exception still leaves a complete file that names it."""
        if error is not None:
            self.abandon(f"{type(error).__name__}: {error}")
        else:
            self._out.close()
