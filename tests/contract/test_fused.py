"""The compiled tick against the loop's own rules: the same drive, the same disturbances, the same log.

Each case runs twice, with and without the compiled tick, in a process whose time is virtual: what comes when
is written, and the host can't change it. Everything must be equal to the bit: every field of every record,
its stamps too, the frames that passed, the events, how it ended. And each case says which stages of the tick
were left to the loop, so that a compiled tick that left everything to it would fail.
"""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import select
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.bcm import SO_TIMESTAMPNS, TX_DELETE, KernelSync
from drivers.bus import (
    BusSettings,
    Frame,
    Link,
    SocketLink,
    open_link,
    raise_link_error,
    unpack_frame,
)
from drivers.client import DriveClient
from drivers.local import CLASSIC, pack_frame
from drivers.lockstep import LockstepLink, tick_over
from drivers.posix import LEFT
from hil.log.check import first_broken
from hil.log.reader import Log, open_log
from hil.log.recorder import Recorder, open_recorder
from hil.log.ring import FAILED_AT
from hil.runtime import fused, inbox
from hil.runtime.clock import LockstepClock, RealClock
from hil.runtime.guardian import (
    BEAT_NS,
    FIRED,
    GUARD_NS,
    GUARDIAN_LOST_NS,
    GuardedDrive,
    Words,
)
from hil.runtime.header import header_of
from hil.runtime.inbox import Inbox, Place, ranges
from hil.runtime.loop import RAMP_EVENT, Loop, Plan, StopRequest, Whole, no_whole, none_compiled
from hil.runtime.rules import (
    BEGUN,
    DECIDED,
    LOST,
    NOT_BEGUN,
    PACINGS,
    RAN,
    RECORDED,
    SENT,
    Pace,
    Pacing,
    new_pace,
)
from hil.runtime.session import plan_of
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.runtime.shadow import ShadowDrive
from hil.signals import FIELDS, Reason, Request, RxFlag, TickArray
from tests.conftest import CONFIGS
from tests.contract import virtual
from tests.contract.virtual import TIME

pytestmark = [pytest.mark.compiled, pytest.mark.process, pytest.mark.beside]

PERIOD_NS, TIMEOUT_NS, ANSWER_NS = 10_000_000, 5_000_000, 1_000_000
TICKS, TOGETHER = 90, 7
PATIENT_NS = 10_000_000_000
"""A period in real time: no host is late by that."""
STATES = {0x0: 1, 0x6: 2, 0x7: 3, 0xF: 4}
SYNC, FEEDBACK, COMMAND, EMERGENCY, STATUS = 0x080, 0x181, 0x201, 0x081, 0x281


class Drive:
    """Answers SYNC over the other end of the loop's socket a millisecond later; ``act`` says how."""

    def __init__(self, setup: Setup, end: socket.socket, words: Words, act: Act) -> None:
        self.end, self.words, self._act = end, words, act
        messages = map(setup.database.message, ("FEEDBACK", "STATUS", "COMMAND"))
        self._feedback, self._status, self._command = messages
        self.counter = self._echo = self._state = self._beats = self._deaf_until = 0
        self.operator, self.speed = StopRequest(), 0.0
        self.tells, self._asked = False, b""
        """Whether it says that a tick is over: in lockstep nobody waits for what was lost."""
        self.inbox: Inbox
        self.recorder: Recorder
        self.heard: list[int] = []
        self._then: list[Callable[[], None]] = []

    def begin(self) -> None:
        """Listen whenever the loop waits."""
        TIME.listen = self.listen

    def listen(self) -> None:
        """Take all that the loop has sent."""
        if TIME.now_ns < self._deaf_until:
            return
        with contextlib.suppress(OSError):  # nothing more, or no longer an end
            while True:
                can_id = self.take(self.end.recv(128, socket.MSG_DONTWAIT))
                if can_id == COMMAND and self._then:
                    self._then.pop()()
                self.hears(can_id)

    def hears(self, can_id: int) -> None:
        """What a frame sets off."""
        if can_id == SYNC:
            TIME.after(ANSWER_NS, self.beat)

    def take(self, raw: bytes) -> int:
        """What a frame of the loop's asks; returns its identifier."""
        can_id, length, data = CLASSIC.unpack(raw)
        self.heard.append(can_id)
        if can_id == SYNC:
            self._asked = data[:length]
        if can_id == COMMAND:
            self._echo, self._state = data[1] & 15, STATES.get(data[2] | data[3] << 8, self._state)
        return int(can_id)

    def beat(self) -> None:
        """The guardian's sign of life, and the next answer."""
        n, self._beats = self._beats, self._beats + 1
        self.words.cells[GUARD_NS] = TIME.now_ns
        with contextlib.suppress(OSError):  # the loop may have ended
            self._act(self, n)
            if self.tells:
                self.end.send(pack_frame(*tick_over(self._asked)))

    def after_command(self, act: Callable[[], None]) -> None:
        """Do that when the next command has come."""
        self._then.append(act)

    def deaf(self, ns: int, act: Callable[[], None]) -> None:
        """Hear nothing for so long, then do that."""
        self._deaf_until = TIME.now_ns + ns
        TIME.after(ns, act)

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
        """What was sent to it counts, nothing more comes of it."""
        self.listen()
        TIME.restart()


