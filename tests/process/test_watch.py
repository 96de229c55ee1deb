"""`hil watch` beside a real run: what it shows, its stop, and that it costs the run nothing."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.log.reader import open_log
from hil.runtime.registry import WatchError, choose
from hil.runtime.setup import Overrides
from hil.signals import DriveState
from hil.sim.demo import emulator_process
from hil.watch.look import Look, outcome
from tests.process.test_run import call, flags, hil, only_log, voltages_after_stop

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def wait_for_run(process: subprocess.Popen[str], channel: str) -> None:
    """Wait until the run has ticked for a while; the first one in a fresh tree compiles before that."""
    for _ in range(2400):
        if process.poll() is not None:
            raise AssertionError(f"the run ended before it began: {process.communicate()}")
        with contextlib.suppress(WatchError):
            look = Look(choose(channel))
            k = look.latest(1)["k"]
            look.close()
            if len(k) and k[0] > 300:
                return
        time.sleep(0.05)
    raise AssertionError("the run does not begin")


def opened_by(pid: int) -> set[str]:
    return {str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()}


def test_a_run_is_seen_stopped_and_says_who_stopped_it(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own = settings("loop.duration_s=60.0")
    path = configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_run(process, channel)
        before = opened_by(process.pid)
        seen = call("watch", channel, "--json")
        assert seen.returncode == 0, seen.stderr
        now = json.loads(seen.stdout)
        assert now["pid"] == process.pid and now["state"] == "operation_enabled" and now["k"] > 0
        assert set(now["lateness_us"]) == {"p50", "p99", "max"} and now["dropped"] == 0
        shown = call("watch", "--once").stdout
        assert all(
            word in shown for word in ("operation enabled", "speed", "load estimate", channel, "state")
        )
        assert "\x1b" not in shown
        look = Look(choose(None))
        first, more = look.new_ticks(), look.new_ticks()
        assert np.all(np.diff(first["k"].astype(np.int64)) > 0)
        assert not set(first["k"]) & set(more["k"])
        assert opened_by(process.pid) == before  # the run has no descriptor, socket or thread for viewers
        assert look.stop("a test") == "stop asked"
        process.communicate(timeout=60)
        assert process.returncode == 0 and not look.alive
        look.close()
    log = open_log(only_log(tmp_path))
    assert outcome(str(log.path)) == "stop_requested"
    assert (voltages_after_stop(log.path) == 0).all()
    assert log.ticks["state"][-1] == DriveState.SWITCH_ON_DISABLED
    assert [event["text"] for event in log.events if event["kind"] == "stop-asked"] == ["a test"]
    gone = call("watch", channel)
    assert gone.returncode == 2 and "no run with" in gone.stderr


def test_no_run_is_one_clear_line() -> None:
    done = call("watch", "--once")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("hil: no run of this user is running")


def test_another_users_run_is_refused() -> None:
    if os.getuid() == 0:
        other = subprocess.Popen(["sleep", "60"], user=65534)
    else:
        pytest.skip("needs root to start a process of another user")
    try:
        done = call("watch", str(other.pid))
        assert done.returncode == 2 and "belongs to another user" in done.stderr
    finally:
        other.kill()
        other.wait()


@pytest.mark.parametrize("port", ["70000", "-1", "x"])
def test_a_port_that_is_none_is_refused(port: str) -> None:
    done = call("watch", "--web", "--port", port)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "argument --port: " in done.stderr and "must be a port, 0 to 65535" in done.stderr


@pytest.mark.parametrize("flags", [("--web", "--foxglove"), ("--once", "--web"), ("--once", "--foxglove")])
def test_one_view_at_a_time(flags: tuple[str, ...]) -> None:
    done = call("watch", *flags)
    assert done.returncode == 2 and "not allowed with argument" in done.stderr


def read_until(fd: int, wanted: bytes, seen: bytes = b"") -> bytes:
    """What a terminal shows, up to some text; all it shows when the text never comes."""
    for _ in range(600):
        if wanted in seen:
            break
        if select.select([fd], [], [], 0.1)[0]:
            try:
                seen += os.read(fd, 65536)
            except OSError:  # the other end has gone
                break
    return seen


def resized(fd: int, columns: int, rows: int) -> list[str]:
    """The lines of the first frame of that width after the terminal got that size, else of the last one."""
    fcntl.ioctl(fd, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    home, seen, end = b"\x1b[H", b"", time.monotonic() + 30
    lines: list[str] = []
    while time.monotonic() < end and max(map(len, lines), default=0) != columns:
        if select.select([fd], [], [], 0.1)[0]:
            seen += os.read(fd, 65536)
        whole, _, rest = seen.rpartition(home)
        if whole:
            text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", whole.rpartition(home)[2].decode())
            lines, seen = [line for line in re.split(r"[\r\n]+", text) if line], rest
    return lines


@pytest.mark.long
def test_the_terminal_is_resized(configs: Path, settings: Settings, channel: str) -> None:
    own, path = settings("loop.duration_s=90.0"), configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_run(process, channel)
        pid, fd = pty.fork()
        if pid == 0:
            env = {name: text for name, text in os.environ.items() if name not in ("COLUMNS", "LINES")}
            os.execve(sys.executable, [sys.executable, "-m", "hil.cli", "watch", channel], env)
        try:
            assert b"q leaves" in read_until(fd, b"q leaves")
            for columns, rows in ((100, 40), (50, 20), (20, 6), (160, 50)):
                lines = resized(fd, columns, rows)
                assert max(map(len, lines)) == columns, (columns, lines)
                assert len(lines) <= rows, (rows, lines)
            os.write(fd, b"q")
            assert b"the run goes on" in read_until(fd, b"the run goes on")
            assert os.waitpid(pid, 0)[1] == 0
            pid = 0
        finally:
            if pid:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            os.close(fd)


@pytest.mark.long
def test_keys_in_the_terminal_leave_and_stop(
    configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own, path = settings("loop.duration_s=90.0"), configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_run(process, channel)
        for keys, answers in (("q", ["the run goes on"]), ("sn", ["y stops it", "not stopped"]), ("sy", [])):
            pid, fd = pty.fork()
            if pid == 0:
                os.execv(sys.executable, [sys.executable, "-m", "hil.cli", "watch", channel])
            try:
                assert b"q leaves" in read_until(fd, b"q leaves")
                for key, answer in zip(keys, [*answers, "", ""], strict=False):
                    os.write(fd, key.encode())
                    wanted = answer.encode() or (
                        b"y stops it" if key == "s" else b"has ended: stop_requested"
                    )
                    assert wanted in read_until(fd, wanted), (keys, key)
            finally:
                if keys == "sn":
                    os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                os.close(fd)
            assert (process.poll() is None) == (keys != "sy")
        process.communicate(timeout=60)
        assert process.returncode == 0
    events = open_log(only_log(tmp_path)).events
    assert ["in the terminal" in event["text"] for event in events if event["kind"] == "stop-asked"] == [True]
