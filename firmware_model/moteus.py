"""Frames of a moteus (register protocol over CAN FD), read and laid out here by hand.

A frame is a row of subframes: write, read, reply, error, NOP; its identifier is source << 8 | destination,
bit 15 asks for an answer. A command acts once its frame writes the mode; position mode is watched, by the
time-out in the frame or the drive's own, and what has timed out is left by a stop alone. Of position mode
the feedforward torque is modelled: gains that are not 0 are not taken. Facts: the maker's docs/protocol
(registers.md, can.md). TRUTH is the emulator's own.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from drivers.bus import Frame
from drivers.local import EFF_FLAG
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Sent, Synchronous
from firmware_model.inverter import controlword
from firmware_model.kernels import Kernels
from firmware_model.plant import ErrorCode, State, Takes

ASKS: Final = 0x8000
TRUTH: Final = EFF_FLAG | 0x1FFFF801
STOPPED, FAULT, VOLTAGE_DQ, CURRENT, POSITION, TIMEOUT = 0, 1, 8, 9, 10, 11
MODES: Final = {VOLTAGE_DQ: Takes.VOLTAGE, CURRENT: Takes.CURRENT, POSITION: Takes.TORQUE}
"""Modes that command, and what a drive behind takes in them."""
MODE, VELOCITY_AT, FAULT_AT = 0x000, 0x002, 0x00F
D_VOLTAGE, Q_VOLTAGE, Q_CURRENT, D_CURRENT = 0x01A, 0x01B, 0x01C, 0x01D
TORQUE, MAX_TORQUE, WATCHDOG = 0x022, 0x025, 0x027
GAINS: Final = (0x023, 0x024, 0x02B)
"""Scales of kp, kd and the integrator's limit."""
DEFAULTS: Final = dict.fromkeys(GAINS, 1.0) | {MAX_TORQUE: math.nan}
"""Of what a command leaves out; all others are 0."""
ERRORS: Final = {
    int(ErrorCode.NONE): 0,
    int(ErrorCode.DC_LINK_OVER_VOLTAGE): 34,
    int(ErrorCode.DC_LINK_UNDER_VOLTAGE): 40,
    int(ErrorCode.OVER_TEMPERATURE_MOTOR): 38,
    int(ErrorCode.OVER_TEMPERATURE_DRIVE): 38,
    int(ErrorCode.COMMUNICATION_TIMEOUT): 0,
}
"""Fault code of each error of the drive behind; motor driver fault for the others."""
DRIVER_FAULT: Final = 33
NOP: Final = 0x50
LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
KINDS: Final = ("<b", "<h", "<i", "<f")
_SCALES: Final = {
    0x001: (0.01, 1e-4, 1e-5), 0x002: (0.1, 0.00025, 1e-5), 0x003: (0.5, 0.01, 0.001),
    0x004: (1.0, 0.1, 0.001), 0x005: (1.0, 0.1, 0.001), 0x00A: (1.0, 0.1, 0.001),
    0x00D: (0.5, 0.1, 0.001), 0x00E: (1.0, 0.1, 0.001), TORQUE: (0.5, 0.01, 0.001),
    MAX_TORQUE: (0.5, 0.01, 0.001), WATCHDOG: (0.01, 0.001, 1e-6),
    Q_CURRENT: (1.0, 0.1, 0.001), D_CURRENT: (1.0, 0.1, 0.001),
    D_VOLTAGE: (0.5, 0.1, 0.001), Q_VOLTAGE: (0.5, 0.1, 0.001),
    **dict.fromkeys(GAINS, (1.0 / 127.0, 1.0 / 32767.0, 1.0 / 2147483647.0)),
}  # fmt: skip
"""Of one step as int8, int16 and int32; of other registers 1."""
TURN: Final = 2.0 * math.pi
IN_FAULT, ENABLED, TIMED_OUT = (
    int(State.FAULT),
    int(State.OPERATION_ENABLED),
    int(ErrorCode.COMMUNICATION_TIMEOUT),
)
"""As numbers: to look up an enumeration's member takes longer than what is done with it."""


class Subframe(NamedTuple):
    """One part of a frame: reads or writes ``many`` registers from ``start`` on, of a kind of KINDS."""

    reads: bool
    kind: int
    start: int
    many: int
    values: tuple[float, ...]


class BadFrame(ValueError):
    """A frame that is no row of subframes."""


def subframes(data: bytes) -> Iterator[Subframe]:
    """The reads and writes of a frame. Raises BadFrame."""
    at = 0
    while at < len(data):
        head, at = data[at], at + 1
        if head == NOP:
            continue
        if head >= 0x20:
            raise BadFrame(f"subframe 0x{head:02X}")
        count, kind = head & 0x03, head >> 2 & 0x03
        if not count:
            count, at = varuint(data, at)
        start, at = varuint(data, at)
        values: tuple[float, ...] = ()
        if head < 0x10:
            values, at = _values(data, at, kind, start, count)
        yield Subframe(head >= 0x10, kind, start, count, values)


