"""Recorded frames back on a bus, each at its absolute deadline. Knows a way to send, no bus.

A command is what the log's own controller sent, by its identifiers; in a shadow run's log or another
program's recording nobody can say, so every frame may be one.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import math
import os
import signal
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Literal, NamedTuple, NoReturn, Protocol

import numpy as np

from hil.exchange.readers.recorded import NOT_DATA
from hil.exchange.recording import Recording, kinds_of
from hil.log.errors import LogError
from hil.log.reader import Log, read_blocks
from hil.signals import new_ticks

Send = Callable[[int, bytes, bool], None]
Direction = Literal["rx", "tx", "both"]
ASKING: Final = "--recorded-channel"
EXTENDED: Final = 0x80000000
LATE_NS: Final = 1_000_000
LEAD_NS: Final = 20_000_000
_BINS: Final = 100_000
_RECORD: Final = struct.Struct("<BqIBBB64s")
"""What goes through the pipe of :func:`ahead`: kind, t_ns, can_id, size, fd, command, data."""
_FRAME, _ROUND, _DONE, _FAILED = range(4)
_PIPE_BYTES: Final = 1 << 20
_NICE: Final = 5


class Played(NamedTuple):
    """A frame to play; ``command``: it may move a drive."""

    t_ns: int
    can_id: int
    data: bytes
    fd: bool
    command: bool


class Sleeper(Protocol):
    """The clock, as far as playing needs it."""

    def now_ns(self) -> int:
        """The time [ns]."""

    def sleep_until(self, deadline_ns: int) -> int:
        """Sleep to the deadline; the time of waking [ns]."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Which frames: direction, identifiers (none: all), window [s] from the first frame."""

    direction: Direction = "rx"
    ids: frozenset[int] = frozenset()
    not_ids: frozenset[int] = frozenset()
    from_s: float = 0.0
    to_s: float = math.inf

    def takes(self, frame: Played, first_ns: int) -> bool:
        """Whether a frame is played."""
        number, t_s = frame.can_id & ~EXTENDED, (frame.t_ns - first_ns) * 1e-9
        return (
            self.from_s <= t_s <= self.to_s
            and (not self.ids or number in self.ids)
            and number not in self.not_ids
            and (self.direction == "both" or frame.command == (self.direction == "tx"))
        )


