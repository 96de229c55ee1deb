"""The emulated CiA 402 node by hand-written frames: NMT, SDO's rules for PDOs, states, stops, EMCY.

BaseNode402 of the canopen library, which knows nothing of ours, walks its states in the end.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402, OperationMode

from drivers.bus import Frame
from drivers.codec import Database
from firmware_model.config import PlantConfig, build_params
from firmware_model.node import Node, wire_of
from hil.config.tables import load_toml
from tests.canopen import E35, EDS, NODE, emulated
from tests.contract.test_drive_firmware import Wires

pytestmark = pytest.mark.alone

DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x0040, 0x0021, 0x0033, 0x0037, 0x0017, 0x0008
STATE_BITS = 0x7F
WRONG_STATE, NO_MAPPING, TOO_LONG, OUT_OF_RANGE = 0x08000022, 0x06040041, 0x06040042, 0x06090030


class Bench:
    """A node and a hand that writes frames."""

    def __init__(self, configs: Path, *settings: str) -> None:
        path = configs / "plants" / "cia402.toml"
        config = load_toml(path, PlantConfig, settings)
        database = Database(path.parent / config.dbc, config.node_id)
        self.link = Wires()
        self.node = Node(
            self.link, database, build_params(config, wire_of(database, "cia402")), clock="lockstep",
            pacing="sync", period_ns=1_000_000, truth=False, protocol="cia402", eds=path.parent / config.eds,
        )  # fmt: skip

    def put(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Send a frame; what is answered at once."""
        self.link.sent.clear()
        self.node.take(Frame(can_id, data, 0, False))
        return list(self.link.sent)

    def nmt(self, command: int, node: int = NODE) -> list[tuple[int, bytes]]:
        return self.put(0x000, bytes((command, node)))

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """An SDO download; 0, or the abort code."""
        data = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        [(can_id, answer)] = self.put(0x605, data + (value % (1 << 32)).to_bytes(4, "little"))
        assert can_id == 0x585 and answer[1:4] == data[1:4]
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0) -> int:
        [(_, answer)] = self.put(0x605, b"\x40" + struct.pack("<HB", index, sub) + bytes(4))
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little")

    def map(self) -> None:
        """RPDO 1: 6040h, 6071h; TPDO 1: 6041h, 606Ch, 6077h; with SYNC; mode CST."""
        for pdo, cob_id, entries in (
            (0x1400, 0x205, (0x60400010, 0x60710010)),
            (0x1800, 0x185, (0x60410010, 0x606C0020, 0x60770010)),
        ):
            done = [self.write(pdo + 0x200, k, entry, 4) for k, entry in enumerate(entries, 1)]
            done.append(self.write(pdo + 0x200, 0, len(entries), 1))
            done += [self.write(pdo, 2, 1, 1), self.write(pdo, 1, cob_id, 4)]
            assert not any(done)
        assert self.write(0x6060, 0, 10, 1) == 0

    def tick(self, controlword: int, torque: int = 0) -> tuple[int, int, int]:
        """A command and a SYNC: statusword's state, velocity, torque."""
        assert self.put(0x205, struct.pack("<Hh", controlword, torque)) == []
        return self.sync()

    def sync(self) -> tuple[int, int, int]:
        answers = dict(self.put(0x080, b""))
        word, velocity, torque = struct.unpack("<Hih", answers[0x185])
        return word & STATE_BITS, velocity, torque

    def enable(self) -> None:
        assert self.nmt(1) == []
        assert [self.tick(word)[0] for word in (0x06, 0x07, 0x0F)] == [READY, SWITCHED_ON, ENABLED]


@pytest.fixture
def bench(configs: Path) -> Bench:
    made = Bench(configs)
    made.map()
    return made


def test_a_node_that_is_not_mapped_has_nothing_but_sdo_and_a_heartbeat(configs: Path) -> None:
    bench = Bench(configs)
    assert bench.put(0x080, b"") == [] and bench.nmt(1) == [] and bench.put(0x080, b"") == []
    assert bench.read(0x1000) == 0x00020192 and bench.read(0x6041) & STATE_BITS == DISABLED
    assert bench.read(0x1017) == 100 and bench.put(0x605, bytes(7)) == []


def test_pdos_go_in_operation_alone(bench: Bench) -> None:
    assert bench.put(0x080, b"") == [], "pre-operational"
    bench.enable()
    for command in (2, 128):
        bench.nmt(command)
        assert bench.put(0x205, struct.pack("<Hh", 0x0F, 100)) == [] == bench.put(0x080, b"")
    bench.nmt(1, 6)
    assert bench.put(0x080, b"") == [], "that was for node 6"
    bench.nmt(1, 0)
    assert bench.sync()[0] == DISABLED


