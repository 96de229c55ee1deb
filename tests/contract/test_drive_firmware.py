"""The emulated drive by hand-written bytes: CiA 402, CRC and counter, watchdog, EMCY, floods, determinism.

The frames' CRCs are computed here, bit by bit from AUTOSAR's definition, not by the package's codec.
"""

from __future__ import annotations

import itertools
import struct
import time
from collections import deque
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from drivers.bus import Frame
from drivers.codec import Database
from firmware_model.config import PlantConfig, build_params
from firmware_model.node import Node, wire_of
from hil.config.tables import load_toml
from tests.conftest import CONFIGS

COMMAND_IDS = bytes.fromhex("395C9840D9E9D87342086F2736513DF8")
LOAD_IDS = bytes.fromhex("A19FBD41309BCACD6BE58B2B3F29A5D8")
DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 1, 2, 3, 4, 5, 7


def crc8(data: bytes) -> int:
    """Polynomial 0x2F, start 0xFF, inverted at the end."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


class Wires:
    """A link whose two ends are lists."""

    def __init__(self) -> None:
        self.waiting: deque[Frame] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.flood: Any = None

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        self.sent.append((can_id, data))

    def receive(self, timeout_ns: int) -> Frame | None:
        if self.flood is not None:
            return next(self.flood)
        if self.waiting:
            return self.waiting.popleft()
        time.sleep(min(timeout_ns, 1_000_000) * 1e-9)
        return None

    def discard(self) -> int:
        return 0

    def close(self) -> None:
        pass


@pytest.fixture
def configs() -> Path:
    """The shipped drive itself, with its watchdog of 20 ms."""
    return CONFIGS


class Bench:
    """A node and a hand that writes frames."""

    def __init__(
        self,
        configs: Path,
        *settings: str,
        clock: Literal["realtime", "lockstep"] = "lockstep",
        pacing: Literal["sync", "cyclic"] = "sync",
        plant: str = "demo.toml",
    ) -> None:
        path = configs / "plants" / plant
        config = load_toml(path, PlantConfig, settings)
        database = Database(path.parent / config.dbc, config.node_id)
        self.link = Wires()
        params = build_params(config, wire_of(database))
        self.node = Node(
            self.link, database, params, clock=clock, pacing=pacing, period_ns=1_000_000, truth=config.truth
        )
        self.counter = -1

    def put(self, can_id: int, data: bytes, flags: int = 0) -> None:
        self.node.take(Frame(can_id, data, flags, False))

    def command(self, controlword: int, u_q: int = 0, u_d: int = 0, mode: int = 0) -> None:
        self.counter = (self.counter + 1) % 16
        self.put(
            0x201, protected(self.counter, mode, struct.pack("<Hhh", controlword, u_q, u_d), COMMAND_IDS)
        )

    def sync(self) -> int:
        """SYNC; return the state in the drive's FEEDBACK."""
        self.link.sent.clear()
        self.put(0x80, b"\x01")
        can_id, data = self.link.sent[-1]
        assert can_id == 0x181 and len(data) == 8
        return data[7] >> 4 & 7

    def tick(self, controlword: int, u_q: int = 0) -> int:
        self.command(controlword, u_q)
        return self.sync()

    def enable(self) -> None:
        assert [self.tick(cw) for cw in (0x06, 0x07, 0x0F)] == [READY, SWITCHED_ON, ENABLED]

    def ids(self) -> list[int]:
        return [can_id for can_id, _ in self.link.sent]


def protected(counter: int, high: int, rest: bytes, ids: bytes) -> bytes:
    body = bytes([counter | high << 4]) + rest
    return bytes([crc8(body + ids[counter : counter + 1])]) + body


def test_a_command_is_these_bytes() -> None:
    """AUTOSAR's check value of CRC-8 0x2F, and one whole frame: counter 3, 0x000F, 80.00 V, -1.00 V."""
    assert crc8(b"123456789") == 0xDF
    body = protected(3, 0, struct.pack("<Hhh", 0x0F, 8000, -100), COMMAND_IDS)[1:]
    assert body == bytes.fromhex("030f00401f9cff")


def test_frames_of_a_sync_and_their_order(configs: Path) -> None:
    bench = Bench(configs)
    assert bench.sync() == DISABLED and bench.ids() == [0x481, 0x281, 0x181]
    assert bench.link.sent[-1][1][1] >> 4 == 15  # echo: no command yet
    assert bench.link.sent[1][1][1] >> 4 == 1  # protocol version
    assert bench.link.sent[1][1][2:4] == (5400).to_bytes(2, "little")
    for _ in range(9):
        bench.sync()
        assert bench.ids() == [0x481, 0x181]
    bench.sync()
    assert bench.ids() == [0x481, 0x281, 0x181]
    for can_id, data in bench.link.sent[1:]:
        ids = {0x281: "8C2E4A035F5F3D218F87211A0BA367EF", 0x181: "1F3C95D5C7DE55A30E20A9AA542B23D9"}[can_id]
        assert data[0] == crc8(data[1:] + bytes.fromhex(ids)[data[1] & 15 : (data[1] & 15) + 1])


