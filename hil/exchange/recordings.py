"""Frames into recordings of the bus: candump, ASC, BLF, MF4. Times are the log's, set off to its start.

An error frame stays one, with its class and its data, a remote frame stays one, with the length it asks for.
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

from hil.exchange.readers.asc import ERROR_COMMENT, START_COMMENT
from hil.exchange.readers.recorded import ERROR, EXTENDED, ID_MASK, REMOTE
from hil.log.frame import need
from hil.log.reader import Log
from hil.log.schema import Records

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
            body = candump_body(can_id, size, raw[at * 128 : at * 128 + 2 * size])
            stamp, way = f"({t_us // 1000000}.{t_us % 1000000:06d})", "R" if received else "T"
            lines.append(f"{stamp} {channel} {body} {way}\n")
        self._file.write("".join(lines))

    def close(self, *, whole: bool) -> None:
        """Flush and close."""
        self._file.close()


def candump_body(can_id: int, size: int, data: str) -> str:
    """Identifier and data of a frame as candump -l writes them; ``data`` in hexadecimal digits."""
    if can_id & ERROR:
        return f"{can_id & (ERROR | ID_MASK):08X}#{data}"
    number = f"{can_id & ID_MASK:08X}" if can_id & EXTENDED else f"{can_id & 0x7FF:03X}"
    if can_id & REMOTE:
        return f"{number}#R{size or ''}"
    return f"{number}##1{data}" if size > 8 else f"{number}#{data}"


_DAYS: Final = ["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"]
_MONTHS: Final = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"]
_FD_ROW: Final = "CANFD   1 {way:<4} {number:>8}  {name:>32} 1 0 {dlc:x} {size:>2} {data} {zeros}"
_FD_ZEROS: Final = "       0    0     3000        0        0        0        0        0"
"""Duration, length, flags (CAN FD with bit rate switch), CRC and bit timings of a CAN FD frame."""


def asc_date(t_us: int) -> str:
    """Local time as Vector's tools write it, in English whatever the locale, with three digits of ms."""
    date = datetime.fromtimestamp(t_us // 1_000_000).astimezone()
    day, month = _DAYS[date.weekday()], _MONTHS[date.month - 1]
    return f"{day} {month} {date.day:02d} {date:%H:%M:%S}.{t_us // 1000 % 1000:03d} {date.year}"


class Asc(_Recording):
    """Vector's ASC in python-can's layout.

    Written here: python-can 4.6.1 writes 45 ms as ".45", and day and month in the process's locale. What the
    format has no place for stands in comments: the start to the microsecond, an error's class and data.
    """

    def __init__(self, path: Path, log: Log) -> None:
        super().__init__(log)
        self._file = path.open("w", encoding="ascii", newline="\n")
        date, start_us = asc_date(self._start_us), self._start_us
        self._file.write(
            f"date {date}\nbase hex  timestamps absolute\ninternal events logged\n"
            f"{START_COMMENT}{start_us // 1_000_000}.{start_us % 1_000_000:06d} s since 1970\n"
            f"Begin Triggerblock {date}\n 0.000000 Start of measurement\n"
        )

    def add(self, frames: Records) -> None:
        """Append frames as lines."""
        raw = frames["data"].tobytes()
        rows = enumerate(self._rows(frames))
        self._file.writelines(
            self._line(t_us - self._start_us, can_id, received, raw[at * 64 : at * 64 + size])
            for at, (t_us, can_id, received, size) in rows
        )

    @staticmethod
    def _line(t_us: int, can_id: int, received: int, raw: bytes) -> str:
        stamp = f"{t_us // 1_000_000: d}.{t_us % 1_000_000:06d}".rjust(9)
        if can_id & ERROR:
            told = candump_body(can_id, len(raw), raw.hex().upper())
            return f"{ERROR_COMMENT}{told}\n{stamp} 1  ErrorFrame\n"
        way, data, size = "Rx" if received else "Tx", raw.hex(" ").upper(), len(raw)
        number = f"{can_id & ID_MASK:X}{'x' if can_id & EXTENDED else ''}"
        if size > 8 and not can_id & REMOTE:
            fd = {"number": number, "name": "", "dlc": _DLC[size], "size": size, "data": data}
            return f"{stamp} {_FD_ROW.format(way=way, zeros=_FD_ZEROS, **fd)}\n"
        body = f"r {size:x} " if can_id & REMOTE else f"d {size:x} {data}"
        return f"{stamp} 1  {number:<15} {way:<4} {body}\n"

    def close(self, *, whole: bool) -> None:
        """Finish the file."""
        with self._file:
            self._file.write("End TriggerBlock\n" if whole else "")


class Blf(_Recording):
    """BLF by python-can's writer."""

    def __init__(self, path: Path, log: Log) -> None:
        super().__init__(log)
        self._writer = can.BLFWriter(path)

    def add(self, frames: Records) -> None:
        """Append frames as messages."""
        raw, put = frames["data"].tobytes(), self._writer.on_message_received
        for at, (t_us, can_id, received, size) in enumerate(self._rows(frames)):
            error, remote = bool(can_id & ERROR), bool(can_id & REMOTE)
            fd = size > 8 and not (error or remote)
            put(
                can.Message(
                    timestamp=t_us * 1e-6,
                    arbitration_id=can_id & ID_MASK,
                    is_extended_id=bool(can_id & EXTENDED) and not error,
                    is_remote_frame=remote and not error,
                    is_error_frame=error,
                    data=None if remote and not error else raw[at * 64 : at * 64 + size],
                    dlc=size,
                    is_fd=fd,
                    bitrate_switch=fd,
                    is_rx=bool(received),
                )
            )

    def close(self, *, whole: bool) -> None:
        """Finish the file."""
        self._writer.stop()


MOST_APART: Final = 400
"""Frames of the same us whose order MF4 keeps; more would read as the next us."""
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
        seconds, can_id = _seconds(frames["t_ns"] - first_ns), frames["can_id"]
        kind = np.where(can_id & ERROR, 2, np.where(can_id & REMOTE, 1, 0))
        for index, group in enumerate(_GROUPS):
            own = kind == index
            if own.any():
                self._file.extend(index, [(seconds[own], None), (_group_rows(group, frames[own]), None)])

    def close(self, *, whole: bool) -> None:
        """Write the file, when it is whole; let go of the temporary one."""
        try:
            if whole:
                self._file.save(self._path, overwrite=True)
        finally:
            self._file.close()


def _seconds(t_ns: Any) -> Any:
    """Times in us as seconds; frames of the same us are 1 ns apart: a file of groups has no other order."""
    t_us = t_ns // 1000
    places = np.arange(len(t_us))
    new = np.append(True, t_us[1:] != t_us[:-1])
    since = places - np.maximum.accumulate(np.where(new, places, 0))
    return t_us * 1e-6 + np.minimum(since, MOST_APART) * 1e-9


def _group_rows(group: str, frames: Records) -> Records:
    """Frames in the structure of their group."""
    rows, fd = np.zeros(len(frames), _group_dtype(group)), frames["size"] > 8
    values = {
        "ID": frames["can_id"] & ID_MASK,
        "IDE": (frames["can_id"] & (EXTENDED | ERROR)) == EXTENDED,
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
