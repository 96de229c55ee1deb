"""The loop's end of the log: packs records into rings; another process does everything slow."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt

from hil.log.errors import LogError
from hil.log.mcapfile import CHUNK_BYTES
from hil.log.push import pusher, ring_places
from hil.log.records import EVENT_BYTES, FRAME_RECORD, pack_event_record
from hil.log.ring import BEAT_AT, FAILED_AT, Ring
from hil.log.split import part_path
from hil.signals import TICK, TickArray, new_ticks

__all__ = ["BYTES_PER_TICK", "LogError", "Recorder", "check_folder", "open_recorder"]

RING_SECONDS: Final = 4
FRAMES_PER_TICK: Final = 5
BYTES_PER_TICK: Final = TICK.itemsize + 31 + 4 * 60
LOOK_EVERY: Final = 16
"""Ticks between two looks at the writer's heartbeat; its word is looked at in each."""
LOOK_NS: Final = 100_000_000
WRITER_SILENT_NS: Final = 2_000_000_000
START_TIMEOUT_S: Final = 60.0  # a log in parts loads the compiled law
CLOSE_TIMEOUT_S: Final = 60.0
HUNG_TIMEOUT_S: Final = 5.0
"""How long a writer that was silent, or killed, is waited for."""


def check_folder(path: Path, needed_bytes: int) -> None:
    """Refuse before arming: folder missing or not writable, file there already, disk too full."""
    folder = path.parent
    for taken in (path, part_path(path, 0), part_path(path, 1)):
        if taken.exists():
            raise LogError(f"{taken}: exists already; choose another [log] name")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        probe = folder / f".{path.name}.{os.getpid()}.probe"
        probe.touch(exist_ok=False)
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise LogError(
            f"{folder}: can't be written to ({error.strerror}); choose another [log] folder"
        ) from error
    if free < needed_bytes:
        raise LogError(
            f"{folder}: {free / 1e6:.0f} MB free, this run needs about {needed_bytes / 1e6:.0f} MB; "
            "free some space or choose another [log] folder"
        )


def open_recorder(
    path: Path, header: dict[str, Any], rate_hz: int, duration_s: float | None = None
) -> Recorder:
    """Check the folder for a run of that rate and length (one minute when open), open the file there."""
    check_folder(path, round((duration_s or 60.0) * rate_hz * BYTES_PER_TICK))
    recorder = Recorder(path, header, rate_hz)
    recorder.await_open()
    return recorder


def first_line(stream: IO[bytes], timeout_s: float) -> str:
    """The first line of a process's output; "" when it ended or said nothing in time."""
    if not select.select([stream], [], [], timeout_s)[0]:
        return ""
    return stream.readline().decode(errors="replace").strip()


def refuse() -> int:
    """The push of a recorder that is closed."""
    raise LogError("the recorder is closed")


