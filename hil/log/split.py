"""A long run as several files, each of which is a log by itself and says where it goes on.

The ticks of a part begin at a split, the frames and events of it no earlier; nothing is lost between parts.
Each part but the first holds the controller's state at its first tick, so that it replays alone.
"""

from __future__ import annotations

import errno
import uuid
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Protocol, Self

import numpy as np

from hil.log.mcapfile import CHUNK_BYTES, RunFile
from hil.log.schema import FRAME, Records
from hil.signals import TickArray

STATE: Final = "state.json"
PART: Final = "part"
FOREVER_NS: Final = 2**63 - 1


class Follower(Protocol):
    """Knows the controller's state after the ticks that it was shown."""

    def feed(self, ticks: TickArray) -> None:
        """Take the ticks that follow."""

    def state(self) -> str:
        """The state after the last of them."""


class Limits(NamedTuple):
    """When a part ends: after so many seconds, or megabytes; infinite for never."""

    seconds: float
    megabytes: float

    @classmethod
    def of(cls, header: dict[str, Any]) -> Limits | None:
        """What a run's header asks for; None for one file."""
        asked = header.get("split") or {}
        seconds, megabytes = (float(asked.get(key) or "inf") for key in ("s", "mb"))
        return None if seconds == megabytes == float("inf") else cls(seconds, megabytes)


def part_path(path: Path, number: int) -> Path:
    """NAME.mcap or NAME.000.mcap as the part of that number."""
    stem = path.stem
    stem = stem[:-4] if stem[-4:-3] == "." and stem[-3:].isdigit() else stem
    return path.with_name(f"{stem}.{number:03d}{path.suffix}")


class SplitFile:
    """Writes as :class:`RunFile` does, one part after the other. Raises OSError as it does."""

    def __init__(
        self, path: Path, header: dict[str, Any], limits: Limits, follower: Follower, chunk_bytes: int
    ) -> None:
        self._path, self._header, self._follower = path, header, follower
        self._limits, self._chunk_bytes = limits, chunk_bytes
        self._run, self._number = uuid.uuid4().hex, 0
        self._span_ns = FOREVER_NS if limits.seconds == float("inf") else round(limits.seconds * 1e9)
        self._end_ns = FOREVER_NS
        self._begun = False
        self._early = np.empty(0, FRAME)
        self._ticks = self._frames = 0
        self._file = self._open({})

    def _open(self, state: dict[str, str]) -> RunFile:
        """The file of the next part, with what tells which part of which run it is.

        It gets its name once that stands in it: a part is never seen without.
        """
        header = self._header | {"attachments": self._header.get("attachments", {}) | state}
        path = part_path(self._path, self._number)
        begun = path.with_name(f".{path.name}.begun")
        file = RunFile(begun, header, self._chunk_bytes)
        file.add_metadata(PART, {"run": self._run, "number": str(self._number)})
        if path.exists():
            raise FileExistsError(errno.EEXIST, "a part of that name exists already")
        begun.rename(path)
        return file

    @property
    def ticks(self) -> int:
        """Ticks in all parts."""
        return self._ticks + self._file.ticks

    @property
    def frames(self) -> int:
        """Frames in all parts."""
        return self._frames + self._file.frames

    @property
    def size(self) -> int:
        """Bytes in this part."""
        return self._file.size

    def add_ticks(self, ticks: TickArray) -> None:
        """Append ticks; a new part begins with the first that is past the limits."""
        while len(ticks):
            if self._begun and self._full(int(ticks["t_ns"][0])):
                self._next()
            if not self._begun:
                self._begun, self._end_ns = True, min(int(ticks["t_ns"][0]) + self._span_ns, FOREVER_NS)
                early, self._early = self._early, np.empty(0, FRAME)
                self.add_frames(early)
            inside = int((ticks["t_ns"].astype(np.int64) < self._end_ns).argmin()) or len(ticks)
            self._follower.feed(ticks[:inside])
            self._file.add_ticks(ticks[:inside])
            ticks = ticks[inside:]

    def _full(self, t_ns: int) -> bool:
        return t_ns >= self._end_ns or self._file.size >= self._limits.megabytes * 1e6

    def _next(self) -> None:
        """The next part; it is there before the last one is finished, so that no moment has neither."""
        before = self._file
        before.flush()
        self._number += 1
        self._file = self._open({STATE: self._follower.state()})
        self._begun = False
        self._ticks, self._frames = self._ticks + before.ticks, self._frames + before.frames
        goes_on = part_path(self._path, self._number).name
        before.finish({"ended": f"goes on in {goes_on}", "ticks": before.ticks})

    def add_frames(self, frames: Records) -> None:
        """Append frames; those past this part's end wait for the next part's first tick."""
        later = frames["t_ns"] >= self._end_ns
        self._file.add_frames(frames[~later])
        if later.any():
            self._early = np.concatenate([self._early, frames[later]])

    def add_event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Append one event."""
        self._file.add_event(t_ns, k, kind, text)

    def add_stats(self, t_ns: int, values: dict[str, int]) -> None:
        """Append the writer's own figures."""
        self._file.add_stats(t_ns, values)

    def check_place(self, _: Path) -> None:
        """Raise OSError when the part in the making is no longer at its path; earlier ones may be moved."""
        self._file.check_place(part_path(self._path, self._number))

    def flush(self) -> None:
        """Close the chunks in the making."""
        self._file.flush()

    def finish(self, result: dict[str, Any]) -> None:
        """Finish the last part."""
        self._file.add_frames(self._early)
        self._file.finish(result)

    def abandon(self, why: str) -> None:
        """After a failed write: finish the part if that still goes."""
        self._file.abandon(why)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """As :class:`RunFile`."""
        self._file.__exit__(kind, error, trace)


def open_run(
    path: Path,
    header: dict[str, Any],
    follower: Callable[[dict[str, Any]], Follower],
    chunk_bytes: int = CHUNK_BYTES,
) -> RunFile | SplitFile:
    """The file of a run, or its first part where the header asks for a split."""
    limits = Limits.of(header)
    if limits is None:
        return RunFile(path, header, chunk_bytes)
    return SplitFile(path, header, limits, follower(header), chunk_bytes)
