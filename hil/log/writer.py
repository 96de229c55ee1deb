"""The writer process: drains the rings of a controller into one MCAP file, whatever happens to it.

Started by :mod:`hil.log.recorder` as ``python -m hil.log.writer FD FD FD``. Its standard input brings one
JSON line with the file's path and header, later one with the result; end of file there means that the
controller is gone. A write error sets a flag in the ring that the loop reads every tick.
"""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.log.mcapfile import RunFile
from hil.log.ring import BEAT_AT, FAILED_AT, HIGH_AT, Ring
from hil.log.schema import pack_can_frame
from hil.signals import TICK

DRAIN_S: Final = 0.02
STATS_EVERY: Final = 50
FRAME = struct.Struct("<qIBB64s")
EVENT = struct.Struct("<qQHH")
EVENT_BYTES: Final = 512
NICE: Final = 10


class Drain:
    """Rings in, file out."""

    def __init__(self, rings: tuple[Ring, Ring, Ring], file: RunFile) -> None:
        self._ticks, self._frames, self._events = rings
        self._file = file
        self._sequence = 0
        self._t_ns = 0

    def once(self, *, final: bool = False) -> None:
        """Move everything that is published."""
        raw = self._ticks.take(final=final)
        if raw:
            ticks = np.frombuffer(raw, TICK)
            self._file.add_ticks(ticks)
            self._t_ns = int(ticks["t_ns"][-1])
        for t_ns, can_id, received, size, data in FRAME.iter_unpack(self._frames.take(final=final)):
            self._file.add_frame(bool(received), t_ns, pack_can_frame(t_ns, can_id, data[:size]), self._sequence)
            self._sequence += 1
        raw = self._events.take(final=final)
        for at in range(0, len(raw), EVENT_BYTES):
            t_ns, k, kind_size, text_size = EVENT.unpack_from(raw, at)
            text = raw[at + EVENT.size : at + EVENT.size + kind_size + text_size]
            self._file.add_event(t_ns, k, text[:kind_size].decode(), text[kind_size:].decode(errors="replace"))
        self._file.flush()

    def stats(self) -> None:
        """Write drops and the ring's high-water mark."""
        self._file.add_stats(self._t_ns, self._ticks.dropped, self._ticks.header[HIGH_AT])

    def losses(self) -> dict[str, int]:
        """Records dropped per ring."""
        return {
            "dropped_ticks": self._ticks.dropped,
            "dropped_frames": self._frames.dropped,
            "dropped_events": self._events.dropped,
        }


def read_available() -> bytes | None:
    """What came on standard input within a drain period; b"" for nothing, None for its end."""
    if not select.select([0], [], [], DRAIN_S)[0]:
        return b""
    return os.read(0, 1 << 16) or None


def serve(rings: tuple[Ring, Ring, Ring], file: RunFile) -> dict[str, Any]:
    """Drain until standard input ends; return the result that the controller sent, if any."""
    drain, control, header = Drain(rings, file), b"", rings[0].header
    turn = 0
    while (more := read_available()) is not None:
        control += more
        drain.once()
        header[BEAT_AT] += 1
        turn += 1
        if turn % STATS_EVERY == 0:
            drain.stats()
    drain.once(final=True)
    drain.stats()
    lines = [line for line in control.split(b"\n") if line]
    result: dict[str, Any] = json.loads(lines[-1]) if lines else {"ended": "controller died"}
    return result | drain.losses()


def main() -> int:
    """Entry point of the process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the file must be finished; the end of input ends us
    os.nice(NICE)
    rings = (Ring(int(sys.argv[1])), Ring(int(sys.argv[2])), Ring(int(sys.argv[3])))
    header = rings[0].header
    opening = json.loads(sys.stdin.buffer.raw.readline())  # type: ignore[attr-defined]
    file = None
    try:
        file = RunFile(Path(opening["path"]), opening["header"], opening["chunk_bytes"])
        header[BEAT_AT] += 1
        print("ready", flush=True)  # noqa: T201 - the recorder waits for this line
        file.finish(serve(rings, file))
    except OSError as error:
        header[FAILED_AT] = 1
        print(f"failed {error}", flush=True)  # noqa: T201 - the recorder shows it
        if file is not None:
            file.abandon()
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
