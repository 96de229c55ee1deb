"""What the logged bytes mean: protobuf schemas, built from the field tables and embedded in every file.

A TICK record's bytes are a valid ``hil.Tick`` message. The other messages are laid out here as packed
dtypes in the same way: each value is preceded by its protobuf tag, so that many are made or read at once.
Units and meanings of the fields go to the file's metadata, since a descriptor carries no comments.
"""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

from hil.signals import FIELDS

Records = npt.NDArray[np.void]
Bytes = npt.NDArray[np.uint8]

TOPICS: Final = {
    "/tick": "hil.Tick",
    "/can/rx": "hil.CanFrame",
    "/can/tx": "hil.CanFrame",
    "/event": "hil.Event",
    "/stats": "hil.Stats",
}


def node_topic(node: str) -> str:
    """Where the ticks of a second node on the bus go; those of the first go to ``/tick``."""
    return f"/tick/{node}"


FRAME: Final = np.dtype(
    [("t_ns", "<i8"), ("can_id", "<u4"), ("received", "u1"), ("size", "u1"), ("data", "u1", (64,))]
)
"""A CAN frame as the ring and the reader hold it; ``can_id`` carries SocketCAN's flag bits."""
FRAME_MESSAGE: Final = np.dtype(
    [
        ("_1", "u1"), ("t_ns", "<i8"), ("_2", "u1"), ("can_id", "<u4"),
        ("_3", "u1"), ("size", "u1"), ("data", "u1", (64,)),
    ]
)  # fmt: skip
"""A ``hil.CanFrame`` with room for 64 bytes; of a shorter frame the message is the first 16 + size bytes."""
FRAME_HEAD: Final = FRAME_MESSAGE.itemsize - 64
FRAME_TAGS: Final = (("_1", 0x09), ("_2", 0x15), ("_3", 0x1A))

TYPES: Final[dict[str, Any]] = {
    "f8": FieldDescriptorProto.TYPE_DOUBLE,
    "u8": FieldDescriptorProto.TYPE_FIXED64,
    "i8": FieldDescriptorProto.TYPE_SFIXED64,
    "u4": FieldDescriptorProto.TYPE_FIXED32,
    "i4": FieldDescriptorProto.TYPE_SFIXED32,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
    "string": FieldDescriptorProto.TYPE_STRING,
}
_STATS: Final = (
    "ticks", "dropped", "high_water", "frames", "dropped_frames", "dropped_events",
    "lateness_p50_ns", "lateness_p99_ns", "lateness_max_ns", "file_bytes",
)  # fmt: skip
_OTHERS: Final = {
    "CanFrame": (("t_ns", "i8"), ("can_id", "u4"), ("data", "bytes")),
    "Event": (("t_ns", "i8"), ("k", "u8"), ("kind", "string"), ("text", "string")),
    "Stats": (("t_ns", "i8"), *((name, "i8") for name in _STATS)),
}


def file_descriptor_set(absent: frozenset[str] = frozenset()) -> FileDescriptorSet:
    """All messages of package ``hil``; a tick without the fields that are ``absent``."""
    file = FileDescriptorProto(name="hil.proto", package="hil", syntax="proto3")
    tick = file.message_type.add(name="Tick")
    for field in FIELDS:
        if field.name not in absent:
            tick.field.add(name=field.name, number=field.number, type=TYPES[field.kind], label=1)
    for name, fields in _OTHERS.items():
        message = file.message_type.add(name=name)
        for number, (field_name, kind) in enumerate(fields, start=1):
            message.field.add(name=field_name, number=number, type=TYPES[kind], label=1)
    return FileDescriptorSet(file=[file])


def message_layout(descriptors: bytes, name: str) -> list[tuple[int, str, int]] | None:
    """(number, name, type) of each field of message ``hil.NAME``; None when there is none."""
    try:
        files = FileDescriptorSet.FromString(descriptors).file
    except DecodeError:
        return None
    for file in files:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == name:
                return [(field.number, field.name, int(field.type)) for field in message.field]
    return None


def units() -> dict[str, str]:
    """Unit of each field of a tick, for the file's metadata."""
    return {field.name: field.unit for field in FIELDS}


def meanings() -> dict[str, str]:
    """Meaning of each field of a tick, for the file's metadata."""
    return {field.name: field.doc for field in FIELDS}


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _text(number: int, text: str) -> bytes:
    """A string field."""
    data = text.encode(errors="replace")
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def pack_event(t_ns: int, k: int, kind: str, text: str) -> bytes:
    """A ``hil.Event``."""
    return struct.pack("<BqBQ", 0x09, t_ns, 0x11, k) + _text(3, kind) + _text(4, text)


def _take_text(raw: bytes, at: int) -> tuple[str, int]:
    """The string field at ``at``, and where it ends. Raises ValueError or IndexError."""
    at += 1
    size = shift = 0
    while raw[at] & 0x80 and shift < 28:
        size, at, shift = size | (raw[at] & 0x7F) << shift, at + 1, shift + 7
    size, at = size | raw[at] << shift, at + 1
    if at + size > len(raw):
        raise ValueError("a text runs over the end of its message")
    return raw[at : at + size].decode(errors="replace"), at + size


def unpack_event(raw: bytes) -> tuple[int, int, str, str]:
    """Inverse of :func:`pack_event`: (t_ns, k, kind, text). Raises ValueError for other bytes."""
    try:
        _, t_ns, _, k = struct.unpack_from("<BqBQ", raw)
        kind, at = _take_text(raw, 18)
        return t_ns, k, kind, _take_text(raw, at)[0]
    except (struct.error, IndexError) as error:
        raise ValueError("not an event message") from error


def pack_stats(t_ns: int, values: dict[str, int]) -> bytes:
    """A ``hil.Stats``; a value that is not given is left out, which protobuf reads as 0."""
    out = struct.pack("<Bq", 0x09, t_ns)
    for number, name in enumerate(_STATS, start=2):
        if name in values:
            out += _varint(number << 3 | 1) + struct.pack("<q", values[name])
    return out


def frame_messages(frames: Records) -> Records:
    """FRAME records as FRAME_MESSAGE records, tags in place; bytes after a frame's size mean nothing."""
    out = np.empty(len(frames), FRAME_MESSAGE)
    for name, tag in FRAME_TAGS:
        out[name] = tag
    for name in ("t_ns", "can_id", "size", "data"):
        out[name] = frames[name]
    return out


def frames_from_messages(
    messages: Records, lengths: npt.NDArray[np.int64], received: npt.NDArray[np.bool_] | bool
) -> Records:
    """Inverse of :func:`frame_messages`. Raises ValueError when bytes are no message of ours."""
    if any((messages[name] != tag).any() for name, tag in FRAME_TAGS) or (messages["size"] > 64).any():
        raise ValueError("not a frame message")
    if (lengths != messages["size"].astype(np.int64) + FRAME_HEAD).any():
        raise ValueError("a frame message of another length than it says")
    out = np.zeros(len(messages), FRAME)
    for name in ("t_ns", "can_id", "size"):
        out[name] = messages[name]
    out["received"] = received
    inside = np.arange(64)[None, :] < messages["size"][:, None]
    out["data"] = np.where(inside, messages["data"], 0)
    return out
