"""The compiled tick against the loop's own rules: the same drive, the same disturbances, the same log.

Each case runs twice, with and without the compiled tick. Everything but the stamps must be equal: every field
of every record, the frames that passed, the events, how it ended. And each case says which stages of the tick
were left to the loop, so that a compiled tick that left everything to it would fail.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.bcm import SO_TIMESTAMPNS, TX_DELETE, KernelSync
from drivers.bus import BusSettings, SocketLink, open_link
from drivers.client import DriveClient
from drivers.local import CLASSIC, pack_frame
from hil.log.check import first_broken
from hil.log.reader import Log, open_log
from hil.log.recorder import Recorder, open_recorder
from hil.runtime import fused
from hil.runtime.clock import RealClock
from hil.runtime.guardian import (
    ARMED,
    BEAT_NS,
    COUNTER,
    FIRED,
    GUARD_NS,
    GUARDIAN_LOST_NS,
    GuardedDrive,
    Words,
)
from hil.runtime.header import header_of
from hil.runtime.loop import (
    BEGUN,
    DECIDED,
    NOT_BEGUN,
    RAMP_EVENT,
    RECORDED,
    SENT,
    Loop,
    Pace,
    Plan,
    StopRequest,
    Whole,
    new_pace,
    no_whole,
    none_compiled,
)
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import FIELDS, Reason, Request, RxFlag, TickArray
from tests.conftest import CONFIGS

pytestmark = [pytest.mark.compiled, pytest.mark.process]

PERIOD_NS, TIMEOUT_NS = 10_000_000, 5_000_000  # a busy host answers within that
TICKS = 90
TURNS = 8
"""A host that stalls for some ms makes two runs differ; so often each may be tried against all others."""
STATES = {0x0: 1, 0x6: 2, 0x7: 3, 0xF: 4}
STAMPS = {"t_ns", "lateness_ns", "received_ns", "computed_ns", "sent_ns", "recorded_ns"}
SYNC, FEEDBACK, COMMAND, EMERGENCY, STATUS = 0x080, 0x181, 0x201, 0x081, 0x281


@pytest.fixture(autouse=True)
def turns() -> Iterator[None]:
    """Loop and drive are threads of one interpreter: let neither wait long for the other's turn."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    yield
    sys.setswitchinterval(before)


class Drive(threading.Thread):
    """Answers SYNC over the other end of the loop's socket; ``act`` says how."""

    def __init__(self, setup: Setup, end: socket.socket, words: Words, act: Act) -> None:
        super().__init__()
        self.end, self.words, self._act = end, words, act
        self._feedback, self._status = (setup.database.message(name) for name in ("FEEDBACK", "STATUS"))
        self._over = threading.Event()
        self.counter = self._echo = self._state = 0
        self.operator, self.speed = StopRequest(), 0.0
        self.heard: list[int] = []

    def run(self) -> None:
        n = 0
        self.end.settimeout(0.05)
        while not self._over.is_set():
            try:
                raw = self.end.recv(128)
            except TimeoutError:
                continue
            except OSError:
                return
            if self.take(raw) == SYNC:
                self.beat(n)
                n += 1

    def take(self, raw: bytes) -> int:
        """What a frame of the loop's asks; returns its identifier."""
        can_id, _, data = CLASSIC.unpack(raw)
        self.heard.append(can_id)
        if can_id == COMMAND:
            self._echo, self._state = data[1] & 15, STATES.get(data[2] | data[3] << 8, self._state)
        return int(can_id)

    def beat(self, n: int) -> None:
        """The guardian's sign of life, and the n-th answer."""
        self.words.cells[GUARD_NS] = time.monotonic_ns()
        with contextlib.suppress(OSError):  # the loop may have ended
            self._act(self, n)

    def feedback(self, n: int) -> bytes:
        """Feedback on the n-th SYNC, with the next counter: never twice the same speed."""
        self.counter = (self.counter + 1) % 16
        values = {
            "Speed": self.speed + 0.01 * (n % 7),
            "CurrentQ": 0.001 * (n % 11),
            "CurrentD": 0.01 * (n % 3),
        }
        more = {"Counter": self.counter, "Echo": self._echo, "State": self._state}
        return pack_frame(FEEDBACK, self._feedback.encode({**values, **more}))

    def status(self, n: int) -> bytes:
        """STATUS with healthy values."""
        values = {"Counter": n % 16, "DcLinkVoltage": 560.0, "TemperatureMotor": 30.0}
        return pack_frame(
            STATUS, self._status.encode({"ProtocolVersion": 1, "TemperatureInverter": 30.0, **values})
        )

    def stop(self) -> None:
        self._over.set()
        self.join()