class Cyclic(Drive):
    """Sends by itself a period after each command; without one the next comes before the loop gives up."""

    def begin(self) -> None:
        super().begin()
        self._awaits = 0
        TIME.after(PERIOD_NS, self.beat)

    def beat(self) -> None:
        super().beat()
        self._awaits = mine = self._beats
        TIME.after(PERIOD_NS * 3 // 10, lambda: self.goes_on(mine))

    def hears(self, can_id: int) -> None:
        if can_id == COMMAND:
            self.goes_on(self._awaits)

    def goes_on(self, beats: int) -> None:
        """The next is a period from now, unless it is on its way."""
        if beats and beats == self._awaits:
            self._awaits = 0
            TIME.after(PERIOD_NS, self.beat)


class Timed(Drive):
    """Sends SYNC, too, by a timer that the loop's job has started: the Broadcast Manager's part."""

    def __init__(self, setup: Setup, end: socket.socket, words: Words, act: Act) -> None:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(2)]
        (job, self.job), (ear, self.ear) = pairs
        ear.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.sync = KernelSync(job, ear, SYNC, True, PERIOD_NS)
        self.asked: list[bytes] = []
        super().__init__(setup, end, words, act)

    def listen(self) -> None:
        super().listen()
        with contextlib.suppress(OSError):  # nothing more, or closed
            while not self.asked or self.asked[-1][0] != TX_DELETE:
                self.asked.append(self.job.recv(8192, socket.MSG_DONTWAIT) or bytes((TX_DELETE,)))
                if len(self.asked) == 1:
                    TIME.after(0, self.beat)

    def hears(self, can_id: int) -> None:
        """Its own timer alone sets it off."""

    def beat(self) -> None:
        if self.asked[-1][0] != TX_DELETE:
            super().beat()
            TIME.after(PERIOD_NS, self.beat)

    def send_sync(self, count: int) -> None:
        """SYNC, with its stamp."""
        TIME.stamps.append(TIME.now_ns)
        self.ear.send(sync_frame(count))

    def stop(self) -> None:
        super().stop()
        self.sync.close()
        self.job.close()
        self.ear.close()


class Beside(Drive):
    """Another controller drives it, which the loop only listens to; ``commands``: how, for the n-th time."""

    commands: Act

    def begin(self) -> None:
        super().begin()
        TIME.after(PERIOD_NS, self.beat)

    def beat(self) -> None:
        n = self._beats
        self.end.send(sync_frame(n))
        super().beat()
        with contextlib.suppress(OSError):
            self.commands(self, n)
        TIME.after(PERIOD_NS, self.beat)

    def hears(self, can_id: int) -> None:
        raise AssertionError(f"a shadow has sent 0x{can_id:X}")

    def command(self, n: int) -> bytes:
        """The n-th command, never twice the same; the drive echoes it from the next answer on."""
        self._echo, self._state = n % 16, STATES[0xF if n > 5 else 0x6]
        values = {"Counter": n % 16, "Controlword": 0xF, "VoltageQ": 0.05 * n, "VoltageD": -0.01 * (n % 9)}
        return pack_frame(COMMAND, self._command.encode({"Mode": 0, **values}))


Act = Callable[[Any, int], None]
Both = Callable[..., tuple[Any, Any]]


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
    drive.after_command(lambda: drive.end.send(drive.feedback(n)))


@now_and_then(30, 50)
def emergency(drive: Drive, n: int) -> None:
    """An error, and at once its end: a frame that the kernel hands back, then the feedback."""
    drive.end.send(pack_frame(EMERGENCY, bytes(8)))
    calm(drive, n)


def between(*raws: bytes) -> Act:
    """Frames after the command, a stranger's and feedback around them: the next tick finds them waiting."""

    def act(drive: Drive, n: int) -> None:
        def rest() -> None:
            for raw in (pack_frame(0x500, bytes(3)), *raws, drive.feedback(n)):
                drive.end.send(raw)

        drive.end.send(drive.feedback(n))
        drive.after_command(rest)

    return act


