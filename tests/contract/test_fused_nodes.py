"""The compiled tick of two nodes against the loop's own rules, as `test_fused.py` has it for one drive.

Each node has a socket of its own, as on a real bus; both drives answer the first one's SYNC.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.bus import SocketLink
from drivers.client import DriveClient
from drivers.local import CLASSIC, pack_frame
from hil.log.reader import Log, open_log
from hil.log.recorder import Recorder
from hil.runtime import fusednodes
from hil.runtime.clock import RealClock
from hil.runtime.guardian import FIRED, GUARD_NS, GUARDIAN_LOST_NS, Words
from hil.runtime.inbox import Inbox
from hil.runtime.loop import Plan, StopRequest, Whole, no_whole
from hil.runtime.nodes import Axis, NodesLoop
from hil.runtime.nodesession import _places, nodes_header
from hil.runtime.nodesetup import load_node_setups
from hil.runtime.rules import BEGUN, DECIDED, RAN, READ, RECORDED, SENT, Pace
from hil.runtime.session import set_by_others
from hil.runtime.setup import Overrides
from hil.signals import FIELDS, Reason, RxFlag
from tests.conftest import CONFIGS
from tests.contract import virtual
from tests.contract.test_fused import ANSWER_NS, PERIOD_NS, TICKS, TIMEOUT_NS, TOGETHER
from tests.contract.virtual import TIME

pytestmark = [pytest.mark.compiled, pytest.mark.process, pytest.mark.beside]

MOTOR, LOAD = 0, 1
SYNC, FEEDBACK, SLOW, COMMAND, EMERGENCY = (
    0x080,
    (0x185, 0x186),
    (0x285, 0x286),
    (0x205, 0x206),
    (0x085, 0x086),
)
FAULTED, STATUSWORD = 0x08, {0x0: 0x40, 0x6: 0x21, 0x7: 0x23, 0xF: 0x27}


class Bench:
    """Both drives over the other ends of the loop's sockets; ``act`` says how the n-th SYNC is answered."""

    def __init__(self, setups: Any, wires: list[socket.socket], words: Words, act: Act) -> None:
        self.ends, self.words, self._act = wires, words, act
        self._feedback = [setup.database.message("TPDO1") for setup in setups.values()]
        self._slow = [setup.database.message("TPDO2") for setup in setups.values()]
        self.state, self._beats, self.turning = [0x40, 0x40], 0, (0.0, 0.0)
        self.heard: list[tuple[int, int]] = []
        self.operator = StopRequest()
        self._then: list[Callable[[], None]] = []

    def listen(self) -> None:
        """Take all that the loop has sent."""
        for node, end in enumerate(self.ends):
            with contextlib.suppress(OSError):  # nothing more, or no longer an end
                while True:
                    self.take(node, end.recv(128, socket.MSG_DONTWAIT))

    def take(self, node: int, raw: bytes) -> None:
        can_id, _, data = CLASSIC.unpack(raw)
        self.heard.append((node, can_id))
        if can_id == COMMAND[node]:
            self.state[node] = STATUSWORD.get(data[0] | data[1] << 8, self.state[node])
            if node == LOAD and self._then:
                self._then.pop()()
        if can_id == SYNC and node == MOTOR:
            TIME.after(ANSWER_NS, self.beat)

    def beat(self) -> None:
        n, self._beats = self._beats, self._beats + 1
        self.words.cells[GUARD_NS] = TIME.now_ns
        with contextlib.suppress(OSError):  # the loop may have ended
            self._act(self, n)

    def after_commands(self, act: Callable[[], None]) -> None:
        """Do that when the load machine's next command has come."""
        self._then.append(act)

    def say(self, node: int, can_id: int, data: bytes) -> None:
        self.ends[node].send(pack_frame(can_id, data))

    def feedback(self, node: int, n: int) -> None:
        """A node's measurement: never twice the same."""
        values = {
            "Statusword": self.state[node],
            "Velocity": self.turning[node] + 0.01 * (n % 7 + node),
            "Torque": 0.01 * (n % 5),
        }
        self.say(node, FEEDBACK[node], self._feedback[node].encode(values))

    def slow(self, node: int, n: int) -> None:
        self.say(node, SLOW[node], self._slow[node].encode({"LoadTorque": 0.1 * (n % 3)}))


