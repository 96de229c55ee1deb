"""How long after SIGKILL of a controller the guardian's first stop frame is on the bus, memory locked.

The end of the wait is the kernel's own stamp of the frame, so that this listener's delays do not count. The
drive's watchdog is at its default of 20 ms: a drive that ends in FAULT was not stopped in time.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import signal
import socket
import struct
import time
from dataclasses import dataclass
from pathlib import Path

from drivers.local import CLASSIC, open_sockets
from tests.crash.processes import CONFIG, alive, ended, forked

SO_TIMESTAMPNS, STAMP = 35, struct.Struct("=qq")
COMMAND, SYNC = 0x201, 0x080
BOUND_MS = 2.0
HEARD_S = 0.4
ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Stop:
    """One kill: time to the first stop frame [ms], memory locked [MB], FIFO, and the drive's last words."""

    after_ms: float
    locked_mb: float
    fifo: bool
    drive: str


class NoKillError(Exception):
    """The run had ended, or never began: a busy host."""


class Ear:
    """Hears a channel, each frame with the kernel's stamp [ns, CLOCK_REALTIME]."""

    def __init__(self, channel: str) -> None:
        self._rx, tx = open_sockets(channel, own=False)
        tx.close()
        self._rx.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def frames(self, seconds: float) -> list[tuple[int, int, bytes]]:
        """(stamp, identifier, data) of what comes within a time."""
        heard, end = [], time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if select.select([self._rx], [], [], left)[0]:
                raw, more, *_ = self._rx.recvmsg(128, 64)
                can_id, size, data = CLASSIC.unpack_from(raw)
                s, ns = STAMP.unpack(more[0][2])
                heard.append((s * 1_000_000_000 + ns, can_id, data[:size]))
        return heard

    def close(self) -> None:
        self._rx.close()


def is_stop(data: bytes) -> bool:
    """A command of the house protocol: both voltages and the controlword are zero."""
    return data[2:8] == bytes(6)


def until_moving(ear: Ear, pid: int) -> None:
    """Wait until voltage is commanded. Raises NoKillError."""
    for _ in range(200):
        if any(can_id == COMMAND and data[4:8] != bytes(4) for _, can_id, data in ear.frames(0.1)):
            return
        if not alive(pid):
            break
    raise NoKillError("no voltage was commanded")


def first_stop_ms(ear: Ear, pid: int) -> float:
    """Kill; time until the first stop frame after the last command that is none. Raises NoKillError."""
    ear.frames(0.0)
    killed_ns = time.time_ns()
    os.kill(pid, signal.SIGKILL)
    commands = [(ns, data) for ns, can_id, data in ear.frames(HEARD_S) if can_id == COMMAND]
    last = max((ns for ns, data in commands if not is_stop(data)), default=0)
    stops = [ns for ns, data in commands if is_stop(data) and ns > max(last, killed_ns)]
    if not stops:
        raise NoKillError("no stop frame was heard")
    return (stops[0] - killed_ns) * 1e-6


def attempt(folder: Path, number: int, wait_s: float) -> Stop:
    """Drive and controller as real processes, one kill. Raises NoKillError."""
    folder.mkdir(parents=True)
    channel = f"delay-{os.getpid()}-{folder.name}"
    own = [f'bus.channel="{channel}"', f'log.folder="{folder}"', 'log.name="run"', "loop.duration_s=60.0",
           "reference.down_at_s=59.0", "realtime.lock_memory=true"]  # fmt: skip
    words = [word for setting in own for word in ("--set", setting)]
    ear, said = Ear(channel), folder / "drive.txt"
    pids = [forked(said, "emulate", str(CONFIG), *words)]
    try:
        pids.append(forked(folder / "run.txt", "run", str(CONFIG), *words))
        until_moving(ear, pids[1])
        ear.frames(wait_s)
        locked, fifo = locked_mb(pids[1]), os.sched_getscheduler(pids[1]) & 0xFF == os.SCHED_FIFO
        after_ms = first_stop_ms(ear, pids[1])
        ended(pids[1])
        os.kill(pids[0], signal.SIGTERM)
        ended(pids[0])
        return Stop(after_ms, locked, fifo, said.read_text().splitlines()[-1])
    finally:
        ear.close()
        for pid in pids:
            if alive(pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                ended(pid)


def locked_mb(pid: int) -> float:
    """Locked memory of a process. Raises NoKillError when it has gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1000 for line in lines if line.startswith("VmLck"))
    except (OSError, StopIteration) as error:
        raise NoKillError("the run has ended") from error


def delays(count: int, seed: int, base: Path) -> list[Stop]:
    """So many kills, one after the other, at moments by the seed."""
    dice, done = random.Random(seed), []
    for number in range(count):
        for again in range(ATTEMPTS):
            with contextlib.suppress(NoKillError):
                done.append(attempt(base / f"{number}-{again}", number, dice.uniform(0.0, 0.5)))
                break
    return done


def verdict(done: list[Stop], count: int) -> tuple[bool, str]:
    """Whether all is as it should be, and the line that says what was found.

    Without the right to lock memory or to FIFO the time is said, not judged; the drive's end always is.
    Of fewer than a hundred kills the middle one is judged: their 99th percentile is the host's worst moment.
    One of so few may end in the drive's watchdog: 1 of 200 did, and whether host or guardian was late is not
    known. From a hundred on none may.
    """
    if not done:
        return False, "first stop frame after SIGKILL: no run could be killed"
    times = sorted(stop.after_ms for stop in done)
    faults = sum("FAULT" in stop.drive for stop in done)
    granted = all(stop.fifo and stop.locked_mb > 0.0 for stop in done)
    p50, p99, worst = (times[min(int(len(times) * q), len(times) - 1)] for q in (0.5, 0.99, 1.0))
    least = min(stop.locked_mb for stop in done)
    judged = p99 if count >= 100 else p50
    good = len(done) == count and faults <= (count < 100) and (judged < BOUND_MS or not granted)
    return good, (
        f"first stop frame after SIGKILL: p50 {p50:.2f}, p99 {p99:.2f}, worst {worst:.2f} ms of {len(done)} "
        f"kills with {least:.0f} MB locked{'' if granted else ' (FIFO or locked memory not granted)'}; "
        f"drive in watchdog fault: {faults}"
    )
