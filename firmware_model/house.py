"""Frames of the house protocol as the drive speaks it: classic or FD, CiA 402 controlword, echo, E2E.

What is taken of a frame, and how an answer is laid out, are kernels, :func:`accept` and :func:`lay_answers`;
:mod:`firmware_model.station` calls the same between the frames of a socket.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from drivers.binding import Bound
from drivers.bus import Frame
from drivers.codec import Database, Message
from drivers.errors import DatabaseError, EncodeError
from drivers.local import pack_frame
from drivers.tables import Tables, laid_out
from drivers.wire import DATA_AT, FD_BYTES, FRAME, REFUSED, STATE, encode, is_valid, phys_of
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Sent, Synchronous
from firmware_model.jit import entry, jit
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
FIRST_ANSWER: Final = 2
"""Place in a drive's counters of the first answer, behind those of the last command and load."""
VOLTAGE, LOAD, STATUS, FEEDBACK = 1, 2, 4, 8
"""What a message carries, as bits."""
COUNTER, MODE_AT, CONTROLWORD, U_Q, U_D, ENABLE, T_L = range(7)
"""Places of a command's signals among the values."""
COMMAND: Final = {
    "Mode": MODE_AT, "Controlword": CONTROLWORD, "VoltageQ": U_Q, "VoltageD": U_D,
    "CurrentQ": U_Q, "CurrentD": U_D, "LoadEnable": ENABLE, "LoadTorque": T_L,
}  # fmt: skip
LOAD_COMMAND: Final = {"Enable": ENABLE, "LoadTorque": T_L}
TAKEN: Final = 0
WHY: Final = ("", "length", "crc", "mode", "repeated")
"""Why a command was not taken, by what :func:`accept` returns."""


@jit
def accept(
    raw: Any, index: int, mode: int, counters: Any, messages: Any, signals: Any, values: Any, words: Any
) -> int:
    """Take the values of a command that is whole, valid and fresh: TAKEN, else the place in WHY."""
    m = messages[index]
    if int(raw[4]) != m["length"]:
        return 1
    if not is_valid(raw, m):
        return 2
    values[COUNTER], values[MODE_AT] = phys_of(raw, m["length"], signals[m["first"]], words), mode
    for place in range(m["first"] + 1, m["first"] + m["count"]):
        values[signals[place]["source"]] = phys_of(raw, m["length"], signals[place], words)
    if values[MODE_AT] != mode:
        return 3
    if int(values[COUNTER]) == counters[index]:
        return 4
    counters[index] = int(values[COUNTER])
    return TAKEN


