"""The guardian's judgement by itself: no process, no clock but the numbers that it is given."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import pytest

from hil.runtime.guardian import (
    GUARDIAN_LOST_NS,
    LOOK_NS,
    STOPS,
    GuardedDrive,
    Judge,
    Word,
    Words,
    guardian_flags,
    watch,
)
from hil.signals import DriveState, RxFlag, new_ticks

TIMEOUT = 50_000_000
FRESH, GUARDIAN, LOST = int(RxFlag.FRESH), int(RxFlag.GUARDIAN), int(RxFlag.GUARDIAN_LOST)


class Stops:
    """A stopper that keeps the counters that it was asked to go on from."""

    def __init__(self) -> None:
        self.after: list[int] = []

    def stop_from(self, counter: int) -> None:
        self.after.append(counter)


class Cells(list[int]):
    """Words that can be looked at 300 times: a watch that never ends is a failure, not a hang."""

    looks = 0

    def __getitem__(self, word: Any) -> Any:
        self.looks += 1
        assert self.looks <= 300, "it watches on"
        return super().__getitem__(word)


class Case:
    """Shared words with a judge."""

    def __init__(self, *, armed: int = 1, fired: int = 0, beat: int = 1000, counter: int = 7) -> None:
        self.words, self.stops = Words(), Stops()
        self.words.cells = Cells([0] * len(Word))
        for word, value in zip((Word.ARMED, Word.BEAT_NS, Word.COUNTER), (armed, beat, counter), strict=True):
            self.words.cells[word] = value
        self.words.cells[Word.FIRED] = fired
        self.judge = Judge(self.words, TIMEOUT, self.stops)

    @property
    def fired(self) -> int:
        return int(self.words.cells[Word.FIRED])


@pytest.mark.parametrize("since_beat", [0, 1, TIMEOUT - 1, TIMEOUT, TIMEOUT + 5_000_000])
def test_the_next_look_is_when_the_heartbeat_is_due(since_beat: int) -> None:
    """A nanosecond later, so that it is not before; one that is overdue is now."""
    case = Case(beat=1000)
    assert case.judge.next_look(1000 + since_beat) == min(1000 + TIMEOUT + 1, 1000 + since_beat + TIMEOUT)
    assert case.words.cells[Word.GUARD_NS] == 1000 + since_beat and case.stops.after == []


@pytest.mark.parametrize(("armed", "fired"), [(0, 0), (1, 1), (0, 1)])
def test_without_a_heartbeat_to_wait_for_it_looks_every_timeout(armed: int, fired: int) -> None:
    case = Case(armed=armed, fired=fired, beat=0)
    assert case.judge.next_look(10 * TIMEOUT) == 11 * TIMEOUT


@pytest.mark.parametrize("armed", [0, 1])
@pytest.mark.parametrize("timeout_ns", [LOOK_NS - 1, LOOK_NS, LOOK_NS + 1, 60_000_000_000, 10**309])
def test_it_beats_often_enough_at_any_timeout(timeout_ns: int, armed: int) -> None:
    case = Case(armed=armed, beat=5_000)
    judge = Judge(case.words, timeout_ns, case.stops)
    assert judge.next_look(5_000) - 5_000 == min(LOOK_NS, timeout_ns)
    assert LOOK_NS == 100_000_000 and 4 * LOOK_NS < GUARDIAN_LOST_NS


@pytest.mark.parametrize(
    ("armed", "gone", "since_beat", "fires"),
    [
        (1, False, 0, False),
        (1, False, TIMEOUT, False),
        (1, False, TIMEOUT + 1, True),
        (1, True, 0, True),
        (1, True, TIMEOUT + 1, True),
        (0, True, TIMEOUT + 1, False),
        (0, False, TIMEOUT + 1, False),
        (0, True, 0, False),
    ],
)
def test_it_fires_when_an_armed_controller_is_gone_or_silent(
    armed: int, gone: bool, since_beat: int, fires: bool
) -> None:
    case = Case(armed=armed, beat=1000, counter=9)
    case.judge.judge(1000 + since_beat, gone)
    assert case.fired == fires
    assert case.stops.after == [9] * (STOPS if fires else 0)


def test_the_stop_frames_are_sent_three_times_over() -> None:
    assert STOPS == 3


def test_the_latch_stands_before_the_first_frame() -> None:
    case = Case()
    seen: list[int] = []
    case.stops.stop_from = lambda counter: seen.append(case.fired)  # type: ignore[method-assign]
    case.judge.judge(0, True)
    assert seen == [1] * STOPS


def test_it_fires_once() -> None:
    case = Case()
    for _ in range(3):
        case.judge.judge(10 * TIMEOUT, True)
    assert len(case.stops.after) == STOPS


def test_each_sign_of_life_after_the_latch_is_answered_once() -> None:
    case = Case(beat=1000)
    case.judge.judge(10 * TIMEOUT, False)
    case.stops.after.clear()
    case.judge.next_look(11 * TIMEOUT)
    assert case.stops.after == [], "nothing was heard since"
    case.words.cells[Word.BEAT_NS], case.words.cells[Word.COUNTER] = 11 * TIMEOUT, 12
    case.judge.next_look(12 * TIMEOUT)
    case.judge.next_look(12 * TIMEOUT)
    assert case.stops.after == [12]
    case.words.cells[Word.BEAT_NS] = 13 * TIMEOUT
    case.judge.next_look(14 * TIMEOUT)
    assert case.stops.after == [12, 12]


def test_life_before_the_latch_is_no_reason_to_send() -> None:
    case = Case(beat=1000)
    case.judge.next_look(2000)
    case.words.cells[Word.BEAT_NS] = 3000
    case.judge.next_look(4000)
    assert case.stops.after == []


class Ending(Stops):
    """A stopper that lets the controller's descriptor report its end at some call."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.ours, self._theirs = os.pipe()
        self._at = at

    def stop_from(self, counter: int) -> None:
        super().stop_from(counter)
        assert len(self.after) <= 2 * STOPS
        if len(self.after) == self._at:
            self.end()

    def end(self) -> None:
        os.close(self._theirs)