Act = Callable[[Bench, int], None]


def calm(bench: Bench, n: int) -> None:
    for node in (MOTOR, LOAD):
        bench.feedback(node, n)
        bench.slow(node, n)


def at(*times: int) -> Callable[[Act], Act]:
    """What is done instead of :func:`calm` on these SYNCs."""

    def made(other: Act) -> Act:
        return lambda bench, n: other(bench, n) if n in times else calm(bench, n)

    return made


def silent(node: int) -> Act:
    return at(30, 31, 50)(lambda bench, n: bench.feedback(1 - node, n))


def late(node: int) -> Act:
    @at(30, 50)
    def act(bench: Bench, n: int) -> None:
        bench.feedback(1 - node, n)
        bench.after_commands(lambda: bench.feedback(node, n))

    return act


def emergency(node: int, code: int = 0) -> Act:
    """An error of a node that is over, or one that is not, before the feedback."""

    @at(30, 50)
    def act(bench: Bench, n: int) -> None:
        bench.say(node, EMERGENCY[node], code.to_bytes(2, "little") + bytes(6))
        bench.state[node] = FAULTED if code else bench.state[node]
        calm(bench, n)

    return act


def emergency_late(node: int) -> Act:
    @at(30, 50)
    def act(bench: Bench, n: int) -> None:
        calm(bench, n)
        bench.after_commands(lambda: bench.say(node, EMERGENCY[node], bytes(8)))

    return act


def second_master(node: int) -> Act:
    @at(60)
    def act(bench: Bench, n: int) -> None:
        bench.say(node, COMMAND[node], bytes(4))
        calm(bench, n)

    return act


def gone(node: int) -> Act:
    @at(60)
    def act(bench: Bench, n: int) -> None:
        bench.ends[node].close()
        bench.feedback(1 - node, n)

    return act


@at(60)
def cut(bench: Bench, n: int) -> None:
    calm(bench, n)
    bench.ends[LOAD].close()


@at(60)
def fault(bench: Bench, n: int) -> None:
    """Its statusword alone says so."""
    bench.state[LOAD] = FAULTED
    calm(bench, n)


@at(60)
def fired(bench: Bench, n: int) -> None:
    bench.words.cells[FIRED] = 1
    calm(bench, n)


def guardian_dies(bench: Bench, n: int) -> None:
    if n >= 60:
        bench.words.cells[GUARD_NS] -= GUARDIAN_LOST_NS + 10**9
    calm(bench, n)


@at(45)
def stopped(bench: Bench, n: int) -> None:
    bench.operator.stop()
    calm(bench, n)


def stopped_turning(bench: Bench, n: int) -> None:
    """The load machine's shaft rests, the motor's ramp takes longer: the one has ended, the other goes on."""
    if n == 45:
        bench.operator.stop()
    bench.turning = (100.0, 0.0) if n < 80 else (0.0, 0.0)
    calm(bench, n)


@at(45)
def stopped_at_once(bench: Bench, n: int) -> None:
    bench.operator.stop()
    bench.operator.stop()
    calm(bench, n)


@dataclass
class Ran:
    """What a run left."""

    path: Path
    stages: Counter[int]
    together: list[int]
    heard: list[tuple[int, int]]
    ended: list[str]
    words: list[int]

    def log(self, node: str) -> Log:
        return open_log(self.path, node=node)


