"""The guardian against real processes: SIGKILL, SIGSTOP and its own death, with the drive's watchdog off."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.codec import Database
from hil.errors import HilError
from hil.log.reader import open_log
from hil.runtime.guardian import GUARDIAN_LOST_NS, STOPS, GuardedDrive, Rights, Word, guardian, guardian_flags
from hil.runtime.setup import Overrides
from hil.signals import DriveState, Reason, RxFlag, new_ticks
from hil.sim.demo import emulator_process
from tests.conftest import CONFIGS

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
HOUSE = Database(CONFIGS / "drives" / "hil_pmsm.dbc")
WATCHDOG_OFF = ("firmware.watchdog_ms=0.0",)
COMMAND, FEEDBACK = HOUSE.message("COMMAND"), HOUSE.message("FEEDBACK")


@dataclass
class Bench:
    """A run in operation on a bus that the test listens to."""

    run: subprocess.Popen[str]
    bus: can.BusABC
    folder: Path

    def frames(self, message: Any, seconds: float) -> list[tuple[float, dict[str, float]]]:
        """What is heard of a message, with the time since now [s]."""
        start, heard = time.monotonic(), []
        while (left := start + seconds - time.monotonic()) > 0:
            frame = self.bus.recv(left)
            if frame is not None and frame.arbitration_id == message.can_id:
                heard.append((time.monotonic() - start, message.decode(bytes(frame.data))))
        return heard

    def until_moving(self) -> None:
        """Wait until the controller commands a voltage."""
        for _ in range(180):  # kernels may have to be compiled first
            if any(abs(values["VoltageQ"]) > 20.0 for _, values in self.frames(COMMAND, 0.5)):
                return
        raise AssertionError("the run does not begin")

    def drain(self) -> None:
        while self.bus.recv(0) is not None:
            pass

    @property
    def relatives(self) -> list[int]:
        """Processes with the run's command line: the controller and its guardian."""
        own = Path(f"/proc/{self.run.pid}/cmdline").read_bytes()
        return [int(p.parent.name) for p in Path("/proc").glob("[0-9]*/cmdline") if _bytes(p) == own]

    @property
    def guardian_pid(self) -> int:
        (pid,) = [pid for pid in self.relatives if pid != self.run.pid]
        return pid

    def log(self) -> Any:
        (path,) = (self.folder / "logs").glob("*.mcap")
        return open_log(path)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def alive(pid: int) -> bool:
    """A process that has ended has no command line, even while nobody has waited for it."""
    return _bytes(Path(f"/proc/{pid}/cmdline")) != b""


