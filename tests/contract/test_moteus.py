"""A moteus over CAN FD: bytes against the maker's own package (PyPI moteus 1.1.1), and a whole run.

What is sent must be what its make_position, make_current and make_query lay out, what the emulated drive
answers what its parse_reply reads.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import moteus
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moteus.protocol import parse_reply

from drivers.bus import BusSettings, Frame, Link, open_link
from drivers.client import DriveClient
from drivers.codec import Database
from drivers.errors import DatabaseError
from drivers.local import EFF_FLAG
from drivers.oneshot import NoAnswer
from drivers.wire import FRAME
from firmware_model.moteus import BadFrame, MoteusFrames, padded, subframes
from firmware_model.plant import ErrorCode, State, Takes
from hil.check.checks import unwatched_rows
from hil.errors import ConfigError
from hil.exchange.importing import import_recording
from hil.log.errors import LogError
from hil.replay.sent import SentCheck
from hil.runtime.refusals import check_reachable
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import Controlword, DriveState, RxFlag, new_ticks
from tests.conftest import CONFIGS
from tests.contract.lockstep import held_in_lockstep

PATH = CONFIGS / "moteus.toml"
COMMAND, ASK, REPLY, ANSWER = 0x8001 | EFF_FLAG, 0x8101 | EFF_FLAG, 0x100, 0x101
R = moteus.Register


class Resolution(moteus.QueryResolution):  # type: ignore[misc, name-defined]
    """The registers that our command asks for."""

    mode, q_current, d_current = moteus.INT16, moteus.F32, moteus.F32
    voltage, temperature, fault = moteus.INT16, moteus.INT16, moteus.INT16


MAKER = moteus.Controller(id=1, query_resolution=Resolution(), transport=object())


def setup_of(*settings: str) -> Setup:
    return load_setup(PATH, Overrides(settings=settings))


def position(torque: float, most: float = 60.0, timeout: float = 0.02) -> bytes:
    """The maker's frame."""
    made = MAKER.make_position(
        position=math.nan, velocity=0.0, feedforward_torque=torque, kp_scale=0.0, kd_scale=0.0,
        maximum_torque=most, watchdog_timeout=timeout, ilimit_scale=0.0, query=True,
    )  # fmt: skip
    return padded(made.data)


OFF = position(0.0)[:2] + b"\0" + position(0.0)[3:]


class Bus:
    """A client on a bus of its own, and what somebody else hears there."""

    def __init__(self, setup: Setup, log: list[bytes] | None = None) -> None:
        settings = BusSettings("hil-local", f"moteus-{time.monotonic_ns()}", 1_000_000, 5_000_000, True)
        self.other: Link = open_link(settings)
        keep = None if log is None else (lambda records: log.append(bytes(records)))
        self.client = DriveClient(
            open_link(settings), setup.database, drive_map=setup.binding.map, on_frames=keep
        )
        self.tick = new_ticks()[0]
        self.client.prepare(self.tick)

    def heard(self) -> list[tuple[int, bytes]]:
        frames: list[tuple[int, bytes]] = []
        while frame := self.other.receive(20_000_000):
            frames.append((frame.can_id | frame.flags, bytes(frame.data)))
        return frames

    def lay(self, torque: float, word: int = Controlword.ENABLE_OPERATION) -> None:
        self.tick["controlword"], self.tick["u_q"] = word, torque
        self.client.send(self.tick)

    def read(self) -> None:
        self.tick["rx_flags"] = 0
        self.client.receive(self.tick, time.monotonic_ns() + 20_000_000)

    def exchange(self) -> None:
        self.tick["rx_flags"] = 0
        self.client.exchange(self.tick, time.monotonic_ns() + 20_000_000)


@pytest.fixture
def bus() -> Iterator[Bus]:
    made = Bus(setup_of())
    yield made
    made.client.close()
    made.other.close()


@given(st.floats(-50.0, 50.0, width=32), st.floats(0.0, 100.0, width=32), st.floats(2.0**-10, 1.0, width=32))
def test_the_command_is_the_makers_position_frame(torque: float, most: float, timeout: float) -> None:
    made = setup_bytes(most, timeout)
    assert made.encode({"Mode": 1.0, "Torque": torque}) == position(torque, most, timeout)


def setup_bytes(most: float, timeout: float) -> Any:
    """The command's message as it is bound with these constants."""
    from drivers.binding import bind
    from drivers.mapping import map_from_table

    table = SIGNALS | {"constants": {"COMMAND.MaxTorque": most, "COMMAND.Timeout": timeout}}
    return bind(map_from_table(table, "test"), DATABASE).command