def run(path: Path, case: str, compiled: bool, config: str = "dyno.toml") -> Ran:
    """A run of the loop of two nodes, for a process of virtual time, which it begins anew."""
    TIME.restart()
    settings = ("feedback.hold_ticks=40", "drive.0.reference.w_rad_s=0.0")
    setups = load_node_setups(CONFIGS / config, Overrides(settings=settings))
    assert setups is not None
    stages: Counter[int] = Counter()
    together: list[int] = []
    words, recorder = Words(), Recorder(path, nodes_header(setups, "monotonic"), 1000, 2)
    recorder.await_open()
    request, plan = StopRequest(), Plan(PERIOD_NS, TIMEOUT_NS, "sync", TICKS, together=TOGETHER)
    with contextlib.ExitStack() as held:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in setups]
        for one in (one for pair in pairs for one in pair):
            held.enter_context(one)
        bench = Bench(setups, [theirs for _, theirs in pairs], words, CASES[case][0])
        bench.operator = request
        machines = [setup.machine.fresh() for setup in setups.values()]
        page = held.enter_context(
            contextlib.closing(Inbox(*_places(machines, {n: set_by_others(s) for n, s in setups.items()})))
        )
        clients = [
            DriveClient(
                SocketLink(None, ours, ours),
                one.database,
                on_frames=recorder.frames,
                drive_map=one.binding.map,
            )
            for (ours, _), one in zip(pairs, setups.values(), strict=True)
        ]
        records = [recorder.record, *recorder.more_records]
        axes = [Axis(*parts) for parts in zip(setups, clients, machines, records, strict=True)]

        def counted(pace: Pace) -> Whole:
            made = fusednodes.whole_nodes(axes, words, recorder, plan, request, pace, page.number)

            def whole(*args: Any) -> int:
                stage = made(*args)
                stages[RECORDED] += int(pace[RAN])
                stages[stage] += stage != RECORDED
                together.append(int(pace[RAN]))
                return stage

            return whole

        words.cells[GUARD_NS] = TIME.now_ns
        whole = counted if compiled else no_whole
        loop = NodesLoop(axes, RealClock(), recorder, plan, request, words, whole, page)
        TIME.restart()  # kernels that were compiled meanwhile have waited
        words.cells[GUARD_NS] = TIME.now_ns
        TIME.listen = bench.listen
        try:
            loop.run()
        finally:
            bench.listen()
            TIME.restart()
            recorder.close({"ended": "in time"})
    if TIME.trouble:
        raise TIME.trouble[0]
    ended = [Reason(axis.outcome.reason).name for axis in axes]
    return Ran(path, stages, together, bench.heard, ended, words.cells.tolist()[:7])