def test_commands_are_latched_with_sync(bench: Bench) -> None:
    bench.enable()
    bench.put(0x205, struct.pack("<Hh", 0x0F, 500))
    assert bench.node.state["next_q"] == pytest.approx(6.84) and bench.read(0x6071) == 500
    before = bench.node.state["t_ns"]
    bench.sync()
    assert bench.node.state["t_ns"] - before == 1_000_000


@pytest.mark.parametrize(
    ("words", "state"),
    [
        ([0x00], DISABLED),
        ([0x06], READY),
        ([0x07], SWITCHED_ON),
        ([0x02], DISABLED),  # 605Ah = 0: quick stop takes the voltage off
        ([0x80], DISABLED),
        ([0x0F], ENABLED),
        ([0x07, 0x0F], ENABLED),
        ([0x06, 0x0F], SWITCHED_ON),
    ],
)
def test_leaving_operation(bench: Bench, words: list[int], state: int) -> None:
    bench.enable()
    assert [bench.tick(word, 10)[0] for word in words][-1] == state


@pytest.mark.parametrize(("code", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, DISABLED)])
def test_leaving_operational_while_enabled(bench: Bench, code: int, state: int) -> None:
    """6007h: nothing, fault, voltage off, quick stop (which is voltage off by 605Ah = 0)."""
    assert bench.write(0x6007, 0, code, 2) == 0
    bench.enable()
    bench.nmt(128)
    assert bench.read(0x6041) & STATE_BITS == state
    emergencies = [data for can_id, data in bench.put(0x080, b"") if can_id == 0x085]
    assert emergencies == ([bytes.fromhex("0081110000000000")] if code == 1 else [])


def test_quick_stop_with_a_ramp(bench: Bench) -> None:
    """605Ah = 6: rated torque against the speed, then it stays in quick stop; 0x00 leaves it."""
    assert bench.write(0x605A, 0, 6, 2) == 0 and bench.write(0x605A, 0, 1, 2) == OUT_OF_RANGE
    bench.enable()
    bench.node.state["x"][0] = 30.0
    assert bench.tick(0x02)[0] == QUICK_STOP and bench.node.state["state"] == 4
    assert bench.node.state["next_q"] == pytest.approx(-13.68)
    bench.node.state["x"][0] = 0.5
    assert bench.tick(0x02)[0] == QUICK_STOP and bench.node.state["state"] == 5
    assert bench.tick(0x0F)[0] == QUICK_STOP and bench.tick(0x00)[0] == DISABLED


def test_a_quick_stop_waits_for_sync_like_every_command(bench: Bench) -> None:
    """Without SYNC it acts no more than a torque does; the newest command before a SYNC is the one."""
    bench.enable()
    stop, go = (struct.pack("<Hh", word, 100) for word in (0x02, 0x0F))
    bench.put(0x205, stop)
    assert bench.node.state["state"] == 4
    bench.put(0x205, go)
    assert bench.sync()[0] == ENABLED
    bench.put(0x205, stop)
    assert bench.node.state["state"] == 4 and bench.sync()[0] == DISABLED


def test_the_deadline_of_the_command_latches(configs: Path) -> None:
    """1400h:5 = 3 ms: EMCY 8250h with the fault, code 0 when it is reset."""
    bench = Bench(configs)
    assert bench.write(0x1400, 5, 3, 2) == 0
    bench.map()
    bench.enable()
    sent = [frame for _ in range(6) for frame in bench.put(0x080, b"")]
    assert [data for can_id, data in sent if can_id == 0x085] == [bytes.fromhex("5082110000000000")]
    assert bench.read(0x603F) == 0x8250 and bench.read(0x6041) & STATE_BITS == FAULT
    assert bench.tick(0x0F)[0] == FAULT
    bench.put(0x205, struct.pack("<Hh", 0x80, 0))
    answers = dict(bench.put(0x080, b""))
    assert answers[0x085] == bytes(8) and answers[0x185][0] == DISABLED


def test_a_short_rpdo_is_not_taken(bench: Bench) -> None:
    bench.enable()
    assert bench.put(0x205, b"\x00\x00") == [(0x085, bytes.fromhex("1082110000000000"))]
    assert bench.sync()[0] == ENABLED


