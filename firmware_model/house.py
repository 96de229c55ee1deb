"""Frames of the house protocol as the drive speaks it: classic or FD, CiA 402 controlword, echo, E2E."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from drivers.bus import Frame
from drivers.codec import Database, Message
from drivers.errors import DatabaseError
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Sent, Synchronous
from firmware_model.kernels import Kernels

VOLTAGE_MODE, CURRENT_MODE = 0, 1
COMMANDED: Final = {"VoltageQ": VOLTAGE_MODE, "CurrentQ": CURRENT_MODE}
"""The mode that a command must have, by the signal that its DBC has in it."""
MEASURED: Final = {
    "Echo": "echo", "Speed": "w", "CurrentQ": "i_q", "CurrentD": "i_d", "State": "state",
    "Limited": "limited",
}  # fmt: skip
SLOW: Final = {
    "ProtocolVersion": "protocol_version",
    "DcLinkVoltage": "v_dc",
    "TemperatureMotor": "temperature_motor",
    "TemperatureInverter": "temperature_inverter",
    "ErrorCode": "error",
}
TRUE: Final = {"LoadTorqueTrue": "T_L_true", "SpeedTrue": "w_true"}
"""Signals of what is sent, by the field of the sample that each carries."""
LAST_COMMAND, LAST_LOAD, FIRST_ANSWER = range(3)
"""Places in a drive's counters: of the last command and load, then of each answer."""


class HouseFrames(Synchronous):
    """What the drive reads and writes. ``ignored`` counts frames that are not whole, valid and fresh."""

    beat_ns = 100_000_000

    def __init__(self, database: Database, *, truth: bool) -> None:
        current = "CurrentQ" in database.message("COMMAND").signals
        self.axes = ("CurrentQ", "CurrentD") if current else ("VoltageQ", "VoltageD")
        self.mode = COMMANDED[self.axes[0]]
        self.command = database.message("COMMAND", "Counter", "Mode", "Controlword", *self.axes)
        self.load_command = database.optional("LOAD_COMMAND")
        self.status = database.message("STATUS", *SLOW) if database.optional("STATUS") else None
        angle = {"Angle": "theta"} if "Angle" in database.message("FEEDBACK").signals else {}
        measured = MEASURED | angle | ({} if self.status else SLOW)
        self.answers = [(database.message("TRUTH", *TRUE), TRUE)] if truth else []
        self.answers += [(self.status, SLOW)] if self.status else []
        self.answers += [(database.message("FEEDBACK", *measured), measured)]
        """What is sent after a SYNC, FEEDBACK last, and the fields of the sample in it."""
        self._check_counters()
        self.counters = np.array([-1, -1, *(0 for _ in self.answers)], np.int64)
        self._counters: Any = self.counters.data
        self._emergency_id = database.message("EMCY").can_id
        self._heartbeat_id = database.message("HEARTBEAT").can_id
        self.sync_id: int | None = database.message("SYNC").can_id
        load, command = self.load_command, self.command
        self._read_load = load.reader("Counter", "Enable", "LoadTorque") if load else None
        self._read_mode = command.reader("Mode")
        self._read_command = command.reader("Counter", "Controlword", *self.axes)
        self.inline_load = "LoadTorque" in command.signals
        self._read_inline = command.reader("LoadEnable", "LoadTorque") if self.inline_load else None
        self.ignored: Counter[str] = Counter()

    def _check_counters(self) -> None:
        """It counts from 0, whatever the DBC would allow a real drive. Raises DatabaseError."""
        for message in (self.command, self.load_command, *(message for message, _ in self.answers)):
            counter = message.signals.get("Counter") if message else None
            if message and counter and counter.raw_range()[0] != 0:
                raise DatabaseError(
                    f"{message.name}.Counter begins with {counter.raw_range()[0]} by the DBC; the emulated "
                    "drive counts from 0: give it a DBC of its own in its plant's file"
                )

    @property
    def spoken(self) -> dict[int, int] | None:
        """Length of each message that it sends or takes, by identifier."""
        load = [self.load_command] if self.load_command else []
        messages = [self.command, *load, *(message for message, _ in self.answers)]
        return {message.send_id: message.length for message in messages}

    @property
    def wire(self) -> Wire:
        """Resolution and range of the measured signals."""
        signals = self.answers[-1][0].signals
        speed, i_q, i_d = signals["Speed"], signals["CurrentQ"], signals["CurrentD"]
        theta_lsb = signals["Angle"].scale if "Angle" in signals else 0.0
        return Wire(speed.scale, speed.top, i_q.scale, i_q.top, i_d.scale, i_d.top, theta_lsb)

    @property
    def counter_modulus(self) -> int:
        """Number of values of the command's counter."""
        return self.command.counter_modulus

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
        elif frame.can_id == self.command.can_id:
            self._on_command(frame.data, drive, catch_up)
        elif self.load_command and frame.can_id == self.load_command.can_id:
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
        if not self._acceptable(self.command, data):
            return
        counter, controlword, u_q, u_d = self._read_command(data)
        if self._read_mode(data)[0] != self.mode:
            self.ignored["mode"] += 1
            return
        if counter == self._counters[LAST_COMMAND]:
            self.ignored["repeated"] += 1
            return
        self._counters[LAST_COMMAND] = int(counter)
        catch_up()
        if self._read_inline:
            enable, T_L = self._read_inline(data)
            drive.load(T_L if enable else 0.0)
        drive.command(int(counter), int(controlword), u_q, u_d)

    def _on_load(self, data: bytes, drive: Kernels) -> None:
        assert self.load_command is not None and self._read_load is not None  # noqa: S101 - set together
        if not self._acceptable(self.load_command, data):
            return
        counter, enable, T_L = self._read_load(data)
        if counter == self._counters[LAST_LOAD]:
            self.ignored["repeated"] += 1
            return
        self._counters[LAST_LOAD] = int(counter)
        drive.load(T_L if enable else 0.0)

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """EMCY if a fault arose, TRUTH, STATUS when due, FEEDBACK last, where it is."""
        frames: list[Sent] = []
        if out["emcy_due"]:
            frames.append((self._emergency_id, struct.pack("<HB5x", int(out["error"]), 1), False))
        for place, (message, fields) in enumerate(self.answers, FIRST_ANSWER):
            if message is self.status and not out["status_due"]:
                continue
            if message is self.answers[-1][0] and not self.feedback:
                continue
            values = {name: out[field] for name, field in fields.items()}
            if "Counter" in message.signals:
                self._counters[place] = (self._counters[place] + 1) % message.counter_modulus
                values["Counter"] = self._counters[place]
            frames.append((message.can_id, message.encode(values), message.fd))
        return frames


MEMBER: Final = Dialect(
    "the house protocol (docs/protocol.md)", lambda database, truth, eds: HouseFrames(database, truth=truth)
)
