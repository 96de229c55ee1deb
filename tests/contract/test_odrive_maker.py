"""ODrive's CAN Simple against the maker's own DBC (PyPI odrive-can 2.1.0), read by cantools.

Our frames are those that it encodes, bit for bit; the emulated drive's and its own are read alike by both.
The maker's file itself serves as a drive's DBC.
"""

from __future__ import annotations

import importlib.util
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusSettings, Frame, open_link
from drivers.client import DriveClient
from drivers.codec import Database
from firmware_model.odrive import ODriveFrames
from hil.runtime.setup import Overrides, load_setup
from hil.signals import Controlword, DriveState, RxFlag, new_ticks
from tests.conftest import CONFIGS
from tests.contract.test_odrive import Drive

NODE = 1
PATH, OURS = CONFIGS / "odrive.toml", CONFIGS / "drives/odrive.dbc"
MAKERS = Path((importlib.util.find_spec("odrive_can") or pytest.fail()).submodule_search_locations[0])  # type: ignore[index]
MAKERS = MAKERS / "dbc/odrive-cansimple-0.6.10.dbc"
EMULATED = {"STEP", "TRUTH"}
"""The emulator's own."""
OWN = Database(OURS, NODE, "id << 5 : 6")
NAMES = sorted(set(OWN.names) - EMULATED)


@pytest.fixture(scope="module")
def maker() -> Any:
    return cantools.database.load_file(MAKERS)


@pytest.fixture(scope="module")
def ours() -> Any:
    return cantools.database.load_file(OURS)


def test_each_message_has_the_makers_identifier_length_and_signals(maker: Any, ours: Any) -> None:
    """Sign, scale and form of each signal, and its unit."""
    assert len(NAMES) > 8
    for name in NAMES:
        own, theirs = OWN.message(name), maker.get_message_by_name(f"Axis{NODE}_{name}")
        assert (own.send_id, own.length) == (theirs.frame_id, theirs.length), name
        known = {signal.name: signal for signal in theirs.signals}
        mine = {signal.name: signal for signal in ours.get_message_by_name(name).signals}
        assert set(mine) == set(known), name
        for part, signal in mine.items():
            other = known[part]
            for kind in ("start", "length", "byte_order", "is_float", "scale", "offset", "unit"):
                assert getattr(signal, kind) == getattr(other, kind), (name, part, kind)


def values_of(name: str) -> st.SearchStrategy[dict[str, float]]:
    """What a message may say."""
    real = st.floats(-(2.0**127), 2.0**127, width=32)
    signals = OWN.message(name).signals
    parts = {n: real if s.is_float else st.integers(*s.raw_range()) for n, s in signals.items()}
    return st.fixed_dictionaries(parts)


@pytest.mark.parametrize("name", NAMES)
def test_what_one_writes_the_other_reads(name: str, maker: Any) -> None:
    own, theirs = OWN.message(name), maker.get_message_by_name(f"Axis{NODE}_{name}")

    @given(values_of(name))
    def same(values: dict[str, float]) -> None:
        data = own.encode(values)
        assert data == theirs.encode(values, strict=False)
        assert theirs.decode(data, decode_choices=False) == values == own.decode(data)

    same()


def read(maker: Any, can_id: int, data: bytes) -> tuple[str, dict[str, Any]]:
    """A frame as the maker's file has it: message without the axis, values."""
    message = maker.get_message_by_frame_id(can_id)
    return message.name.removeprefix(f"Axis{NODE}_"), message.decode(data)


class Bus:
    """A client of a configuration on a bus of its own, whose frames the maker's file reads."""

    def __init__(self, path: Path, maker: Any) -> None:
        settings = BusSettings("hil-local", f"odrive-{time.monotonic_ns()}", 1_000_000, None, False)
        setup = load_setup(path, Overrides())
        self._other, self._maker, self.tick = open_link(settings), maker, new_ticks()[0]
        self.client = DriveClient(open_link(settings), setup.database, drive_map=setup.binding.map)
        self.client.prepare(self.tick)

    def says(self, name: str, values: dict[str, Any]) -> None:
        """The drive sends a message as the maker's file encodes it."""
        message = self._maker.get_message_by_name(f"Axis{NODE}_{name}")
        self._other.send(message.frame_id, message.encode(values, strict=False))

    def heard(self) -> list[tuple[str, dict[str, Any]]]:
        """What the client has sent, read by the maker's file."""
        frames = []
        while frame := self._other.receive(20_000_000):
            frames.append(read(self._maker, frame.can_id, bytes(frame.data)))
        return frames

    def close(self) -> None:
        self.client.close()
        self._other.close()


def makers_config(folder: Path) -> Path:
    """`configs/odrive.toml` by the maker's file, in which each axis has messages of its own."""
    text = re.sub(r"^(load_true|step|node_rule) .*\n", "", PATH.read_text(), flags=re.M)
    text = re.sub(r'(?<=")(Get_|Set_|Heartbeat|Clear_)', rf"Axis{NODE}_\1", text)
    text = text.replace("drives/odrive.dbc", str(MAKERS)).replace('"../', f'"{CONFIGS.parent}/')
    text = text.replace('"plants/', f'"{CONFIGS}/plants/')
    text = text.replace(
        "[drive.signals]", f"[drive.signals]\ncycle_ms = {{ Axis{NODE}_Get_Encoder_Estimates = 1 }}", 1
    )
    path = folder / "makers.toml"
    path.write_text(text)
    return path


