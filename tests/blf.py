"""BLF by hand, as Vector's header ``binlog_objects.h`` lays its objects out; no library has a part in it."""

from __future__ import annotations

import struct
import zlib

HEADER_SIZE, OBJECT_SIZE = 144, 32
EXTENDED = 0x8000_0000
START = (2026, 11, 5, 27, 8, 23, 47, 920)
RECEIVED, SENT, REQUESTED = 0, 1, 2


def of(kind: int, t_ns: int, body: bytes, *, version: int = 1, ten_us: bool = False) -> bytes:
    """An object: VBLObjectHeader (or VBLObjectHeader2), the body, padding."""
    size = OBJECT_SIZE + (8 if version == 2 else 0)
    head = struct.pack("<4sHHII", b"LOBJ", size, version, size + len(body), kind)
    stamp = t_ns // 10_000 if ten_us else t_ns
    rest = struct.pack("<IHHQ", 1 if ten_us else 2, 0, 0, stamp) + bytes(8 if version == 2 else 0)
    return head + rest + body + bytes((size + len(body)) % 4)


def message(
    number: int, data: bytes = b"", *, way: int = SENT, remote: bool = False, dlc: int | None = None
) -> bytes:
    """VBLCANMessage: mChannel, mFlags, mDLC, mID, mData[8]."""
    flags = way | (0x80 if remote else 0)
    return struct.pack("<HBBI8s", 1, flags, len(data) if dlc is None else dlc, number, data)


def message_2(number: int, data: bytes = b"", *, way: int = SENT) -> bytes:
    """VBLCANMessage2: the same, then mFrameLength, mBitCount."""
    return message(number, data, way=way) + struct.pack("<IBBH", 0, 0, 0, 0)


def error() -> bytes:
    """VBLCANErrorFrame: mChannel, mLength."""
    return struct.pack("<HHI", 1, 0, 0)


def error_ext(number: int, data: bytes, registers: int) -> bytes:
    """VBLCANErrorFrameExt: mChannel, mLength, mFlags, mECC, mPosition, mDLC, length in ns, mID, mFlagsExt."""
    body = struct.pack("<HHIBBBBIIHH", 1, 6, registers, 0x19, 3, len(data), 0, 0, number, 0, 0)
    return body + data.ljust(8, b"\0")


def fd(number: int, data: bytes, *, way: int = SENT, edl: bool = True) -> bytes:
    """VBLCANFDMessage: mChannel, mFlags, mDLC, mID, mFrameLength, bits, mCANFDFlags, mValidDataBytes."""
    return struct.pack(
        "<HBBIIBBB5x64s", 1, way, dlc_of(len(data)), number, 0, 0, 3 if edl else 0, len(data), data
    )


def fd_64(number: int, data: bytes, *, way: int = SENT, edl: bool = True, kept: int | None = None) -> bytes:
    """VBLCANFDMessage64; of the data ``kept`` bytes are in the file."""
    flags = 0x3000 if edl else 0
    head = (1, dlc_of(len(data)), len(data), 0, number, 0, flags, 0, 0, 0, 0, 0, way, 0, 0)
    return struct.pack("<BBBBIIIIIIIHBBI", *head) + data[:kept]


def fd_error(number: int, data: bytes) -> bytes:
    """VBLCANFDErrorFrame64, whose identifier and data are those of the frame that was disturbed."""
    head = (1, dlc_of(len(data)), len(data), 0x19, 1, 0, 0, 0, 0, number, 0, 0, 0, 0, 0, 0, 9, 0)
    return struct.pack("<BBBBHHHBBIIIIIIIHH", *head) + data


def dlc_of(size: int) -> int:
    """Data length code."""
    return (*range(9), 12, 16, 20, 24, 32, 48, 64).index(size)


def container(data: bytes, method: int = 2) -> bytes:
    """VBLLogContainer."""
    packed = zlib.compress(data) if method == 2 else data
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10)
    return head + struct.pack("<H6xI4x", method, len(data)) + packed + bytes(len(packed) % 4)


def file_of(*parts: bytes, start: tuple[int, ...] = START) -> bytes:
    """A file's header before its containers or bare objects."""
    size = HEADER_SIZE + sum(map(len, parts))
    head = struct.pack("<4sI8BQQII", b"LOGG", HEADER_SIZE, 1, 0, 0, 0, 2, 6, 8, 1, size, size, 0, 0)
    return (head + struct.pack("<16H", *start, *start)).ljust(HEADER_SIZE, b"\0") + b"".join(parts)
