"""ODrive's CAN Simple: bytes pinned by hand, the emulated frames by cantools, and a whole run of both."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
import pytest

from drivers.bus import BusSettings, Frame, Link, SocketLink, open_link
from drivers.client import DriveClient
from drivers.errors import DatabaseError, LinkError
from drivers.listen import Heard, Traffic
from drivers.oneshot import NoAnswer
from drivers.wire import FRAME
from firmware_model.odrive import ODriveFrames
from hil.check.checks import traffic_rows
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import Controlword, DriveState, new_ticks
from tests.conftest import CONFIGS
from tests.contract.lockstep import held_in_lockstep

PATH = CONFIGS / "odrive.toml"
NODE = 1
HEARTBEAT, STATE, ESTIMATES, MODE, TORQUE, IQ, CLEAR = (
    NODE << 5 | c for c in (1, 7, 9, 0xB, 0xE, 0x14, 0x18)
)


def setup_of(*settings: str) -> Setup:
    return load_setup(PATH, Overrides(settings=settings))


class Bus:
    """A client on a bus of its own, and what somebody else hears there."""

    def __init__(self, channel: str) -> None:
        settings = BusSettings("hil-local", channel, 1_000_000, None, False)
        setup = setup_of()
        self.other: Link = open_link(settings)
        self.log: list[bytes] = []
        self.client = DriveClient(
            open_link(settings),
            setup.database,
            drive_map=setup.binding.map,
            on_frames=lambda records: self.log.append(bytes(records)),
        )

    def heard(self) -> list[tuple[int, bytes]]:
        frames: list[tuple[int, bytes]] = []
        while frame := self.other.receive(20_000_000):
            frames.append((frame.can_id, bytes(frame.data)))
        return frames


@pytest.fixture
def bus(request: pytest.FixtureRequest) -> Iterator[Bus]:
    made = Bus(f"odrive-{time.monotonic_ns()}")
    yield made
    made.client.close()
    made.other.close()


def test_the_start_frames_wait_for_the_heartbeat(bus: Bus) -> None:
    bus.other.send(HEARTBEAT, struct.pack("<IBBBx", 0x1000, 1, 0, 0))  # it still has its error
    bus.other.send(HEARTBEAT, struct.pack("<IBBBx", 0, 1, 0, 0))
    bus.client.start()
    assert bus.heard() == [(CLEAR, b"\0"), (MODE, struct.pack("<II", 1, 1))]


def test_a_drive_that_keeps_its_error_is_told_and_not_started(bus: Bus) -> None:
    bus.other.send(HEARTBEAT, struct.pack("<IBBBx", 0x1000, 1, 0, 0))
    with pytest.raises(
        NoAnswer, match=r"Set_Controller_Mode was sent, and Heartbeat\.Axis_Error = 0 did not"
    ):
        bus.client.start()


def test_the_axis_state_is_sent_when_it_changes_and_with_each_stop(bus: Bus) -> None:
    ticks = new_ticks()
    tick = ticks[0]
    bus.client.prepare(tick)
    for word, torque in ((Controlword.SHUTDOWN, 0.0), (Controlword.ENABLE_OPERATION, 1.5)):
        for _ in range(3):
            tick["controlword"], tick["u_q"] = word, torque
            bus.client.send(tick)
    sent = bus.heard()
    assert [data for can_id, data in sent if can_id == STATE] == [struct.pack("<Q", 1), struct.pack("<Q", 8)]
    torques = [data for can_id, data in sent if can_id == TORQUE]
    assert torques == [struct.pack("<fxxxx", 0.0)] * 3 + [struct.pack("<fxxxx", 1.5)] * 3
    bus.client.flush()
    logged = np.frombuffer(b"".join(bus.log), FRAME)
    assert [(int(f["can_id"]), f["data"][: f["size"]].tobytes()) for f in logged] == sent
    bus.client.stop()
    stopped = bus.heard()
    assert stopped == [(STATE, struct.pack("<Q", 1)), (TORQUE, bytes(8))] * 5


class Drive:
    """What the frames' rules need of the drive behind."""

    def __init__(self) -> None:
        self.state: Any = {"state": int(DriveState.SWITCH_ON_DISABLED)}
        self.commands: list[tuple[int, float]] = []

    def command(self, _counter: int, word: int, torque: float, _d: float) -> None:
        self.commands.append((word, torque))


