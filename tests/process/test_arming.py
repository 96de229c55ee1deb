"""Arming on a terminal, the dead-man's switch, and the shadow that sends nothing: real processes."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.local import CLASSIC, open_sockets
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.arming import HOLD_NS, DeadMan
from hil.runtime.setup import Overrides
from hil.signals import DriveState, Request
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags, hil, only_log, wait_for_log

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
COMMAND = 0x201


def talk(words: list[str], answer: bytes, timeout_s: float = 180.0) -> tuple[int, str]:
    """Run hil on a terminal of its own, type ``answer`` at the question; exit code and what was shown.

    The time holds the compilation of kernels after a change of the sources.
    """
    own, its = pty.openpty()
    process = subprocess.Popen([sys.executable, "-m", "hil.cli", *words], stdin=its, stdout=its, stderr=its)
    os.close(its)
    shown, asked, end = b"", False, time.monotonic() + timeout_s
    try:
        while time.monotonic() < end:
            if not select.select([own], [], [], 0.1)[0]:
                continue
            try:
                shown += os.read(own, 4096)
            except OSError:  # the other end was closed: the process has ended
                break
            if b"type yes to arm" in shown and not asked:
                asked = True
                os.write(own, answer)
        return process.wait(10), shown.decode(errors="replace")
    finally:
        process.kill()
        process.wait()
        os.close(own)


def real_bus(configs: Path, settings: Settings) -> list[str]:
    """A run on a bus that may be real: an interface that no machine has."""
    return ["run", str(configs / "can0.toml"), *flags(settings()), "-c", "nonecan9"]


def test_a_real_bus_asks_and_names_the_limits(configs: Path, settings: Settings) -> None:
    code, shown = talk([*real_bus(configs, settings), "--arm"], b"no\n")
    assert code == 2 and "the answer was not yes; nothing was sent" in shown
    for limit in ("60 V", "5 A", "40 rad/s", "soft start 1 s", "socketcan:nonecan9"):
        assert limit in shown
    assert "can't open bus" not in shown


def test_yes_goes_on_to_the_bus(configs: Path, settings: Settings) -> None:
    code, shown = talk([*real_bus(configs, settings), "--arm"], b"yes\n")
    assert code == 2 and "can't open bus socketcan:nonecan9" in shown


def test_yes_on_the_command_line_is_not_asked(configs: Path, settings: Settings) -> None:
    code, shown = talk([*real_bus(configs, settings), "--arm", "--yes"], b"no\n")
    assert code == 2 and "can't open bus" in shown and "type yes" not in shown


def test_yes_alone_does_not_arm(configs: Path, settings: Settings) -> None:
    done = call(*real_bus(configs, settings), "--yes")
    assert done.returncode == 2 and "arm with --arm" in done.stderr


def test_the_run_stops_when_standard_input_closes(configs: Path, settings: Settings, tmp_path: Path) -> None:
    own, path = settings("loop.duration_s=60.0"), configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), dead_man_run(path, own, subprocess.PIPE) as process:
        wait_for_log(tmp_path)
        time.sleep(1.5)  # a pipe needs no keys
        assert process.poll() is None
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(30) == 0
    assert_stopped_safely(only_log(tmp_path))


@pytest.mark.long
def test_the_run_stops_a_second_after_the_key_is_let_go(
    configs: Path, settings: Settings, tmp_path: Path
) -> None:
    own, path = settings("loop.duration_s=60.0"), configs / "demo.toml"
    terminal, its = pty.openpty()
    with emulator_process(path, Overrides(settings=own)), dead_man_run(path, own, its) as process:
        os.close(its)
        for _ in range(400):  # held until the run has gone on for over a second
            os.write(terminal, b"x")
            time.sleep(0.05)
            logs = list(tmp_path.glob("logs/*.mcap"))
            if logs and logs[0].stat().st_size > 1_500_000:
                break
        assert process.poll() is None, "stopped while the key was held"
        assert process.wait(30) == 0
    os.close(terminal)
    log = only_log(tmp_path)
    assert_stopped_safely(log)
    assert len(open_log(log).ticks) > 1500


@contextmanager
def dead_man_run(path: Path, own: tuple[str, ...], stdin: int):  # type: ignore[no-untyped-def]  # noqa: ANN201
    command = [sys.executable, "-m", "hil.cli", "run", str(path), "--dead-man", *flags(own)]
    process = subprocess.Popen(command, stdin=stdin, stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()


def assert_stopped_safely(path: Path) -> None:
    log = open_log(path)
    assert log.result["ended"] == "stop_requested"
    assert log.ticks["state"][-1] == DriveState.SWITCH_ON_DISABLED
    stopped = log.ticks[log.ticks["reason"] != 0]
    assert (stopped["u_q"] == 0).all() and (stopped["u_d"] == 0).all()


def test_closed_input_ends_a_run_that_was_not_yet_armed(
    configs: Path, settings: Settings, tmp_path: Path
) -> None:
    own, path = settings("loop.duration_s=60.0"), configs / "demo.toml"
    with (
        emulator_process(path, Overrides(settings=own)),
        dead_man_run(path, own, subprocess.DEVNULL) as process,
    ):
        assert process.wait(60) == 0
    ticks = open_log(only_log(tmp_path)).ticks
    assert not ticks["send"].any() and (ticks["state"] == DriveState.SWITCH_ON_DISABLED).all()


def test_dead_man_by_a_fake_clock() -> None:
    now = 0
    terminal, its = pty.openpty()
    try:
        request = DeadMan(its, lambda: now)
        assert request.value == Request.ARM
        now += HOLD_NS
        assert request.value == Request.ARM
        os.write(terminal, b"xx\n")
        assert request.value == Request.ARM
        now += HOLD_NS
        assert request.value == Request.ARM
        now += 1
        assert request.value == Request.STOP
        assert request.value == Request.STOP, "polling again must not make it a quick stop"
        request.stop()
        assert request.value == Request.QUICK_STOP
    finally:
        os.close(terminal)
        os.close(its)


class Monitor:
    """Counts frames on a hil-local bus by the socket that sent them."""

    def __init__(self, channel: str) -> None:
        self._receiving, sending = open_sockets(channel, own=True)
        sending.close()

    def count(self, seconds: float) -> Counter[tuple[int, int]]:
        """(sender's port, identifier) of all frames for a while."""
        seen: Counter[tuple[int, int]] = Counter()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if select.select([self._receiving], [], [], 0.05)[0]:
                try:
                    data, sender = self._receiving.recvfrom(128)
                except BlockingIOError:
                    continue
                seen[sender[1], CLASSIC.unpack(data[: CLASSIC.size])[0]] += 1
        return seen

    def close(self) -> None:
        self._receiving.close()


def senders(seen: Counter[tuple[int, int]]) -> set[int]:
    return {port for port, _ in seen}


def test_a_shadow_beside_a_controller_sends_nothing_and_replays(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own, path = settings("loop.duration_s=300.0", "reference.down_at_s=290.0"), configs / "demo.toml"
    monitor = Monitor(channel)
    shadow_folder = tmp_path / "shadow"
    shadow_own = (*own, f'log.folder="{shadow_folder / "logs"}"', "loop.duration_s=3.0")
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as master:
        wait_for_log(tmp_path)
        before = senders(monitor.count(0.5))
        with hil("run", str(path), "--shadow", *flags(shadow_own)) as shadow:
            during: Counter[tuple[int, int]] = Counter()
            while shadow.poll() is None:
                during += monitor.count(0.2)
            assert shadow.returncode == 0, shadow.communicate()
        during += monitor.count(0.2)
        assert master.poll() is None
        master.send_signal(signal.SIGTERM)
        assert master.wait(30) == 0
    monitor.close()
    assert len(before) == 2, before
    assert senders(during) == before, "a third one sent something"
    assert sum(n for (_, can_id), n in during.items() if can_id == COMMAND) > 1000
    assert_silent(only_log(shadow_folder), least=2000)


def assert_silent(path: Path, least: int) -> None:
    """Nothing sent, and ``least`` ticks in which the drive is driven, computed as the log's replay does.

    That the controller computed the same: tests/vm, where no frame is late or lost by the host's doing.
    """
    log = open_log(path)
    assert replay(path).verdict == "same"
    assert not log.ticks["send"].any()
    assert all(frame.received for frame in log.frames)
    assert any(event["kind"] == "shadow" for event in log.events)
    assert (log.ticks["state"] == DriveState.OPERATION_ENABLED).sum() > least


@pytest.mark.long
def test_a_shadow_without_another_controller_waits_and_sends_nothing(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own, path = settings("loop.duration_s=1.0"), configs / "demo.toml"
    monitor = Monitor(channel)
    with (
        emulator_process(path, Overrides(settings=own)),
        hil("run", str(path), "--shadow", *flags(own)) as shadow,
    ):
        seen: Counter[tuple[int, int]] = Counter()
        while shadow.poll() is None:
            seen += monitor.count(0.2)
        assert shadow.returncode == 0, shadow.communicate()
    seen += monitor.count(0.2)
    monitor.close()
    assert {can_id for _, can_id in seen} == {0x701}
    assert len(senders(seen)) == 1