@contextmanager
def held(words: Words) -> Iterator[None]:
    """A loop's thread that holds the lock while the block runs."""
    holds, ends = threading.Event(), threading.Event()

    def hold() -> None:
        words.lifeline.hold()
        holds.set()
        ends.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    holds.wait()
    try:
        yield
    finally:
        ends.set()
        thread.join()


@pytest.mark.parametrize("armed", [0, 1])
def test_watching_ends_with_the_controller(armed: int) -> None:
    """The second sign alone: the lock is still held."""
    case, controller = Case(armed=armed, beat=time.monotonic_ns()), Ending(0)
    controller.end()
    with held(case.words):
        watch(case.words, controller.ours, TIMEOUT, controller)
    os.close(controller.ours)
    assert controller.after == [7] * (STOPS * armed) and case.fired == armed
    assert abs(time.monotonic_ns() - case.words.cells[Word.GUARD_NS]) < 4_000_000_000


@pytest.mark.parametrize("armed", [0, 1])
def test_watching_ends_when_the_loop_gives_up_its_lock(armed: int) -> None:
    """Handed on at the end of a run; while armed that is an end without stop frames."""
    case, controller = Case(armed=armed, beat=time.monotonic_ns()), Ending(0)
    watch(case.words, controller.ours, 60_000_000_000, controller)  # nobody holds it
    controller.end()
    os.close(controller.ours)
    assert controller.after == [7] * (STOPS * armed) and case.fired == armed


@pytest.mark.timeout(10)
def test_watching_fires_when_the_heart_stops_and_goes_on() -> None:
    begun = time.monotonic_ns()
    case, controller = Case(beat=begun), Ending(STOPS)
    with held(case.words):
        watch(case.words, controller.ours, TIMEOUT, controller)
    os.close(controller.ours)
    assert controller.after == [7] * STOPS and time.monotonic_ns() - begun >= TIMEOUT


class Port:
    """A drive port that keeps what was called."""

    def __init__(self) -> None:
        self.called: list[Any] = []

    def prepare(self, tick: Any) -> None:
        self.called.append("prepare")

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        self.called.append(("sync", deadline_ns))

    def receive(self, tick: Any, deadline_ns: int) -> None:
        self.called.append(deadline_ns)

    def send(self, tick: Any) -> None:
        self.called.append("send")

    def stop(self) -> None:
        self.called.append("stop")

    def close(self) -> None:
        self.called.append("close")


class Guarded:
    """A guarded drive at a time that the test sets."""

    def __init__(self, *, fired: int = 0) -> None:
        self.port, self.words, self.now_ns = Port(), Words(), 5_000
        self.cells = self.words.cells
        self.cells[Word.FIRED] = fired
        self.ticks = new_ticks()
        self.tick: Any = self.ticks[0]
        self.drive = GuardedDrive(self.port, self.words, lambda: self.now_ns)
        self.drive.prepare(self.tick)
        assert self.port.called.pop() == "prepare"


class Clockwork:
    """What sends SYNC in the loop's place: it is stopped or it is not."""

    stopped = 0

    def stop(self) -> None:
        self.stopped += 1


