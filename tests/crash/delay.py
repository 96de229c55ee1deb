"""How long after SIGKILL of a controller the guardian's first stop frame is on the bus, memory locked.

The end of the wait is the kernel's own stamp of the frame, so that this listener's delays do not count. Its
begin is stamped above all other programs under FIFO: one that ran between stamp and signal would count as the
guardian's delay. The drive's watchdog is at its default of 20 ms: a drive that ends in FAULT was not
stopped in time. Each kill is judged beside a control (:mod:`tests.crash.witness`), which tells a host that
stood still from a guardian that was late.
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
from tests.crash.witness import Delay, Witness, above_all, within_ms, witness

SO_TIMESTAMPNS, STAMP = 35, struct.Struct("=qq")
COMMAND, SYNC = 0x201, 0x080
BOUND_MS, MOST_MS = 2.0, 5.0
"""What the 99th percentile keeps, and every single stop: a quarter of the drive's watchdog."""
OWN_MS = 1.0
"""So long the loop's own end may keep a core from others (0.9 ms seen): no excuse for the guardian."""
WATCHDOG_MS = 20.0
BEFORE_NS, AFTER_NS = 50_000_000, 100_000_000
"""What may have cost the drive its commands: from before the kill until it must have read its stop frames."""
HEARD_S = 0.4
ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Stop:
    """One kill: time to the first stop frame [ms], memory locked [MB], FIFO, and the drive's last words.

    Beside it: how long the drive had no command [ms], and the control's longest delay from the kill to the
    stop frame and around both [ms].
    """

    after_ms: float
    locked_mb: float
    fifo: bool
    drive: str
    silent_ms: float = 0.0
    control_ms: float = 0.0
    around_ms: float = 0.0

    @property
    def late(self) -> bool:
        """Later than the bound by more than the host stood still."""
        return self.after_ms - (self.control_ms if self.control_ms >= OWN_MS else 0.0) >= BOUND_MS

    @property
    def tripped(self) -> bool:
        """The drive's watchdog tripped, and the host did not stand still for that long."""
        return "FAULT" in self.drive and self.around_ms < WATCHDOG_MS

    def __str__(self) -> str:
        """What there is to say of a kill that did not go as it should."""
        return (
            f"  {self.after_ms:.2f} ms after SIGKILL, {self.silent_ms:.2f} ms after the last command; "
            f"control late by {self.control_ms:.2f} ms meanwhile, {self.around_ms:.2f} around; {self.drive}"
        )


@dataclass(frozen=True, slots=True)
class Heard:
    """When it was killed, the last command before, the first stop frame after [ns, CLOCK_REALTIME]."""

    killed_ns: int
    last_ns: int
    stop_ns: int


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


def kill(ear: Ear, pid: int, wait_s: float) -> Heard:
    """Kill after a while; the first stop frame after the last command that is none. Raises NoKillError."""
    before = ear.frames(wait_s)
    with above_all():
        killed_ns = time.time_ns()
        os.kill(pid, signal.SIGKILL)
    commands = [(ns, data) for ns, can_id, data in before + ear.frames(HEARD_S) if can_id == COMMAND]
    last = max((ns for ns, data in commands if not is_stop(data)), default=0)
    stops = [ns for ns, data in commands if is_stop(data) and ns > max(last, killed_ns)]
    if not (last and stops):
        raise NoKillError("no stop frame was heard")
    return Heard(killed_ns, last, stops[0])


def attempt(folder: Path, control: Witness, wait_s: float) -> Stop:
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
        locked, fifo = locked_mb(pids[1]), os.sched_getscheduler(pids[1]) & 0xFF == os.SCHED_FIFO
        heard = kill(ear, pids[1], wait_s)
        delays = control.delays()
        ended(pids[1])
        os.kill(pids[0], signal.SIGTERM)
        ended(pids[0])
        return stop_of(heard, delays, locked, fifo, said.read_text().splitlines()[-1])
    finally:
        ear.close()
        for pid in pids:
            if alive(pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                ended(pid)


def stop_of(heard: Heard, delays: list[Delay], locked: float, fifo: bool, drive: str) -> Stop:
    """A kill beside its control."""
    killed, last, stop = heard.killed_ns, heard.last_ns, heard.stop_ns
    control_ms = within_ms(delays, killed, stop)
    around_ms = within_ms(delays, min(killed, last) - BEFORE_NS, stop + AFTER_NS)
    return Stop((stop - killed) * 1e-6, locked, fifo, drive, (stop - last) * 1e-6, control_ms, around_ms)


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
    with witness() as control:
        for number in range(count):
            for again in range(ATTEMPTS):
                with contextlib.suppress(NoKillError):
                    done.append(attempt(base / f"{number}-{again}", control, dice.uniform(0.0, 0.5)))
                    break
    return done


def spread(values: list[float]) -> str:
    """Middle one, 99th percentile and worst, in words."""
    ordered = sorted(values)
    p50, p99 = (ordered[min(int(len(ordered) * q), len(ordered) - 1)] for q in (0.5, 0.99))
    return f"p50 {p50:.2f}, p99 {p99:.2f}, worst {ordered[-1]:.2f} ms"


def verdict(done: list[Stop], count: int) -> tuple[bool, str]:
    """Whether all is as it should be, and what was found: a line, and one for each kill that was not.

    The 99th percentile is judged: one stop frame of a hundred, or of ten and more, may be later than
    BOUND_MS, none than MOST_MS. No drive may end in its watchdog. A host that itself stood still so long is
    an excuse.
    Without the right to FIFO or to lock memory the time is said, not judged, and the control, which has
    no more rights, excuses nothing.
    """
    if not done:
        return False, "first stop frame after SIGKILL: no run could be killed"
    granted = all(stop.fifo and stop.locked_mb > 0.0 for stop in done)
    faults = [stop for stop in done if "FAULT" in stop.drive]
    slow = [stop for stop in done if stop.after_ms >= BOUND_MS]
    late = [stop for stop in slow if stop.late and granted]
    tripped = [stop for stop in faults if stop.tripped or not granted]
    least = min(stop.locked_mb for stop in done)
    still = len(slow) - len(late) if granted else 0
    line = (
        f"first stop frame after SIGKILL: {spread([stop.after_ms for stop in done])} of {len(done)} kills "
        f"with {least:.0f} MB locked{'' if granted else ' (FIFO or locked memory not granted)'}; control "
        f"late by {spread([stop.control_ms for stop in done])}; over {BOUND_MS:g} ms: {len(slow)}, the host "
        f"stood still in {still}; drive in watchdog fault: {len(faults)}, the host stood still in "
        f"{len(faults) - len(tripped)}"
    )
    odd = [stop for stop in done if stop in slow or stop in faults]
    spared = count // 100 or int(count >= 10)
    in_time = len(late) <= spared and all(stop.after_ms < MOST_MS for stop in late)
    return len(done) == count and in_time and not tripped, "\n".join([line, *map(str, odd)])