def varuint(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, the lowest first, and where it ends."""
    value = 0
    for shift in range(0, 35, 7):
        if at >= len(data):
            raise BadFrame("ends in a number")
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    raise BadFrame("a number of more than 32 bits")


def _values(data: bytes, at: int, kind: int, start: int, count: int) -> tuple[tuple[float, ...], int]:
    layout = struct.Struct(f"<{count}{KINDS[kind][1]}")
    if at + layout.size > len(data):
        raise BadFrame("ends in a value")
    raw = layout.unpack_from(data, at)
    return tuple(to_physical(start + n, kind, one) for n, one in enumerate(raw)), at + layout.size


def to_physical(register: int, kind: int, raw: float) -> float:
    """A register's value; an integer's lowest number means none."""
    if kind == 3:
        return raw
    if raw == -(1 << 8 * (1 << kind) - 1):
        return math.nan
    return raw * _SCALES.get(register, (1.0, 1.0, 1.0))[kind]


def to_wire(register: int, kind: int, value: float) -> bytes:
    """A register's value as it is answered, rounded and kept within what the kind holds."""
    if kind == 3:
        return struct.pack("<f", value)
    top = (1 << 8 * (1 << kind) - 1) - 1
    raw = -top - 1 if math.isnan(value) else round(value / _SCALES.get(register, (1.0, 1.0, 1.0))[kind])
    return struct.pack(KINDS[kind], min(max(raw, -top), top) if math.isfinite(value) else raw)


def padded(data: bytes) -> bytes:
    """Filled up with NOP to the next length that a frame has."""
    return data.ljust(next(length for length in LENGTHS if length >= len(data)), bytes((NOP,)))


@dataclass(slots=True)
class Asked:
    """What is to be answered, and to whom."""

    source: int = 0
    reads: tuple[Subframe, ...] = ()


class MoteusFrames(Synchronous):
    """What this drive reads and writes. ``ignored`` counts frames that it did not take."""

    answers_commands = True
    beat_ns = 0
    """It speaks when it is asked, never by itself."""
    counter_modulus = 256
    wire = Wire(1e-6, 1e5, 1e-6, 1e4, 1e-6, 1e4, theta_lsb=1e-6, theta_counts=2.0**53)
    """Of float32 on the wire: rounded before to what its bits hold, the position over turns."""
    spoken: dict[int, int] | None = None
    """It answers what it is asked for, in a frame as long as that takes."""

    def __init__(self, node_id: int, *, truth: bool) -> None:
        self._node, self._truth = node_id, truth
        self._on = self._clear = False
        self._counter = 0
        self._asked = Asked()
        self._default_ns: int | None = None
        self._drive: Kernels | None = None
        self._known: dict[int, Callable[[], float]] | None = None
        self.sync_id: int | None = EFF_FLAG | ASKS | node_id
        """The command of the first master: it moves a drive in lockstep on."""
        self.ignored: Counter[str] = Counter()

    def asks(self, data: bytes) -> bool:
        """Any frame to it, whatever is in it."""
        return True

    def boot(self) -> list[Sent]:
        """It sends nothing when it starts."""
        return []

    def beat(self) -> list[Sent]:
        """It has no heartbeat."""
        return []

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """Take a frame for this drive, whole or not at all; another source is answered at once."""
        if frame.can_id & 0x7F != self._node or frame.can_id & 0x80 or frame.can_id >> 16:
            return
        self._drive, self._asked = drive, Asked()
        try:
            parts = tuple(subframes(frame.data))
        except BadFrame:
            self.ignored["subframe"] += 1
            return
        written = {one.start + n: v for one in parts if not one.reads for n, v in enumerate(one.values)}
        if MODE in written:
            catch_up()
            self._command(written, drive)
        if frame.can_id & ASKS:
            self._asked = Asked(frame.can_id >> 8 & 0x7F, tuple(one for one in parts if one.reads))
        if frame.can_id | frame.flags != self.sync_id:
            self.due = self._reply(drive)

    def _command(self, written: dict[int, float], drive: Kernels) -> None:
        """A command that wrote the mode; what it does not say has its default."""
        mode = int(written[MODE]) if math.isfinite(written[MODE]) else -1
        said = DEFAULTS | written
        q, d = self._wanted(mode, said)
        if mode not in (STOPPED, *MODES) or not (math.isfinite(q) and math.isfinite(d)):
            self.ignored["mode" if mode not in (STOPPED, *MODES) else "number"] += 1
            return
        fits = mode in MODES and MODES[mode] == drive.params["takes"]
        if mode == POSITION and any(said[gain] != 0.0 for gain in GAINS):
            self.ignored["gains"] += 1
            fits = False
        self._watch(mode, said.get(WATCHDOG, 0.0), drive)
        self._on, self._clear = fits, self._clear or mode == STOPPED
        if drive.state["state"] == IN_FAULT:
            self._on = False
        word = controlword(drive.state, self._on, self._clear)
        self._clear = self._clear and drive.state["state"] != IN_FAULT
        self._counter = (self._counter + 1) % self.counter_modulus
        drive.command(self._counter, word, q if fits else 0.0, d if fits else 0.0)

    @staticmethod
    def _wanted(mode: int, said: dict[int, float]) -> tuple[float, float]:
        """Command (q, d) of a mode."""
        if mode == POSITION:
            torque, most = said.get(TORQUE, 0.0), said[MAX_TORQUE]
            return (torque if math.isnan(most) else min(max(torque, -most), most)), 0.0
        if mode == CURRENT:
            return said.get(Q_CURRENT, 0.0), said.get(D_CURRENT, 0.0)
        return (said.get(Q_VOLTAGE, 0.0), said.get(D_VOLTAGE, 0.0)) if mode == VOLTAGE_DQ else (0.0, 0.0)

    def _watch(self, mode: int, timeout_s: float, drive: Kernels) -> None:
        """In position mode alone a command is valid for so long: NaN for ever, 0 the drive's own time."""
        if self._default_ns is None:
            self._default_ns = int(drive.params["watchdog_ns"])
        own = self._default_ns if timeout_s == 0.0 else round(timeout_s * 1e9) if timeout_s > 0.0 else 0
        drive.params["watchdog_ns"] = own if mode == POSITION else 0

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """The truth, then what was asked; the answer wakes the loop."""
        if self._drive is None:
            return []
        truth = (TRUTH & ~0x7F | self._node, struct.pack("<ff", out["T_L_true"], out["w_true"]), False)
        return ([truth] if self._truth else []) + self._reply(self._drive)

    def _reply(self, drive: Kernels) -> list[Sent]:
        """The registers that were asked for, in their order."""
        data = b"".join(self._answered(one, drive) for one in self._asked.reads)
        can_id = self._node << 8 | self._asked.source
        return [(can_id | (EFF_FLAG if can_id > 0x7FF else 0), padded(data), True)] if data else []

    def _answered(self, part: Subframe, drive: Kernels) -> bytes:
        values = [self.register(part.start + n, drive) for n in range(part.many)]
        unknown = next((part.start + n for n, value in enumerate(values) if value is None), None)
        if unknown is not None:
            return bytes((0x31, unknown & 0x7F | 0x80, unknown >> 7, 1))
        head = 0x20 | part.kind << 2
        count = bytes((head | part.many,)) if part.many < 4 else bytes((head, part.many))
        wire = (to_wire(part.start + n, part.kind, value or 0.0) for n, value in enumerate(values))
        return count + bytes((part.start,)) + b"".join(wire)

    def register(self, number: int, drive: Kernels) -> float | None:
        """What a register holds now; None for one that is not modelled."""
        if self._known is None:
            self._known = self._registers(drive)
        held = self._known.get(number)
        return None if held is None else float(held())

    def _registers(self, drive: Kernels) -> dict[int, Callable[[], float]]:
        """What the registers hold, by their numbers."""
        sample = drive.sample
        return {
            MODE: lambda: self._mode(drive.state),
            0x001: lambda: sample["theta"] / TURN,
            VELOCITY_AT: lambda: sample["w"] / TURN,
            0x003: lambda: sample["i_q"] * drive.params["drive_k_t"],
            0x004: lambda: sample["i_q"],
            0x005: lambda: sample["i_d"],
            0x00A: lambda: sample["temperature_motor"],
            0x00B: lambda: 0.0,
            0x00C: lambda: 1.0,
            0x00D: lambda: sample["v_dc"] or drive.params["v_dc"],
            0x00E: lambda: sample["temperature_inverter"] or drive.params["ambient"],
            FAULT_AT: lambda: self._fault(drive.state),
        }

    def _mode(self, state: Any) -> int:
        if state["state"] == IN_FAULT:
            return TIMEOUT if state["error"] == TIMED_OUT else FAULT
        if state["state"] != ENABLED:
            return STOPPED
        assert self._drive is not None  # noqa: S101 - it was enabled by a command
        return next(mode for mode, takes in MODES.items() if takes == self._drive.params["takes"])

    @staticmethod
    def _fault(state: Any) -> int:
        return ERRORS.get(int(state["error"]), DRIVER_FAULT) if state["state"] == IN_FAULT else 0


MEMBER: Final = Dialect(
    "the register protocol over CAN FD",
    lambda database, truth, eds: MoteusFrames(database.node.node_id, truth=truth),
)
