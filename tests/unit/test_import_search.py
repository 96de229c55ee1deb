"""Import finds a disturbed run's own ticks again: the real loop in a world whose hold-ups are scripted.

The world is a fake clock, a bus and a drive that measures small random numbers. It keeps the frames twice: as
the controller read and sent them, and as a listener on the wire saw them. No process, no wall time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

from drivers.client import DriveClient
from drivers.codec import Message
from drivers.mapping import MEASURED
from hil.exchange.periods import HELD_PERIODS, Heard, periods
from hil.exchange.rerun import FAR_NS, Run, Tape, roles_of
from hil.exchange.search import DEEP_TRIES, TRIES, NotOursError, Search
from hil.runtime.loop import Loop, Plan, StopRequest
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import FIELDS, DriveState, RxFlag, TickArray, new_ticks
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

MS = 1_000_000
US = 1_000
STATES = {6: 2, 7: 3, 15: 4}
Hold = Callable[[str, int], int]
"""How long the controller is held up at a point of a tick [ns]: wake, read, sync, send; or the drive."""


@cache
def setup_of(name: str, *more: str) -> Setup:
    patient = ("feedback.hold_ticks=150", "feedback.quick_stop_ticks=200", "loop.max_gap_ticks=64")
    return load_setup(CONFIGS / name, Overrides(settings=(*patient, *more)))


SLOW, FIRST = 10, 5
"""Measurements to a status, and to the first: the drive is not enabled before that has come."""
HEALTHY = {"v_dc": 540.0, "temperature_motor": 25.0, "temperature_inverter": 25.0}


class World:
    """Clock, drive port and recorder of a loop, all of one time.

    ``slow``: when the drive says its status: before its measurement as the emulated drives do, after it in
    one go, or late, once the controller has read the measurement. ``first``: with which measurement first.
    """

    failed = False

    def __init__(
        self, setup: Setup, hold: Hold, seed: int = 1, slow: str = "before", first: int = FIRST
    ) -> None:
        self.tape, self.binding, self._hold = Tape(), setup.binding, hold
        self._slow, self._first = slow, first
        self.client = DriveClient(self.tape, setup.database, drive_map=setup.binding.map, now=lambda: 0)
        self.now, self.n, self.period_ns = 0, 0, setup.config.loop.period_ns
        self.rng = np.random.default_rng(seed)
        self.queue: deque[Heard] = deque()
        self.wire: list[Heard] = []
        self.own: list[Heard] = []
        self.ticks: list[TickArray] = []
        self._bound = next(b for b in setup.binding.incoming if {p for p, _ in b.parts} & set(MEASURED))
        self._count, self._state, self._echo = 0, 0, 0
        self._due: deque[int] = deque() if setup.binding.sync else deque([self.period_ns])

    def _measure(self, t_ns: int) -> None:
        self._count += 1
        w, i_q, i_d = self.rng.uniform(-0.05, 0.05, 3)
        off_by_one = 1 if self._state == 4 else 0
        state = off_by_one if self.binding.map.states else self._state
        given = {"speed": w * 9.549 if "Rpm" in dict(self._bound.parts).values() else w}
        given |= {"i_q": i_q, "i_d": i_d, "state": state, "echo": self._echo}
        values = {signal: given.get(part, 0.0) for part, signal in self._bound.parts}
        values[self._bound.counter] = self._count % self._bound.counter_modulus
        message = self._bound.message
        if self._slow == "before":
            self._say_slow(t_ns)
        self._say(t_ns, message, values)
        if self._slow == "after":
            self._say_slow(t_ns)

    def _say_slow(self, t_ns: int) -> None:
        if self._count % SLOW != self._first:
            return
        for bound in self.binding.slow:
            values = {signal: HEALTHY.get(part, 0.0) for part, signal in bound.parts}
            if bound.counter:
                values[bound.counter] = self._count // SLOW % bound.counter_modulus
            self._say(t_ns, bound.message, values)

    def _say(self, t_ns: int, message: Message, values: Mapping[str, float]) -> None:
        frame = Heard(t_ns, message.send_id, True, message.fd, message.encode(values))
        self.queue.append(frame)
        self.wire.append(frame)

    def _pass(self, t_ns: int) -> None:
        """Let time pass; what the drive has to say by then is said."""
        while self._due and self._due[0] <= t_ns:
            due_ns = self._due.popleft()
            if not self.binding.sync:
                self._due.append(due_ns + self.period_ns + self._hold("drive", self._count))
            self._measure(due_ns)
        self.now = max(self.now, t_ns)

    def _held(self, point: str) -> None:
        self._pass(self.now + 10 * US + self._hold(point, self.n))

    def _sent(self) -> None:
        for can_id, data in self.tape.sent:
            frame = Heard(self.now, can_id, False, len(data) > 8, data)
            self.own.append(frame)
            self.wire.append(frame._replace(received=True))
            if self.binding.sync and can_id == self.binding.sync.send_id:
                self._due.append(self.now + 200 * US + self._hold("drive", self.n))
        self.tape.sent.clear()

    def now_ns(self) -> int:
        return self.now

    def sleep_until(self, deadline_ns: int) -> int:
        self._pass(deadline_ns)
        self._held("wake")
        return self.now

    def receive_deadline(self, deadline_ns: int, timeout_ns: int) -> int:
        return deadline_ns + timeout_ns

    def prepare(self, tick: Any) -> None:
        self.client.prepare(tick)

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        self._held("read")
        self.own += [frame._replace(t_ns=self.now) for frame in self.queue]
        self.tape.lay(self.queue)
        self.queue.clear()
        self.client._cells[0] = 0
        self.client.follow(tick)
        self._held("sync")
        self.client._send_sync()
        self._sent()
        self.receive(tick, deadline_ns)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        if deadline_ns > self.now:
            self._held("read")
        while True:
            if self.queue:
                self.own.append(self.queue[0]._replace(t_ns=self.now))
                self.tape.lay([self.queue.popleft()])
                self.client.receive(tick, FAR_NS)
                if int(tick["rx_flags"]) & RxFlag.FRESH:
                    return
            elif self._due and self._due[0] <= deadline_ns:
                self._pass(self._due[0] + 5 * US)
            else:
                self._pass(max(deadline_ns, self.now))
                return

    def send(self, tick: Any) -> None:
        self._held("send")
        if self._slow == "late":
            self._say_slow(self.now)
        self.client.send(tick)
        self._sent()
        self._state, self._echo = STATES.get(int(tick["controlword"]), 1), int(tick["counter"])
        self.n += 1

    def stop(self) -> None:
        self.client.stop()
        self._sent()

    def close(self) -> None:
        pass

    def tick(self, ticks: TickArray) -> None:
        self.ticks.append(ticks.copy())

    def event(self, t_ns: int, k: int, kind: str, text: str) -> None:
        pass


def ran(
    name: str, hold: Hold, ticks: int = 300, seed: int = 1, slow: str = "before", first: int = FIRST
) -> World:
    """A run in such a world."""
    setup = setup_of(name)
    world, machine = World(setup, hold, seed, slow, first), setup.machine.fresh()

    def step(record: TickArray) -> None:
        machine.prepare(record)
        machine.step(record)

    loop = setup.config.loop
    plan = Plan(loop.period_ns, loop.timeout_ns, loop.pacing, ticks)
    Loop(world, world, world, step, new_ticks(), plan, StopRequest()).run()
    return world


def found(frames: Iterable[Heard], setup: Setup) -> tuple[Run, Iterator[TickArray]]:
    """What import makes of frames."""
    run, loop = Run(setup), setup.config.loop
    return run, Search(run).ticks(periods(frames, run.roles, loop.timeout_ns, loop.period_ns, HELD_PERIODS))


TIMES = {"k", "t_ns", "lateness_ns", "received_ns", "computed_ns", "sent_ns", "recorded_ns"}


def assert_same(world: World, frames: Iterable[Heard], name: str, *unseen: str) -> Run:
    """Import finds each tick of the world's run again, in all but its times and where k begins.

    ``unseen``: fields that may differ where no command depends on them; k and reference are right at each
    measurement.
    """
    run, ticks = found(frames, setup_of(name))
    back, true = np.concatenate(list(ticks)), np.concatenate(world.ticks)
    operating = true["state"] == DriveState.OPERATION_ENABLED
    assert len(back) == len(true) > 100 and operating.sum() > 80
    fields = [field.name for field in FIELDS if field.name not in TIMES]
    differ = {field for field in fields if back[field].tobytes() != true[field].tobytes()}
    other = np.nonzero(true["gap"] != back["gap"])[0]
    assert differ <= set(unseen), (differ, [(i, true["gap"][i], back["gap"][i]) for i in other])
    measured = operating & (true["rx_flags"] & RxFlag.FRESH > 0)
    assert len(np.unique(true["k"][measured].astype(int) - back["k"][measured].astype(int))) == 1
    assert all((true[name][measured] == back[name][measured]).all() for name in ("w_ref", "dw_ref"))
    return run


def at(**points: dict[int, int]) -> Hold:
    """Hold-ups by point and tick."""
    return lambda point, n: points.get(point, {}).get(n, 0)


@pytest.mark.corners
@pytest.mark.parametrize("name", ["demo.toml", "inverter.toml"])
@pytest.mark.parametrize("seed", range(6))
def test_hold_ups_anywhere_come_back_from_the_controllers_own_recording(name: str, seed: int) -> None:
    """The loop's arithmetic of waits in vain, queues and skipped periods is the import's."""
    rng = np.random.default_rng(seed)
    shares = {"wake": 0.03, "read": 0.03, "sync": 0.003, "send": 0.03, "drive": 0.02}

    def hold(point: str, n: int) -> int:
        jitter = int(rng.exponential(10 * US))
        long = int(rng.choice([0.3, 0.8, 2.0, 5.0, 20.0]) * MS * rng.uniform(0.8, 1.2))
        return jitter + (long if n > 20 and rng.random() < shares[point] else 0)

    world = ran(name, hold, 500, seed)
    true = np.concatenate(world.ticks)
    assert true["skipped"].sum() > 20 and (true["rx_flags"] & RxFlag.FRESH == 0).sum() > 5, f"seed {seed}"
    assert_same(world, world.own, name, "gap", "skipped", "w_ref", "dw_ref")


def commands(frames: list[Heard], setup: Setup) -> list[int]:
    """Places of the commands."""
    ours = setup.binding.command.message.send_id
    return [place for place, frame in enumerate(frames) if frame.can_id == ours]


def syncs(frames: list[Heard]) -> list[int]:
    """Places of SYNC."""
    return [place for place, frame in enumerate(frames) if frame.can_id == 0x80]


def test_a_wrong_gap_of_a_held_tick_shows_later_and_is_taken_back() -> None:
    """The drive is silent for ten periods; the recorder stamps one of the held commands a period late."""
    setup, world = setup_of("inverter.toml"), ran("inverter.toml", at(drive={60: 10 * MS}))
    frames = list(world.own)
    place = commands(frames, setup)[65]
    assert not int(world.ticks[65]["rx_flags"][0]) & RxFlag.FRESH, "a wait in vain"
    frames[place] = frames[place]._replace(t_ns=frames[place].t_ns + MS * 9 // 10)
    assert frames[place].t_ns < frames[place + 1].t_ns
    run = assert_same(world, frames, "inverter.toml")
    assert len(world.ticks) + 5 < run.tries < len(world.ticks) + 500, "gone back, and not far"


def test_a_measurement_on_the_wire_before_the_command_but_after_the_read() -> None:
    """Paced by feedback: the controller is held up between reading and sending."""
    setup, world = setup_of("inverter.toml"), ran("inverter.toml", at(send={40: 1050 * US, 90: 1050 * US}))
    assert [f.can_id for f in world.wire] != [f.can_id for f in world.own], "the listener sees another order"
    place = commands(world.wire, setup)[40]
    assert not {world.wire[place - 1].can_id, world.wire[place - 2].can_id} & set(
        roles_of(setup.binding).commands
    )
    assert_same(world, world.wire, "inverter.toml")


def test_an_answer_on_the_wire_before_the_command_that_was_late_for_the_read() -> None:
    """Paced by SYNC: the answer came after the timeout, the command after the answer."""
    world = ran("demo.toml", at(drive={40: 620 * US}, send={40: 100 * US}))
    assert not int(world.ticks[40]["rx_flags"][0]) & RxFlag.FRESH
    assert [f.can_id for f in world.wire] != [f.can_id for f in world.own]
    assert_same(world, world.wire, "demo.toml")


def test_an_answer_on_the_wire_before_sync_that_was_read_after_it() -> None:
    """Paced by SYNC: the last answer came between the look for late ones and SYNC, and passes for the new."""
    world = ran("demo.toml", at(drive={40: 810 * US}, sync={41: 60 * US}))
    assert not int(world.ticks[40]["rx_flags"][0]) & RxFlag.FRESH
    before = [[f.can_id for f in frames][syncs(frames)[41] - 1] for frames in (world.wire, world.own)]
    assert before == [0x181, 0x201]
    assert_same(world, world.wire, "demo.toml")


@pytest.mark.parametrize("hold", [at(), at(drive={120: 20 * MS}, send={100: 3 * MS, 140: 3 * MS})])
def test_a_command_that_nothing_explains_ends_the_search_soon(hold: Hold) -> None:
    setup, world = setup_of("inverter.toml"), ran("inverter.toml", hold)
    frames = list(world.own)
    place = commands(frames, setup)[150]
    data = bytearray(frames[place].data)
    data[3] ^= 4
    frames[place] = frames[place]._replace(data=bytes(data))
    run, ticks = found(frames, setup)
    measured_ns = next(f.t_ns for f in reversed(frames[:place]) if f.received)
    with pytest.raises(NotOursError, match=f"at {measured_ns * 1e-9:.6f} s this controller sends"):
        list(ticks)
    assert run.tries < 150 + (TRIES + DEEP_TRIES) * 11 // 10


def test_a_pause_in_the_recording_is_bounded_work() -> None:
    """An hour in which nobody sent: more skipped periods than could be tried one by one."""
    world = ran("demo.toml", at())
    place = syncs(world.own)[150]
    late = [f._replace(t_ns=f.t_ns + 3600_000 * MS) for f in world.own[place:]]
    run, ticks = found([*world.own[:place], *late], setup_of("demo.toml"))
    with pytest.raises(NotOursError):
        list(ticks)
    assert run.tries < 300 + (TRIES + DEEP_TRIES) * 11 // 10


def test_a_drive_that_was_there_before_the_controller() -> None:
    """What a drive with a clock of its own sends before the first command is not the run's."""
    world = ran("inverter.toml", at())
    first = commands(world.own, setup_of("inverter.toml"))[0]
    sent = [f._replace(t_ns=f.t_ns - 20 * MS) for f in world.own[:first] * 15]
    sent = [f._replace(t_ns=f.t_ns + i // first * MS) for i, f in enumerate(sent)]
    assert_same(world, [*sent, *world.own], "inverter.toml")


@pytest.mark.parametrize("slow", ["after", "late"])
def test_a_listener_finds_when_the_status_was_read_that_enables_the_drive(slow: str) -> None:
    """On the wire it is between measurement and command; the controller reads it at once, or a tick later.

    No command depends on those that follow: the likely guess stands.
    """
    world = ran("inverter.toml", at(), slow=slow)
    true = np.concatenate(world.ticks)
    enabled = np.nonzero(true["state"] == DriveState.OPERATION_ENABLED)[0][0]
    came = np.nonzero(np.isfinite(true["v_dc"]))[0][0]
    assert came == (FIRST if slow == "late" else FIRST - 1) and enabled - came <= 1
    assert_same(world, world.wire, "inverter.toml", *(("missing", "rx_flags") if slow == "after" else ()))


@pytest.mark.parametrize("slow", ["before", "after", "late"])
@pytest.mark.parametrize("first", [1, FIRST])
def test_the_controllers_own_recording_tells_when_each_status_was_read(slow: str, first: int) -> None:
    """From the first tick on, whose command is the first frame that tells whose recording it is."""
    world = ran("inverter.toml", at(), slow=slow, first=first)
    assert_same(world, world.own, "inverter.toml")


def test_a_recording_without_a_command_is_not_of_this_controller() -> None:
    world = ran("inverter.toml", at())
    with pytest.raises(NotOursError, match="there is no command"):
        list(
            found(
                [frame for frame in world.wire if frame.can_id & 0x1FFFFFFF != 0x18FF1100],
                setup_of("inverter.toml"),
            )[1]
        )