@pytest.fixture
def bench(configs: Path, settings: Settings, channel: str, tmp_path: Path) -> Iterator[Bench]:
    own = settings("loop.duration_s=60.0", "reference.down_at_s=59.0", "guardian.timeout_ms=80.0")
    path = configs / "demo.toml"
    words = [word for setting in own for word in ("--set", setting)]
    with emulator_process(path, Overrides(settings=own), WATCHDOG_OFF), listener(channel) as bus:
        run = subprocess.Popen(
            [sys.executable, "-m", "hil.cli", "run", str(path), *words],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            made = Bench(run, bus, tmp_path)
            made.until_moving()
            yield made
        finally:
            if run.poll() is None:
                run.send_signal(signal.SIGCONT)
                run.kill()
            run.communicate()


@contextmanager
def listener(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(interface="hil-local", channel=channel) as bus:
        yield bus


def assert_stopped(bench: Bench, within_s: float) -> None:
    """Zero voltage and disable are heard in time and nothing else; the drive says that it is off."""
    start = time.monotonic()
    commands, states = [], []
    while time.monotonic() - start < within_s:
        frame = bench.bus.recv(0.05)
        if frame is not None and frame.arbitration_id == COMMAND.can_id:
            commands.append(COMMAND.decode(bytes(frame.data)))
        elif frame is not None and frame.arbitration_id == FEEDBACK.can_id:
            states.append(FEEDBACK.decode(bytes(frame.data))["State"])
    stops = [c for c in commands if c["Controlword"] == 0]
    assert len(stops) >= 5 and all(c["VoltageQ"] == c["VoltageD"] == 0.0 for c in stops)
    assert commands[-len(stops) :] == stops  # and nothing after them
    assert states and states[-1] == DriveState.SWITCH_ON_DISABLED


def test_a_killed_controller_leaves_a_stopped_drive(bench: Bench) -> None:
    own = bench.relatives
    assert len(own) == 2
    bench.drain()
    bench.run.kill()
    assert_stopped(bench, 1.0)
    assert not [pid for pid in own if alive(pid)]
    log = bench.log()
    assert log.damage is None or "result" in log.damage


def test_a_stopped_controller_never_sends_again(bench: Bench) -> None:
    bench.drain()
    bench.run.send_signal(signal.SIGSTOP)
    assert_stopped(bench, 1.0)
    assert bench.frames(COMMAND, 0.3) == []
    bench.run.send_signal(signal.SIGCONT)
    later = bench.frames(COMMAND, 1.0)
    assert all(c["Controlword"] == 0 and c["VoltageQ"] == 0.0 for _, c in later)  # the guardian once more
    assert bench.run.wait(10) == 1
    ticks = bench.log().ticks
    assert Reason(int(ticks["reason"][-1])) == Reason.GUARDIAN
    assert not ticks["send"][ticks["reason"] == Reason.GUARDIAN].any()


def test_without_its_guardian_a_run_ends(bench: Bench) -> None:
    os.kill(bench.guardian_pid, signal.SIGKILL)
    killed_ns = time.monotonic_ns()
    assert bench.run.wait(20) == 1
    ticks = bench.log().ticks
    assert Reason(int(ticks["reason"][-1])) == Reason.GUARDIAN_LOST
    seen = ticks[ticks["reason"] != 0][0]
    after_ns = int(seen["t_ns"]) - killed_ns  # its last beat was up to a timeout before
    assert GUARDIAN_LOST_NS - 90_000_000 < after_ns < GUARDIAN_LOST_NS + int(seen["gap"]) * 1_000_000
    assert float(abs(ticks["u_q"][-1])) == 0.0


def test_a_run_that_ends_leaves_nobody(bench: Bench) -> None:
    own = bench.relatives
    bench.run.send_signal(signal.SIGINT)
    assert bench.run.wait(20) == 0
    assert not [pid for pid in own if alive(pid)]


class Wire:
    """A stopper that writes a byte for each call."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def stop_from(self, counter: int) -> None:
        os.write(self._fd, bytes((counter,)))


class Quiet:
    """A drive port that counts what it would send."""

    def __init__(self) -> None:
        self.sent = 0

    def prepare(self, tick: Any) -> None: ...

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        self.sent += 1

    def receive(self, tick: Any, deadline_ns: int) -> None:
        tick["rx_flags"] = int(RxFlag.FRESH)

    def send(self, tick: Any) -> None:
        self.sent += 1

    def stop(self) -> None:
        self.sent += 1

    def close(self) -> None: ...


def test_a_loop_that_hangs_is_stopped_and_stays_stopped() -> None:
    ours, theirs = os.pipe()
    with guardian(50_000_000, Rights(), lambda: Wire(theirs)) as words:
        os.set_blocking(ours, False)
        drive, tick = Quiet(), new_ticks()[0]
        guarded = GuardedDrive(drive, words, time.monotonic_ns)
        guarded.prepare(tick)
        time.sleep(0.2)  # not armed: silence is nothing
        with pytest.raises(BlockingIOError):
            os.read(ours, 100)
        tick["state"], tick["counter"], tick["send"] = int(DriveState.OPERATION_ENABLED), 7, 1
        guarded.send(tick)
        time.sleep(0.5)  # the hang
        assert set(os.read(ours, 100)) == {7} and words.cells[Word.FIRED] == 1
        before = drive.sent
        guarded.exchange(tick, 0)
        with pytest.raises(OSError, match="guardian has stopped"):
            guarded.send(tick)
        guarded.stop()
        assert drive.sent == before and tick["send"] == 1  # the record is the kernel's
        assert int(tick["rx_flags"]) & int(RxFlag.GUARDIAN)


def test_a_loop_that_ends_while_armed_is_stopped_before_its_process_goes_on() -> None:
    ours, theirs = os.pipe()
    with guardian(60_000_000_000, Rights(), lambda: Wire(theirs)) as words:
        words.cells[Word.COUNTER], words.cells[Word.ARMED] = 9, 1
    os.set_blocking(ours, False)
    assert os.read(ours, 100) == bytes((9,)) * STOPS


def test_a_loop_that_ends_disarmed_sends_nothing() -> None:
    ours, theirs = os.pipe()
    with guardian(60_000_000_000, Rights(), lambda: Wire(theirs)):
        pass
    os.set_blocking(ours, False)
    with pytest.raises(BlockingIOError):
        os.read(ours, 100)


def test_a_guardian_with_a_long_timeout_is_not_lost() -> None:
    _, theirs = os.pipe()
    with guardian(3_000_000_000, Rights(), lambda: Wire(theirs)) as words:
        for _ in range(20):
            time.sleep(0.05)
            words.cells[Word.BEAT_NS] = time.monotonic_ns()
            assert guardian_flags(words.cells) == 0


def test_a_guardian_that_can_not_open_its_link_says_why() -> None:
    def fail() -> Wire:
        raise OSError("no such bus")

    with (
        pytest.raises(HilError, match=r"can't start: OSError: no such bus; nothing was sent"),
        guardian(10_000_000, Rights(), fail),
    ):
        raise AssertionError("it must not run")
