"""The loop over a scripted drive and a fake clock: deadlines, skips, and a stop on every way out."""

from __future__ import annotations

import errno
import itertools
from typing import Any

import pytest

from drivers.errors import EncodeError
from hil.runtime.clock import FakeClock, LockstepClock, RealClock
from hil.runtime.loop import Loop, Outcome, Plan, StopRequest
from hil.runtime.rules import NO_WAIT
from hil.runtime.trouble import QUIET_TICKS
from hil.signals import DriveState, Reason, Request, RxFlag, TickArray, new_ticks

MS = 1_000_000


class ScriptedDrive:
    """A drive port that writes down what is asked of it."""

    def __init__(self, fail_at: dict[str, int] | None = None, error: type[Exception] = OSError) -> None:
        self.calls: list[str] = []
        self.fail_at, self.error = fail_at or {}, error

    def _note(self, name: str) -> None:
        self.calls.append(name)
        if self.calls.count(name) == self.fail_at.get(name):
            raise self.error(f"{name} failed")

    def prepare(self, tick: Any) -> None:
        self.calls.append("prepare")

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        self._note("sync")
        self.receive(tick, deadline_ns)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        self._note("receive")
        tick["rx_flags"] |= int(RxFlag.FRESH)

    def send(self, tick: Any) -> None:
        self._note("send")

    def stop(self) -> None:
        self.calls.append("stop")

    def close(self) -> None:
        self.calls.append("close")


class Memory:
    """A recorder that keeps copies."""

    failed = False

    def __init__(self) -> None:
        self.ticks: list[TickArray] = []
        self.events: list[str] = []
        self.said: list[tuple[str, int, str]] = []

    def tick(self, tick: TickArray) -> None:
        self.ticks.append(tick.copy())

    def event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        self.events.append(kind)
        self.said.append((kind, k, text))


def obedient(ticks: TickArray) -> None:
    """A supervisor that sends until it is asked to stop."""
    t = ticks[0]
    stop = t["request"] in (Request.STOP, Request.QUICK_STOP) or t["rx_flags"] & RxFlag.BUS_DOWN
    t["send"] = 0 if stop else 1
    t["state"] = int(DriveState.SWITCH_ON_DISABLED if stop else DriveState.OPERATION_ENABLED)
    t["reason"] = int(Reason.STOP_REQUESTED) if stop else 0