@dataclass(slots=True)
class Result:
    """What was played and how late, by a histogram of 1 us bins up to 0.1 s."""

    sent: int = 0
    late: int = 0
    max_us: float = 0.0
    interrupted: bool = False
    _bins: Any = field(default_factory=lambda: np.zeros(_BINS + 1, np.int64))

    def add(self, lateness_ns: int) -> None:
        """Count a frame."""
        self.sent += 1
        self.late += lateness_ns > LATE_NS
        self.max_us = max(self.max_us, lateness_ns * 1e-3)
        self._bins[min(max(lateness_ns, 0) // 1000, _BINS)] += 1

    def quantile_us(self, share: float) -> float:
        """Upper edge of the bin that holds this quantile; the largest value in the last one."""
        if not self.sent:
            return 0.0
        at = int(np.searchsorted(np.cumsum(self._bins), math.ceil(share * self.sent)))
        return min(at + 1.0, self.max_us) if at < _BINS else self.max_us

    def as_dict(self) -> dict[str, Any]:
        """As a plain dict; times in us."""
        return {
            "frames sent": self.sent,
            "lateness p50 us": self.quantile_us(0.5),
            "lateness p99 us": self.quantile_us(0.99),
            "lateness max us": self.max_us,
            "frames late by over 1 ms": self.late,
            "interrupted": self.interrupted,
        }


class Source:
    """Data frames of a log of hil (.mcap) or of another tool's recording. Raises LogError.

    Error and remote frames are never played: they are counted in ``left_out``. ``channel``, ``partial``: as
    :class:`hil.exchange.recording.Recording`; both are checked here, before anything is sent.
    """

    def __init__(self, path: Path, channel: str | None = None, *, partial: bool = False) -> None:
        if not path.is_file():
            raise LogError(f"{path}: no such file")
        self.path = path
        self.damage: str | None = None
        self.left_out: dict[str, int] = {}
        self._recording: Recording | None = None
        self._own_ids: frozenset[int] = frozenset()
        if path.suffix.lower() == ".mcap":
            if channel is not None:
                raise LogError(f"{path}: a log of hil holds one channel; leave {ASKING} out")
            self._scan()
        else:
            self._recording = Recording(path, channel, partial, ASKING)
            self.damage = self._recording.damage
            self._leave_out(self._recording.identifiers)
        self.roles_known = bool(self._own_ids)

    def _scan(self) -> None:
        """Identifiers that the controller itself sent; none are known in the log of a shadow run."""
        own: set[int] = set()
        seen: Counter[int] = Counter()
        log = Log(self.path, new_ticks(0))
        for block in read_blocks(log):
            if block.kind == "frames":
                own.update(np.unique(block.records["can_id"][block.records["received"] == 0]).tolist())
                numbers, counts = np.unique(block.records["can_id"], return_counts=True)
                seen.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        self.damage = log.damage
        self._own_ids = frozenset(can_id for can_id in own if not can_id & NOT_DATA)
        self._leave_out(seen)

    def _leave_out(self, seen: Counter[int]) -> None:
        kinds = kinds_of(seen)
        self.left_out = {
            f"{kind} frames left out": kinds[kind] for kind in ("error", "remote") if kinds[kind]
        }

    def frames(self) -> Iterator[Played]:
        """All data frames in their order."""
        return self._of_log() if self._recording is None else self._of_recording(self._recording)

    def _of_log(self) -> Iterator[Played]:
        for block in read_blocks(Log(self.path, new_ticks(0))):
            if block.kind != "frames":
                continue
            raw = block.records["data"].tobytes()
            for at, (t_ns, can_id, received, size) in enumerate(
                block.records[["t_ns", "can_id", "received", "size"]].tolist()
            ):
                if not can_id & NOT_DATA:
                    command = not received or can_id in self._own_ids
                    yield Played(t_ns, can_id, raw[at * 64 : at * 64 + size], size > 8, command)

    def _of_recording(self, recording: Recording) -> Iterator[Played]:
        for t_ns, _, can_id, received, fd, data in recording.frames():
            if not can_id & NOT_DATA:
                yield Played(t_ns, can_id, data, fd, not received)


def play(
    rounds: Iterable[Iterable[Played]],
    send: Send,
    clock: Sleeper,
    *,
    rate: float = 1.0,
    before: Callable[[Played], bool] = lambda frame: False,
) -> Result:
    """Send the frames of each round at their distances, divided by ``rate``; a late one goes at once.

    ``before`` is called ahead of each frame and returns True when it held the frame up: time goes on from
    there. Ctrl-C ends at once and the result so far is returned.
    """
    result = Result()
    gc.collect()
    gc.freeze()  # what is there already need not be looked through again: that took 0.1 s in mid-play
    try:
        for frames in rounds:
            _one_round(frames, send, clock, rate, before, result)
    except KeyboardInterrupt:
        result.interrupted = True
    finally:
        gc.unfreeze()
    return result


@contextlib.contextmanager
def ahead(rounds: Iterable[Iterable[Played]]) -> Iterator[Iterator[Iterator[Played]]]:
    """The same rounds, read by a process of its own: a frame is there when its time comes.

    To read a chunk of a log takes milliseconds, for which the frames before it would have to wait.
    """
    ours, theirs = os.pipe()
    with contextlib.suppress(OSError):  # as it is by default, it holds a few hundred frames
        fcntl.fcntl(theirs, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    pid = os.fork()
    if pid == 0:
        os.close(ours)
        _read(rounds, theirs)
    os.close(theirs)
    try:
        with os.fdopen(ours, "rb", _PIPE_BYTES // 16) as stream:
            yield _rounds(stream)
    finally:
        os.waitpid(pid, 0)


def _read(rounds: Iterable[Iterable[Played]], pipe: int) -> NoReturn:
    """The reading process: until all is written, or nobody reads any more."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the player's business; its end of the pipe ends this
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.nice(_NICE)
        with contextlib.suppress(BrokenPipeError), os.fdopen(pipe, "wb", _PIPE_BYTES // 16) as stream:
            try:
                for frames in rounds:
                    for t_ns, can_id, data, fd, command in frames:
                        stream.write(_RECORD.pack(_FRAME, t_ns, can_id, len(data), fd, command, data))
                    stream.write(_RECORD.pack(_ROUND, 0, 0, 0, 0, 0, b""))
                stream.write(_RECORD.pack(_DONE, 0, 0, 0, 0, 0, b""))
            except LogError as error:
                text = str(error).encode()
                stream.write(_RECORD.pack(_FAILED, len(text), 0, 0, 0, 0, b"") + text)
    finally:
        os._exit(0)


def _rounds(stream: IO[bytes]) -> Iterator[Iterator[Played]]:
    """What comes through the pipe, one round after the other, each to be taken to its end; the last is empty.

    Raises the reader's LogError, or one of its own when the reader has died.
    """
    kind = _ROUND

    def one() -> Iterator[Played]:
        nonlocal kind
        while len(raw := stream.read(_RECORD.size)) == _RECORD.size:
            kind, t_ns, can_id, size, fd, command, data = _RECORD.unpack(raw)
            if kind == _FAILED:
                raise LogError(stream.read(t_ns).decode())
            if kind != _FRAME:
                return
            yield Played(t_ns, can_id, data[:size], bool(fd), bool(command))
        raise LogError("the process that reads the recording has died")

    while kind == _ROUND:
        yield one()


def _one_round(
    frames: Iterable[Played],
    send: Send,
    clock: Sleeper,
    rate: float,
    before: Callable[[Played], bool],
    result: Result,
) -> None:
    start_ns, first_ns = 0, None
    for frame in frames:
        if first_ns is None:  # reading up to it may have taken long
            start_ns, first_ns = clock.now_ns() + LEAD_NS, frame.t_ns
        deadline_ns = start_ns + round((frame.t_ns - first_ns) / rate)
        if before(frame):
            start_ns += clock.now_ns() - deadline_ns
            deadline_ns = clock.now_ns()
        clock.sleep_until(deadline_ns)
        send(frame.can_id, frame.data, frame.fd)
        result.add(clock.now_ns() - deadline_ns)


def chosen(source: Source, choice: Choice) -> Iterator[Played]:
    """The frames of a source that a choice takes."""
    frames = source.frames()
    head = next(frames, None)
    if head is None:
        raise LogError(f"{source.path}: holds no frames")
    for frame in itertools.chain([head], frames):
        if (frame.t_ns - head.t_ns) * 1e-9 > choice.to_s:
            return
        if choice.takes(frame, head.t_ns):
            yield frame
