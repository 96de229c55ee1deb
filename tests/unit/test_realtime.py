"""Where the processes of a run may go."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from hil.realtime import keep_off


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