def make(
    drive: ScriptedDrive, clock: FakeClock, ticks: int | None = 10, step: Any = obedient, pacing: Any = "sync"
) -> tuple[Loop, Memory, StopRequest]:
    memory, request = Memory(), StopRequest()
    plan = Plan(MS, MS * 6 // 10, pacing, ticks)
    return Loop(drive, clock, memory, step, new_ticks(), plan, request), memory, request


def test_read_judge_compute_write_record_in_order() -> None:
    drive = ScriptedDrive()
    loop, memory, _ = make(drive, FakeClock(), ticks=2)
    outcome = loop.run()
    assert drive.calls == ["prepare", *["sync", "receive", "send"] * 2, "sync", "receive", "stop"]
    assert [int(t["k"][0]) for t in memory.ticks] == [0, 1, 2]
    assert (outcome.ticks, outcome.skipped, outcome.reason) == (3, 0, Reason.STOP_REQUESTED)


def test_deadlines_are_absolute() -> None:
    deadlines: list[int] = []
    loop, memory, _ = make(ScriptedDrive(), FakeClock([300_000] * 20, deadlines.append), ticks=5)
    loop.run()
    assert deadlines == [k * MS for k in range(6)]
    assert {int(t["lateness_ns"][0]) for t in memory.ticks} == {300_000}


def test_whole_periods_are_skipped_and_counted_never_caught_up() -> None:
    late = [0, 0, 3 * MS + 200_000, 0, 0, 0]
    loop, memory, _ = make(ScriptedDrive(), FakeClock(late), ticks=8)
    outcome = loop.run()
    assert [(int(t["k"][0]), int(t["gap"][0]), int(t["skipped"][0])) for t in memory.ticks][:4] == [
        (0, 1, 0), (1, 1, 0), (5, 4, 3), (6, 1, 0),
    ]  # fmt: skip
    assert outcome.skipped == 3
    assert int(memory.ticks[2]["lateness_ns"][0]) == 200_000
    assert int(memory.ticks[2]["t_ns"][0]) == 5 * MS


def test_a_little_late_is_run_and_not_skipped() -> None:
    loop, memory, _ = make(ScriptedDrive(), FakeClock([0, 999_999, 0]), ticks=3)
    assert loop.run().skipped == 0
    assert int(memory.ticks[1]["gap"][0]) == 1


@pytest.mark.parametrize("where", ["sync", "receive", "send"])
@pytest.mark.parametrize("error", [EncodeError, RuntimeError, KeyboardInterrupt, SystemExit])
def test_every_exception_ends_with_a_stopped_drive(where: str, error: type[Exception]) -> None:
    """In the same tick: the next thing that is asked of the drive is the stop, and nothing after it."""
    drive = ScriptedDrive({where: 3}, error)
    loop, memory, _ = make(drive, FakeClock())
    with pytest.raises(error):
        loop.run()
    assert drive.calls[-2:] == [where, "stop"] and drive.calls.count(where) == 3
    assert len(memory.ticks) == 2, "what was not sent is not logged as a tick"


@pytest.mark.parametrize("where", ["tick", "event"])
def test_a_recorder_that_raises_ends_with_a_stopped_drive(where: str) -> None:
    drive = ScriptedDrive()
    loop, memory, _ = make(drive, FakeClock())

    def broken(*_: object) -> None:
        raise RuntimeError(where)

    setattr(memory, where, broken)
    with pytest.raises(RuntimeError, match=where):
        loop.run()
    assert drive.calls[-2:] == ["send", "stop"]


def test_an_exception_in_the_law_ends_with_a_stopped_drive() -> None:
    def broken(ticks: TickArray) -> None:
        raise ZeroDivisionError

    drive = ScriptedDrive()
    loop, _, _ = make(drive, FakeClock(), step=broken)
    with pytest.raises(ZeroDivisionError):
        loop.run()
    assert drive.calls[-1] == "stop" and "send" not in drive.calls


def test_a_sync_that_fails_is_a_bus_that_is_down() -> None:
    drive = ScriptedDrive({"sync": 2})
    loop, memory, _ = make(drive, FakeClock())
    loop.run()
    assert memory.ticks[1]["rx_flags"][0] & RxFlag.BUS_DOWN
    assert drive.calls[-1] == "stop"


class Full(OSError):
    """What the kernel says when the transmit queue is full."""

    def __init__(self, text: str) -> None:
        super().__init__(errno.ENOBUFS, text)


def test_a_sync_that_meets_a_full_queue_is_a_failed_send() -> None:
    drive = ScriptedDrive({"sync": 2}, Full)
    loop, memory, _ = make(drive, FakeClock(), ticks=4)
    loop.run()
    flags = memory.ticks[1]["rx_flags"][0]
    assert flags & RxFlag.SEND_FAILED and not flags & RxFlag.BUS_DOWN
    assert ("bus", 1, "SEND_FAILED") in memory.said


def test_a_command_that_fails_is_logged() -> None:
    loop, memory, _ = make(ScriptedDrive({"send": 2}), FakeClock(), ticks=4)
    loop.run()
    assert memory.events == ["state", "send-failed", "stop"]
    assert all(t["send"][0] == 1 for t in memory.ticks[:4])  # an output: what the kernel decided, for replay


class TroubledDrive(ScriptedDrive):
    """Feedback of which some ticks carry the given bits of rx_flags, too."""

    def __init__(self, flags: dict[int, int]) -> None:
        super().__init__()
        self.flags = flags

    def receive(self, tick: Any, deadline_ns: int) -> None:
        super().receive(tick, deadline_ns)
        tick["rx_flags"] |= self.flags.get(int(tick["k"]), 0)


def test_trouble_on_the_bus_is_an_event_when_it_begins() -> None:
    crc, error = int(RxFlag.CRC_ERROR), int(RxFlag.ERROR_FRAME)
    later = 13 + QUIET_TICKS + 1
    flags = {10: crc, 11: crc, 12: crc | error, 13: error, later: error | int(RxFlag.STATUS), later + 1: crc}
    loop, memory, _ = make(TroubledDrive(flags), FakeClock(), ticks=later + 10)
    loop.run()
    bus = [(k, text) for kind, k, text in memory.said if kind == "bus"]
    expected = [(10, "CRC_ERROR"), (12, "ERROR_FRAME"), (later, "ERROR_FRAME"), (later + 1, "CRC_ERROR")]
    assert bus == expected


def test_timer_pacing_takes_what_is_there_and_sends_no_sync() -> None:
    drive = ScriptedDrive()
    make(drive, FakeClock(), ticks=2, pacing="timer")[0].run()
    assert drive.calls == ["prepare", *["receive", "send"] * 2, "receive", "stop"]


class SilentAtTimes(ScriptedDrive):
    """Feedback in some ticks only."""

    def receive(self, tick: Any, deadline_ns: int) -> None:
        if int(tick["k"]) in (0, 1, 5):
            super().receive(tick, deadline_ns)


def test_timer_pacing_logs_the_age_of_the_feedback() -> None:
    loop, memory, _ = make(SilentAtTimes(), FakeClock([300_000] * 20), ticks=6, pacing="timer")
    loop.run()
    ages = [int(t["received_ns"][0]) for t in memory.ticks]
    assert ages == [300_000, 300_000, 300_000 - MS, 300_000 - 2 * MS, 300_000 - 3 * MS, 300_000, 300_000 - MS]


class CyclicDrive(ScriptedDrive):
    """Of feedback that comes by the drive's clock: how many lie in the queue at each wait."""

    def __init__(self, queued: list[int]) -> None:
        super().__init__()
        self._later, self._now = queued, 0

    def receive(self, tick: Any, deadline_ns: int) -> None:
        if deadline_ns > NO_WAIT:
            self._note("receive")
            self._now = self._later.pop(0) if self._later else 1
        if self._now:
            self._now -= 1
            tick["rx_flags"] |= int(RxFlag.FRESH)


def test_feedback_pacing_is_woken_by_the_drive() -> None:
    drive, slept = CyclicDrive([]), []
    make(drive, FakeClock(on_sleep=slept.append), ticks=2, pacing="feedback")[0].run()
    assert drive.calls == ["prepare", *["receive", "send"] * 2, "receive", "stop"] and slept == []


def test_of_queued_feedback_the_newest_counts_and_the_others_are_skipped() -> None:
    loop, memory, _ = make(CyclicDrive([5, 1, 4, 0, 1]), FakeClock(), ticks=9, pacing="feedback")
    outcome = loop.run()
    seen = [(int(t["k"][0]), int(t["gap"][0]), int(t["rx_flags"][0] & RxFlag.FRESH)) for t in memory.ticks]
    assert seen[:5] == [(0, 1, 1), (1, 1, 1), (5, 4, 1), (6, 1, 0), (7, 1, 1)]
    assert outcome.skipped == 3
    assert int(memory.ticks[2]["t_ns"][0]) == 5 * MS


class LossyDrive(ScriptedDrive):
    """Feedback by the drive's clock, of which some is lost; the fake clock passes while the loop waits."""

    def __init__(self, clock: FakeClock, lost: set[int], stalls: dict[int, int]) -> None:
        super().__init__()
        self._clock, self._lost, self._stalls = clock, lost, stalls
        self._next, self._jump = 0, 0

    def receive(self, tick: Any, deadline_ns: int) -> None:
        while self._next in self._lost:
            self._next, self._jump = self._next + 1, int(RxFlag.COUNTER_JUMP)
        comes_ns, now_ns = self._next * MS, self._clock.now_ns()
        if comes_ns > max(deadline_ns, now_ns):
            self._clock.advance(max(deadline_ns - now_ns, 0))
            return
        self._clock.advance(max(comes_ns - now_ns, 0))
        tick["rx_flags"] |= int(RxFlag.FRESH) | self._jump
        tick["w"], self._jump, self._next = self._next, 0, self._next + 1

    def send(self, tick: Any) -> None:
        self._clock.advance(self._stalls.pop(int(tick["k"]), 0) * MS)


@pytest.mark.parametrize(
    ("lost", "stalls"),
    [({3}, {}), ({3, 4, 5, 6, 9}, {}), ({20, 21}, {5: 4}), ({7, 8, 10}, {5: 9}), (set(range(6, 30)), {5: 9})],
)
def test_with_cyclic_feedback_k_follows_the_time_when_frames_are_lost(
    lost: set[int], stalls: dict[int, int]
) -> None:
    """The tick's index stays that of the drive's period whatever was lost; each period counts once."""
    clock = FakeClock()
    loop, memory, _ = make(LossyDrive(clock, lost, stalls), clock, ticks=40, pacing="feedback")  # type: ignore[arg-type]
    outcome = loop.run()
    fresh = [t[0] for t in memory.ticks if t["rx_flags"][0] & RxFlag.FRESH]
    assert [int(t["k"]) for t in fresh] == [int(t["w"]) for t in fresh]
    assert int(fresh[-1]["k"]) == 40
    pairs = itertools.pairwise([(int(t["k"][0]), int(t["gap"][0])) for t in memory.ticks])
    assert all(k - before == gap for (before, _), (k, gap) in pairs)
    assert outcome.skipped == sum(int(t["skipped"][0]) for t in memory.ticks)
    assert outcome.ticks + outcome.skipped == 41


def test_stop_asked_twice_is_a_quick_stop() -> None:
    request = StopRequest()
    request.stop(2, None)
    assert request.value == Request.STOP
    request.stop()
    assert request.value == Request.QUICK_STOP
    request.stop()
    assert request.value == Request.QUICK_STOP


def test_a_run_without_length_goes_on_until_it_is_stopped() -> None:
    drive = ScriptedDrive()
    loop, _, request = make(
        drive, FakeClock(on_sleep=lambda d: request.stop() if d == 50 * MS else None), None
    )
    assert loop.run().ticks == 51


def test_outcome_starts_empty() -> None:
    assert Outcome() == Outcome(0, 0, 0, 0)


def test_clocks() -> None:
    real, lockstep = RealClock(), LockstepClock()
    now = real.now_ns()
    assert real.sleep_until(now + 2 * MS) >= now + 2 * MS
    assert real.sleep_until(now) >= now + 2 * MS
    assert real.receive_deadline(5, 7) == 12
    assert (lockstep.sleep_until(9 * MS), lockstep.now_ns()) == (9 * MS, 9 * MS)
    assert lockstep.receive_deadline(0, 1) > real.now_ns() + 1_000 * MS
    fake = FakeClock([5])
    fake.advance(3)
    assert (fake.now_ns(), fake.sleep_until(10), fake.receive_deadline(1, 2)) == (3, 15, 3)