class NoDescriptor:
    """A link that is no socket to the client."""

    def __init__(self, link: SocketLink) -> None:
        self.send, self.receive, self.discard, self.close = link.send, link.receive, link.discard, link.close


@pytest.mark.compiled
def test_a_command_of_two_messages_is_one_compiled_call() -> None:
    """The same frames on any bus; one sent on change counts only once it was sent."""
    said: list[list[bytes]] = []
    for way in (lambda link: link, NoDescriptor):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        theirs.setblocking(False)
        setup, tick = setup_of(), new_ticks()[0]
        link: Link = way(SocketLink(None, ours, ours))
        client = DriveClient(link, setup.database, drive_map=setup.binding.map)
        client.prepare(tick)
        assert client.compiled() is not None
        sent: list[bytes] = []
        for controlword, torque in ((0, 0.0), (15, 0.0), (15, 1.5), (15, -1.5), (0, 0.0)):
            tick["controlword"], tick["u_q"] = controlword, torque
            client.send(tick)
            with contextlib.suppress(BlockingIOError):
                while True:
                    sent.append(theirs.recv(128))
        said.append(sent)
        theirs.close()
        tick["controlword"] = 15
        with pytest.raises(LinkError):
            client.send(tick)
        held = client._commanding["held"][: len(sent[0])]
        assert held.tobytes() == sent[-2], "what was not sent is not what went last"
        ours.close()
    assert said[0] == said[1]
    ids = [int.from_bytes(frame[:4], "little") for frame in said[0]]
    assert ids == [STATE, TORQUE, STATE, TORQUE, TORQUE, TORQUE, STATE, TORQUE]


def test_the_emulated_drive_takes_a_torque_in_mode_1_1_and_state_8_alone() -> None:
    frames, drive = ODriveFrames(NODE, truth=False), Drive()

    def take(can_id: int, data: bytes) -> None:
        frames.take(Frame(can_id, data, 0, False), drive, lambda: None)  # type: ignore[arg-type]

    torque = struct.pack("<fxxxx", 2.5)
    take(TORQUE, torque)
    assert drive.commands == [(0, 0.0)] and frames.ignored["mode"] == 1
    take(MODE, struct.pack("<II", 1, 1))
    take(STATE, struct.pack("<Q", 8))
    take(TORQUE, torque)
    assert drive.commands[-1] == (0x06, 2.5)
    drive.state["state"] = int(DriveState.OPERATION_ENABLED)
    take(TORQUE, torque[:4])
    assert frames.ignored["length"] == 1
    take(STATE, struct.pack("<Q", 1))
    assert drive.commands[-1] == (0, 0.0)


def test_an_idle_drive_whose_time_stands_still_goes_on_beating() -> None:
    """In lockstep nobody moves it on after a run, and the next must hear it; a run hears no beat more."""
    frames, drive = ODriveFrames(NODE, truth=False), Drive()
    out = dict.fromkeys(("v_dc", "temperature_motor", "temperature_inverter", "i_q", "w"), 0.0)
    out |= {"error": 0x8130, "state": int(DriveState.FAULT)}
    assert frames.beat() == [(HEARTBEAT, struct.pack("<IBBBx", 0, 1, 0, 0), False)]
    frames.answer(out)
    assert frames.beat() == []
    error = struct.pack("<IBBBx", 0x1000000, 1, 0, 0)
    assert frames.beat() == [(HEARTBEAT, error, False)]
    frames.take(Frame(STATE, struct.pack("<Q", 8), 0, False), drive, lambda: None)  # type: ignore[arg-type]
    assert frames.beat() == []


