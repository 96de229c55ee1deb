"""Where the processes of a run may go, and in which order they ask for their rights."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from hil.config.loop import RealtimeTable
from hil.runtime import realtime
from hil.runtime.guardian import Rights
from hil.runtime.realtime import keep_off


@pytest.fixture
def other() -> Iterator[int]:
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    yield process.pid
    process.kill()
    process.communicate()


def test_a_writer_keeps_off_the_loops_core(other: int) -> None:
    cores = os.sched_getaffinity(0)
    keep_off(other, None)
    assert os.sched_getaffinity(other) == cores, "a loop that is not pinned leaves it alone"
    core = min(cores)
    keep_off(other, core)
    assert os.sched_getaffinity(other) == ((cores - {core}) or cores), "with one core there is no other"


def test_one_that_has_gone_is_left_to_the_loop() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    keep_off(process.pid, min(os.sched_getaffinity(0)))


@pytest.mark.parametrize(
    "ask",
    [
        lambda: realtime.acquire(RealtimeTable()),
        lambda: realtime.probe(RealtimeTable()),
        lambda: Rights(priority=50, lock_memory=True).acquire(),
    ],
    ids=["run and emulator", "check", "guardian"],
)
def test_memory_is_locked_before_fifo_is_asked_for(
    ask: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a second under FIFO on each core ended another run on the machine, its drive in watchdog fault."""
    asked: list[str] = []

    def memory(*_: object) -> list[realtime.Grant]:
        asked.append("memory")
        return []

    monkeypatch.setattr(realtime, "_memory", memory)
    monkeypatch.setattr(realtime, "lock_as_touched", memory)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: asked.append("fifo"))
    for name in ("disable", "freeze"):
        monkeypatch.setattr(gc, name, lambda: None)
    ask()
    assert asked == ["memory", "fifo"]


@pytest.mark.parametrize(("ask", "left"), [("acquire", "0"), ("probe", "1")])
def test_khugepaged_is_kept_off_the_loops_pages(ask: str, left: str) -> None:
    """While it copies pages together nothing preempts it: two periods of a run without FIFO were skipped."""
    code = f"""
from hil.config.loop import RealtimeTable
from hil.runtime import realtime
grants = realtime.{ask}(RealtimeTable(fifo_priority=0))
assert [grant.granted for grant in grants if grant.what == "pages left in place"] == [True], grants
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("THP_enabled")))
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == left


@pytest.mark.parametrize(("wanted", "done"), [(True, ["locked", "in place"]), (False, [])])
def test_the_guardians_memory_stays_where_it_is_wanted(
    wanted: bool, done: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []
    monkeypatch.setattr(realtime, "lock_as_touched", lambda: found.append("locked"))
    monkeypatch.setattr(realtime, "keep_pages", lambda: found.append("in place"))
    for name in ("disable", "freeze"):
        monkeypatch.setattr(gc, name, lambda: None)
    Rights(priority=0, lock_memory=wanted).acquire()
    assert found == done