SIGNALS: dict[str, Any] = {
    "poll": "COMMAND", "speed": "REPLY.Velocity", "torque_ref": "COMMAND.Torque",
    "enable": "COMMAND.Mode", "on_value": 10, "off_value": 0,
}  # fmt: skip
DATABASE = Database(CONFIGS / "drives/moteus.dbc", 1, "moteus")


def test_the_torque_goes_out_with_the_next_exchange_and_off_where_none_was_laid(bus: Bus) -> None:
    bus.exchange()
    assert bus.heard() == [(COMMAND, OFF)]
    bus.lay(1.5)
    assert bus.heard() == []
    bus.exchange()
    bus.exchange()
    assert bus.heard() == [(COMMAND, position(1.5)), (COMMAND, OFF)]


def test_a_stop_sends_off_at_once_and_never_what_was_laid_before_it(bus: Bus) -> None:
    bus.lay(7.0)
    bus.client.stop()
    assert bus.heard() == [(COMMAND, OFF)] * 5
    assert OFF.startswith(MAKER.make_stop().data)


def reply(mode: int = 0, w: float = 0.0, i_q: float = 0.0, fault: int = 0) -> bytes:
    head = struct.pack("<BBh3sfffff", 0x25, 0, mode, b"\x2c\x05\x01", 0.0, w, 0.0, i_q, 0.25)
    return padded(head + struct.pack("<BBhhh", 0x27, 0x0D, 5400, 253, fault))


def test_the_answer_is_read_as_the_maker_reads_it(bus: Bus) -> None:
    data = reply(10, 12.5, -3.5, 102)
    bus.other.send(REPLY, data, True)
    bus.read()
    tick, said = bus.tick, parse_reply(data)
    assert said[R.MODE] == 10 and tick["drive_state"] == DriveState.OPERATION_ENABLED
    assert tick["w"] == pytest.approx(said[R.VELOCITY] * 2 * math.pi, rel=1e-15) and tick["w"] > 78.0
    assert (tick["i_q"], tick["i_d"]) == (said[R.Q_CURRENT], said[R.D_CURRENT]) == (-3.5, 0.25)
    assert (tick["v_dc"], tick["temperature_inverter"]) == (said[R.VOLTAGE], said[R.TEMPERATURE])
    assert tick["drive_error"] == said[R.FAULT] == 102 and tick["rx_flags"] & RxFlag.FRESH


@pytest.mark.parametrize(("mode", "state"), [(1, 7), (11, 7), (12, 0), (3, 1)])
def test_a_mode_that_is_not_position_is_no_operation(bus: Bus, mode: int, state: int) -> None:
    bus.client.send(bus.tick)  # a command that disables
    bus.other.send(REPLY, reply(mode), True)
    bus.read()
    assert bus.tick["rx_flags"] & RxFlag.FRESH
    assert bus.tick["drive_state"] == state


@pytest.mark.parametrize("odd", [{27: b"\x31\x0d"}, {27: b"\x27\x0c"}])
def test_an_answer_of_other_registers_is_not_taken(bus: Bus, odd: dict[int, bytes]) -> None:
    data = bytearray(reply(10, 12.5))
    for at, new in odd.items():
        data[at : at + len(new)] = new
    bus.other.send(REPLY, bytes(data), True)
    bus.read()
    assert bus.tick["w"] == 0.0 and not bus.tick["rx_flags"] & RxFlag.FRESH


def answer(fault: int) -> bytes:
    return struct.pack("<BBhBBhhh", 0x25, 0, 1 if fault else 0, 0x27, 0x0D, 5400, 253, fault)


def test_the_drive_is_asked_before_it_is_commanded(bus: Bus) -> None:
    bus.other.send(ANSWER, answer(0), True)
    bus.other.send(REPLY, reply(), True)
    bus.client.start()
    asked, *stops = bus.heard()
    query = moteus.parse_registers(asked[1])
    assert asked[0] == ASK and query.query == [(r, 1) for r in (R.MODE, R.VOLTAGE, R.TEMPERATURE, R.FAULT)]
    assert not query.command and len(stops) == 2
    assert {can_id for can_id, _ in stops} == {COMMAND}
    assert all(moteus.parse_registers(data).command[R.MODE] == 0 for _, data in stops)


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ([], "ASK was sent, and ANSWER.Fault = 0 did not come within 500 ms: no ANSWER came at all"),
        ([(ANSWER, answer(33))], "did not come within 500 ms: it said ANSWER.Fault = 33; look at"),
        (
            [(ANSWER, answer(0)), (REPLY, reply(11))],
            "COMMAND was sent, and REPLY.Mode = 0 did not come within 500 ms: it said REPLY.Mode = 11",
        ),
        ([(0x200, answer(0))], "no ANSWER came at all; look at the drive's state, errors and node number"),
    ],
)
def test_what_keeps_a_drive_from_starting_is_one_line(
    bus: Bus, answers: list[tuple[int, bytes]], said: str
) -> None:
    for can_id, data in answers:
        bus.other.send(can_id, data, True)
    with pytest.raises(NoAnswer) as caught:
        bus.client.start()
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert not any(data[2] == 10 for can_id, data in bus.heard() if can_id == COMMAND)


