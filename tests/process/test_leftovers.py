"""What is left when a command is killed early, and when its standard streams are closed."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.log.reader import open_log
from hil.runtime.setup import Overrides
from hil.signals import Request
from hil.sim.demo import emulator_process
from tests.process.test_run import call, flags, hil, only_log, wait_for_log

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]


def emulators(channel: str) -> list[int]:
    """Processes that emulate on a channel."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if "emulate" in words and any(channel in word for word in words):
            found.append(int(path.parent.name))
    return found


def until(condition: Callable[[], object], within_s: float) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.mark.corners
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("after_s", [0.0, 0.3, 3.0])
def test_a_demo_that_is_ended_leaves_no_emulator(
    configs: Path, settings: Settings, channel: str, number: signal.Signals, after_s: float
) -> None:
    words = ["demo", str(configs / "demo.toml"), "--json", *flags(settings()), "-c", channel]
    command = [sys.executable, "-m", "hil.cli", *words]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        assert until(lambda: emulators(channel), 60.0), "no emulator was started"
        time.sleep(after_s)
        demo.send_signal(number)
        demo.wait(30)
        assert until(lambda: not emulators(channel), 10.0), "the emulator is left"
    finally:
        demo.kill()
        demo.wait()


@pytest.mark.long
def test_a_signal_is_heard_however_long_a_tick_waits(
    configs: Path, settings: Settings, tmp_path: Path
) -> None:
    """The longest feedback timeout that is allowed, and a drive that no longer answers."""
    path = configs / "demo.toml"
    more = ("loop.feedback_timeout_us=64000", "feedback.hold_ticks=900", "loop.duration_s=60.0")
    own = settings(*more)
    with emulator_process(path, Overrides(settings=own)) as drive, hil("run", str(path), *flags(own)) as run:
        wait_for_log(tmp_path)
        os.kill(drive, signal.SIGSTOP)
        time.sleep(0.1)
        asked_ns = time.monotonic_ns()
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=30)
        os.kill(drive, signal.SIGCONT)
    ticks = open_log(only_log(tmp_path)).ticks
    heard = ticks[ticks["request"] >= Request.STOP][0]
    assert int(heard["t_ns"]) - asked_ns < 200_000_000


def test_a_feedback_timeout_longer_than_any_tick_is_refused(configs: Path, settings: Settings) -> None:
    for value in ("1000000000000", "1e300", "100001"):
        done = call("run", str(configs / "demo.toml"), *flags(settings(f"loop.feedback_timeout_us={value}")))
        assert done.returncode == 2 and "feedback_timeout_us" in done.stderr, done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.corners
@pytest.mark.parametrize("value", ["1e300", "1e-9", "-1.0", "nan", "20000.0"])
def test_a_guardian_that_could_not_watch_is_refused(configs: Path, settings: Settings, value: str) -> None:
    done = call("run", str(configs / "demo.toml"), *flags(settings(f"guardian.timeout_ms={value}")))
    assert done.returncode == 2 and "guardian.timeout_ms" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr and "waiting" not in done.stderr


@pytest.mark.corners
@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&-", "<&- >&- 2>&-"])
def test_closed_streams_are_no_traceback(
    configs: Path, settings: Settings, tmp_path: Path, closed: str
) -> None:
    own = flags(settings("loop.duration_s=0.3", 'loop.clock="lockstep"', "reference.down_at_s=0.2"))
    path, log = shlex.quote(str(configs / "demo.toml")), tmp_path / "errors.txt"
    hil = f"{sys.executable} -X faulthandler -m hil.cli"
    more = shlex.join(own)
    script = (
        f"{hil} emulate {path} {more} >/dev/null 2>&1 & e=$!\n"
        f"exec 2>{log}\n{hil} run {path} {more} {closed}\ncode=$?\nkill $e; wait $e; exit $code"
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, timeout=180, check=False)
    said = log.read_text()
    assert done.returncode == 0, said
    assert "Traceback" not in said
    assert "2>" in closed or "arming" in said


def test_a_refusal_with_closed_streams_is_still_one(configs: Path) -> None:
    for closed in ("2>&-", "2>&- >&-"):
        line = f"{sys.executable} -m hil.cli run {configs / 'none.toml'} {closed}"
        assert subprocess.run(["bash", "-c", line], timeout=60, check=False).returncode == 2