@now_and_then(30, 50)
def late_and_judged(drive: Drive, n: int) -> None:
    """Status and a spoiled frame after the command, which the next tick finds waiting."""
    drive.end.send(drive.feedback(n))
    spoiled = bytearray(drive.feedback(n))
    spoiled[-1] ^= 1
    drive.counter -= 1
    drive.after_command(lambda: [drive.end.send(raw) for raw in (drive.status(n), spoiled)] and None)


def and_judged(other: Act, *at: int) -> Act:
    """A frame that the kernel hands back, before these answers."""

    def act(drive: Drive, n: int) -> None:
        if n in at:
            drive.end.send(pack_frame(EMERGENCY, bytes(8)))
        other(drive, n)

    return act


def seldom(drive: Drive, n: int) -> None:
    """Feedback on every third SYNC; after one without it a frame that the kernel hands back."""
    if n in (31, 49):
        drive.end.send(pack_frame(EMERGENCY, bytes(8)))
    if n % 3 == 0:
        calm(drive, n)


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
            drive.send_sync(n - sum(other < n for other in silent))
        answer(drive, n)

    return act


@timed
@now_and_then(30, 50)
def answered_late(drive: Timed, n: int) -> None:
    """Feedback after the loop gave up, and before the next SYNC: it is not applied."""
    raw = drive.feedback(n)
    drive.after_command(lambda: drive.end.send(raw))


@timed
@now_and_then(60)
def sync_of_another(drive: Timed, n: int) -> None:
    drive.send_sync(n + 99)
    calm(drive, n)


@now_and_then(60)
def gone(drive: Drive, n: int) -> None:
    drive.end.close()


@now_and_then(50)
def deaf(drive: Drive, n: int) -> None:
    """Nothing is read for as long as it takes to fill the queue to the drive."""
    drive.deaf(255_000_000, lambda: calm(drive, n))


@now_and_then(60)
def fired(drive: Drive, n: int) -> None:
    """The guardian fires while the loop waits for feedback."""
    drive.words.cells[FIRED] = 1
    calm(drive, n)


@now_and_then(45)
def asked_for_a_speed(drive: Drive, n: int) -> None:
    """Another process asks for a set-point while the loop waits: the next tick takes it."""
    cells = drive.inbox.cells
    w = int(np.float64(1.5).view(np.int64))
    cells[inbox.HAS], cells[inbox.W], cells[inbox.I_Q] = 1, w, 0
    cells[inbox.CHECK] = inbox._check(1, 1, w, 0, 0)
    cells[inbox.ASKED] = 1
    calm(drive, n)


@now_and_then(45)
def writer_fails(drive: Drive, n: int) -> None:
    """The writer says so while the loop waits: the next tick knows it."""
    drive.recorder._ticks.header[FAILED_AT] = 1
    calm(drive, n)


def guardian_dies(drive: Drive, n: int) -> None:
    if n >= 60:
        drive.words.cells[GUARD_NS] -= GUARDIAN_LOST_NS + 10**9
    calm(drive, n)


@dataclass
class Ran:
    """What a run left."""

    path: Path
    stages: Counter[int]
    together: list[int]
    """Ticks that each compiled call recorded."""
    heard: list[int]
    ended: str
    words: list[int]
    failure: str = ""

    @cached_property
    def log(self) -> Log:
        """Its log."""
        return open_log(self.path)


@contextlib.contextmanager
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of a wire; each frame is a datagram."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # room for some frames
    theirs.setblocking(False)
    with ours, theirs:
        yield ours, theirs


class Plain:
    """A bus that is no descriptor: an end of the wire behind Python's own send and receive."""

    def __init__(self, end: socket.socket) -> None:
        self._end, self._poll = end, select.poll()
        self._poll.register(end, select.POLLIN)
        end.setblocking(False)

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        try:
            self._end.send(pack_frame(can_id, data, fd))
        except OSError as error:
            raise_link_error(error, "send")

    def receive(self, timeout_ns: int) -> Frame | None:
        if timeout_ns:
            TIME.pass_until(TIME.now_ns + timeout_ns, lambda: bool(self._poll.poll(0)))
        try:
            return unpack_frame(self._end.recv(128))
        except BlockingIOError:
            return None
        except OSError as error:
            raise_link_error(error, "receive")

    def discard(self) -> int:
        return 0

    def close(self) -> None: ...


def setup_of(*more: str) -> Setup:
    """The demo, patient with what is missing, at rest."""
    settings = ("feedback.hold_ticks=40", "reference.w_rad_s=0.0", *more)
    return load_setup(CONFIGS / "demo.toml", Overrides(settings=settings))


