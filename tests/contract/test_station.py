"""The drive's compiled way on a socket says to the byte what its rules in Python say."""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.bus import Frame, Link, SocketLink, unpack_frame
from drivers.codec import Database
from drivers.local import pack_frame
from firmware_model.config import PlantConfig, build_params
from firmware_model.node import Node, wire_of
from firmware_model.station import STARTED
from hil.config.tables import load_toml
from tests.conftest import CONFIGS

pytestmark = pytest.mark.compiled  # interpreted there is but one way

PERIOD_NS = 1_000_000
ENABLED, FAULT = 4, 7


class Collected:
    """A link that is no socket: what is sent is kept."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes, bool]] = []

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        self.sent.append((can_id, data, fd))

    def receive(self, timeout_ns: int) -> Frame | None:
        return None

    def discard(self) -> int:
        return 0

    def close(self) -> None:
        pass


class Wire:
    """The other end of a drive's socket."""

    def __init__(self) -> None:
        self.hand, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.hand.setblocking(False)
        self.link = SocketLink(None, theirs, theirs)
        self._theirs = theirs

    def put(self, raw: bytes) -> None:
        self.hand.send(raw)

    def serve(self, node: Node) -> None:
        """Let the drive take all that waits."""
        assert node._station is not None
        while select.select([self._theirs], [], [], 0)[0]:
            node._attend(node._station, time.monotonic_ns() + 100_000)

    def heard(self) -> list[tuple[int, bytes, bool]]:
        out = []
        while True:
            try:
                frame = unpack_frame(self.hand.recv(128))
            except BlockingIOError:
                return out
            assert frame is not None
            out.append((frame.can_id | frame.flags, frame.data, frame.fd))

    def close(self) -> None:
        self.hand.close()
        self._theirs.close()


@pytest.fixture
def wire() -> Iterator[Wire]:
    one = Wire()
    yield one
    one.close()


def drive(link: Link, plant: str, *settings: str, clock: Any = "lockstep") -> tuple[Node, Database]:
    path = CONFIGS / "plants" / plant
    config = load_toml(path, PlantConfig, settings)
    database = Database(path.parent / config.dbc, config.node_id)
    params = build_params(config, wire_of(database))
    return Node(
        link, database, params, clock=clock, pacing="sync", period_ns=PERIOD_NS, truth=config.truth
    ), database


