"""MF4 by ASAM's bus logging, block by block through asammdf: data, remote and error frames of any groups.

Read here, since python-can 4.6.1 takes every frame of a group without the member IDE for an extended one.
"""

from __future__ import annotations

import gc
import heapq
import logging
import sys
from collections.abc import Callable, Iterator
from typing import IO, Any, Final

import numpy as np

from hil.exchange.readers.library import stamp_ns
from hil.exchange.readers.recorded import (
    BUS_ERROR,
    ID_MASK,
    Found,
    NotThisFormatError,
    Recorded,
    UnreadableError,
    frame,
    identifier,
)
from hil.log.frame import need

GROUPS: Final = ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame")
SLAB: Final = 4096


def read(file: IO[bytes], found: Found) -> Iterator[Recorded]:
    """Frames of all groups in the order of time. Raises NotThisFormatError, MissingPackage."""
    asammdf = need("asammdf", "MF4")
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # it prints the traceback of what it raises
    found.unit = "frames"
    if not file.read(1):
        raise NotThisFormatError("empty")
    file.seek(0)
    mdf = _opened(asammdf.MDF, file)
    try:
        if mdf.version < "4":
            raise NotThisFormatError(f"MDF {mdf.version}: bus logging begins with MDF 4")
        start_ns = stamp_ns(max(0.0, mdf.header.start_time.timestamp()))
        groups = [_group(mdf, *which, start_ns, found) for which in _found_groups(mdf)]
        if not groups:
            raise NotThisFormatError("holds no frames: it has no group CAN_DataFrame (a file of signals?)")
        yield from (one for _, one in heapq.merge(*groups, key=lambda pair: pair[0]))
    finally:
        mdf.close()


def _opened(mdf: Callable[[IO[bytes]], Any], file: IO[bytes]) -> Any:
    """The file's MDF object. Raises NotThisFormatError.

    Where asammdf 8.8.28 fails, the end of its half-made object fails once more and would print a traceback.
    """
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        try:
            return mdf(file)
        except Exception as error:  # noqa: BLE001 - whatever its parser meets in bad bytes
            said = _said(error)
        gc.collect()
    finally:
        sys.unraisablehook = hook
    raise NotThisFormatError(f"not an MF4 file, or cut off: {said}")


def _found_groups(mdf: Any) -> list[tuple[int, str]]:
    return [
        (index, name)
        for index, group in enumerate(mdf.groups)
        for name in GROUPS
        if any(channel.name == name for channel in group.channels)
    ]


def _group(mdf: Any, index: int, name: str, start_ns: int, found: Found) -> Iterator[tuple[float, Recorded]]:
    """Frames of one group with their exact times [s]; what of it can't be read is counted by its header."""
    count = int(mdf.groups[index].channel_group.cycles_nr)
    for at in range(0, count, SLAB):
        take = min(SLAB, count - at)
        try:
            signal = mdf.get(name, group=index, record_offset=at, record_count=take)
            rows = _Rows(name, signal)
        except Exception as error:  # noqa: BLE001 - asammdf and numpy raise whatever bad bytes bring
            found.cut = f"damaged: {count - at} of {count} frames of {name} can't be read: {_said(error)}"
            return
        found.places += len(rows)
        for row in range(len(rows)):
            try:
                yield rows.seconds(row), rows.frame(row, start_ns)
            except UnreadableError as error:
                found.lose(f"frame {at + row + 1} of {name}", error)
        if len(rows) < take:
            found.cut = f"cut off: {count - at - len(rows)} of {count} frames of {name} are missing"
            return


class _Rows:
    """Records of a group by members, of which a recorder writes those it likes."""

    def __init__(self, name: str, signal: Any) -> None:
        samples, self._times, self._kind = signal.samples, signal.timestamps, name
        names = samples.dtype.names or ()
        of = {short: samples[f"{name}.{short}"] for short in _MEMBERS if f"{name}.{short}" in names}
        size = len(samples)
        if "ID" not in of and name != "CAN_ErrorFrame":
            raise ValueError(f"{name} has no member ID")
        self._id = np.asarray(of.get("ID", np.full(size, BUS_ERROR)), np.int64)
        beyond = (self._id & ~ID_MASK != 0) | (self._id > 0x7FF)
        self._extended = np.asarray(of["IDE"], bool) if "IDE" in of else beyond
        self._fd = np.asarray(of.get("EDL", np.zeros(size)), bool)
        way = of.get("Dir", np.zeros(size))
        self._sent = np.char.upper(way) == b"TX" if way.dtype.kind == "S" else np.asarray(way) != 0
        dlc = np.asarray(of.get("DLC", np.zeros(size)), np.int64)
        self._length = np.asarray(of.get("DataLength", np.minimum(dlc, 8)), np.int64)
        self._dlc, self._data = dlc, of.get("DataBytes")
        self._channel = of.get("BusChannel", np.zeros(size, np.int64))

    def __len__(self) -> int:
        return len(self._times)

    def seconds(self, row: int) -> float:
        """Time from the file's start [s]."""
        return float(self._times[row])

    def frame(self, row: int, start_ns: int) -> Recorded:
        """One record. Raises UnreadableError."""
        remote, error = self._kind == "CAN_RemoteFrame", self._kind == "CAN_ErrorFrame"
        number = int(self._id[row]) & ID_MASK
        can_id = identifier(number, extended=bool(self._extended[row]), remote=remote, error=error)
        t_ns = start_ns + stamp_ns(self.seconds(row))
        if remote:
            return frame(t_ns, self._name(row), can_id, not self._sent[row], False, self._asked(row))
        return frame(t_ns, self._name(row), can_id, not self._sent[row], self._is_fd(row), self._bytes(row))

    def _name(self, row: int) -> str:
        return str(int(self._channel[row]))

    def _is_fd(self, row: int) -> bool:
        return bool(self._fd[row]) and self._kind == "CAN_DataFrame"

    def _asked(self, row: int) -> bytes:
        return bytes(min(int(self._dlc[row]), 8))

    def _bytes(self, row: int) -> bytes:
        size = int(self._length[row])
        raw = b"" if self._data is None else np.asarray(self._data[row], np.uint8).tobytes()
        if size > len(raw) and not (self._data is None and self._kind == "CAN_ErrorFrame"):
            raise UnreadableError(f"{len(raw)} of {size} bytes are there")
        return raw[:size]


_MEMBERS: Final = ("ID", "IDE", "DLC", "DataLength", "DataBytes", "Dir", "EDL", "BusChannel")


def _said(error: Exception) -> str:
    """One line of what a library says."""
    return (str(error) or type(error).__name__).splitlines()[0][:200]