def run(settings: tuple[str, ...], path: Path, case: tuple[str, str], compiled: bool) -> Ran:
    """A run of the loop with its guardian's words, recorder and log, against the drive of that case.

    For a process of virtual time, which it begins anew.
    """
    TIME.restart()
    setup, act = setup_of(*settings), TABLES[case[0]][case[1]][0]
    request = StopRequest()
    stages: Counter[int] = Counter()
    together: list[int] = []
    words, machine = Words(), setup.machine.fresh()
    words.cells[GUARD_NS] = TIME.now_ns
    shadow, pacing = setup.config.loop.shadow, plan_of(setup.config).pacing
    plan = Plan(PERIOD_NS, TIMEOUT_NS, pacing, TICKS, 3 if case[0] == "seldom" else 1, TOGETHER)
    recorder = Recorder(path, header_of(setup, "run", "monotonic"), 1000)
    recorder.await_open()
    failure = ""
    with ends() as (ours, theirs):
        other = Timed if case[0] == "by the kernel" else Drive if pacing == "sync" else Cyclic
        other = Beside if shadow else other
        drive = other(setup, theirs, words, act)
        sync = drive.sync if isinstance(drive, Timed) else None
        link: Link = Plain(ours) if case[0] in PLAIN else SocketLink(None, ours, ours)
        clock = LockstepClock() if case[0] == "in lockstep" else RealClock()
        if isinstance(clock, LockstepClock):
            link, drive.tells = LockstepLink(link, SYNC), True
        client = DriveClient(link, setup.database, on_frames=recorder.frames, now=clock.now_ns, timed=sync)
        real = isinstance(clock, RealClock)
        told = words if real and not shadow else None  # where time stands still, or nothing is sent
        seen = client.overhear() if shadow else None

        def counted(pace: Pace) -> Whole:
            parts = client, told, machine, recorder, plan, request, pace, page.number
            made = fused.whole_tick(*parts, clock=clock.cell, seen=seen)

            def whole(*args: Any) -> int:
                stage = made(*args)
                stages[RECORDED] += int(pace[RAN])
                stages[stage] += stage != RECORDED
                together.append(int(pace[RAN]))
                newest = 1 + int(record["skipped"][0]) if stage == RECORDED else 0
                assert pace[RAN] + pace[LOST] - newest < TOGETHER, "Python has its turn by time"
                return stage

            return whole

        guarded = GuardedDrive(client, told, time.monotonic_ns, sync) if told else client
        guarded, record = guarded if seen is None else ShadowDrive(client, seen), recorder.record
        whole = counted if compiled else no_whole
        parts = guarded, clock, recorder, machine.looped(), record, plan, request, whole
        page = Inbox(Place(machine, ranges(machine, "cascade")))
        loop = Loop(*parts, page, sync)
        drive.operator, drive.inbox, drive.recorder = request, page, recorder
        TIME.restart()  # kernels that were compiled meanwhile have waited
        drive.begin()
        try:
            outcome = loop.run()
        except Exception as error:  # noqa: BLE001 - the two runs are compared in how they fail, too
            outcome, failure = loop._outcome, f"{type(error).__name__}: {error}"
        finally:
            drive.stop()
            client.flush()
            recorder.close({"ended": "in time"})
            page.close()
    if TIME.trouble:
        raise TIME.trouble[0]
    ended = Reason(outcome.reason).name
    return Ran(path, stages, together, drive.heard, ended, words.cells.tolist()[:5], failure)