@pytest.mark.parametrize(
    ("node", "ids"),
    [
        (1, (0x80008001, 0x100, 0x101)),
        (7, (0x80008007, 0x700, 0x701)),
        (8, (0x80008008, 0x80000800, 0x80000801)),
        (127, (0x8000807F, 0x80007F00, 0x80007F01)),
    ],
)
def test_the_node_number_is_destination_of_a_command_and_source_of_an_answer(
    node: int, ids: tuple[int, ...]
) -> None:
    database = Database(CONFIGS / "drives/moteus.dbc", node, "moteus")
    found = tuple(database.message(name).send_id for name in ("COMMAND", "REPLY", "ANSWER"))
    assert found == ids
    assert database.of_frame(ids[1]) is database.message("REPLY")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('drive.signals.poll="REPLY"', "poll: REPLY is not the message with the command; that is COMMAND"),
        ('drive.signals.sync="ASK"', "poll: the drive's cycle begins with its command; leave sync and step"),
        ('drive.signals.reset="ASK.Read"', "must be in COMMAND; ASK would go out beside it"),
        ('loop.pacing="timer"', 'the drive answers each command (drive.signals.poll); take "sync"'),
        ('drive.signals.expect={"COMMAND.Nop0"=1}', "expect: COMMAND is no message that is read"),
        ('drive.signals.expect={"REPLY.Position"=-1}', "expect: -1 is no raw number of REPLY.Position"),
        ('drive.signals.expect={"REPLY.ReplyMode"=65536}', "expect: 65536 is no raw number"),
        ('drive.signals.expect={"REPLY.ReplyMode"=1.5}', "is not of the form that it takes"),
        ('drive.signals.expect={"REPLY.ReplyMode"=37,"REPLY.ReplyMotion"=1}', "expect: REPLY has two"),
        ('drive.signals.unwatched="yes"', "is not of the form that it takes"),
        ("drive.node_id=0", "a moteus has one of 1 to 127"),
        ("drive.node_id=128", "a moteus has one of 1 to 127"),
        ('drive.node_rule="mjbots"', 'or "moteus"'),
    ],
)
def test_a_mistake_of_the_map_is_one_line(setting: str, said: str) -> None:
    with pytest.raises((DatabaseError, ConfigError)) as caught:
        setup_of(setting)
    assert said in str(caught.value)


class Drive:
    """What the frames' rules need of the drive behind."""

    def __init__(self, takes: Takes = Takes.TORQUE) -> None:
        self.state: Any = {"state": State.SWITCH_ON_DISABLED, "error": 0, "t_ns": 0}
        self.params: Any = {
            "watchdog_ns": 100_000_000, "takes": takes, "drive_k_t": 3.6, "v_dc": 540.0, "ambient": 25.0,
        }  # fmt: skip
        self.sample: Any = {
            "w": 80.0, "i_q": -2.5, "i_d": 0.5, "v_dc": 541.0, "temperature_motor": 31.0,
            "temperature_inverter": 26.0, "theta": 7.0,
        }  # fmt: skip
        self.commands: list[tuple[int, float, float]] = []

    def command(self, _counter: int, word: int, q: float, d: float) -> None:
        self.commands.append((word, q, d))


def take(frames: MoteusFrames, drive: Drive, data: bytes, can_id: int = 0x8001) -> None:
    frames.take(Frame(can_id, data, EFF_FLAG, True), drive, lambda: None)  # type: ignore[arg-type]


OUT = {"w": 80.0, "T_L_true": 5.5, "w_true": 80.0}


