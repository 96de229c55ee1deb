"""Frames into recordings of the bus: candump, ASC, BLF, MF4. Times are the log's, set off to its start.

A frame of more than 8 bytes is a CAN FD frame; a log does not keep whether a shorter one was.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import can
import numpy as np

from hil.convert.frame import need
from hil.log.reader import Log
from hil.log.schema import Records

EXTENDED, REMOTE, ERROR, ID_MASK = 0x80000000, 0x40000000, 0x20000000, 0x1FFFFFFF
_PLAIN: Final = re.compile(r"[A-Za-z0-9._-]{1,15}")


def start_s(log: Log) -> float:
    """Wall time of the run's start [s since 1970]; 0 when the log does not say."""
    try:
        return datetime.fromisoformat(log.metadata.get("run", {}).get("started", "")).timestamp()
    except ValueError:
        return 0.0


class _Recording:
    """What the recordings share: the time of the first frame is the start of the run."""

    def __init__(self, log: Log) -> None:
        self._start_us = round(start_s(log) * 1e6)
        self._first_ns: int | None = None

    def _rows(self, frames: Records) -> Iterable[tuple[int, int, int, int]]:
        """(t, can_id, received, size) of each frame; t in us since 1970, which all common tools resolve."""
        if self._first_ns is None:
            self._first_ns = int(frames["t_ns"][0])
        times = self._start_us + (frames["t_ns"] - self._first_ns) // 1000
        others = (frames[name].tolist() for name in ("can_id", "received", "size"))
        return zip(times.tolist(), *others, strict=True)


class Candump(_Recording):
    """can-utils' log format, direction included (R received, T transmitted)."""

    def __init__(self, path: Path, log: Log, channel: str) -> None:
        super().__init__(log)
        self._channel = channel if _PLAIN.fullmatch(channel) else "can0"
        self._file = path.open("w", encoding="ascii", newline="\n")

    def add(self, frames: Records) -> None:
        """Append frames as lines."""
        lines, channel = [], self._channel
        raw = frames["data"].tobytes().hex().upper()
        for at, (t_us, can_id, received, size) in enumerate(self._rows(frames)):
            number = f"{can_id & ID_MASK:08X}" if can_id & EXTENDED else f"{can_id & 0x7FF:03X}"
            data = raw[at * 128 : at * 128 + 2 * size]
            body = f"{number}##1{data}" if size > 8 else f"{number}#{'R' if can_id & REMOTE else data}"
            stamp, way = f"({t_us // 1000000}.{t_us % 1000000:06d})", "R" if received else "T"
            lines.append(f"{stamp} {channel} {body} {way}\n")
        self._file.write("".join(lines))

    def close(self, *, whole: bool) -> None:
        """Flush and close."""
        self._file.close()


class Vector(_Recording):
    """ASC or BLF by python-can's writer."""

    def __init__(self, writer: Any, log: Log) -> None:
        super().__init__(log)
        self._writer = writer

    def add(self, frames: Records) -> None:
        """Append frames as messages."""
        raw, put = frames["data"].tobytes(), self._writer.on_message_received
        for at, (t_us, can_id, received, size) in enumerate(self._rows(frames)):
            put(
                can.Message(
                    timestamp=t_us * 1e-6,
                    arbitration_id=can_id & ID_MASK,
                    is_extended_id=bool(can_id & EXTENDED),
                    is_remote_frame=bool(can_id & REMOTE),
                    data=raw[at * 64 : at * 64 + size],
                    dlc=size,
                    is_fd=size > 8,
                    bitrate_switch=size > 8,
                    is_rx=bool(received),
                )
            )

    def close(self, *, whole: bool) -> None:
        """Finish the file."""
        self._writer.stop()


_GROUPS: Final = ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame")
_FIELDS: Final = (
    ("BusChannel", "u1"), ("ID", "<u4"), ("IDE", "u1"), ("DLC", "u1"), ("DataLength", "u1"),
    ("DataBytes", "u1", (64,)), ("Dir", "u1"), ("EDL", "u1"), ("BRS", "u1"), ("ESI", "u1"),
)  # fmt: skip
_DLC: Final = np.searchsorted([*range(9), 12, 16, 20, 24, 32, 48, 64], np.arange(65)).astype(np.uint8)


def _group_dtype(group: str) -> np.dtype[np.void]:
    """The structure of a group by ASAM's bus logging; a remote frame has neither data nor FD flags."""
    fields = _FIELDS[:5] + _FIELDS[6:7] if group == "CAN_RemoteFrame" else _FIELDS
    return np.dtype([(f"{group}.{name}", *rest) for name, *rest in fields])


class Mf4Recording(_Recording):
    """MF4 by ASAM's bus logging through asammdf: data, remote and error frames in a group each.

    Whole blocks at once; python-can's own writer takes message by message.
    """

    def __init__(self, path: Path, log: Log) -> None:
        super().__init__(log)
        asammdf = need("asammdf", "MF4")
        blocks = need("asammdf.blocks.v4_constants", "MF4")
        source = need("asammdf.blocks.v4_blocks", "MF4").SourceInformation(
            source_type=blocks.SOURCE_BUS, bus_type=blocks.BUS_TYPE_CAN
        )
        self._path, self._file = path, asammdf.MDF(version="4.10")
        self._file.header.start_time = datetime.fromtimestamp(self._start_us * 1e-6).astimezone()
        for group in _GROUPS:
            samples = np.empty(0, _group_dtype(group))
            self._file.append(asammdf.Signal(samples, np.empty(0), name=group, source=source))

    def add(self, frames: Records) -> None:
        """Append frames, each to its group."""
        first_ns = self._first_ns = int(frames["t_ns"][0]) if self._first_ns is None else self._first_ns
        can_id = frames["can_id"]
        kind = np.where(can_id & ERROR, 2, np.where(can_id & REMOTE, 1, 0))
        for index, group in enumerate(_GROUPS):
            own = frames[kind == index]
            if len(own):
                seconds = (own["t_ns"] - first_ns) // 1000 * 1e-6
                self._file.extend(index, [(seconds, None), (_group_rows(group, own), None)])

    def close(self, *, whole: bool) -> None:
        """Write the file, when it is whole; let go of the temporary one."""
        try:
            if whole:
                self._file.save(self._path, overwrite=True)
        finally:
            self._file.close()


def _group_rows(group: str, frames: Records) -> Records:
    """Frames in the structure of their group."""
    rows, fd = np.zeros(len(frames), _group_dtype(group)), frames["size"] > 8
    values = {
        "ID": frames["can_id"] & ID_MASK,
        "IDE": (frames["can_id"] & EXTENDED) != 0,
        "DLC": _DLC[frames["size"]],
        "DataLength": frames["size"],
        "DataBytes": frames["data"],
        "Dir": frames["received"] == 0,
        "EDL": fd,
        "BRS": fd,
    }
    for name, column in values.items():
        if f"{group}.{name}" in (rows.dtype.names or ()):
            rows[f"{group}.{name}"] = column
    return rows
