"""Recorder and writer process: kills at random moments, a full disk, a slow writer, early refusals."""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hil.log.container import MAGIC
from hil.log.errors import LogError
from hil.log.reader import open_log
from hil.log.recorder import RING_SECONDS, Recorder, check_folder, open_recorder
from hil.log.records import FRAME_RECORD
from hil.log.ring import FAILED_AT, attach
from hil.signals import TICK, TickArray, new_ticks
from tests.logfiles import HEADER, some_ticks

pytestmark = pytest.mark.process
RATE_HZ = 1000


@contextlib.contextmanager
def recording(path: Path) -> Iterator[Recorder]:
    recorder = open_recorder(path, HEADER, RATE_HZ, 1.0)
    try:
        yield recorder
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(recorder.writer_pid, signal.SIGCONT)
        recorder.close({"ended": "test ended"})


def push(recorder: Recorder, ticks: TickArray, pause_s: float = 0.0) -> None:
    for at in range(len(ticks)):
        recorder.tick(ticks[at : at + 1])
        if pause_s:
            time.sleep(pause_s)


def wait_for(condition: Callable[[], bool], timeout_s: float) -> float:
    """Seconds until ``condition`` held; fails the test when it never does."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < timeout_s, "never happened"
        time.sleep(0.005)
    return time.monotonic() - start


def test_a_run_is_recorded_whole(tmp_path: Path) -> None:
    path, ticks = tmp_path / "run.mcap", some_ticks(1500)
    with recording(path) as recorder:
        push(recorder, ticks[:700], 0.001)
        frames = [(True, 5, 0x181, b"\x01\x02"), (False, 6, 0x201, bytes(range(64)))]
        records = [FRAME_RECORD.pack(t, can_id, rx, len(data), data) for rx, t, can_id, data in frames]
        recorder.frames(memoryview(b"".join(records)))
        recorder.event(7, 3, "state", "OPERATION_ENABLED")
        push(recorder, ticks[700:])
        assert not recorder.failed
        assert recorder.close({"ended": "stop_requested"})
        assert recorder.close({}) and not recorder.failed
    log = open_log(path)
    assert log.damage is None and log.ticks.tobytes() == ticks.tobytes()
    assert log.frames == [(True, 5, 0x181, b"\x01\x02"), (False, 6, 0x201, bytes(range(64)))]
    assert log.events == [{"t_ns": 7, "k": 3, "kind": "state", "text": "OPERATION_ENABLED"}]
    assert log.result == {
        "ended": "stop_requested",
        "dropped_ticks": 0,
        "dropped_frames": 0,
        "dropped_events": 0,
    }
    assert path.stat().st_mode & 0o777 == 0o600


CONTROLLER = """
import sys, time
from pathlib import Path
from hil.log.records import FRAME_RECORD
from hil.log.recorder import Recorder
from tests.logfiles import HEADER, some_ticks
recorder = Recorder(Path(sys.argv[1]), HEADER, 1000)
ticks = some_ticks(4000)
for at in range(len(ticks)):
    recorder.tick(ticks[at:at + 1])
    print(at, recorder.writer_pid, flush=True)
    time.sleep(0.0005)
"""


def controller(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", CONTROLLER, str(path)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])


def gone(pid: int) -> bool:
    """True when a process that is no child of ours has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.corners
@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_lost_when_the_controller_is_killed(tmp_path: Path, seed: int) -> None:
    path, lives_s = tmp_path / "run.mcap", random.Random(seed).uniform(0.05, 1.0)
    with controller(path) as process:
        assert process.stdout is not None
        writer = int(process.stdout.readline().split()[1])
        time.sleep(lives_s)
        process.kill()
        pushed = int(process.stdout.read().split("\n")[-2].split()[0])
    wait_for(lambda: gone(writer), 10)
    log = open_log(path)
    assert log.damage is None and log.result["ended"] == "controller died", f"seed {seed}"
    assert int(log.ticks["k"][-1]) >= pushed and log.gaps == [], f"seed {seed}"
    assert log.ticks.tobytes() == some_ticks(4000)[: len(log.ticks)].tobytes(), f"seed {seed}"


