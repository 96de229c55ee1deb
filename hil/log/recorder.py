"""The loop's end of the log: packs records into rings; another process does everything slow."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

from hil.errors import HilError
from hil.log.mcapfile import CHUNK_BYTES
from hil.log.ring import BEAT_AT, FAILED_AT, Ring
from hil.log.writer import EVENT, EVENT_BYTES, FRAME
from hil.signals import TICK, TickArray

RING_SECONDS: Final = 4
WRITER_SILENT_NS: Final = 1_000_000_000
BYTES_PER_TICK: Final = TICK.itemsize + 31 + 4 * 60
START_TIMEOUT_S: Final = 20.0
CLOSE_TIMEOUT_S: Final = 60.0


class LogError(HilError, OSError):
    """A log that can't be written or read; the message says where and what to do."""


def check_folder(path: Path, needed_bytes: int) -> None:
    """Refuse before arming: folder missing or not writable, file there already, disk too full."""
    folder = path.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{path.name}.probe"
        probe.touch(exist_ok=False)
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise LogError(f"{folder}: can't be written to ({error.strerror}); choose another [log] folder") from error
    if path.exists():
        raise LogError(f"{path}: exists already; choose another [log] name")
    if free < needed_bytes:
        raise LogError(
            f"{folder}: {free / 1e6:.0f} MB free, this run needs about {needed_bytes / 1e6:.0f} MB; "
            "free some space or choose another [log] folder"
        )


class Recorder:
    """Implements :class:`hil.ports.Recorder`. ``failed`` is what the loop looks at every tick."""

    def __init__(self, path: Path, header: dict[str, Any], rate_hz: int) -> None:
        self.path = path
        self._ticks = Ring.create("ticks", TICK.itemsize, rate_hz * RING_SECONDS)
        self._frames = Ring.create("frames", FRAME.size, rate_hz * RING_SECONDS * 5)
        self._events = Ring.create("events", EVENT_BYTES, 1024)
        self._header = self._ticks.header
        self._beat, self._beat_ns = 0, time.monotonic_ns()
        self._writer = self._start(path, header, rate_hz)

    def _start(self, path: Path, header: dict[str, Any], rate_hz: int) -> subprocess.Popen[bytes]:
        fds = [self._ticks.fd, self._frames.fd, self._events.fd]
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", "hil.log.writer", *map(str, fds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=fds,
            start_new_session=True,
        )
        chunk = max(4096, min(CHUNK_BYTES, rate_hz * BYTES_PER_TICK // 2))
        opening = {"path": str(path), "header": header, "chunk_bytes": chunk}
        assert process.stdin is not None and process.stdout is not None  # noqa: S101 - PIPE was asked for
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(opening).encode() + b"\n")
            process.stdin.flush()
        answer = process.stdout.readline().decode().strip()
        if answer != "ready":
            process.stdin.close()
            process.wait(START_TIMEOUT_S)
            raise LogError(f"{path}: the writer can't start ({answer or 'it died'})")
        return process

    @property
    def writer_pid(self) -> int:
        """Process id of the writer."""
        return self._writer.pid

    @property
    def failed(self) -> bool:
        """True when the writer reported an error or has not been heard of for a second."""
        header = self._header
        if header[FAILED_AT]:
            return True
        beat = header[BEAT_AT]
        if beat != self._beat:
            self._beat, self._beat_ns = beat, time.monotonic_ns()
            return False
        return time.monotonic_ns() - self._beat_ns > WRITER_SILENT_NS

    def tick(self, tick: TickArray) -> None:
        """Store one tick."""
        self._ticks.push(tick.view("u1").data)

    def frame(self, received: bool, t_ns: int, can_id: int, data: bytes) -> None:
        """Store one raw CAN frame."""
        self._frames.push(FRAME.pack(t_ns, can_id, received, len(data), data))

    def event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        """Store one event; the text is cut to what a record holds."""
        kind_raw = kind.encode()[:64]
        text_raw = text.encode()[: EVENT_BYTES - EVENT.size - len(kind_raw)]
        record = EVENT.pack(t_ns, k, len(kind_raw), len(text_raw)) + kind_raw + text_raw
        self._events.push(record.ljust(EVENT_BYTES, b"\0"))

    @property
    def dropped(self) -> int:
        """Ticks that the ring had no room for."""
        return self._ticks.dropped

    def close(self, result: dict[str, Any]) -> bool:
        """Hand over the result, wait for the writer; True when the file is complete."""
        pipe = self._writer.stdin
        assert pipe is not None  # noqa: S101 - PIPE was asked for
        with contextlib.suppress(BrokenPipeError):
            pipe.write(json.dumps(result).encode() + b"\n")
            pipe.flush()
        with contextlib.suppress(BrokenPipeError):
            pipe.close()
        try:
            code = self._writer.wait(CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._writer.kill()
            code = self._writer.wait()
        if self._writer.stdout is not None:
            self._writer.stdout.close()
        for ring in (self._ticks, self._frames, self._events):
            if ring is self._ticks:
                self._header.release()
            ring.close()
        return code == 0