def assert_same(rules: Ran, compiled: Ran) -> None:
    """Every field of every record, its stamps, every frame, every event, and the end."""
    assert (compiled.ended, compiled.failure) == (rules.ended, rules.failure)
    assert len(compiled.log.ticks) == len(rules.log.ticks)
    for one in FIELDS:
        theirs, ours = rules.log.ticks[one.name], compiled.log.ticks[one.name]
        assert theirs.tobytes() == ours.tobytes(), one.name
    for ran in (rules, compiled):
        assert first_broken(ran.log.ticks, ran.log.absent) is None and ran.log.ticks["check"].all()
    passed = [[(f.t_ns, f.can_id, f.data, f.received) for f in ran.log.frames] for ran in (rules, compiled)]
    assert passed[0] == passed[1] and compiled.heard == rules.heard
    told = [[(e["t_ns"], e["k"], e["kind"], e["text"]) for e in ran.log.events] for ran in (rules, compiled)]
    assert told[0] == told[1]
    assert compiled.words == rules.words


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[ProcessPoolExecutor]:
    """A process that lives in virtual time."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, virtual.begin) as pool:
        yield pool


@pytest.fixture
def both(elsewhere: ProcessPoolExecutor, tmp_path: Path) -> Both:
    """Runs a case with these settings (by the loop's rules, compiled)."""

    def made(case: tuple[str, str], *settings: str) -> tuple[Ran, Ran]:
        rules, compiled = (
            elsewhere.submit(run, settings, tmp_path / f"{form}.mcap", case, form).result()
            for form in (False, True)
        )
        return rules, compiled

    return made


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
    "late emergency": (emergency_late, {SENT, BEGUN}, "STOP_REQUESTED"),
    "late frames and an emergency": (and_judged(late_and_judged, 31, 51), {SENT, BEGUN}, "STOP_REQUESTED"),
    "second master between ticks": (second_master_late, {SENT, BEGUN}, "FOREIGN_COMMAND"),
    "strangers' frames": (strangers, {SENT}, "STOP_REQUESTED"),
    "second master": (second_master, {SENT, BEGUN}, "FOREIGN_COMMAND"),
    "wrong length": (wrong_length, {SENT}, "STOP_REQUESTED"),
    "the other end is gone": (gone, {SENT, BEGUN, DECIDED}, "BUS_DOWN"),
    "the queue is full": (deaf, {SENT, BEGUN, DECIDED}, "SEND_FAILED"),
    "the guardian fires": (fired, {SENT, DECIDED, BEGUN}, "GUARDIAN"),
    "the guardian dies": (guardian_dies, {SENT}, "GUARDIAN_LOST"),
    "a set-point": (asked_for_a_speed, {SENT}, "STOP_REQUESTED"),
    "the writer fails": (writer_fails, {SENT}, "LOG_FAILED"),
}


def stopped(drive: Drive, n: int) -> None:
    """The operator asks for a stop before the answer that the loop waits for: it is the same tick in both."""
    if n == 40:
        drive.operator.stop()
    drive.speed = 2.0 if n < 70 else 0.0
    calm(drive, n)


def test_the_ramp_of_a_stop_is_compiled(both: Both) -> None:
    """Each tick of it is the compiled one, the events are the loop's."""
    up = (
        "reference.w_rad_s=2.0",
        "reference.at_s=0.0",
        "reference.rate_rad_s2=200.0",
        "reference.jerk_rad_s3=1e5",
    )
    rules, compiled = both(("ramp", "stop"), *up, "stop.ramp_rad_s2=80.0")
    assert_same(rules, compiled)
    asked = compiled.log.ticks["request"] == Request.RAMP_DOWN
    w_ref = compiled.log.ticks["w_ref"][asked]
    assert w_ref[0] > 0 and w_ref[-1] == 0 and (np.diff(w_ref) <= 0).all() and asked.sum() > 20
    assert [e["text"] for e in compiled.log.events].count(RAMP_EVENT[1]) == 1
    assert compiled.stages[RECORDED] > asked.sum() and compiled.ended == "STOP_REQUESTED"


def test_a_tick_without_feedback_that_is_due_waits_for_none(both: Both) -> None:
    """One that is left to the loop before SYNC is out, too."""
    rules, compiled = both(("seldom", "emergency"))
    assert_same(rules, compiled)
    waited = compiled.log.ticks["received_ns"]
    assert compiled.stages[BEGUN] == 2 and compiled.ended == "STOP_REQUESTED"
    assert (waited[32], waited[50]) == (0, 0) and waited[33] == waited[51] == ANSWER_NS


FOLLOWED: dict[str, tuple[Act, set[int], str]] = {
    # the same where the drive's own feedback wakes the loop
    "calm": (calm, {SENT}, "STOP_REQUESTED"),
    "wrong crc": (wrong_crc, {SENT}, "STOP_REQUESTED"),
    "repeated counter": (repeated, {SENT}, "STOP_REQUESTED"),
    "jump of the counter": (jumped, {SENT}, "STOP_REQUESTED"),
    "no feedback": (silent, {SENT}, "STOP_REQUESTED"),
    "a heap": (heap, {SENT}, "STOP_REQUESTED"),
    "emergency that is over": (emergency, {SENT, BEGUN}, "STOP_REQUESTED"),
    "emergency behind feedback": (emergency_behind, {SENT, BEGUN}, "STOP_REQUESTED"),
    "emergency": (alarm, {SENT, BEGUN}, "STOP_REQUESTED"),
    "strangers' frames": (strangers, {SENT}, "STOP_REQUESTED"),
    "second master": (second_master, {SENT, BEGUN}, "FOREIGN_COMMAND"),
    "wrong length": (wrong_length, {SENT}, "STOP_REQUESTED"),
    "the other end is gone": (gone, {SENT, BEGUN, DECIDED}, "SEND_FAILED"),
    "the guardian fires": (fired, {SENT, BEGUN}, "GUARDIAN"),
}


