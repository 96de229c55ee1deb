"""Protobuf schemas of the logged topics, built from the field tables and embedded in every file.

A TICK record's bytes are a valid ``hil.Tick`` message. Units and meanings of the fields go to the file's
metadata, since a descriptor carries no comments.
"""

from __future__ import annotations

import struct
from typing import Final

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from hil.signals import FIELDS

TOPICS: Final = {"/tick": "hil.Tick", "/can/rx": "hil.CanFrame", "/can/tx": "hil.CanFrame", "/event": "hil.Event",
                 "/stats": "hil.Stats"}
_TYPES: Final = {
    "f8": FieldDescriptorProto.TYPE_DOUBLE,
    "u8": FieldDescriptorProto.TYPE_FIXED64,
    "i8": FieldDescriptorProto.TYPE_SFIXED64,
    "u4": FieldDescriptorProto.TYPE_FIXED32,
    "i4": FieldDescriptorProto.TYPE_SFIXED32,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
    "string": FieldDescriptorProto.TYPE_STRING,
}
_OTHERS: Final = {
    "CanFrame": (("t_ns", "i8"), ("can_id", "u4"), ("data", "bytes")),
    "Event": (("t_ns", "i8"), ("k", "u8"), ("kind", "string"), ("text", "string")),
    "Stats": (("t_ns", "i8"), ("ticks", "u8"), ("dropped", "u8"), ("high_water", "u8"), ("frames", "u8")),
}


def file_descriptor_set() -> FileDescriptorSet:
    """All messages of package ``hil``."""
    file = FileDescriptorProto(name="hil.proto", package="hil", syntax="proto3")
    tick = file.message_type.add(name="Tick")
    for field in FIELDS:
        tick.field.add(name=field.name, number=field.number, type=_TYPES[field.kind], label=1)
    for name, fields in _OTHERS.items():
        message = file.message_type.add(name=name)
        for number, (field_name, kind) in enumerate(fields, start=1):
            message.field.add(name=field_name, number=number, type=_TYPES[kind], label=1)
    return FileDescriptorSet(file=[file])


def units() -> dict[str, str]:
    """Unit of each field of a tick, for the file's metadata."""
    return {field.name: field.unit for field in FIELDS}


def meanings() -> dict[str, str]:
    """Meaning of each field of a tick, for the file's metadata."""
    return {field.name: field.doc for field in FIELDS}


def _length_delimited(number: int, data: bytes) -> bytes:
    """A bytes or string field of fewer than 16384 bytes."""
    size = len(data)
    varint = bytes((size,)) if size < 128 else bytes((size & 0x7F | 0x80, size >> 7))
    return bytes((number << 3 | 2,)) + varint + data


def pack_can_frame(t_ns: int, can_id: int, data: bytes) -> bytes:
    """A ``hil.CanFrame``; can_id with SocketCAN's flag bits."""
    return struct.pack("<BqBI", 0x09, t_ns, 0x15, can_id) + _length_delimited(3, data)


def unpack_can_frame(raw: bytes) -> tuple[int, int, bytes]:
    """Inverse of :func:`pack_can_frame`: (t_ns, can_id, data)."""
    _, t_ns, _, can_id = struct.unpack_from("<BqBI", raw)
    size = raw[15]
    return t_ns, can_id, raw[16 : 16 + size]


def pack_event(t_ns: int, k: int, kind: str, text: str) -> bytes:
    """A ``hil.Event``."""
    head = struct.pack("<BqBQ", 0x09, t_ns, 0x11, k)
    return head + _length_delimited(3, kind.encode()) + _length_delimited(4, text.encode()[:8000])


def pack_stats(t_ns: int, ticks: int, dropped: int, high_water: int, frames: int) -> bytes:
    """A ``hil.Stats``."""
    return struct.pack("<BqBQBQBQBQ", 0x09, t_ns, 0x11, ticks, 0x19, dropped, 0x21, high_water, 0x29, frames)