@pytest.fixture(params=["ours", "the maker's"])
def bus(request: pytest.FixtureRequest, maker: Any, tmp_path: Path) -> Iterator[Bus]:
    """By our DBC, and by the maker's."""
    made = Bus(PATH if request.param == "ours" else makers_config(tmp_path), maker)
    yield made
    made.close()


def test_what_a_run_sends_and_hears_is_what_the_maker_says(bus: Bus) -> None:
    """Start frames, a command, measurements, the stop."""
    bus.says(
        "Heartbeat", {"Axis_Error": 0, "Axis_State": 1, "Procedure_Result": 0, "Trajectory_Done_Flag": 0}
    )
    bus.client.start()
    bus.tick["controlword"], bus.tick["u_q"] = Controlword.ENABLE_OPERATION, 1.5
    bus.client.send(bus.tick)
    assert bus.heard() == [
        ("Clear_Errors", {"Identify": 0}),
        ("Set_Controller_Mode", {"Control_Mode": "TORQUE_CONTROL", "Input_Mode": "PASSTHROUGH"}),
        ("Set_Axis_State", {"Axis_Requested_State": "CLOSED_LOOP_CONTROL"}),
        ("Set_Input_Torque", {"Input_Torque": 1.5}),
    ]
    beat = {"Axis_Error": 0x1000000, "Axis_State": 8, "Procedure_Result": 0, "Trajectory_Done_Flag": 0}
    bus.says("Heartbeat", beat)
    bus.says("Get_Bus_Voltage_Current", {"Bus_Voltage": 540.5, "Bus_Current": 0.0})
    bus.says("Get_Temperature", {"FET_Temperature": 25.0, "Motor_Temperature": 30.5})
    bus.says("Get_Iq", {"Iq_Setpoint": 0.0, "Iq_Measured": -2.5})
    bus.says("Get_Encoder_Estimates", {"Pos_Estimate": 0.0, "Vel_Estimate": 12.5})
    bus.client.receive(bus.tick, time.monotonic_ns() + 1_000_000_000)
    t = bus.tick
    assert t["rx_flags"] & int(RxFlag.FRESH)
    assert (t["drive_state"], t["drive_error"]) == (DriveState.OPERATION_ENABLED, 0x1000000)
    assert (t["i_q"], t["v_dc"], t["temperature_motor"], t["temperature_inverter"]) == (
        -2.5,
        540.5,
        30.5,
        25.0,
    )
    assert t["w"] == pytest.approx(12.5 * 2 * np.pi, rel=1e-15)
    bus.client.stop()
    stopped = [
        ("Set_Axis_State", {"Axis_Requested_State": "IDLE"}),
        ("Set_Input_Torque", {"Input_Torque": 0.0}),
    ]
    assert bus.heard() == stopped * 5


def test_what_the_emulated_drive_sends_is_what_the_maker_says(maker: Any) -> None:
    """And it takes what the maker's file encodes."""
    out = {
        "error": 0x8130, "state": int(DriveState.FAULT), "v_dc": 540.5, "temperature_motor": 30.0,
        "i_q": -2.5, "temperature_inverter": 25.0, "w": 25.0 * np.pi, "theta": np.pi,
    }  # fmt: skip
    frames = ODriveFrames(NODE, truth=False)
    said = dict(read(maker, can_id, data) for can_id, data, _ in frames.answer(out))
    assert said == {
        "Heartbeat": {"Axis_Error": "WATCHDOG_TIMER_EXPIRED", "Axis_State": "IDLE",
                      "Procedure_Result": "SUCCESS", "Trajectory_Done_Flag": 0},
        "Get_Temperature": {"FET_Temperature": 25.0, "Motor_Temperature": 30.0},
        "Get_Bus_Voltage_Current": {"Bus_Voltage": 540.5, "Bus_Current": 0.0},
        "Get_Iq": {"Iq_Setpoint": 0.0, "Iq_Measured": -2.5},
        "Get_Encoder_Estimates": {"Pos_Estimate": 0.5, "Vel_Estimate": 12.5},
    }  # fmt: skip
    drive = Drive()
    asked: list[tuple[str, dict[str, Any]]] = [
        ("Set_Controller_Mode", {"Control_Mode": "TORQUE_CONTROL", "Input_Mode": "PASSTHROUGH"}),
        ("Set_Axis_State", {"Axis_Requested_State": "CLOSED_LOOP_CONTROL"}),
        ("Set_Input_Torque", {"Input_Torque": 2.5}),
    ]
    for name, values in asked:
        message = maker.get_message_by_name(f"Axis{NODE}_{name}")
        frame = Frame(message.frame_id, message.encode(values), 0, False)
        frames.take(frame, drive, lambda: None)  # type: ignore[arg-type]
    assert drive.commands == [(int(Controlword.SHUTDOWN), 2.5)] and not frames.ignored
