"""Frames of the house protocol as the drive speaks it: classic or FD, CiA 402 controlword, echo, E2E."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

from drivers.bus import Frame
from drivers.codec import Database, Message
from firmware_model.config import Wire
from firmware_model.kernels import Kernels

PROTOCOL_VERSION = 1
VOLTAGE_MODE = 0
Sent = tuple[int, bytes, bool]
"""Identifier as it stands in the frame, data, FD."""


class HouseFrames:
    """What the drive reads and writes. ``ignored`` counts frames that are not whole, valid and fresh."""

    def __init__(self, database: Database, *, truth: bool) -> None:
        self._feedback: Message = database.message("FEEDBACK", "Speed", "CurrentQ", "CurrentD")
        self._command = database.message("COMMAND")
        self._status = database.messages.get("STATUS")
        self._load = database.messages.get("LOAD_COMMAND")
        self._truth_id = database.message("TRUTH").can_id if truth else None
        self._emergency_id = database.message("EMCY").can_id
        self._heartbeat_id = database.message("HEARTBEAT").can_id
        self.sync_id: int | None = database.message("SYNC").can_id
        self._read_load = self._load.reader("Counter", "Enable", "LoadTorque") if self._load else None
        self._read_mode = self._command.reader("Mode")
        self._read_command = self._command.reader("Counter", "Controlword", "VoltageQ", "VoltageD")
        inline = "LoadTorque" in self._command.signals
        self._read_inline = self._command.reader("LoadEnable", "LoadTorque") if inline else None
        self._counter = self._status_counter = 0
        self._last_command = self._last_load = -1
        self.ignored: Counter[str] = Counter()

    @property
    def wire(self) -> Wire:
        """Resolution and range of the measured signals."""
        signals = self._feedback.signals
        speed, i_q, i_d = signals["Speed"], signals["CurrentQ"], signals["CurrentD"]
        return Wire(speed.scale, speed.top, i_q.scale, i_q.top, i_d.scale, i_d.top)

    @property
    def counter_modulus(self) -> int:
        """Number of values of the command's counter."""
        return self._command.counter_modulus

    def boot(self) -> list[Sent]:
        """The boot-up message."""
        return [(self._heartbeat_id, b"\x00", False)]

    def beat(self) -> list[Sent]:
        """The heartbeat: operational."""
        return [(self._heartbeat_id, b"\x05", False)]

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """Take a command, whole or not at all; ``catch_up`` brings the plant to now first."""
        if frame.flags:
            self.ignored["flags"] += 1
        elif frame.can_id == self._command.can_id:
            self._on_command(frame.data, drive, catch_up)
        elif self._load and frame.can_id == self._load.can_id:
            self._on_load(frame.data, drive)

    def _acceptable(self, message: Message, data: bytes) -> bool:
        if len(data) != message.length:
            self.ignored["length"] += 1
            return False
        if not message.valid(data):
            self.ignored["crc"] += 1
            return False
        return True

    def _on_command(self, data: bytes, drive: Kernels, catch_up: Callable[[], None]) -> None:
        if not self._acceptable(self._command, data):
            return
        counter, controlword, u_q, u_d = self._read_command(data)
        if self._read_mode(data)[0] != VOLTAGE_MODE:
            self.ignored["mode"] += 1
            return
        if counter == self._last_command:
            self.ignored["repeated"] += 1
            return
        self._last_command = int(counter)
        catch_up()
        if self._read_inline:
            enable, T_L = self._read_inline(data)
            drive.load(T_L if enable else 0.0)
        drive.command(int(counter), int(controlword), u_q, u_d)

    def _on_load(self, data: bytes, drive: Kernels) -> None:
        assert self._load is not None and self._read_load is not None  # noqa: S101 - set together
        if not self._acceptable(self._load, data):
            return
        counter, enable, T_L = self._read_load(data)
        if counter == self._last_load:
            self.ignored["repeated"] += 1
            return
        self._last_load = int(counter)
        drive.load(T_L if enable else 0.0)

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """EMCY if a fault arose, TRUTH, STATUS when due, FEEDBACK last."""
        frames: list[Sent] = []
        if out["emcy_due"]:
            frames.append((self._emergency_id, struct.pack("<HB5x", int(out["error"]), 1), False))
        if self._truth_id is not None:
            frames.append((self._truth_id, struct.pack("<ff", out["T_L_true"], out["w_true"]), False))
        status = {
            "ProtocolVersion": PROTOCOL_VERSION,
            "DcLinkVoltage": float(out["v_dc"]),
            "TemperatureMotor": float(out["temperature_motor"]),
            "TemperatureInverter": float(out["temperature_inverter"]),
            "ErrorCode": int(out["error"]),
        }
        if self._status and out["status_due"]:
            self._status_counter = (self._status_counter + 1) % self._status.counter_modulus
            data = self._status.encode({"Counter": self._status_counter, **status})
            frames.append((self._status.can_id, data, False))
        self._counter = (self._counter + 1) % self._feedback.counter_modulus
        values = {
            "Counter": self._counter,
            "Echo": int(out["echo"]),
            "Speed": float(out["w"]),
            "CurrentQ": float(out["i_q"]),
            "CurrentD": float(out["i_d"]),
            "State": int(out["state"]),
            "Limited": int(out["limited"]),
        }
        if not self._status:
            values |= status
        return [*frames, (self._feedback.can_id, self._feedback.encode(values), self._feedback.fd)]