class Recorder:
    """Implements :class:`hil.ports.Recorder`. ``failed`` is what the loop looks at every tick.

    ``header`` holds ``metadata`` (text to text) and ``attachments`` (name to text); None when it is given to
    :meth:`begin` later. The writer starts while the caller goes on; the file is there once
    :meth:`await_open` has returned.
    """

    def __init__(self, path: Path, header: dict[str, Any] | None, rate_hz: int, nodes: int = 1) -> None:
        """``nodes``: how many nodes on the bus have ticks; the header names those after the first."""
        self.path = path
        self._ticks = Ring.create("ticks", TICK.itemsize, rate_hz * RING_SECONDS)
        self._frames = Ring.create("frames", FRAME_RECORD.size, rate_hz * RING_SECONDS * FRAMES_PER_TICK)
        self._events = Ring.create("events", EVENT_BYTES, 1024)
        more = range(1, nodes)
        self._more = [Ring.create(f"ticks-{i}", TICK.itemsize, rate_hz * RING_SECONDS) for i in more]
        self._more_records = [new_ticks() for _ in more]
        self._more_push = [pusher(*both) for both in zip(self._more, self._more_records, strict=True)]
        self._failed = self._closed = self._begun = False
        self._looks = 0
        self._beat, self._beat_ns, self._look_ns = 0, time.monotonic_ns(), 0
        self._writer = self._spawn()
        if header is not None:
            self.begin(header)
        self._attach(new_ticks())  # what is compiled for it is there before the loop

    def begin(self, header: dict[str, Any]) -> None:
        """Let the writer open the file with this header."""
        self._begun = True
        self._say({"path": str(self.path), "header": header, "chunk_bytes": CHUNK_BYTES})

    def _spawn(self) -> subprocess.Popen[bytes]:
        fds = [ring.fd for ring in self._rings]
        return subprocess.Popen(
            [sys.executable, "-m", "hil.log.writer", *map(str, fds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=fds,
            start_new_session=True,
        )

    def await_open(self) -> None:
        """Wait until the writer has opened the file. Raises LogError; the recorder is closed then."""
        assert self._writer.stdout is not None  # noqa: S101 - PIPE was asked for
        answer = first_line(self._writer.stdout, START_TIMEOUT_S)
        if answer != "ready":
            self._end_writer(START_TIMEOUT_S)
            self._release()
            raise LogError(f"{self.path}: can't be written ({answer or 'the writer process died'})")

    def _say(self, what: dict[str, Any]) -> None:
        """One JSON line to the writer, if it lives."""
        assert self._writer.stdin is not None  # noqa: S101 - PIPE was asked for
        with contextlib.suppress(BrokenPipeError):
            self._writer.stdin.write(json.dumps(what).encode() + b"\n")
            self._writer.stdin.flush()

    @property
    def _rings(self) -> tuple[Ring, ...]:
        return (self._ticks, self._frames, self._events, *self._more)

    @property
    def writer_pid(self) -> int:
        """Process id of the writer."""
        return self._writer.pid

    @property
    def failed(self) -> bool:
        """True for good once the writer reported an error, died, or was silent for two seconds.

        A writer that is merely slow is no failure: the rings hold twice as long.
        """
        if self._failed or self._closed:
            return self._failed
        self._looks -= 1
        if self._looks <= 0 or self._ticks.header[FAILED_AT]:
            self._look()
        return self._failed

    def _look(self) -> None:
        """Look at the writer's word, its heartbeat and whether it lives."""
        header, self._looks = self._ticks.header, LOOK_EVERY
        beat, now_ns = header[BEAT_AT], time.monotonic_ns()
        if header[FAILED_AT]:
            self._failed = True
        elif beat != self._beat:
            self._beat, self._beat_ns = beat, now_ns
        elif now_ns - max(self._beat_ns, self._look_ns) > LOOK_NS:
            self._look_ns = now_ns
            self._failed = self._writer.poll() is not None or now_ns - self._beat_ns > WRITER_SILENT_NS

    def tick(self, tick: TickArray) -> None:
        """Store one tick."""
        if tick is not self._record:
            self._attach(tick)
        self._push()

    @property
    def record(self) -> TickArray:
        """The record that it is ready to store: a loop that writes it has a first tick like the others."""
        return self._record

    def places(
        self, frames: npt.NDArray[np.void], node: int = 0
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """What :func:`hil.log.push.push` stores a node's record by, and rows of :attr:`frames`.

        ``node``: place of it; its record is :attr:`record` or of :attr:`more_records`.
        """
        ring, record = [(self._ticks, self._record), *zip(self._more, self._more_records, strict=True)][node]
        both = (ring, record), (self._frames, frames)
        ticks, more = (ring_places(ring, records.view(np.uint8)) for ring, records in both)
        return ticks, more

    @property
    def more_records(self) -> list[TickArray]:
        """The records of the nodes after the first, which :meth:`more_ticks` stores."""
        return self._more_records

    def more_ticks(self) -> None:
        """Store the tick of each node after the first."""
        for push in self._more_push:
            push()

    def _attach(self, record: TickArray) -> None:
        """Be ready to store this very record."""
        self._record, self._push = record, pusher(self._ticks, record)

    def frames(self, records: memoryview) -> None:
        """Store raw CAN frames, as bytes of :data:`hil.log.schema.FRAME` records."""
        self._frames.push_many(records)

    def event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Store one event; the text is cut to what a record holds."""
        self._events.push(pack_event_record(t_ns, k, kind, text))

    @property
    def dropped(self) -> int:
        """Ticks that the ring had no room for."""
        return self._dropped if self._closed else sum(ring.dropped for ring in (self._ticks, *self._more))

    def close(self, result: dict[str, Any]) -> bool:
        """Hand over the result, wait for the writer; True when the file is complete."""
        if self._closed:
            return not self._failed
        if self._begun:  # else there is no file, and nothing to say of it
            self._say(result)
        complete = self._end_writer(HUNG_TIMEOUT_S if self._failed else CLOSE_TIMEOUT_S) == 0
        self._failed = self._failed or not complete
        self._release()
        return complete

    def leave(self) -> None:
        """Let go of the writer in a forked process: only then does the controller's death end its input."""
        for pipe in (self._writer.stdin, self._writer.stdout):
            assert pipe is not None  # noqa: S101 - PIPE was asked for
            pipe.close()

    def _end_writer(self, timeout_s: float) -> int:
        """End the writer's input and wait for it; kill it when that takes too long.

        One that was stopped (SIGSTOP) goes on, and what waits in the rings reaches the file.
        """
        assert self._writer.stdin is not None and self._writer.stdout is not None  # noqa: S101 - PIPE
        with contextlib.suppress(BrokenPipeError):
            self._writer.stdin.close()
        self._writer.send_signal(signal.SIGCONT)
        try:
            code = self._writer.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._writer.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # a disk that hangs holds it
                self._writer.wait(HUNG_TIMEOUT_S)
            code = -signal.SIGKILL
        self._writer.stdout.close()
        return code

    def _release(self) -> None:
        self._dropped, self._closed = self.dropped, True
        self._push = refuse
        self._more_push = [refuse for _ in self._more]
        for ring in self._rings:
            ring.close()
