"""The writer process: drains the rings of a controller into one MCAP file, whatever happens to it.

Started by :mod:`hil.log.recorder` as ``python -m hil.log.writer FD FD FD``, with one FD more for each further
node on the bus. Its standard input brings one
JSON line with the file's path and header, later one with the result; end of file there means that the
controller is gone. A write error sets a flag in the ring that the loop reads every tick.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.log.mcapfile import RunFile
from hil.log.records import EVENT, EVENT_BYTES
from hil.log.ring import BEAT_AT, FAILED_AT, Ring
from hil.log.schema import FRAME
from hil.log.split import Follower, SplitFile, open_run
from hil.signals import TICK

DRAIN_S: Final = 0.01
CHUNK_S: Final = 0.04
"""What a kill of everything may cost, together with two drains: under 100 ms. It makes a log 9 % larger."""
STATS_S: Final = 1.0
NICE: Final = 10
Rings = tuple[Ring, Ring, Ring]
Nodes = dict[str, Ring]
"""The ticks of further nodes on the bus, by name."""


class Every:
    """True once a period; the first time after one period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._next_s = time.monotonic() + period_s

    def due(self) -> bool:
        """Whether the period has passed since it last was true."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._period_s
        return True


class Drain:
    """Rings in, file out."""

    def __init__(self, rings: Rings, file: RunFile | SplitFile, nodes: Nodes) -> None:
        self._ticks, self._frames, self._events = rings
        self._file, self._nodes = file, nodes
        self._t_ns: int | None = None
        self._lateness: list[np.ndarray[Any, np.dtype[np.int32]]] = []

    def once(self, *, final: bool = False) -> None:
        """Move everything that is published into the file's chunks."""
        ticks = np.frombuffer(self._ticks.take(final=final), TICK)
        # taken after the ticks, so none of theirs is missing, and written before, so they share their part
        self._file.add_frames(np.frombuffer(self._frames.take(final=final), FRAME))
        if len(ticks):
            self._file.add_ticks(ticks)
            self._t_ns = int(ticks["t_ns"][-1])
            self._lateness.append(ticks["lateness_ns"])
        for node, ring in self._nodes.items():
            assert isinstance(self._file, RunFile)  # noqa: S101 - a log of several nodes is one file
            self._file.add_ticks(np.frombuffer(ring.take(final=final), TICK), node)
        raw = self._events.take(final=final)
        for at in range(0, len(raw), EVENT_BYTES):
            self._event(raw[at : at + EVENT_BYTES])

    def _event(self, raw: bytes) -> None:
        t_ns, k, kind_size, text_size = EVENT.unpack_from(raw)
        kind = raw[EVENT.size : EVENT.size + kind_size].decode(errors="replace")
        text = raw[EVENT.size + kind_size : EVENT.size + kind_size + text_size].decode(errors="replace")
        self._file.add_event(t_ns, k, kind, text)

    def stats(self) -> None:
        """Write what was dropped, how full the ring was and how late the ticks since the last time were.

        They are stamped with the last tick's time; before the first there is none, and nothing to tell.
        """
        if self._t_ns is None:
            return
        values = {
            "ticks": self._file.ticks,
            "dropped": self._ticks.dropped,
            "high_water": self._ticks.high_water,
            "frames": self._file.frames,
            "dropped_frames": self._frames.dropped,
            "dropped_events": self._events.dropped,
            "file_bytes": self._file.size,
        }
        if self._lateness:
            p50, p99, top = np.percentile(np.concatenate(self._lateness), (50, 99, 100))
            values |= {"lateness_p50_ns": int(p50), "lateness_p99_ns": int(p99), "lateness_max_ns": int(top)}
            self._lateness = []
        self._file.add_stats(self._t_ns, values)

    def losses(self) -> dict[str, int]:
        """Records dropped per ring."""
        return {
            "dropped_ticks": sum(ring.dropped for ring in (self._ticks, *self._nodes.values())),
            "dropped_frames": self._frames.dropped,
            "dropped_events": self._events.dropped,
        }


def read_available(wait_s: float) -> bytes | None:
    """What came on standard input within ``wait_s``; b"" for nothing, None for its end."""
    if not select.select([0], [], [], wait_s)[0]:
        return b""
    return os.read(0, 1 << 16) or None


def read_opening() -> tuple[dict[str, Any], bytes] | None:
    """The first line of standard input and what follows it; None when the controller went away before."""
    raw = b""
    while b"\n" not in raw:
        more = os.read(0, 1 << 16)
        if not more:
            return None
        raw += more
    line, rest = raw.split(b"\n", 1)
    opening: dict[str, Any] = json.loads(line)
    return opening, rest


def serve(
    rings: Rings, file: RunFile | SplitFile, path: Path, control: bytes, nodes: Nodes
) -> dict[str, Any]:
    """Drain until standard input ends; return the result that the controller sent, if any."""
    drain, header = Drain(rings, file, nodes), rings[0].header
    chunk, stats = Every(CHUNK_S), Every(STATS_S)
    while (more := read_available(DRAIN_S)) is not None:
        control += more
        drain.once()
        if stats.due():
            drain.stats()
        if chunk.due():
            file.flush()
            file.check_place(path)
        header[BEAT_AT] += 1
    drain.once(final=True)
    drain.stats()
    return result_of(control) | drain.losses()


def result_of(control: bytes) -> dict[str, Any]:
    """The last whole line that the controller sent; it died when there is none."""
    lines = control.split(b"\n")[:-1]
    result: dict[str, Any] = json.loads(lines[-1]) if lines else {"ended": "controller died"}
    return result


def main() -> int:
    """Entry point of the process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the file must be finished; the end of input ends us
    os.nice(NICE)
    rings = (Ring(int(sys.argv[1])), Ring(int(sys.argv[2])), Ring(int(sys.argv[3])))
    came = read_opening()
    if came is None:
        return 1
    return write_run(rings, *came, [Ring(int(fd)) for fd in sys.argv[4:]])


def _follower(header: dict[str, Any]) -> Follower:
    """What knows the controller's state; the compiled law is loaded for a log in parts alone."""
    from hil.replay.snapshot import StateFollower

    return StateFollower(header)


def write_run(rings: Rings, opening: dict[str, Any], control: bytes, more: Sequence[Ring] = ()) -> int:
    """Write the file that ``opening`` names; 0 when it is complete."""
    header, file, path = rings[0].header, None, Path(opening["path"])
    try:
        file = open_run(path, opening["header"], _follower, opening["chunk_bytes"])
        header[BEAT_AT] += 1
        with contextlib.suppress(BrokenPipeError):  # a controller that was killed: its records are kept
            os.write(1, b"ready\n")
        nodes = dict(zip(opening["header"].get("nodes", []), more, strict=True))
        file.finish(serve(rings, file, path, control, nodes))
        file.check_place(path)
    except OSError as error:
        header[FAILED_AT] = 1
        if file is None:
            os.write(1, f"{error.strerror}\n".encode())  # the recorder waits for a line
        else:
            file.abandon(f"log failed: {error.strerror}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