def test_once_the_guardian_has_fired_nothing_sends_sync_in_the_loops_place() -> None:
    g, timed = Guarded(), Clockwork()
    drive: Any = GuardedDrive(g.port, g.words, lambda: g.now_ns, cast("Any", timed))
    drive.prepare(g.tick)
    drive.receive(g.tick, 123)
    assert timed.stopped == 0
    g.cells[Word.FIRED] = 1
    drive.receive(g.tick, 123)
    assert timed.stopped == 1


def test_a_tick_beats_and_is_passed_on() -> None:
    g = Guarded()
    g.drive.exchange(g.tick, 122)
    assert g.cells[Word.BEAT_NS] == 5_000
    g.now_ns = 6_000
    g.drive.receive(g.tick, 123)
    assert g.cells[Word.BEAT_NS] == 5_000, "receiving is no sign of life"
    g.drive.send(g.tick)
    assert g.cells[Word.BEAT_NS] == 6_000
    g.drive.close()
    assert g.port.called == [("sync", 122), 123, "send", "close"]


@pytest.mark.parametrize("state", list(DriveState))
def test_it_is_armed_in_every_state_but_the_first(state: DriveState) -> None:
    g = Guarded()
    g.tick["state"], g.tick["counter"] = int(state), 11
    g.drive.send(g.tick)
    assert g.cells[Word.ARMED] == (state != DriveState.SWITCH_ON_DISABLED)
    assert g.cells[Word.COUNTER] == 11


@pytest.mark.parametrize(
    ("fired", "age", "flags"),
    [
        (0, 0, FRESH),
        (0, GUARDIAN_LOST_NS, FRESH),
        (0, GUARDIAN_LOST_NS + 1, FRESH | LOST),
        (1, 0, FRESH | GUARDIAN),
        (1, GUARDIAN_LOST_NS + 1, FRESH | GUARDIAN),
    ],
)
def test_what_the_guardian_did_is_flagged(fired: int, age: int, flags: int) -> None:
    g = Guarded(fired=fired)
    g.cells[Word.GUARD_NS], g.cells[Word.BEAT_NS] = 1_000, 1_000 + age
    g.tick["rx_flags"] = FRESH
    g.drive.receive(g.tick, 0)
    assert int(g.tick["rx_flags"]) == flags
    assert guardian_flags(g.cells) == flags & ~FRESH


@pytest.mark.parametrize(
    ("age", "fires", "flags"),
    [
        (0, 0, FRESH),
        (GUARDIAN_LOST_NS, 0, FRESH),
        (GUARDIAN_LOST_NS + 1, 0, FRESH | LOST),
        (0, 1, FRESH | GUARDIAN),
    ],
)
def test_what_the_guardian_did_during_an_exchange_is_flagged(age: int, fires: int, flags: int) -> None:
    g = Guarded()
    g.now_ns = 1_000 + age
    g.cells[Word.GUARD_NS] = 1_000

    def exchange(tick: Any, _: int) -> None:
        tick["rx_flags"] = FRESH
        g.cells[Word.FIRED] = fires

    g.port.exchange = exchange  # type: ignore[method-assign]
    g.drive.exchange(g.tick, 1)
    assert int(g.tick["rx_flags"]) == flags


def test_a_guardian_is_lost_after_half_a_second() -> None:
    assert GUARDIAN_LOST_NS == 500_000_000


def fails(action: Callable[[], None]) -> bool:
    try:
        action()
    except OSError as error:
        return "the guardian has stopped the drive" in str(error)
    return False


def test_after_the_latch_nothing_is_passed_on() -> None:
    """The controller beats on, so that the guardian sees it, and says which counter came last."""
    g = Guarded(fired=1)
    g.tick["counter"], g.tick["state"] = 3, int(DriveState.OPERATION_ENABLED)
    g.drive.exchange(g.tick, 9)
    assert g.cells[Word.BEAT_NS] == 5_000 and g.port.called.pop() == 9, "it still hears"
    assert int(g.tick["rx_flags"]) == GUARDIAN
    g.now_ns = 6_000
    assert fails(lambda: g.drive.send(g.tick))
    assert (g.cells[Word.BEAT_NS], g.cells[Word.COUNTER], g.cells[Word.ARMED]) == (6_000, 3, 1)
    g.drive.stop()
    assert g.port.called == [] and g.cells[Word.ARMED] == 0


def test_the_controllers_own_stop_disarms_after_its_frames() -> None:
    g = Guarded()
    g.drive.send(g.tick)
    g.cells[Word.ARMED] = 1
    seen: list[int] = []
    g.port.stop = lambda: seen.append(int(g.cells[Word.ARMED]))  # type: ignore[method-assign]
    g.drive.stop()
    assert seen == [1] and g.cells[Word.ARMED] == 0