@jit
def lay_answers(
    left_out: int, counters: Any, messages: Any, signals: Any, values: Any, out: Any, words: Any, wire: Any,
    log: Any,
) -> int:  # fmt: skip
    """Lay out what answers a SYNC but what carries ``left_out``; the place of what can't be sent, or -1."""
    for index in range(len(messages)):
        m = messages[index]
        if m["bit"] & left_out:
            continue
        if m["modulus"] > 0:
            place = FIRST_ANSWER + index
            counters[place] = (counters[place] + 1) % m["modulus"]
            values[COUNTER] = counters[place]
        if encode(out[index * FD_BYTES :], values, index, messages, signals, wire, words, log, 0) == REFUSED:
            return index
    return -1


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
        self._check_floats()
        self._emergency_id = database.message("EMCY").can_id
        self._heartbeat_id = database.message("HEARTBEAT").can_id
        self.sync_id: int | None = database.message("SYNC").can_id
        self.inline_load = "LoadTorque" in self.command.signals
        self.ignored: Counter[str] = Counter()
        self._make_tables()

    def _make_tables(self) -> None:
        """What the kernels work on: the messages taken and sent, their values, and room for each frame."""
        taken, sent, place = Tables(), Tables(), 1
        has = {name: at for name, at in COMMAND.items() if name in self.command.signals}
        _add(taken, self.command, has, VOLTAGE | (LOAD if self.inline_load else 0))
        if self.load_command:
            _add(taken, self.load_command, LOAD_COMMAND, LOAD)
        for message, fields in self.answers:
            carries = STATUS if message is self.status else 0
            carries |= FEEDBACK if message is self.answers[-1][0] else 0
            _add(sent, message, {name: at for at, name in enumerate(fields, place)}, carries)
            place += len(fields)
        self.fields = [field for _, fields in self.answers for field in fields.values()]
        """Of the sample what is sent, in the order of the values, from the second on."""
        heads = [laid_out(message.send_id, message.length, message.fd) for message, _ in self.answers]
        self._places = {self.command.can_id: 0} | ({self.load_command.can_id: 1} if self.load_command else {})
        (self.taken, self.taken_signals), (self.sent, self.sent_signals) = taken.records(), sent.records()
        self.counters = np.array([-1, -1, *(0 for _ in self.answers)], np.int64)
        self.values, self.out = np.zeros(max(place, len(COMMAND) + 1)), np.concatenate(heads)
        self.raw, self.words = np.zeros(FD_BYTES + DATA_AT, np.uint8), np.zeros(2, np.uint32)
        self.wire_state, self.log = np.zeros(1, STATE), np.zeros(0, FRAME)
        self._v: Any = self.values.data
        more = self.values, self.words
        taking = self.mode, self.counters, self.taken, self.taken_signals, *more
        self._accept, self._taking = entry(accept, self.raw, 0, *taking), taking
        laying = self.sent, self.sent_signals, self.values, self.out, self.words, self.wire_state, self.log
        self._lay, self._laying = entry(lay_answers, 0, self.counters.copy(), *laying), laying

    def _check_counters(self) -> None:
        """It counts from 0, whatever the DBC would allow a real drive. Raises DatabaseError."""
        for message in (self.command, self.load_command, *(message for message, _ in self.answers)):
            counter = message.signals.get("Counter") if message else None
            if message and counter and counter.raw_range()[0] != 0:
                raise DatabaseError(
                    f"{message.name}.Counter begins with {counter.raw_range()[0]} by the DBC; the emulated "
                    "drive counts from 0: give it a DBC of its own in its plant's file"
                )

    def _check_floats(self) -> None:
        """The kernels write floats of 32 and 64 bits. Raises DatabaseError."""
        for message, _ in self.answers:
            for signal in message.signals.values():
                if signal.is_float and signal.length == 16:
                    raise DatabaseError(
                        f"{message.name}.{signal.name} is a float of 16 bits, which the emulated drive "
                        "can't send: give it a DBC of its own in its plant's file"
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
            return
        index = self._places.get(frame.can_id)
        if index is None:
            return
        raw, v = pack_frame(frame.can_id, frame.data, len(frame.data) > 8), self._v
        self.raw[: len(raw)] = np.frombuffer(raw, np.uint8)
        if why := self._accept(self.raw, index, *self._taking):
            self.ignored[WHY[why]] += 1
            return
        carries = int(self.taken[index]["bit"])
        if carries & VOLTAGE:
            catch_up()
        if carries & LOAD:
            drive.load(v[T_L] if v[ENABLE] else 0.0)
        if carries & VOLTAGE:
            drive.command(int(v[COUNTER]), int(v[CONTROLWORD]), v[U_Q], v[U_D])

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """EMCY if a fault arose, TRUTH, STATUS when due, FEEDBACK last, where it is."""
        frames: list[Sent] = []
        if out["emcy_due"]:
            frames.append((self._emergency_id, struct.pack("<HB5x", int(out["error"]), 1), False))
        for place, field in enumerate(self.fields, 1):
            self._v[place] = out[field]
        left_out = (0 if out["status_due"] else STATUS) | (0 if self.feedback else FEEDBACK)
        if (odd := self._lay(left_out, self.counters, *self._laying)) >= 0:
            message, fields = self.answers[odd]
            message.encode({name: out[field] for name, field in fields.items()})
            raise EncodeError(f"{message.name} can't be sent")
        for index, (message, _) in enumerate(self.answers):
            if not int(self.sent[index]["bit"]) & left_out:
                at = FD_BYTES * index + DATA_AT
                frames.append((message.can_id, self.out[at : at + message.length].tobytes(), message.fd))
        return frames


def _add(tables: Tables, message: Message, sources: dict[str, int], carries: int) -> None:
    counter = "Counter" if "Counter" in message.signals else ""
    rows = [(message.signals[name], 0, 0, source, False) for name, source in sources.items()]
    tables.add(Bound(message, counter, ()), rows, carries)


MEMBER: Final = Dialect(
    "the house protocol (docs/protocol.md)", lambda database, truth, eds: HouseFrames(database, truth=truth)
)