def test_what_the_emulated_drive_answers_is_read_by_the_maker() -> None:
    frames, drive = MoteusFrames(1, truth=False), Drive()
    drive.state["state"] = State.OPERATION_ENABLED
    take(frames, drive, position(2.5))
    [(can_id, data, fd)] = frames.answer(OUT)
    assert (can_id, len(data), fd) == (REPLY, 48, True) and data[27:29] == b"\x27\x0d"
    said = parse_reply(data)
    assert (said[R.MODE], said[R.FAULT], said[R.VOLTAGE]) == (10, 0, 541.0)
    assert said[R.VELOCITY] == pytest.approx(80.0 / (2 * math.pi), rel=1e-7)
    assert (said[R.Q_CURRENT], said[R.D_CURRENT], said[R.TORQUE]) == (-2.5, 0.5, -9.0)
    assert said[R.POSITION] == pytest.approx(7.0 / (2 * math.pi), rel=1e-7), "turns, over one"
    take(frames, drive, MAKER.make_query().data, 0x8201)  # another source gets its answer by itself
    [(can_id, data, _)] = frames.due
    assert can_id == 0x102 and parse_reply(data)[R.TEMPERATURE] == 26.0


@pytest.mark.parametrize(
    ("takes", "data", "commanded"),
    [
        (Takes.TORQUE, position(2.5), (0x06, 2.5, 0.0)),
        (Takes.TORQUE, position(2.5, most=1.0), (0x06, 1.0, 0.0)),
        (Takes.TORQUE, position(-2.5, most=math.nan), (0x06, -2.5, 0.0)),
        (Takes.TORQUE, MAKER.make_position(feedforward_torque=2.5).data, (0x00, 0.0, 0.0)),  # gains of 1
        (Takes.TORQUE, MAKER.make_stop().data, (0x00, 0.0, 0.0)),
        (Takes.CURRENT, MAKER.make_current(q_A=3.0, d_A=-1.0).data, (0x06, 3.0, -1.0)),
        (Takes.TORQUE, MAKER.make_current(q_A=3.0, d_A=-1.0).data, (0x00, 0.0, 0.0)),
        (Takes.VOLTAGE, b"\x01\x00\x08\x0e\x1a" + struct.pack("<ff", 7.0, 9.0), (0x06, 9.0, 7.0)),
    ],
)
def test_the_emulated_drive_takes_the_makers_commands(
    takes: Takes, data: bytes, commanded: tuple[int, float, float]
) -> None:
    frames, drive = MoteusFrames(1, truth=False), Drive(takes)
    take(frames, drive, data)
    assert drive.commands == [commanded]


def test_only_position_mode_is_watched_and_a_time_out_is_left_by_a_stop_alone() -> None:
    frames, drive = MoteusFrames(1, truth=False), Drive()
    for timeout, watchdog_ns in ((0.02, 20_000_000), (math.nan, 0), (0.0, 100_000_000)):
        take(frames, drive, position(1.0, timeout=timeout))
        assert drive.params["watchdog_ns"] == watchdog_ns
    drive.state |= {"state": State.FAULT, "error": ErrorCode.COMMUNICATION_TIMEOUT}
    take(frames, drive, position(1.0))
    assert drive.commands[-1][0] == 0 and frames.register(0x000, drive) == 11  # type: ignore[arg-type]
    take(frames, drive, MAKER.make_stop().data)
    assert drive.commands[-1][0] == 0x80
    take(frames, drive, MAKER.make_current(q_A=1.0, d_A=0.0).data)
    assert drive.params["watchdog_ns"] == 0


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"\x01\x00", "subframe"),
        (b"\x0c\x06\x20\x00", "subframe"),
        (b"\x10\x80\x80\x80\x80\x80\x01", "subframe"),
        (b"\x60", "subframe"),
        (b"\x01\x00\x06", "mode"),
        (position(1.0)[:14] + struct.pack("<f", math.nan) + position(1.0)[18:], "number"),
    ],
)
def test_a_frame_that_says_nothing_certain_is_not_taken(data: bytes, why: str) -> None:
    frames, drive = MoteusFrames(1, truth=False), Drive()
    take(frames, drive, data)
    assert frames.ignored == {why: 1} and not drive.commands


@given(st.binary(max_size=64))
def test_any_bytes_are_taken_apart_or_refused(data: bytes) -> None:
    try:
        parts = list(subframes(data))
    except BadFrame:
        return
    written = sum(len(one.values) for one in parts if not one.reads)
    assert written == sum(one.many for one in parts if not one.reads)


def test_a_register_that_is_not_there_is_answered_by_an_error() -> None:
    frames, drive = MoteusFrames(1, truth=False), Drive()
    take(frames, drive, b"\x11\x55")
    [(_, data, _)] = frames.answer(OUT)
    assert moteus.parse_registers(data).errors == [(0x55, 1)]