def test_what_the_emulated_drive_sends_is_read_by_cantools() -> None:
    database = cantools.database.load_file(CONFIGS / "drives/odrive.dbc", strict=False)
    out = {
        "error": 0x8130, "state": int(DriveState.FAULT), "v_dc": 540.5, "temperature_motor": 30.0,
        "i_q": -2.5, "temperature_inverter": 25.0, "w": 80.0, "T_L_true": 5.5, "w_true": 80.0,
    }  # fmt: skip
    frames = ODriveFrames(NODE, truth=True).answer(out)
    read: dict[str, Any] = {}
    for can_id, data, _ in frames:
        plain = can_id & 0x1FFFFFFF & ~(0x3F << 5)
        read |= database.get_message_by_frame_id(plain).decode(data, decode_choices=True)
    assert str(read["Axis_Error"]) == "WATCHDOG_TIMER_EXPIRED" and str(read["Axis_State"]) == "IDLE"
    assert read["Vel_Estimate"] == pytest.approx(80.0 / (2 * np.pi), rel=1e-7)
    assert (read["Iq_Measured"], read["Bus_Voltage"], read["Motor_Temperature"]) == (-2.5, 540.5, 30.0)
    assert read["LoadTorqueTrue"] == 5.5


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("drive.signals.on_value=1", "on_value and off_value are both 1"),
        ("drive.signals.on_value=5000000000", "on_value: 5000000000 is not of the form"),
        ('drive.signals.on_change=["Set_Input_Torque"]', "carries the command, which each tick sends"),
        ('drive.signals.on_change=["Get_Iq"]', "on_change: Get_Iq is no message of the command"),
        ('drive.signals.start=[{message="Nothing"}]', "start: "),
        (
            "drive.signals.cycle_ms={Set_Axis_State=1}",
            "cycle_ms: Set_Axis_State is no message that is received",
        ),
        ("drive.signals.cycle_ms={Get_Iq=0}", "cycle_ms: {'Get_Iq': 0} is not of the form"),
        (
            "drive.signals.cycle_ms={Get_Iq=10}",
            "or, where the drive is set to more, drive.signals.cycle_ms = { Get_Iq",
        ),
        ('drive.signals.start=[{message="Clear_Errors",values={Foo=1}}]', "Foo"),
        ('drive.signals.start=[{message="Clear_Errors",expect={Heartbeat=0}}]', "MESSAGE.Signal"),
        ('drive.signals.start=[{massage="Clear_Errors"}]', "is not of the form that it takes"),
        ('drive.signals.start=[{message="Clear_Errors",wait_ms=1e9}]', "is not of the form that it takes"),
        ('drive.signals.stop=[{message="Set_Axis_State",values={Axis_Requested_State=-1}}]', "does not fit"),
    ],
)
def test_a_mistake_of_the_map_is_one_line(setting: str, said: str) -> None:
    with pytest.raises(DatabaseError) as caught:
        setup_of(setting)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_check_names_the_parameter_that_switches_a_message_on() -> None:
    """As shipped the drive sends estimates every 10 ms, and neither currents nor its supply."""
    beat, estimates = Heard(count=11, last_ns=10**9), Heard(count=101, last_ns=10**9)
    traffic = Traffic({"Heartbeat": beat, "Get_Encoder_Estimates": estimates})
    rows = {row.check: row for row in traffic_rows(setup_of(), traffic)}
    remedies = {check: row.remedy for check, row in rows.items() if "msg_rate_ms" in row.remedy}
    own = "<axis>.config.can"
    assert remedies == {
        "feedback rate Get_Encoder_Estimates":
            f"set {own}.encoder_msg_rate_ms = 1 in the drive, or feedback.period_ms",
        "feedback rate Get_Iq": f"set {own}.iq_msg_rate_ms = 1 in the drive",
        "rate Get_Bus_Voltage_Current": f"set {own}.bus_voltage_msg_rate_ms = 10 in the drive",
        "rate Get_Temperature": f"set {own}.temperature_msg_rate_ms = 10 in the drive",
    }  # fmt: skip
    silent = traffic_rows(setup_of(), Traffic())
    assert not [row for row in silent if row.check.startswith("rate ")], "the row drive says it"


@pytest.mark.compiled
def test_in_lockstep_it_holds_the_load_and_replays_to_the_bit(tmp_path: Path) -> None:
    assert held_in_lockstep(PATH, tmp_path).verdict == "same"
