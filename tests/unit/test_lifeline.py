"""The lock that tells of the end of whoever holds it, between real processes and threads."""

from __future__ import annotations

import gc
import mmap
import os
import signal
import threading
import time
from collections.abc import Callable

import pytest

from hil.runtime.lifeline import BYTES, Lifeline

FAR_NS = 20_000_000_000


def shared() -> Lifeline:
    return Lifeline(memoryview(mmap.mmap(-1, mmap.PAGESIZE))[-BYTES:])


def holder(line: Lifeline, then: Callable[[], object]) -> int:
    """A process that holds the line; its pid once it does."""
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            line.hold()
            os.write(theirs, b"x")
            then()
        finally:
            os._exit(0)
    os.read(ours, 1)
    os.close(ours)
    os.close(theirs)
    return pid


def soon(seconds: float) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


@pytest.mark.parametrize("stopped_first", [False, True])
def test_a_killed_holder_gives_it_up_at_once(stopped_first: bool) -> None:
    line = shared()
    pid = holder(line, signal.pause)
    if stopped_first:
        os.kill(pid, signal.SIGSTOP)
    assert not line.given_up_by(soon(0.05)), "it lives"
    begun = time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)
    assert line.given_up_by(soon(10.0))
    assert time.monotonic_ns() - begun < 5_000_000_000
    os.waitpid(pid, 0)


def test_a_holder_that_leaves_gives_it_up() -> None:
    line = shared()
    pid = holder(line, lambda: None)
    assert line.given_up_by(soon(10.0))
    os.waitpid(pid, 0)


def test_it_is_handed_on_while_the_holder_lives() -> None:
    line = shared()

    def later() -> None:
        time.sleep(0.05)
        line.hand_on()
        signal.pause()

    pid = holder(line, later)
    assert line.given_up_by(soon(10.0))
    assert os.waitpid(pid, os.WNOHANG) == (0, 0)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def test_a_fork_of_the_holder_does_not_hold_it() -> None:
    line = shared()
    line.hold()
    pid = os.fork()
    if pid == 0:
        os._exit(0)
    os.waitpid(pid, 0)
    other = os.fork()
    if other == 0:
        os._exit(3 if line.given_up_by(soon(0.05)) else 4)
    assert os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]) == 4
    line.hand_on()


def test_it_tells_of_the_thread_that_holds_it() -> None:
    line = shared()
    thread = threading.Thread(target=line.hold)
    thread.start()
    thread.join()
    assert line.given_up_by(soon(10.0))


def test_another_thread_can_not_hand_it_on() -> None:
    line = shared()
    line.hold()
    wrong: list[BaseException] = []

    def try_it() -> None:
        try:
            line.hand_on()
        except OSError as error:
            wrong.append(error)

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    assert len(wrong) == 1
    line.hand_on()


@pytest.mark.parametrize("passed_ns", [0, 1_000_000])
def test_a_time_that_has_passed_is_no_wait(passed_ns: int) -> None:
    line = shared()
    pid = holder(line, signal.pause)
    begun = time.monotonic_ns()
    assert not line.given_up_by(begun - passed_ns)
    assert time.monotonic_ns() - begun < FAR_NS
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def test_memory_outlives_a_lock_that_is_never_handed_on() -> None:
    """Once held, its place is in the thread's list: gone, the next lock would write to it and crash."""
    lines = [shared(), shared()]
    for _ in range(2):
        pid = holder(lines[-1], lambda: None)
        assert lines[-1].given_up_by(soon(10.0))
        os.waitpid(pid, 0)
        lines.pop()
        gc.collect()
