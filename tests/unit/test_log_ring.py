"""The ring against a plain queue, under any order of pushes and takes, wrapped or full."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.log.push import push, pusher, ring_places
from hil.log.ring import HEADER_BYTES, Ring, RingError, attach

SIZE = 16


def record(number: int) -> bytes:
    return number.to_bytes(SIZE // 2, "little") * 2


def numbers(raw: bytes) -> list[int]:
    """The records' numbers; a torn record fails here."""
    out = [int.from_bytes(raw[at : at + SIZE // 2], "little") for at in range(0, len(raw), SIZE)]
    assert raw == b"".join(map(record, out)), "a torn record"
    return out


@settings(deadline=None)  # the first push is compiled
@given(
    capacity=st.integers(1, 7),
    steps=st.lists(
        st.one_of(st.integers(-9, -1), st.integers(1, 9), st.sampled_from(["take", "final"])), max_size=40
    ),
)
def test_the_ring_is_a_queue_that_drops_when_full(capacity: int, steps: list[int | str]) -> None:
    ring, held = Ring.create("test", SIZE, capacity), np.zeros(SIZE, np.uint8)
    push = pusher(ring, held)
    queue: deque[int] = deque()
    dropped, pushed, seen = 0, 0, 0
    for step in steps:
        if isinstance(step, int) and step < 0:  # many at once
            ring.push_many(memoryview(b"".join(record(pushed + n) for n in range(-step))))
            kept = min(-step, capacity - len(queue))
            queue.extend(range(pushed, pushed + kept))
            dropped, pushed = dropped - step - kept, pushed - step
            continue
        if isinstance(step, int):
            for one in range(step):
                held[:] = np.frombuffer(record(pushed), np.uint8)
                kept = push() if one % 2 else ring.push(record(pushed))  # the compiled form and Python's
                assert kept == (len(queue) < capacity)
                if kept:
                    queue.append(pushed)
                dropped += not kept
                pushed += 1
            continue
        ready = len(queue) if step == "final" else seen
        assert numbers(ring.take(final=step == "final")) == [queue.popleft() for _ in range(ready)]
        seen = len(queue)
        assert ring.high_water >= seen
    assert ring.dropped == dropped
    ring.close()


@given(capacity=st.integers(2, 9), pushed=st.integers(0, 30), wanted=st.integers(0, 12))
def test_a_viewer_sees_the_newest_and_takes_nothing(capacity: int, pushed: int, wanted: int) -> None:
    ring = Ring.create("test", SIZE, capacity)
    for number in range(pushed):
        ring.push(record(number))
        if ring.header[3] - ring.header[4] == capacity:
            ring.take(final=True)
    waiting = ring.header[3] - ring.header[4]
    seen = numbers(ring.latest(wanted))
    assert seen == list(range(pushed))[max(0, pushed - min(wanted, capacity - 1)) :]
    assert ring.header[3] - ring.header[4] == waiting
    ring.close()


class Overtaken(Ring):
    """A ring whose producer goes on while a viewer copies; the copy is what it was before or after."""

    pushes = 0

    def _copy(self, start: int, end: int) -> bytes:
        for _ in range(self.pushes):
            self.header[4] = self.header[3]
            self.push(record(self.header[3]))
        return super()._copy(start, end)


@pytest.mark.parametrize("pushes", range(12))
def test_a_viewer_is_never_shown_what_was_overwritten_meanwhile(pushes: int) -> None:
    ring = Overtaken.create("test", SIZE, 8)
    for number in range(20):
        ring.header[4] = ring.header[3]
        ring.push(record(number))
    ring.pushes = pushes
    expected = list(range(13, 20))[max(0, 20 + pushes + 1 - 8 - 13) :]
    assert numbers(ring.latest(7)) == expected
    ring.close()


def test_a_record_is_taken_only_at_the_look_after_the_one_that_saw_it() -> None:
    ring = Ring.create("test", SIZE, 4)
    ring.push(record(1))
    assert ring.take() == b""
    ring.push(record(2))
    assert numbers(ring.take()) == [1]
    assert numbers(ring.take()) == [2]
    ring.close()


def test_the_memory_has_no_name_and_is_the_users_alone() -> None:
    ring = Ring.create("test", SIZE, 4)
    assert stat.S_IMODE(os.fstat(ring.fd).st_mode) == 0o600
    assert not os.get_inheritable(ring.fd)
    with pytest.raises(PermissionError):
        os.ftruncate(ring.fd, 0)
    ring.close()


@pytest.mark.parametrize(("size", "capacity"), [(0, 4), (16, 0), (1 << 20, 1 << 20)])
def test_an_impossible_ring_is_refused(size: int, capacity: int) -> None:
    with pytest.raises(RingError):
        Ring.create("test", size, capacity)


@pytest.mark.parametrize("content", [b"", bytes(100), bytes(HEADER_BYTES + 64)])
def test_foreign_memory_is_no_ring(content: bytes) -> None:
    fd = os.memfd_create("foreign")
    os.write(fd, content)
    with pytest.raises(RingError):
        Ring(fd)


def test_a_wrong_record_size_is_refused() -> None:
    ring = Ring.create("test", SIZE, 4)
    with pytest.raises(ValueError):
        ring.push(bytes(SIZE + 1))
    with pytest.raises(RingError, match="a record of 17 bytes in a ring for 16"):
        pusher(ring, np.zeros(SIZE + 1, np.uint8))
    assert ring.take(final=True) == b""
    ring.close()


PRODUCER = """
import sys
import numpy as np
from hil.log.push import pusher
from hil.log.ring import Ring
ring, record = Ring(int(sys.argv[1])), np.zeros(2, np.int64)
push, number = pusher(ring, record), 0
while number < int(sys.argv[2]):
    record[:] = number
    number += push()
"""


def test_two_processes_lose_and_tear_nothing() -> None:
    """The producer tries again after a drop, so that the consumer must see every number once, in order."""
    ring, total = Ring.create("test", SIZE, 64), 30_000
    producer = subprocess.Popen(
        [sys.executable, "-c", PRODUCER, str(ring.fd), str(total)], pass_fds=[ring.fd]
    )
    expected = 0
    while expected < total:
        for number in numbers(ring.take()):
            assert number == expected
            expected += 1
        assert producer.poll() in (None, 0)
        time.sleep(0.0005)
    assert producer.wait(30) == 0 and ring.take(final=True) == b""
    ring.close()


@pytest.mark.compiled
@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.booleans()), max_size=40))
def test_many_by_the_kernel_are_many_by_the_ring(steps: list[tuple[int, bool]]) -> None:
    """Pushes of several and takes, wrapped or full: the same records, the same drops."""
    rows = np.zeros((6, SIZE // 8), np.int64)
    plain, compiled = Ring.create("plain", SIZE, 5), Ring.create("compiled", SIZE, 5)
    places, number = ring_places(compiled, rows.view(np.uint8).reshape(-1)), 0
    for count, take in steps:
        rows[:count] = np.arange(number, number + count)[:, None]
        number += count
        plain.push_many(memoryview(rows[:count].tobytes()))
        push(places, count)
        assert compiled.dropped == plain.dropped and compiled.published == plain.published
        if take:
            assert numbers(compiled.take()) == numbers(plain.take())
    assert compiled.take(final=True) == plain.take(final=True)
    plain.close()
    compiled.close()


def test_another_process_can_attach_by_pid() -> None:
    ring = Ring.create("test-attach", SIZE, 8)
    ring.push(record(5))
    view = attach(os.getpid(), "test-attach", SIZE)
    assert numbers(view.latest(3)) == [5]
    with pytest.raises(TypeError):
        view.push(record(6))
    view.close()
    with pytest.raises(RingError, match="no ring"):
        attach(os.getpid(), "none", SIZE)
    ring.close()