def test_enable_handshake_and_voltage_from_the_next_sync_on(configs: Path) -> None:
    bench = Bench(configs)
    assert bench.sync() == DISABLED
    assert bench.tick(0x0F) == DISABLED and bench.tick(0x07) == DISABLED  # 0x06 comes first
    bench.enable()
    bench.command(0x0F, 8000)
    assert bench.node.state["u_q"] == 0.0
    bench.sync()
    assert bench.node.state["u_q"] == 80.0 and bench.link.sent[-1][1][1] >> 4 == bench.counter
    bench.sync()  # a lost command: the voltage and the echo stay
    assert bench.node.state["u_q"] == 80.0 and bench.link.sent[-1][1][1] >> 4 == bench.counter


@pytest.mark.parametrize(
    ("words", "state"),
    [
        ([0x00], DISABLED),
        ([0x02], QUICK_STOP),
        ([0x02, 0x0F], QUICK_STOP),
        ([0x02, 0x00], DISABLED),
        ([0x06], READY),
        ([0x07], SWITCHED_ON),
        ([0x07, 0x0F], ENABLED),
        ([0xFFFF], ENABLED),  # bits of other modes do not disturb
        ([0xFF00], DISABLED),
        ([0x80], DISABLED),
    ],
)
def test_leaving_operation(configs: Path, words: list[int], state: int) -> None:
    bench = Bench(configs)
    bench.sync()
    bench.enable()
    assert [bench.tick(word, 8000) for word in words][-1] == state
    assert (bench.node.state["u_q"] == 0) == (state != ENABLED)


def test_watchdog_latches_and_a_rising_edge_resets(configs: Path) -> None:
    bench = Bench(configs)
    bench.sync()
    bench.enable()
    assert [bench.sync() for _ in range(19)] == [ENABLED] * 19
    states = [bench.sync() for _ in range(3)]
    assert states[-1] == FAULT
    emergencies = [data for can_id, data in bench.link.sent if can_id == 0x81]
    assert emergencies == [] or states[1] == ENABLED
    assert bench.tick(0x0F) == FAULT and bench.tick(0x06) == FAULT
    assert bench.tick(0x80) == DISABLED and bench.tick(0x80) == DISABLED
    bench.enable()
    while bench.sync() != FAULT:
        pass
    assert bench.link.sent[0] == (0x81, bytes.fromhex("3081010000000000"))  # with the first FAULT feedback
    assert bench.tick(0x80) == DISABLED


@pytest.mark.parametrize("fault", ["crc", "repeated", "length", "mode", "flags", "foreign"])
def test_bad_commands_are_ignored_and_do_not_feed_the_watchdog(configs: Path, fault: str) -> None:
    bench = Bench(configs)
    bench.sync()
    bench.enable()
    last = bench.counter
    for k in range(30):
        counter = last if fault == "repeated" else (last + 1 + k) % 16
        body = struct.pack("<Hhh", 0x0F, 9000, 0)
        frame = protected(counter, 2 if fault == "mode" else 0, body, COMMAND_IDS)
        if fault == "crc":
            frame = bytes([frame[0] ^ 1]) + frame[1:]
        if fault == "length":
            frame = frame[:7]
        can_id = 0x202 if fault == "foreign" else 0x201
        bench.put(can_id, frame, 0x80000000 if fault == "flags" else 0)
        state = bench.sync()
        assert bench.node.state["u_q"] == 0.0
    assert state == FAULT and bench.node.state["error"] == 0x8130
    assert fault == "foreign" or bench.node.ignored[fault] == 30


def test_commanded_load_comes_with_the_command_and_goes_with_the_enable(configs: Path) -> None:
    bench = Bench(configs)
    bench.sync()
    bench.enable()
    load = protected(4, 1, struct.pack("<h", 250), LOAD_IDS)
    bench.put(0x301, load)
    bench.put(0x301, load)
    assert bench.node.ignored["repeated"] == 1
    bench.sync()
    assert bench.node.state["T_commanded"] == 0.0
    bench.tick(0x0F)
    assert bench.node.state["T_commanded"] == 2.5
    bench.tick(0x00)
    assert bench.node.state["T_commanded"] == 0.0


def test_random_frames_never_move_the_drive_and_never_stop_it(configs: Path) -> None:
    seed, bench = 7, Bench(configs)
    rng = np.random.default_rng(seed)
    bench.sync()
    ids = [0x80, 0x81, 0x181, 0x201, 0x201, 0x281, 0x301, 0x701]
    for _ in range(20_000):
        can_id = int(rng.choice(ids)) if rng.random() < 0.8 else int(rng.integers(0, 0x800))
        data = rng.bytes(int(rng.integers(0, 9)))
        if can_id == 0x201:
            data = bytes(8) if len(data) == 8 else data  # all zero: a wrong CRC, never right by chance
        bench.put(can_id, data, int(rng.choice([0, 0, 0, 0x20000000, 0x40000000])))
        assert bench.node.state["state"] == DISABLED and bench.node.state["u_q"] == 0, seed
    assert bench.sync() == DISABLED and min(bench.node.ignored[x] for x in ("crc", "length", "flags")) > 300