def test_unwatched_modes_are_the_makers_frames_and_are_refused_without_a_word() -> None:
    current = {"i_q_ref": "COMMAND.CurrentQ", "i_d_ref": "COMMAND.CurrentD", "on_value": 9}
    voltage = {"u_q": "COMMAND.VoltageQ", "u_d": "COMMAND.VoltageD", "on_value": 8}
    query = MAKER.make_query().data
    hand = b"\x01\x00\x08\x0e\x1a" + struct.pack("<ff", 0.5, 2.0) + query
    made = MAKER.make_current(q_A=2.0, d_A=0.5, query=True).data
    for name, own, frame in (("current", current, made), ("voltage", voltage, hand)):
        q, d = (part.rpartition(".")[2] for part in list(own.values())[:2])  # type: ignore[attr-defined]
        bound = binding_of(name, own | {"unwatched": True})
        assert bound.command.encode({"Mode": 1.0, q: 2.0, d: 0.5}) == padded(frame)
        [row] = unwatched_rows(bound)
        assert row.verdict == "warn" and "applies no time-out" in row.found
        with pytest.raises(DatabaseError, match=r"applies no time-out.* or say unwatched = true"):
            binding_of(name, own)


def binding_of(name: str, own: dict[str, Any]) -> Any:
    from drivers.binding import bind
    from drivers.mapping import map_from_table

    table: dict[str, Any] = {
        "poll": "COMMAND", "speed": "REPLY.Velocity", "i_q": "REPLY.CurrentQ", "i_d": "REPLY.CurrentD",
        "state": "REPLY.Mode", "enable": "COMMAND.Mode", "off_value": 0,
        "states": {0: "off", own["on_value"]: "operation enabled"},
    }  # fmt: skip
    database = Database(CONFIGS / f"drives/moteus_{name}.dbc", 1, "moteus")
    return bind(map_from_table(table | own, "test"), database)


def test_a_run_in_an_unwatched_mode_says_why_that_is_dangerous(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = PATH.read_text(encoding="utf-8")
    for old, new in (
        ("drives/moteus.dbc", f"{CONFIGS}/drives/moteus_current.dbc"),
        ('torque_ref = "COMMAND.Torque" ', 'unwatched = true\ni_q_ref = "COMMAND.CurrentQ"'),
        ("on_value = 10 ", "on_value = 9"),
        ("dtorque_max_n_m", "di_max_a"),
        ('"COMMAND.MaxTorque" = 60.0', ""),
        ('"COMMAND.Timeout" = 0.02', ""),
    ):
        assert old in text
        text = text.replace(old, new)
    own = tmp_path / "own.toml"
    own.write_text(text, encoding="utf-8")
    check_reachable(load_setup(own, Overrides()))
    said = capsys.readouterr().err
    assert "warning: drive.signals.unwatched: in current mode (9) a moteus applies no time-out" in said


def test_the_log_has_each_command_of_the_last_tick_and_replay_finds_another() -> None:
    log: list[bytes] = []
    setup = setup_of()
    bus, ticks = Bus(setup, log), new_ticks(4)
    for k, tick in enumerate(ticks):
        tick["k"], tick["t_ns"] = k, time.monotonic_ns()
        bus.exchange()
        tick["send"], tick["controlword"], tick["u_q"] = k != 2, Controlword.ENABLE_OPERATION, k + 1.0
        tick["computed_ns"] = time.monotonic_ns() - tick["t_ns"]
        if tick["send"]:
            bus.lay(k + 1.0)
    bus.client.stop()
    bus.client.close()
    bus.other.close()
    frames = np.frombuffer(b"".join(log), FRAME).copy()
    torques = [struct.unpack_from("<f", bytes(f["data"]), 14)[0] for f in frames]
    assert torques == [0.0, 1.0, 2.0, 0.0] + [0.0] * 5
    assert SentCheck(setup.binding).compare(ticks, frames, last=True) is None
    frames["data"][2, 16] ^= 0x10
    found = SentCheck(setup.binding).compare(ticks, frames, last=True)
    assert found is not None and (found.tick, found.field) == (1, "u_q")


def test_a_recording_of_an_asked_drive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"drive\.signals\.poll: a recording .* can't be imported"):
        import_recording(tmp_path / "x.log", tmp_path / "x.mcap", PATH)


@pytest.mark.compiled
def test_in_lockstep_it_holds_the_load_and_replays_to_the_bit(tmp_path: Path) -> None:
    verdict = held_in_lockstep(PATH, tmp_path)
    assert verdict.verdict == "same" and not verdict.notes