class Cyclic(Drive):
    """Sends by itself a period after each command: its clock and the loop's wait can't drift apart."""

    def run(self) -> None:
        n = 0
        self.end.settimeout(0.3e-9 * PERIOD_NS)  # without a command the next comes before the loop gives up
        while not self._over.is_set():
            try:
                time.sleep(PERIOD_NS * 1e-9)
                self.beat(n)
                while self.take(self.end.recv(128)) != COMMAND:
                    pass
            except TimeoutError:
                pass
            except OSError:
                return
            n += 1


class Timed(Drive):
    """Sends SYNC, too, by a timer that the loop's job has started: the Broadcast Manager's part."""

    def __init__(self, setup: Setup, end: socket.socket, words: Words, act: Act) -> None:
        super().__init__(setup, end, words, act)
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(2)]
        (job, self.job), (ear, self.ear) = pairs
        ear.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.sync = KernelSync(job, ear, SYNC, True, PERIOD_NS)
        self.asked: list[bytes] = []

    def run(self) -> None:
        self.asked.append(self.job.recv(8192))
        n, next_ns = 0, time.monotonic_ns()
        while not self._over.is_set():
            if self.asked[-1][0] != TX_DELETE:
                self.beat(n)
            n, next_ns = n + 1, next_ns + PERIOD_NS
            self.until(next_ns)

    def until(self, then_ns: int) -> None:
        """Take what the loop sends and asks of the job meanwhile."""
        while (left := then_ns - time.monotonic_ns()) > 0:
            going = [self.job] if self.asked[-1][0] != TX_DELETE else []
            ready, _, _ = select.select([self.end, *going], [], [], left * 1e-9)
            if self.end in ready:
                self.take(self.end.recv(128))
            if self.job in ready:
                self.asked.append(self.job.recv(8192) or bytes((TX_DELETE,)))

    def stop(self) -> None:
        super().stop()
        self.sync.close()
        self.job.close()
        self.ear.close()


Act = Callable[[Any, int], None]