@pytest.mark.corners
@pytest.mark.parametrize("seed", range(3))
def test_a_killed_writer_is_noticed_and_its_file_reads_to_the_last_second(tmp_path: Path, seed: int) -> None:
    """Also a slow run's, whose chunks close by time and not by size."""
    path, lives_s = tmp_path / "run.mcap", random.Random(seed).uniform(1.1, 1.7)
    with recording(path) as recorder:
        assert not recorder.failed
        ticks, start, k = some_ticks(4000), time.monotonic(), 0
        while time.monotonic() - start < lives_s:
            recorder.tick(ticks[k : k + 1])
            k += 1
            time.sleep(0.01)
        written = time.monotonic()
        os.kill(recorder.writer_pid, signal.SIGKILL)
        assert wait_for(lambda: recorder.failed, 5) < 1.5, "sooner than by its silence"
        assert recorder.failed, "for good"
        assert not recorder.close({"ended": "log failed"})
    log = open_log(path)
    assert log.damage is not None and "the result is missing" in log.damage, f"seed {seed}"
    lost_s = (k - len(log.ticks)) * (written - start) / k
    assert lost_s < 1.0 and log.gaps == [], f"seed {seed}"


def test_signals_meant_for_the_controller_do_not_end_the_writer(tmp_path: Path) -> None:
    path, ticks = tmp_path / "run.mcap", some_ticks(300)
    with recording(path) as recorder:
        assert os.getsid(recorder.writer_pid) != os.getsid(0)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(recorder.writer_pid, number)
        push(recorder, ticks, 0.001)
        assert recorder.close({"ended": "stop_requested"})
    assert len(open_log(path).ticks) == 300


def test_a_slow_writer_drops_counts_and_names_the_gap(tmp_path: Path) -> None:
    path, capacity = tmp_path / "run.mcap", RATE_HZ * RING_SECONDS
    with recording(path) as recorder:
        os.kill(recorder.writer_pid, signal.SIGSTOP)
        push(recorder, some_ticks(capacity + 123))
        assert recorder.dropped == 123
        os.kill(recorder.writer_pid, signal.SIGCONT)
        ring = attach(os.getpid(), "ticks", TICK.itemsize)
        wait_for(lambda: bool(ring.header[3] == ring.header[4]), 10)
        ring.close()
        push(recorder, some_ticks(10, capacity + 123))
        assert not recorder.failed
        assert recorder.close({"ended": "stop_requested"})
        assert recorder.dropped == 123
    log = open_log(path)
    assert log.gaps == [(capacity + 123, 123)] and log.result["dropped_ticks"] == 123


def test_a_writer_that_hangs_is_a_failure_after_two_seconds(tmp_path: Path) -> None:
    with recording(tmp_path / "run.mcap") as recorder:
        wait_for(lambda: not recorder.failed, 1)
        os.kill(recorder.writer_pid, signal.SIGSTOP)
        assert wait_for(lambda: recorder.failed, 10) > 1.5


def test_a_writer_that_was_stopped_finishes_what_the_rings_hold(tmp_path: Path) -> None:
    path, ticks = tmp_path / "run.mcap", some_ticks(700)
    with recording(path) as recorder:
        push(recorder, ticks[:200], 0.0005)
        os.kill(recorder.writer_pid, signal.SIGSTOP)
        push(recorder, ticks[200:])
        wait_for(lambda: recorder.failed, 10)
        begun = time.monotonic()
        recorder.close({"ended": "log_failed"})
        assert time.monotonic() - begun < 20.0, "it waited for the longest time"
    log = open_log(path)
    assert log.damage is None and log.ticks.tobytes() == ticks.tobytes()
    assert log.result["ended"] == "log_failed"


@pytest.mark.parametrize("how", ["folder deleted", "file deleted", "folder moved", "file replaced"])
@pytest.mark.parametrize("late", [False, True])
def test_a_log_that_is_no_longer_there_is_a_failure(tmp_path: Path, how: str, late: bool) -> None:
    """Noticed while the run goes on, or at the latest when it is closed."""
    path = tmp_path / "logs" / "run.mcap"
    with recording(path) as recorder:
        push(recorder, some_ticks(200), 0.0005)
        if how == "folder deleted":
            shutil.rmtree(path.parent)
        elif how == "folder moved":
            path.parent.rename(tmp_path / "elsewhere")
        else:
            path.unlink()
        if how == "file replaced":
            path.write_bytes(b"another's")
        if not late:
            wait_for(lambda: recorder.failed, 10)
        assert not recorder.close({"ended": "stop_requested"}) and recorder.failed