class Pair:
    """The same drive twice: on a socket, compiled, and by its rules in Python."""

    def __init__(self, wire: Wire, plant: str, *settings: str) -> None:
        self.wire, self.plain = wire, Collected()
        self.compiled, self.database = drive(wire.link, plant, *settings)
        self.ruled, _ = drive(self.plain, plant, *settings)
        assert self.compiled._station is not None and self.ruled._station is None
        self.count = 0

    def put(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """One frame to both; what they answer and what they are is the same."""
        self.wire.put(pack_frame(can_id, data, fd))
        self.wire.serve(self.compiled)
        frame = unpack_frame(pack_frame(can_id, data, fd))
        assert frame is not None
        self.ruled.take(frame)
        heard, said = self.wire.heard(), self.plain.sent
        assert heard == said, f"{can_id:x} {data.hex()}"
        self.plain.sent = []
        a, b = self.compiled.state, self.ruled.state
        assert a.tobytes() == b.tobytes(), [n for n in a.dtype.names if a[n].tobytes() != b[n].tobytes()]
        assert self.compiled.ignored == self.ruled.ignored

    def sync(self) -> None:
        self.count = self.count % 240 + 1
        self.put(0x80, bytes((self.count,)))

    def command(self, controlword: int, u_q: float = 0.0, u_d: float = 0.0, **more: float) -> bytes:
        message = self.database.message("COMMAND")
        values = {"Controlword": controlword, "VoltageQ": u_q, "VoltageD": u_d, **more}
        data = message.encode({"Counter": (self.count + 1) % message.counter_modulus, **values})
        self.put(message.can_id, data, message.fd)
        return data

    def enable(self) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.command(word)
            self.sync()
        assert self.compiled.state["state"] == ENABLED


@pytest.mark.parametrize("plant", ["demo.toml", "paper.toml", "matched.toml"])
def test_a_drive_that_is_driven(wire: Wire, plant: str) -> None:
    """Turned by a voltage that changes, through its load step, with STATUS when it is due."""
    pair = Pair(wire, plant, "firmware.watchdog_ms=400.0")
    pair.sync()
    pair.enable()
    rng = np.random.default_rng(1)
    for _ in range(400):
        u_q, u_d = rng.uniform(0.0, 60.0), rng.uniform(-5.0, 5.0)
        pair.command(0x0F, round(u_q, 2), round(u_d, 2))
        pair.sync()
    assert pair.compiled.state["state"] == ENABLED and abs(pair.compiled.state["x"][0]) > 1.0
    assert not pair.compiled.ignored


@pytest.mark.parametrize("plant", ["demo.toml", "paper.toml"])
def test_a_commanded_load(wire: Wire, plant: str) -> None:
    pair = Pair(wire, plant)
    pair.sync()
    pair.enable()
    for torque in (0.0, 1.5, -2.25, 1.0):
        if load := pair.database.messages.get("LOAD_COMMAND"):
            values = {
                "Counter": pair.count % load.counter_modulus,
                "Enable": torque != 1.0,
                "LoadTorque": torque,
            }
            data = load.encode(values)
            pair.put(load.can_id, data)
            pair.put(load.can_id, data)  # repeated
            pair.command(0x0F, 10.0)
        else:
            pair.command(0x0F, 10.0, LoadEnable=torque != 1.0, LoadTorque=torque)
        pair.sync()
        assert pair.compiled.state["T_commanded"] == (0.0 if torque == 1.0 else torque)


@pytest.mark.parametrize("plant", ["demo.toml", "paper.toml"])
def test_frames_that_are_not_whole_valid_and_fresh(wire: Wire, plant: str) -> None:
    """Random and spoiled frames leave both the same, counted by what was wrong."""
    pair = Pair(wire, plant, "firmware.watchdog_ms=1000.0")
    pair.sync()
    pair.enable()
    rng = np.random.default_rng(2)
    fd = pair.database.message("COMMAND").fd
    for turn in range(300):
        data = bytearray(pair.command(0x0F, float(turn % 20)))
        kind = turn % 7
        if kind == 0:
            pair.put(0x201, bytes(data), fd)  # repeated
        elif kind == 1:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            pair.put(0x201, bytes(data), fd)
        elif kind == 2:
            pair.put(0x201, bytes(data[: rng.integers(len(data))]), fd)
        elif kind == 3:
            pair.put(0x80, bytes(rng.integers(0, 256, 2).tolist()))
        elif kind == 4:
            flags = int(rng.choice([0x80000000, 0x40000000, 0x20000000]))
            pair.put(0x201 | flags, bytes(data), fd)
        elif kind == 5:
            pair.put(int(rng.integers(0x7FF)) | 0x400, bytes(rng.integers(0, 256, 8).tolist()))
        else:
            pair.put(0x80, b"")  # CANopen: SYNC without a counter
        pair.sync()
    ignored = pair.compiled.ignored
    assert min(ignored[what] for what in ("repeated", "crc", "length", "flags")) > 30, ignored


def test_another_mode_is_not_taken(wire: Wire) -> None:
    pair = Pair(wire, "demo.toml")
    pair.sync()
    pair.command(0x06, Mode=1)
    pair.sync()
    assert pair.compiled.ignored == {"mode": 1} and pair.compiled.state["echo"] == 15
    pair.enable()


def test_a_fault_sends_its_emergency_message(wire: Wire) -> None:
    pair = Pair(wire, "demo.toml", "firmware.watchdog_ms=5.0")
    pair.sync()
    pair.enable()
    for _ in range(8):
        pair.sync()
    assert pair.compiled.state["state"] == FAULT and pair.compiled.state["error"] == 0x8130


def test_what_is_no_frame_is_passed_over(wire: Wire) -> None:
    pair = Pair(wire, "demo.toml")
    for junk in (b"", b"x", bytes(15), bytes(17), bytes(73), pack_frame(0x80, b"")[:4] + b"\x09" + bytes(11)):
        wire.put(junk)
    pair.sync()
    assert pair.compiled._cells[STARTED] and not pair.compiled.ignored


def test_answers_that_the_bus_does_not_take_are_counted(wire: Wire) -> None:
    """As by the rules; the plant moves on and answers again once it can."""
    node, _ = drive(wire.link, "demo.toml")
    own, nowhere = wire.link.fds[1], os.open("/dev/null", os.O_WRONLY)  # no socket: ENOTSOCK
    wire.link.fds[1] = nowhere
    wire.put(pack_frame(0x80, b"\x01"))
    wire.serve(node)
    assert node.ignored == {"send": 3} and wire.heard() == []
    wire.link.fds[1] = own
    os.close(nowhere)
    wire.put(pack_frame(0x80, b"\x02"))
    wire.serve(node)
    assert [can_id for can_id, _, _ in wire.heard()] == [0x481, 0x181] and node.ignored == {"send": 3}
    assert node.state["t_ns"] == PERIOD_NS


@pytest.mark.alone
def test_in_real_time_the_plant_moves_by_the_clock(wire: Wire) -> None:
    node, database = drive(wire.link, "demo.toml", clock="realtime")
    station, command = node._station, database.message("COMMAND")
    assert station is not None
    begin_ns = time.monotonic_ns()
    wire.put(pack_frame(0x80, b"\x01"))
    wire.serve(node)
    time.sleep(0.02)
    wire.put(pack_frame(command.can_id, command.encode({"Counter": 0, "Controlword": 6})))
    wire.put(pack_frame(0x80, b"\x02"))
    wire.serve(node)
    passed_ns = time.monotonic_ns() - begin_ns
    assert 20_000_000 <= node.state["t_ns"] <= passed_ns
    assert node.state["fed_ns"] <= node.state["t_ns"]
    time.sleep(0.01)
    node._attend(station, time.monotonic_ns() + 6_000_000)  # silence of 5 ms
    assert node.state["t_ns"] >= 30_000_000


def test_a_socket_that_fails_is_a_bus_that_is_down(wire: Wire) -> None:
    node, _ = drive(wire.link, "demo.toml")
    assert node._station is not None
    wire.link.fds[0] = os.open("/dev/null", os.O_RDONLY)
    begin_ns = time.monotonic_ns()
    assert node._station.attend(begin_ns + 1_000_000_000) == -errno.ENOTSOCK
    node._attend(node._station, begin_ns + 1_000_000_000)
    os.close(wire.link.fds[0])
    assert time.monotonic_ns() - begin_ns >= 10_000_000, "it waits a little and goes on"


@pytest.mark.alone
def test_a_busy_bus_does_not_keep_the_drive_from_its_stop(wire: Wire) -> None:
    """The compiled call ends with its time although frames go on coming."""
    node, _ = drive(wire.link, "demo.toml", clock="realtime")
    stop = threading.Event()

    def talk() -> None:
        count = 0
        while not stop.is_set():
            count += 1
            wire.put(pack_frame(0x80, bytes((count % 240 + 1,))))
            wire.heard()
            time.sleep(5e-4)

    talker = threading.Thread(target=talk)
    talker.start()
    end = time.monotonic() + 0.4
    node.run(lambda: time.monotonic() > end)
    late = time.monotonic() - end
    stop.set()
    talker.join()
    assert late < 1.0 and node.state["syncs"] > 50