def assert_same(rules: Ran, compiled: Ran) -> None:
    """Every field of every record of both nodes, every frame in its order, every event, and the ends."""
    assert compiled.ended == rules.ended
    for node in ("motor", "load"):
        theirs, ours = rules.log(node).ticks, compiled.log(node).ticks
        assert len(theirs) == len(ours)
        for one in FIELDS:
            assert theirs[one.name].tobytes() == ours[one.name].tobytes(), (node, one.name)
    logs = [ran.log("motor") for ran in (rules, compiled)]
    passed = [[(f.t_ns, f.can_id, f.data, f.received) for f in log.frames] for log in logs]
    assert passed[0] == passed[1] and compiled.heard == rules.heard
    told = [[(e["t_ns"], e["k"], e["kind"], e["text"]) for e in log.events] for log in logs]
    assert told[0] == told[1]
    assert compiled.words == rules.words


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[ProcessPoolExecutor]:
    """A process that lives in virtual time."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), virtual.begin) as pool:
        yield pool


STOP, OTHER = "STOP_REQUESTED", "NODE_STOPPED"
CASES: dict[str, tuple[Act, set[int], list[str]]] = {
    # what happens: the act, the stages at which ticks were left to the loop, how motor and load end
    "calm": (calm, {SENT}, [STOP, STOP]),
    "no feedback of the motor": (silent(MOTOR), {SENT}, [STOP, STOP]),
    "no feedback of the load": (silent(LOAD), {SENT}, [STOP, STOP]),
    "late feedback of the motor": (late(MOTOR), {SENT}, [STOP, STOP]),
    "late feedback of the load": (late(LOAD), {SENT}, [STOP, STOP]),
    "motor's error that is over": (emergency(MOTOR), {SENT, BEGUN}, [STOP, STOP]),
    "load's error that is over": (emergency(LOAD), {SENT, BEGUN}, [STOP, STOP]),
    "motor's error": (emergency(MOTOR, 0x4310), {SENT, BEGUN, READ}, ["DRIVE_FAULT", OTHER]),
    "load's error": (emergency(LOAD, 0x4310), {SENT, BEGUN, READ}, [OTHER, "DRIVE_FAULT"]),
    "the load's fault": (fault, {SENT, READ}, [OTHER, "DRIVE_FAULT"]),
    "motor's late error": (emergency_late(MOTOR), {SENT, BEGUN}, [STOP, STOP]),
    "load's late error": (emergency_late(LOAD), {SENT, BEGUN}, [STOP, STOP]),
    "another commands the motor": (second_master(MOTOR), {SENT, BEGUN, READ}, ["FOREIGN_COMMAND", OTHER]),
    "another commands the load": (second_master(LOAD), {SENT, BEGUN, READ}, [OTHER, "FOREIGN_COMMAND"]),
    "the motor's end is gone": (gone(MOTOR), {SENT, BEGUN, READ, DECIDED}, ["BUS_DOWN", "BUS_DOWN"]),
    "the load's end is gone": (gone(LOAD), {SENT, BEGUN, READ, DECIDED}, [OTHER, "SEND_FAILED"]),
    "gone before the commands": (cut, {SENT, BEGUN, READ, DECIDED}, [OTHER, "SEND_FAILED"]),
    "the guardian fires": (fired, {SENT, BEGUN, DECIDED}, ["GUARDIAN", "GUARDIAN"]),
    "the guardian dies": (guardian_dies, {SENT, READ}, ["GUARDIAN_LOST", "GUARDIAN_LOST"]),
    "a stop": (stopped, {SENT}, [STOP, STOP]),
    "a stop of one before the other": (stopped_turning, {SENT}, [STOP, STOP]),
    "a quick stop": (stopped_at_once, {SENT, READ}, ["QUICK_STOP_REQUESTED", "QUICK_STOP_REQUESTED"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_compiled_tick_of_two_nodes_is_the_loops_own(
    case: str, elsewhere: ProcessPoolExecutor, tmp_path: Path
) -> None:
    _, left, ended = CASES[case]
    rules, compiled = (
        elsewhere.submit(run, tmp_path / f"{form}.mcap", case, form).result() for form in (False, True)
    )
    assert_same(rules, compiled)
    assert not rules.stages and max(compiled.together) == TOGETHER
    assert compiled.ended == ended
    assert set(compiled.stages) - {RECORDED} <= left and compiled.stages[RECORDED] > 20, compiled.stages
    if case == "the load's fault":
        assert compiled.stages[READ] == 1, "the laws had run, then the other one stopped"
    if case == "a stop of one before the other":
        ended = compiled.log("load").ticks["reason"] != 0
        assert ended.sum() > 25 and compiled.stages[SENT] < 20, (
            "the one's end leaves the other's ticks compiled"
        )
    if case == "no feedback of the load":
        fresh = [
            (log.ticks["rx_flags"] & int(RxFlag.FRESH) != 0) for log in map(compiled.log, ("motor", "load"))
        ]
        assert fresh[0].all() and (~fresh[1]).sum() == 3


PAIRED = ("calm", "no feedback of the motor", "no feedback of the load", "late feedback of the load",
          "motor's error", "the load's fault", "gone before the commands", "a stop")  # fmt: skip


@pytest.mark.parametrize("case", PAIRED)
def test_so_is_one_law_over_both(case: str, elsewhere: ProcessPoolExecutor, tmp_path: Path) -> None:
    """What each node is told by the other stands in its record, whichever computed it."""
    _, left, ended = CASES[case]
    rules, compiled = (
        elsewhere.submit(run, tmp_path / f"{form}.mcap", case, form, "dyno-fac.toml").result()
        for form in (False, True)
    )
    assert_same(rules, compiled)
    assert compiled.ended == ended and set(compiled.stages) - {RECORDED} <= left, compiled.stages
    motor, load = (compiled.log(node).ticks for node in ("motor", "load"))
    heard = load["rx_flags"] & int(RxFlag.FRESH) != 0
    assert (np.isnan(motor["T_L_in"]) == ~heard).all() and np.abs(motor["T_L"]).max() > 0.1
    going = motor["reason"] == 0  # a motor that must stop with the load has computed once more
    assert np.array_equal(load["i_q_ref_in"][going], 0.0 - motor["T_L"][going] / 3.6)