BY_THE_KERNEL: dict[str, tuple[Act, set[int], str]] = {
    # SYNC is sent by a timer, and heard with its stamps; each SYNC is a period
    "calm": (timed(calm), {SENT}, "STOP_REQUESTED"),
    "no feedback": (timed(silent), {SENT}, "STOP_REQUESTED"),
    "no SYNC": (timed(calm, 40, 41), {SENT}, "STOP_REQUESTED"),
    "late feedback": (answered_late, {SENT}, "STOP_REQUESTED"),
    "another's SYNC": (sync_of_another, {SENT}, "FOREIGN_COMMAND"),
    "emergency": (timed(alarm), {SENT, BEGUN}, "STOP_REQUESTED"),
    "the guardian fires": (timed(fired), {SENT, BEGUN}, "GUARDIAN"),
}


def beside(commands: Act, feedback: Act = calm) -> Act:
    """Another controller's command after the drive's answer, and how both are."""

    def act(drive: Beside, n: int) -> None:
        drive.commands = commands
        feedback(drive, n)

    return act


def commanded(drive: Beside, n: int) -> None:
    """At once: who looks for more feedback finds it."""
    drive.end.send(drive.command(n))


def commanded_later(drive: Beside, n: int) -> None:
    """While the loop waits for the next feedback."""
    raw = drive.command(n)
    TIME.after(PERIOD_NS // 3, lambda: drive.end.send(raw) and None)


def spoiled(drive: Beside, n: int) -> None:
    """Commands with a wrong CRC, a wrong length and as a remote frame: none is what the drive applies."""
    raw = bytearray(drive.command(n))
    drive.end.send(raw)
    raw[-1] ^= 1
    for other in (raw, pack_frame(COMMAND, bytes(7)), pack_frame(COMMAND | 0x40000000, b"")):
        drive.end.send(other)


def commanded_twice(drive: Beside, n: int) -> None:
    """Another one with the same counter: the newest counts."""
    drive.end.send(drive.command(n + 1))
    commanded(drive, n)


OVERHEARD: dict[str, tuple[Act, set[int], str]] = {
    # another controller drives the drive, and a shadow listens
    "calm": (beside(commanded), {SENT}, "STOP_REQUESTED"),
    "commands later": (beside(commanded_later), {SENT}, "STOP_REQUESTED"),
    "spoiled commands": (beside(spoiled), {SENT}, "STOP_REQUESTED"),
    "commands twice": (beside(commanded_twice), {SENT}, "STOP_REQUESTED"),
    "no command": (beside(lambda *_: None), {SENT}, "STOP_REQUESTED"),
    "no feedback": (beside(commanded, silent), {SENT}, "STOP_REQUESTED"),
    "a heap": (beside(commanded, heap), {SENT}, "STOP_REQUESTED"),
    "emergency behind feedback": (beside(commanded, emergency_behind), {SENT, BEGUN}, "STOP_REQUESTED"),
    "emergency": (beside(commanded, alarm), {SENT, BEGUN}, "STOP_REQUESTED"),
    "strangers' frames": (beside(commanded, strangers), {SENT}, "STOP_REQUESTED"),
    "a stop": (beside(commanded, stopped), {SENT}, "STOP_REQUESTED"),
}


BY_THE_TIMER: dict[str, tuple[Act, set[int], str]] = {
    # nobody sends SYNC, and the loop takes what is there
    "calm": (calm, {SENT}, "STOP_REQUESTED"),
    "no feedback": (silent, {SENT}, "STOP_REQUESTED"),
    "a heap": (heap, {SENT}, "STOP_REQUESTED"),
    "emergency behind feedback": (emergency_behind, {SENT, BEGUN}, "STOP_REQUESTED"),
    "second master": (second_master, {SENT, BEGUN}, "FOREIGN_COMMAND"),
    "the guardian fires": (fired, {SENT, BEGUN}, "GUARDIAN"),
}


PLAIN = ("no descriptor", "in lockstep", "a shadow without a descriptor")
"""Where the bus is Python's; and in lockstep time is a word that goes from tick to tick."""
STANDING_STILL = (
    "calm", "wrong crc", "jump of the counter", "no feedback", "late feedback", "emergency",
    "late frames and an emergency", "second master", "wrong length", "a set-point",
)  # fmt: skip


TABLES: dict[str, dict[str, tuple[Act, set[int], str]]] = {
    "by us": CASES,
    "by feedback": FOLLOWED,
    "by the kernel": BY_THE_KERNEL,
    "by the timer": BY_THE_TIMER,
    "a shadow": OVERHEARD,
    "a shadow by the timer": {name: OVERHEARD[name] for name in ("calm", "commands later", "a heap")},
    "a shadow without a descriptor": OVERHEARD,
    "no descriptor": CASES,
    "in lockstep": {name: CASES[name] for name in STANDING_STILL},
    "ramp": {"stop": (stopped, set(), "STOP_REQUESTED")},
    "seldom": {"emergency": (seldom, set(), "STOP_REQUESTED")},
}
"""Who sends SYNC, or that nobody does; then what happens."""


PACED = {
    "by us": "sync", "by feedback": "feedback", "by the kernel": "feedback", "by the timer": "timer",
    "no descriptor": "sync", "in lockstep": "sync", "a shadow": "sync", "a shadow by the timer": "timer",
    "a shadow without a descriptor": "feedback",
}  # fmt: skip
UNSURE = ("the other end is gone", "the queue is full", "the guardian fires")
"""Where the drive does not listen to the end, not all of the stages need come."""


FURTHER = ("a shadow by the timer", "a shadow without a descriptor")
"""Ways of what has rows for each of its parts already."""


@pytest.mark.parametrize(
    ("by", "name"),
    [
        pytest.param(by, name, marks=[pytest.mark.long] if by in FURTHER else [])
        for by in PACED
        for name in TABLES[by]
    ],
)
def test_a_compiled_tick_is_the_loops_own(by: str, name: str, both: Both) -> None:
    _, left, ended = TABLES[by][name]
    shadow = ("loop.shadow=true",) if by.startswith("a shadow") else ()
    rules, compiled = both((by, name), f'loop.pacing="{PACED[by]}"', *shadow)
    assert_same(rules, compiled)
    stages = set(compiled.stages) - {RECORDED}
    assert stages <= left and (stages == left or name in UNSURE), compiled.stages
    assert compiled.stages[RECORDED] > 20 and max(compiled.together) == TOGETHER and not rules.stages
    assert compiled.ended == ended
    AND.get(by, AND.get(name, lambda *_: None))(compiled, name)


def a_set_point_is_taken(ran: Ran, _name: str) -> None:
    (taken,) = [event["k"] for event in ran.log.events if event["kind"] == "set-point"]
    assert taken == 46 and ran.log.ticks["w_ref"].max() == 1.5


def feedback_ages(ran: Ran, name: str) -> None:
    age_ns = -ran.log.ticks["received_ns"][5:]
    assert (age_ns > PERIOD_NS).any() == (name == "no feedback")


def the_kernel_counts(ran: Ran, name: str) -> None:
    stale = ran.log.ticks["rx_flags"] & int(RxFlag.FRESH) == 0
    assert stale.any() == (name in ("no feedback", "no SYNC", "late feedback") or ran.ended == "GUARDIAN")
    syncs = [frame for frame in ran.log.frames if frame.can_id == SYNC and not frame.received]
    assert len(syncs) > 40 and [s.data[0] for s in syncs[:40]] == list(range(1, 41))


def others_commands_are_applied(ran: Ran, name: str) -> None:
    """Of each tick in which the drive is driven what its echo names, and nothing was sent."""
    ticks = ran.log.ticks
    assert not ticks["send"].any() and ran.heard == []
    if name == "no command":
        assert not ticks["u_q_seen"].any()
        return
    driven = ticks[(ticks["rx_flags"] & int(RxFlag.FRESH) != 0) & (ticks["drive_state"] == 4)]
    number = np.round(driven["u_q_seen"] / 0.05).astype(int)
    assert len(driven) > 60 and (number % 16 == driven["echo"]).all()
    assert np.allclose(driven["u_d_seen"], -0.01 * (number % 9)) and (np.diff(number) >= 1).all()


AND: dict[str, Callable[[Ran, str], None]] = {
    "by the kernel": the_kernel_counts,
    "by the timer": feedback_ages,
    "a set-point": a_set_point_is_taken,
    "a shadow": others_commands_are_applied,
    "a shadow by the timer": others_commands_are_applied,
    "a shadow without a descriptor": others_commands_are_applied,
}
"""What is checked besides, by who sends SYNC or by what happens."""


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    """A client, its compiled tick and the other end of the wire, without a loop."""
    setup, words, request = setup_of(), Words(), StopRequest()
    machine, plan = setup.machine.fresh(), Plan(PATIENT_NS, TIMEOUT_NS, "sync", TICKS, together=4)
    pace = new_pace()
    recorder = open_recorder(tmp_path / "run.mcap", header_of(setup, "run", "monotonic"), 1000)
    with ends() as (ours, theirs):
        client = DriveClient(SocketLink(None, ours, ours), setup.database, on_frames=recorder.frames)
        client.prepare(recorder.record[0])
        whole = fused.whole_tick(client, words, machine, recorder, plan, request, pace)
        yield Parts(whole, words, recorder.record, theirs, request, pace, client)
        recorder.close({})


@dataclass
class Parts:
    """What :func:`parts` makes."""

    whole: Whole
    words: Words
    record: TickArray
    end: socket.socket
    request: StopRequest
    pace: Pace
    client: DriveClient

    def silent(self) -> bool:
        """Nothing was sent, nothing stored."""
        with pytest.raises(BlockingIOError):
            self.end.recv(128)
        return True


def test_a_tick_that_is_late_by_periods_is_the_one_whose_time_it_is(parts: Parts) -> None:
    due_ns = time.monotonic_ns() - 3 * PATIENT_NS
    assert parts.whole(7, due_ns, False) == SENT
    tick = parts.record[0]
    assert (tick["k"], tick["t_ns"], tick["gap"], tick["skipped"]) == (10, due_ns + 3 * PATIENT_NS, 4, 3)
    assert 0 <= tick["lateness_ns"] < PATIENT_NS


def test_python_has_its_turn_by_time_not_by_ticks(parts: Parts) -> None:
    """A drive that is dead makes each tick many periods long: a signal is not to wait for four of them."""
    parts.words.cells[GUARD_NS] = time.monotonic_ns()
    assert parts.whole(7, time.monotonic_ns(), False) == SENT, "what is asked is new"
    assert parts.whole(8, time.monotonic_ns() - 3 * PATIENT_NS, False) == RECORDED
    assert (parts.pace[RAN], parts.pace[LOST], parts.record["k"][0]) == (1, 3, 11)


def test_nothing_is_sent_once_the_guardian_has_fired(parts: Parts) -> None:
    parts.words.cells[FIRED] = 1
    assert parts.whole(7, time.monotonic_ns(), False) == BEGUN
    assert parts.silent() and parts.words.cells[BEAT_NS] > 0


def test_what_was_left_of_a_tick_is_not_the_next_ones(parts: Parts) -> None:
    """A command that the bus refused, and the guardian fires before the loop hears of it."""
    parts.words.cells[GUARD_NS] = time.monotonic_ns()
    parts.client._port.io[LEFT] = -errno.ENOBUFS
    parts.words.cells[FIRED] = 1
    assert parts.whole(7, time.monotonic_ns(), False) == BEGUN
    parts.client.receive(parts.record[0], 0)
    assert parts.record["rx_flags"][0] == 0


def test_a_signal_ends_the_sleep(parts: Parts) -> None:
    """So that its handler can run before the tick."""
    seen: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: seen.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        begin_ns = time.monotonic_ns()
        assert parts.whole(7, begin_ns + 20 * 10**9, False) == NOT_BEGUN
    finally:
        signal.signal(signal.SIGALRM, before)
    assert seen == [signal.SIGALRM] and time.monotonic_ns() - begin_ns < 10 * 10**9
    assert parts.silent()


def test_a_tick_sleeps_to_its_deadline(parts: Parts) -> None:
    deadline_ns = time.monotonic_ns() + 30_000_000
    parts.request.value = Request.STOP
    parts.whole(7, deadline_ns, True)
    assert CLASSIC.unpack(parts.end.recv(128))[0] == SYNC
    tick = parts.record[0]
    assert (tick["k"], tick["t_ns"], tick["request"], tick["log_failed"]) == (7, deadline_ns, 3, 1)
    assert (tick["gap"], tick["skipped"]) == (1, 0)
    stamps = [tick[name] for name in ("lateness_ns", "received_ns", "computed_ns", "sent_ns")]
    assert stamps == sorted(stamps) and stamps[0] >= 0 and stamps[1] >= TIMEOUT_NS


@pytest.mark.parametrize("pacing", PACINGS)
def test_what_has_no_socket_is_compiled_too(tmp_path: Path, channel: str, pacing: Pacing) -> None:
    """By python-can's own send and receive: see also the cases of :data:`PLAIN`."""
    setup, link = setup_of(), open_link(BusSettings("virtual", channel))
    machine, header = setup.machine, header_of(setup, "run", "x")
    recorder = open_recorder(tmp_path / "run.mcap", header, 1000)
    client, plan = DriveClient(link, setup.database), Plan(PERIOD_NS, TIMEOUT_NS, pacing, TICKS)
    client.prepare(recorder.record[0])
    parts = client, None, machine, recorder, plan, StopRequest(), new_pace()
    assert fused.whole_tick(*parts) is not none_compiled
    client.compiled = lambda: None  # type: ignore[method-assign]
    assert fused.whole_tick(*parts) is none_compiled
    link.close()
    recorder.close({})