def test_rules_of_mapping(bench: Bench) -> None:
    """CiA 301's abort codes, each by the change that it answers."""
    assert bench.write(0x1A00, 1, 0x60410010, 4) == WRONG_STATE, "the PDO is on"
    assert bench.write(0x1800, 1, 0x186, 4) == WRONG_STATE, "another identifier while it is on"
    assert bench.write(0x1800, 1, 0x80000185, 4) == 0
    assert bench.write(0x1A00, 1, 0x60410010, 4) == WRONG_STATE, "entries count still"
    assert bench.write(0x1A00, 0, 0, 1) == 0
    assert bench.write(0x1A00, 1, 0x10170010, 4) == NO_MAPPING
    assert bench.write(0x1A00, 1, 0x60410008, 4) == NO_MAPPING, "another length"
    assert bench.write(0x1A00, 1, 0x69990010, 4) == 0x06020000
    assert bench.write(0x1A00, 4, 0x60780010, 4) == 0
    assert bench.write(0x1A00, 0, 4, 1) == TOO_LONG, "ten bytes"
    assert bench.write(0x1800, 2, 250, 1) == OUT_OF_RANGE
    assert bench.write(0x6060, 0, 3, 1) == OUT_OF_RANGE
    assert bench.write(0x1010, 1, 0x12345678, 4) == 0x08000020
    assert bench.write(0x6041, 0, 0, 2) == 0x06010002 and bench.write(0x6040, 0, 0, 4) == 0x06070010
    bench.nmt(1)
    assert bench.write(0x1800, 2, 1, 1) == WRONG_STATE, "operational"


def test_every_so_many_syncs(bench: Bench) -> None:
    assert bench.write(0x1800, 2, 3, 1) == 0
    bench.nmt(1)
    assert [len(bench.put(0x080, b"")) for _ in range(9)] == [0, 0, 1] * 3


def test_reset_boots_anew(bench: Bench) -> None:
    bench.enable()
    assert bench.nmt(0x81) == [(0x705, b"\x00")]
    assert bench.read(0x1A00) == 0 and bench.read(0x6060) == 0


def test_two_runs_are_the_same_to_the_bit(configs: Path) -> None:
    def run() -> list[tuple[int, int, int]]:
        bench = Bench(configs)
        bench.map()
        bench.enable()
        return [bench.tick(0x0F, 300) for _ in range(50)]

    assert run() == run()


@pytest.fixture
def judge(request: pytest.FixtureRequest, configs: Path, channel: str) -> Iterator[BaseNode402]:
    """Strangers' view of the emulated drive, over a bus, by an EDS."""
    network = canopen.Network()
    with emulated(configs, channel):
        network.connect(interface="hil-local", channel=channel)
        node = network.add_node(BaseNode402(NODE, str(getattr(request, "param", EDS))))
        try:
            yield node
        finally:
            network.disconnect()


@pytest.mark.parametrize("judge", [EDS, E35], indirect=True, ids=["ours", "whole"])
def test_a_strangers_state_machine_walks_it(judge: BaseNode402) -> None:
    """By SDO, unmapped: each state is reached, and read back, by canopen's own table of CiA 402."""
    assert judge.state == "SWITCH ON DISABLED"
    for state in (
        "READY TO SWITCH ON",
        "SWITCHED ON",
        "OPERATION ENABLED",
        "SWITCHED ON",
        "SWITCH ON DISABLED",
    ):
        judge.state = state
        assert judge.state == state
    judge.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert judge.op_mode == "CYCLIC SYNCHRONOUS TORQUE" and judge.is_op_mode_supported(judge.op_mode)
    assert OperationMode.NAME2CODE[judge.op_mode] == 10


def test_a_strangers_state_machine_walks_it_over_pdos(judge: BaseNode402) -> None:
    """Mapped by canopen's own PDO classes; SYNC by its producer, the command by its cyclic sender."""
    judge.nmt.wait_for_heartbeat(10)
    judge.rpdo.read()
    judge.tpdo.read()
    for pdo, names in ((judge.rpdo[1], ("Controlword", "Target torque")), (judge.tpdo[1], ("Statusword",))):
        pdo.clear()
        for name in names:
            pdo.add_variable(name)
        pdo.trans_type, pdo.enabled = 1, True
    judge.pdo.save()
    judge.setup_402_state_machine()
    judge.nmt.state = "OPERATIONAL"
    heard = threading.Event()
    judge.tpdo[1].add_callback(lambda _: heard.set())
    judge.rpdo[1].start(0.005)
    judge.network.sync.start(0.005)
    try:
        assert heard.wait(5)
        judge.state = "OPERATION ENABLED"
        assert judge.state == "OPERATION ENABLED"
        judge.state = "SWITCH ON DISABLED"
    finally:
        judge.network.sync.stop()
        judge.rpdo[1].stop()