def calm(drive: Drive, n: int) -> None:
    """Feedback, and each tenth tick a status before it."""
    if n % 10 == 0:
        drive.end.send(drive.status(n // 10))
    drive.end.send(drive.feedback(n))


def now_and_then(*at: int) -> Callable[[Act], Act]:
    """What is done instead of :func:`calm` on these SYNCs."""

    def made(other: Act) -> Act:
        return lambda drive, n: other(drive, n) if n in at else calm(drive, n)

    return made


@now_and_then(30, 40, 41)
def wrong_crc(drive: Drive, n: int) -> None:
    raw = bytearray(drive.feedback(n))
    raw[-1] ^= 1
    drive.end.send(raw)


@now_and_then(30)
def repeated(drive: Drive, n: int) -> None:
    drive.counter -= 1
    calm(drive, n)


@now_and_then(30, 50)
def jumped(drive: Drive, n: int) -> None:
    drive.feedback(n)
    calm(drive, n)


@now_and_then(30, 31, 50)
def silent(drive: Drive, n: int) -> None:
    drive.feedback(n)


@now_and_then(30, 50)
def late(drive: Drive, n: int) -> None:
    """After the loop has given up and sent its command, before the next SYNC."""
    assert drive.end.recv(128)[:2] == COMMAND.to_bytes(2, "little")
    drive.end.send(drive.feedback(n))


@now_and_then(30, 50)
def emergency(drive: Drive, n: int) -> None:
    """An error, and at once its end: a frame that the kernel hands back, then the feedback."""
    drive.end.send(pack_frame(EMERGENCY, bytes(8)))
    calm(drive, n)


def between(*raws: bytes) -> Act:
    """Frames after the command, a stranger's and feedback around them: the next tick finds them waiting."""

    def act(drive: Drive, n: int) -> None:
        drive.end.send(drive.feedback(n))
        assert drive.end.recv(128)[:2] == COMMAND.to_bytes(2, "little")
        drive.end.send(pack_frame(0x500, bytes(3)))
        for raw in raws:
            drive.end.send(raw)
        drive.end.send(drive.feedback(n))

    return act


MOTOR_TOO_HOT = pack_frame(EMERGENCY, bytes((0x10, 0x43, 1, 0, 0, 0, 0, 0)))
emergency_late = now_and_then(30, 50)(between(MOTOR_TOO_HOT))
second_master_late = now_and_then(60)(between(pack_frame(COMMAND, bytes(8))))


@now_and_then(60)
def alarm(drive: Drive, n: int) -> None:
    drive.end.send(MOTOR_TOO_HOT)
    calm(drive, n)


@now_and_then(30, 45)
def strangers(drive: Drive, n: int) -> None:
    for other in range(6):
        drive.end.send(pack_frame(0x500 + other, bytes(other)))
    calm(drive, n)


@now_and_then(60)
def second_master(drive: Drive, n: int) -> None:
    drive.end.send(pack_frame(COMMAND, bytes(8)))
    calm(drive, n)


@now_and_then(30, 31)
def wrong_length(drive: Drive, n: int) -> None:
    drive.end.send(pack_frame(FEEDBACK, bytes(7)))
    drive.end.send(b"no frame")
    calm(drive, n)


@now_and_then(30, 45)
def heap(drive: Drive, n: int) -> None:
    """Three at once: the newest counts, the others are periods that had no tick."""
    for _ in range(3):
        drive.end.send(drive.feedback(n))


@now_and_then(30)
def emergency_behind(drive: Drive, n: int) -> None:
    """A frame that the kernel hands back when it has taken feedback already, and more feedback behind it."""
    drive.end.send(drive.feedback(n))
    drive.end.send(pack_frame(EMERGENCY, bytes(8)))
    drive.end.send(drive.feedback(n))


def sync_frame(count: int) -> bytes:
    """SYNC with its counter from 1 to 240."""
    return pack_frame(SYNC, bytes((count % 240 + 1,)))


def timed(answer: Act, *silent: int) -> Act:
    """SYNC by the kernel before each answer, but for those."""

    def act(drive: Timed, n: int) -> None:
        if n not in silent:
            drive.ear.send(sync_frame(n - sum(other < n for other in silent)))
        answer(drive, n)

    return act


@timed
@now_and_then(30, 50)
def answered_late(drive: Timed, n: int) -> None:
    """Feedback after the loop gave up, and before the next SYNC: it is not applied."""
    raw = drive.feedback(n)
    while drive.take(drive.end.recv(128)) != COMMAND:
        pass
    drive.end.send(raw)


@timed
@now_and_then(60)
def sync_of_another(drive: Timed, n: int) -> None:
    drive.ear.send(sync_frame(n + 99))
    calm(drive, n)


@now_and_then(60)
def gone(drive: Drive, n: int) -> None:
    drive.end.close()


@now_and_then(50)
def deaf(drive: Drive, n: int) -> None:
    """Nothing is read for as long as it takes to fill the queue to the drive."""
    time.sleep(0.255)
    calm(drive, n)


@now_and_then(60)
def fired(drive: Drive, n: int) -> None:
    """The guardian fires while the loop waits for feedback."""
    drive.words.cells[FIRED] = 1
    calm(drive, n)


def guardian_dies(drive: Drive, n: int) -> None:
    if n >= 60:
        drive.words.cells[GUARD_NS] -= GUARDIAN_LOST_NS + 10**9
    calm(drive, n)


@dataclass
class Ran:
    """What a run left."""

    log: Log
    stages: Counter[int]
    heard: list[int]
    ended: str
    words: list[int]
    failure: str = ""


@contextlib.contextmanager
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of a wire; each frame is a datagram."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # room for some frames
    with ours, theirs:
        yield ours, theirs


def setup_of(*more: str) -> Setup:
    """The demo, patient with what is missing, at rest."""
    settings = ("feedback.hold_ticks=40", "reference.w_rad_s=0.0", *more)
    return load_setup(CONFIGS / "demo.toml", Overrides(settings=settings))


def run(setup: Setup, path: Path, act: Act, compiled: bool, ticks: int = TICKS) -> Ran:
    """A run of the loop with its guardian's words, recorder and log, against that drive."""
    request = StopRequest()
    stages: Counter[int] = Counter()
    words, machine = Words(), setup.machine.fresh()
    words.cells[GUARD_NS] = time.monotonic_ns()
    pacing = setup.config.loop.pacing
    plan = Plan(PERIOD_NS, TIMEOUT_NS, pacing, ticks)
    recorder = Recorder(path, header_of(setup, "run", "monotonic"), 1000)
    recorder.await_open()
    failure = ""
    with ends() as (ours, theirs):
        other = Timed if act in TIMED else Drive if pacing == "sync" else Cyclic
        drive = other(setup, theirs, words, act)
        sync = drive.sync if isinstance(drive, Timed) else None
        link = SocketLink(None, ours, ours)
        client = DriveClient(link, setup.database, on_frames=recorder.frames, timed=sync)

        def counted(pace: Pace) -> Whole:
            made = fused.whole_tick(client, words, machine, recorder, plan, pace)

            def whole(*args: Any) -> int:
                stage = made(*args)
                stages[stage] += 1
                return stage

            return whole

        guarded, record = GuardedDrive(client, words, time.monotonic_ns, sync), recorder.record
        whole = counted if compiled else no_whole
        parts = guarded, RealClock(), recorder, machine.looped(), record, plan, request, whole
        loop = Loop(*parts, timed=sync)
        drive.operator = request
        drive.start()
        try:
            outcome = loop.run()
        except Exception as error:  # noqa: BLE001 - the two runs are compared in how they fail, too
            outcome, failure = loop._outcome, f"{type(error).__name__}: {error}"
        finally:
            recorder.close({"ended": "in time"})
            drive.stop()
    log, ended = open_log(path), Reason(outcome.reason).name
    return Ran(log, stages, drive.heard, ended, words.cells.tolist()[:5], failure)


def paced_by_drive(ran: Ran) -> bool:
    """The drive's own clock goes on in the stop, too."""
    return bool(json.loads(ran.log.attachments["config.json"])["loop"]["pacing"] == "feedback")


def in_time(ran: Ran) -> tuple[list[tuple[int, bytes, bool]], list[int]]:
    """Frames up to the last tick, and what the drive heard of them: what follows depends on who is faster."""
    end_ns = int(ran.log.ticks["t_ns"][-1]) + int(ran.log.ticks["sent_ns"][-1])
    frames = [(f.can_id, f.data, f.received) for f in ran.log.frames if f.t_ns <= end_ns]
    return frames, ran.heard[: sum(not received for _, _, received in frames)]


def assert_same(rules: Ran, compiled: Ran) -> None:
    """Every field of every record, every frame, every event, and the end."""
    assert (compiled.ended, compiled.failure) == (rules.ended, rules.failure)
    assert len(compiled.log.ticks) == len(rules.log.ticks)
    for one in FIELDS:
        if one.name not in STAMPS | {"check"}:
            theirs, ours = rules.log.ticks[one.name], compiled.log.ticks[one.name]
            assert theirs.tobytes() == ours.tobytes(), one.name
    for ran in (rules, compiled):  # the check is of the stamps too: each must fit its own
        assert first_broken(ran.log.ticks, ran.log.absent) is None and ran.log.ticks["check"].all()
    at = [ran.log.ticks["t_ns"] - ran.log.ticks["t_ns"][0] for ran in (rules, compiled)]
    assert (at[0] == at[1]).all()
    if paced_by_drive(rules):
        assert in_time(rules) == in_time(compiled)
    else:
        passed = [[(f.can_id, f.data, f.received) for f in ran.log.frames] for ran in (rules, compiled)]
        assert passed[0] == passed[1] and compiled.heard == rules.heard
    told = [[(e["k"], e["kind"], e["text"]) for e in ran.log.events] for ran in (rules, compiled)]
    assert told[0] == told[1]
    assert compiled.words[ARMED] == rules.words[ARMED] and compiled.words[COUNTER] == rules.words[COUNTER]


def both(setup: Setup, folder: Path, act: Act) -> tuple[Ran, Ran]:
    """(by the loop's rules, compiled): the first two of all turns that are the same, else the last."""
    ran: dict[bool, list[Ran]] = {False: [], True: []}
    for turn in range(TURNS):
        for form, runs in ran.items():
            runs.append(run(setup, folder / f"{turn}-{form}.mcap", act, form))
        for rules, compiled in itertools.product(*ran.values()):
            with contextlib.suppress(AssertionError):
                assert_same(rules, compiled)
                return rules, compiled
    return ran[False][-1], ran[True][-1]


CASES: dict[str, tuple[Act, set[int], str]] = {
    # what happens: the act, the stages at which ticks were left to the loop, how it ends
    "calm": (calm, {SENT}, "STOP_REQUESTED"),
    "wrong crc": (wrong_crc, {SENT}, "STOP_REQUESTED"),
    "repeated counter": (repeated, {SENT}, "STOP_REQUESTED"),
    "jump of the counter": (jumped, {SENT}, "STOP_REQUESTED"),
    "no feedback": (silent, {SENT}, "STOP_REQUESTED"),
    "late feedback": (late, {SENT}, "STOP_REQUESTED"),
    "emergency that is over": (emergency, {SENT, BEGUN}, "STOP_REQUESTED"),
    "emergency": (alarm, {SENT, BEGUN}, "STOP_REQUESTED"),
    "late emergency": (emergency_late, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "second master between ticks": (second_master_late, {SENT, NOT_BEGUN}, "FOREIGN_COMMAND"),
    "strangers' frames": (strangers, {SENT}, "STOP_REQUESTED"),
    "second master": (second_master, {SENT, BEGUN}, "FOREIGN_COMMAND"),
    "wrong length": (wrong_length, {SENT}, "STOP_REQUESTED"),
    "the other end is gone": (gone, {SENT, BEGUN, NOT_BEGUN, DECIDED}, "BUS_DOWN"),
    "the queue is full": (deaf, {SENT, BEGUN, NOT_BEGUN, DECIDED}, "SEND_FAILED"),
    "the guardian fires": (fired, {SENT, DECIDED, NOT_BEGUN}, "GUARDIAN"),
    "the guardian dies": (guardian_dies, {SENT}, "GUARDIAN_LOST"),
}


def test_the_ramp_of_a_stop_is_compiled(tmp_path: Path) -> None:
    """Each tick of it is the compiled one, the events are the loop's."""

    def act(drive: Drive, n: int) -> None:
        if n == 40:  # before the answer that the loop waits for, so that it is the same tick in both
            drive.operator.stop()
        drive.speed = 2.0 if n < 70 else 0.0
        calm(drive, n)

    up = (
        "reference.w_rad_s=2.0",
        "reference.at_s=0.0",
        "reference.rate_rad_s2=200.0",
        "reference.jerk_rad_s3=1e5",
    )
    setup = setup_of(*up, "stop.ramp_rad_s2=80.0")
    rules, compiled = both(setup, tmp_path, act)
    assert_same(rules, compiled)
    asked = compiled.log.ticks["request"] == Request.RAMP_DOWN
    w_ref = compiled.log.ticks["w_ref"][asked]
    assert w_ref[0] > 0 and w_ref[-1] == 0 and (np.diff(w_ref) <= 0).all() and asked.sum() > 20
    assert [e["text"] for e in compiled.log.events].count(RAMP_EVENT[1]) == 1
    assert compiled.stages[RECORDED] > asked.sum() and compiled.ended == "STOP_REQUESTED"


LATE = ("late emergency", "second master between ticks")
EXACT = {name for name, (_, left, _) in CASES.items() if left <= {SENT, BEGUN} or name in LATE}
"""Where the drive listens to the end, the stages are known exactly."""


@pytest.mark.parametrize("name", CASES)
def test_a_compiled_tick_is_the_loops_own(name: str, tmp_path: Path) -> None:
    act, left, ended = CASES[name]
    rules, compiled = both(setup_of(), tmp_path, act)
    assert_same(rules, compiled)
    assert set(compiled.stages) - {RECORDED} <= left and compiled.stages[RECORDED] > 20, compiled.stages
    assert name not in EXACT or set(compiled.stages) - {RECORDED} == left, compiled.stages
    assert compiled.ended == ended
    assert not rules.stages


FOLLOWED: dict[str, tuple[Act, set[int], str]] = {
    # the same where the drive's own feedback wakes the loop; the first tick is the loop's
    "calm": (calm, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "wrong crc": (wrong_crc, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "repeated counter": (repeated, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "jump of the counter": (jumped, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "no feedback": (silent, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "a heap": (heap, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "emergency that is over": (emergency, {SENT, NOT_BEGUN, BEGUN}, "STOP_REQUESTED"),
    "emergency behind feedback": (emergency_behind, {SENT, NOT_BEGUN, BEGUN}, "STOP_REQUESTED"),
    "emergency": (alarm, {SENT, NOT_BEGUN, BEGUN}, "STOP_REQUESTED"),
    "strangers' frames": (strangers, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "second master": (second_master, {SENT, NOT_BEGUN, BEGUN}, "FOREIGN_COMMAND"),
    "wrong length": (wrong_length, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "the other end is gone": (gone, {SENT, NOT_BEGUN, DECIDED}, "SEND_FAILED"),
    "the guardian fires": (fired, {SENT, DECIDED, NOT_BEGUN}, "GUARDIAN"),
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_a_compiled_tick_that_feedback_wakes_is_the_loops_own(name: str, tmp_path: Path) -> None:
    act, left, ended = FOLLOWED[name]
    rules, compiled = both(setup_of('loop.pacing="feedback"'), tmp_path, act)
    assert_same(rules, compiled)
    assert set(compiled.stages) - {RECORDED} <= left and compiled.stages[RECORDED] > 20, compiled.stages
    assert compiled.stages[NOT_BEGUN] == 1 or ended in ("SEND_FAILED", "GUARDIAN")
    assert (BEGUN in compiled.stages) == (BEGUN in left)
    assert compiled.ended == ended and not rules.stages


BY_THE_KERNEL: dict[str, tuple[Act, set[int], str]] = {
    # SYNC is sent by a timer, and heard with its stamps; each SYNC is a period
    "calm": (timed(calm), {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "no feedback": (timed(silent), {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "no SYNC": (timed(calm, 40, 41), {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "late feedback": (answered_late, {SENT, NOT_BEGUN}, "STOP_REQUESTED"),
    "another's SYNC": (sync_of_another, {SENT, NOT_BEGUN}, "FOREIGN_COMMAND"),
    "emergency": (timed(alarm), {SENT, NOT_BEGUN, BEGUN}, "STOP_REQUESTED"),
    "the guardian fires": (timed(fired), {SENT, DECIDED, NOT_BEGUN}, "GUARDIAN"),
}
TIMED = [act for act, _, _ in BY_THE_KERNEL.values()]


@pytest.mark.parametrize("name", BY_THE_KERNEL)
def test_a_compiled_tick_by_the_kernels_sync_is_the_loops_own(name: str, tmp_path: Path) -> None:
    act, left, ended = BY_THE_KERNEL[name]
    rules, compiled = both(setup_of('loop.pacing="feedback"'), tmp_path, act)
    assert_same(rules, compiled)
    assert set(compiled.stages) - {RECORDED} <= left and compiled.stages[RECORDED] > 20, compiled.stages
    assert compiled.ended == ended and not rules.stages
    stale = compiled.log.ticks["rx_flags"] & int(RxFlag.FRESH) == 0
    assert stale.any() == (name in ("no feedback", "no SYNC", "late feedback") or ended == "GUARDIAN")
    syncs = [frame for frame in compiled.log.frames if frame.can_id == SYNC and not frame.received]
    assert len(syncs) > 40 and [s.data[0] for s in syncs[:40]] == list(range(1, 41))


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    """A client, its compiled tick and the other end of the wire, without a loop."""
    setup, words = setup_of(), Words()
    machine, plan = setup.machine.fresh(), Plan(PERIOD_NS, TIMEOUT_NS, "sync", TICKS)
    recorder = open_recorder(tmp_path / "run.mcap", header_of(setup, "run", "monotonic"), 1000)
    with ends() as (ours, theirs):
        theirs.setblocking(False)
        client = DriveClient(SocketLink(None, ours, ours), setup.database, on_frames=recorder.frames)
        client.prepare(recorder.record[0])
        whole = fused.whole_tick(client, words, machine, recorder, plan, new_pace())
        yield Parts(whole, words, recorder.record, theirs)
        recorder.close({})


@dataclass
class Parts:
    """What :func:`parts` makes."""

    whole: Whole
    words: Words
    record: TickArray
    end: socket.socket

    def silent(self) -> bool:
        """Nothing was sent, nothing stored."""
        with pytest.raises(BlockingIOError):
            self.end.recv(128)
        return True


def test_a_tick_that_is_late_by_a_period_is_the_loops(parts: Parts) -> None:
    before = parts.record.tobytes()
    assert parts.whole(7, time.monotonic_ns() - PERIOD_NS, 1, False) == NOT_BEGUN
    assert parts.silent() and parts.record.tobytes() == before


def test_nothing_is_sent_once_the_guardian_has_fired(parts: Parts) -> None:
    parts.words.cells[FIRED] = 1
    assert parts.whole(7, time.monotonic_ns(), 1, False) == NOT_BEGUN
    assert parts.silent() and parts.words.cells[BEAT_NS] > 0


def test_a_signal_ends_the_sleep(parts: Parts) -> None:
    """So that its handler can run before the tick."""
    seen: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: seen.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        begin_ns = time.monotonic_ns()
        assert parts.whole(7, begin_ns + 20 * 10**9, 1, False) == NOT_BEGUN
    finally:
        signal.signal(signal.SIGALRM, before)
    assert seen == [signal.SIGALRM] and time.monotonic_ns() - begin_ns < 10 * 10**9
    assert parts.silent()


def test_a_tick_sleeps_to_its_deadline(parts: Parts) -> None:
    deadline_ns = time.monotonic_ns() + 30_000_000
    parts.whole(7, deadline_ns, 3, True)
    assert CLASSIC.unpack(parts.end.recv(128))[0] == SYNC
    tick = parts.record[0]
    assert (tick["k"], tick["t_ns"], tick["request"], tick["log_failed"]) == (7, deadline_ns, 3, 1)
    assert (tick["gap"], tick["skipped"]) == (1, 0)
    stamps = [tick[name] for name in ("lateness_ns", "received_ns", "computed_ns", "sent_ns")]
    assert stamps == sorted(stamps) and stamps[0] >= 0 and stamps[1] >= TIMEOUT_NS


def test_what_has_no_sync_or_no_socket_is_the_loops(tmp_path: Path, channel: str) -> None:
    setup = setup_of()
    machine, recorder = (
        setup.machine,
        open_recorder(tmp_path / "run.mcap", header_of(setup, "run", "x"), 1000),
    )
    other = open_link(BusSettings("virtual", channel))
    with ends() as (ours, _):
        for link, pacing in ((SocketLink(None, ours, ours), "timer"), (other, "sync"), (other, "feedback")):
            client = DriveClient(link, setup.database)
            client.prepare(recorder.record[0])
            plan = Plan(PERIOD_NS, TIMEOUT_NS, pacing, TICKS)
            assert fused.whole_tick(client, None, machine, recorder, plan, new_pace()) is none_compiled
    other.close()
    recorder.close({})