def lost_s(path: Path, lives_s: float) -> float:
    """What is missing in the log [s] of a recorder whose writer is killed after so long."""
    ticks, pushed_s, k = some_ticks(4000), [0.0] * 4000, 0
    with recording(path) as recorder:
        start = time.monotonic()
        while (now := time.monotonic() - start) < lives_s:
            recorder.tick(ticks[k : k + 1])
            pushed_s[k] = now
            k += 1
            time.sleep(0.001)
        os.kill(recorder.writer_pid, signal.SIGKILL)
        killed_s = time.monotonic() - start
        assert not recorder.close({})
    kept = open_log(path).ticks
    assert kept.tobytes() == ticks[: len(kept)].tobytes()
    return killed_s - pushed_s[len(kept) - 1] if len(kept) else killed_s


def test_a_kill_of_everything_costs_less_than_a_tenth_of_a_second(tmp_path: Path) -> None:
    """Also early in the run. By the median: a busy machine may keep one writer from its chunk."""
    lost = [lost_s(tmp_path / f"{k}.mcap", lives_s) for k, lives_s in enumerate((0.2, 0.3, 0.4, 0.6, 0.9))]
    assert statistics.median(lost) < 0.1 and max(lost) < 1.0, lost


def fill(recorder: Recorder) -> int:
    """Push until the writer fails; return how many."""
    k = 0
    while not recorder.failed and k < 100_000:
        push(recorder, some_ticks(100, k))
        k += 100
        time.sleep(0.02)
    assert recorder.failed, "never noticed"
    assert recorder._ticks.header[FAILED_AT] == 1, "noticed by the writer's own word"
    return k


def test_a_write_that_fails_half_way_leaves_whole_records(tmp_path: Path) -> None:
    """A limit on the writer's file size, of which no room can be kept for the summary."""
    path = tmp_path / "run.mcap"
    with recording(path) as recorder:
        resource.prlimit(recorder.writer_pid, resource.RLIMIT_FSIZE, (400_000, 400_000))
        fill(recorder)
        assert not recorder.close({"ended": "log failed"})
    log = open_log(path)
    assert log.gaps == [] and len(log.ticks) > 500
    assert log.damage is None or "the summary is missing" in log.damage
    assert path.stat().st_size <= 400_000


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting needs root")
def test_a_full_file_system_stops_the_run_with_the_log_complete(tmp_path: Path) -> None:
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting is not allowed here")
    try:
        path = tmp_path / "run.mcap"
        with pytest.raises(LogError, match="MB free"):
            check_folder(path, 2 << 20)
        recorder = Recorder(path, HEADER, RATE_HZ)
        fill(recorder)
        assert not recorder.close({"ended": "log failed"})
        log = open_log(path)
        assert log.damage is None and log.gaps == [] and len(log.ticks) > 500
        assert log.result["ended"] == "log failed: No space left on device"
        assert path.read_bytes().endswith(MAGIC) and path.stat().st_blocks * 512 - path.stat().st_size < 4096
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_refusals_before_arming(tmp_path: Path) -> None:
    existing = tmp_path / "run.mcap"
    existing.write_bytes(b"precious")
    with pytest.raises(LogError, match=r"exists already; choose another \[log\] name"):
        open_recorder(existing, HEADER, RATE_HZ, 1.0)
    with pytest.raises(LogError, match="can't be written to"):
        open_recorder(existing / "run.mcap", HEADER, RATE_HZ, 1.0)
    with pytest.raises(LogError, match="MB free"):
        open_recorder(tmp_path / "long.mcap", HEADER, RATE_HZ, 1e9)
    with pytest.raises(LogError, match="can't be written"):
        Recorder(existing, HEADER, RATE_HZ).await_open()
    assert existing.read_bytes() == b"precious" and [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(LogError, match="Permission denied"):
        open_recorder(tmp_path / "run.mcap", HEADER, RATE_HZ, 1.0)


def test_a_viewer_follows_a_run_without_the_writer_noticing(tmp_path: Path) -> None:
    path, ticks = tmp_path / "run.mcap", some_ticks(50)
    with recording(path) as recorder:
        push(recorder, ticks)
        ring = attach(os.getpid(), "ticks", TICK.itemsize)
        assert ring.latest(3) == ticks[-3:].tobytes() and ring.record_size == TICK.itemsize
        ring.close()
        assert recorder.close({"ended": "stop_requested"})
    assert len(open_log(path).ticks) == 50


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for number in range(3):
        with recording(tmp_path / f"{number}.mcap") as recorder:
            recorder.tick(new_ticks())
    assert len(list(Path("/proc/self/fd").iterdir())) == before