def test_a_flood_does_not_keep_the_watchdog_from_tripping(configs: Path) -> None:
    bench = Bench(configs, clock="realtime")
    bench.node.warm_up()
    bench.sync()
    bench.command(0x06)

    def junk() -> Any:
        while True:
            time.sleep(1e-4)
            yield Frame(0x5FF, b"", 0, False)

    bench.link.flood = junk()
    end = time.monotonic() + 5.0
    bench.node.run(lambda: bench.node.state["state"] == FAULT or time.monotonic() > end)
    assert bench.node.state["error"] == 0x8130
    assert (
        bench.link.sent[-2:] and (0x701, b"\x00") in bench.link.sent and (0x701, b"\x05") in bench.link.sent
    )


@pytest.mark.alone
@pytest.mark.compiled  # real time: interpreted kernels are too slow for it
def test_a_cyclic_drive_stands_still_until_its_first_command(configs: Path) -> None:
    bench = Bench(configs, clock="realtime", pacing="cyclic")
    bench.node.warm_up()
    end = time.monotonic() + 0.05
    bench.node.run(lambda: time.monotonic() > end)
    assert bench.ids().count(0x181) > 3 and bench.node.state["t_ns"] == 0


@pytest.mark.alone
def test_a_cyclic_drive_keeps_its_own_time(configs: Path) -> None:
    bench = Bench(configs, clock="realtime", pacing="cyclic")
    bench.node.warm_up()

    def stalls() -> Any:
        """The process stands still for 200 ms, then there is time enough to catch up in a burst."""
        for pause in itertools.chain([0.2], itertools.repeat(1e-4)):
            time.sleep(pause)
            yield None

    bench.command(0)  # its loads and its motion begin with the first command
    bench.link.flood = stalls()
    end = time.monotonic() + 0.5
    bench.node.run(lambda: time.monotonic() > end)
    count = bench.ids().count(0x181)
    assert 30 < count <= 305, count  # skipped cycles are skipped, never sent in a burst
    assert bench.node.state["t_ns"] > 300_000_000


@pytest.mark.parametrize("plant", ["demo.toml", "matched.toml"])
def test_two_lockstep_runs_send_the_same_bytes(configs: Path, plant: str) -> None:
    def run(*settings: str) -> list[tuple[int, bytes]]:
        bench, sent = Bench(configs, *settings, plant=plant), []
        for k in range(300):
            bench.tick((0x06, 0x07, 0x0F)[min(k, 2)], 10 * k)
            sent += bench.link.sent
        return sent

    first = run()
    assert first == run()
    assert (first != run("seed=2")) == (plant == "demo.toml")  # matched.toml has no noise


def test_the_papers_plant_reaches_its_operating_point(configs: Path) -> None:
    """500 rad/s against a commanded 5.29 N m: 1204 V unclipped, phi = (0.1, 0.2), 64-byte frames."""
    path = configs / "plants" / "paper.toml"
    config = load_toml(path, PlantConfig, [])
    enough = ("inverter.v_dc_v=2200.0", "firmware.w_trip_rad_s=700.0")  # sqrt(3) * 1204 V = 2086 V
    bench = Bench(configs, *enough, plant="paper.toml")
    command = Database(path.parent / config.dbc).message("COMMAND")
    state = bench.node.state
    T_L = 1.5 * 3 * 0.8 * 1.5 - 2e-4 * 500
    for k in range(2000):
        state["x"][0] = max(state["x"][0], 495.0)  # spun up by hand
        word = (0x06, 0x07, 0x0F)[min(k, 2)]
        values = {
            "Counter": k % 256,
            "Controlword": word,
            "VoltageQ": 1204.3125,
            "VoltageD": -3 * 500 * 0.033 * 1.5,
        }
        bench.put(0x201, command.encode(values | {"LoadEnable": 1, "LoadTorque": T_L}))
        bench.link.sent.clear()
        bench.put(0x80, b"")
    assert state["state"] == ENABLED and state["limited"] == 0
    assert (np.abs(state["x"] - [500.0, 1.5, 0.0]) < [0.2, 0.01, 0.01]).all(), state["x"]
    assert bench.ids() == [0x481, 0x181] and len(bench.link.sent[-1][1]) == 64
    assert (config.disturbance.phi_w_rad_s2, config.disturbance.phi_q_a_s) == (0.1, 0.2)


def test_a_reset_bit_that_is_held_resets_nothing(configs: Path) -> None:
    bench = Bench(configs)
    bench.sync()
    bench.enable()
    assert bench.tick(0x8F) == ENABLED
    while bench.sync() != FAULT:
        pass
    assert [bench.tick(0x8F) for _ in range(3)] == [FAULT] * 3
    assert [bench.tick(0x0F), bench.tick(0x80)] == [FAULT, DISABLED]
