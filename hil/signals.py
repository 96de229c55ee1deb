"""What flows through a tick and is logged: one fixed-size record whose bytes are a protobuf message.

Each field of :data:`TICK` is preceded by its protobuf tag, so a record needs no encoding: its raw
bytes are a valid message of the schema that :mod:`hil.log` embeds in the file. Fields are fixed-width
only. Field numbers are part of the file format and never reused. Units are SI; ``dq`` quantities are
amplitude-invariant; ``w`` is the mechanical speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

Kind = Literal["f8", "u8", "i8", "u4", "i4"]
Role = Literal["time", "input", "output", "check"]
TickArray = npt.NDArray[np.void]
"""A one-element (or longer) structured array of dtype :data:`TICK`."""

_WIRE_TYPE: Final[dict[str, int]] = {"f8": 1, "u8": 1, "i8": 1, "u4": 5, "i4": 5}


class DriveState(IntEnum):
    """States of CiA 402, used by the drive and, under the same names, by the supervisor."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class Controlword(IntEnum):
    """CiA 402 controlwords that the supervisor sends."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    FAULT_RESET = 0x0080


class Request(IntEnum):
    """What the operator (or the end of the run) asks of the supervisor; an input of the tick."""

    NONE = 0
    ARM = 1
    RAMP_DOWN = 2
    """A stop that was asked for, while the reference still ramps to 0: see :mod:`hil.tick.setpoint`."""
    STOP = 3
    QUICK_STOP = 4
    NODE_STOPPED = 5
    """Another node of the same run has left operation by a fault or a quick stop."""


class RxFlag(IntEnum):
    """Bits of what was seen on the bus while waiting for this tick's feedback (IntEnum: numba knows it)."""

    FRESH = 1 << 0
    CRC_ERROR = 1 << 1
    COUNTER_REPEATED = 1 << 2
    COUNTER_JUMP = 1 << 3
    LENGTH_ERROR = 1 << 4
    STATUS = 1 << 5
    EMERGENCY = 1 << 6
    ERROR_FRAME = 1 << 7
    BUS_DOWN = 1 << 8
    FOREIGN_COMMAND = 1 << 9
    SEND_FAILED = 1 << 10
    GUARDIAN = 1 << 11
    GUARDIAN_LOST = 1 << 12


ALL_MISSING: Final = 2**32 - 1
"""``missing`` at the beginning of a tick: each mapped message that comes takes its bit out."""


class Reason(IntEnum):
    """Why the supervisor left normal operation, or the guard changed a command. 0 is no reason."""

    NONE = 0
    STOP_REQUESTED = 1
    QUICK_STOP_REQUESTED = 2
    STALE_FEEDBACK = 3
    NOT_A_NUMBER = 4
    CRC_ERRORS = 5
    COUNTER_ERRORS = 6
    OVER_SPEED = 7
    OVER_CURRENT = 8
    OVER_TEMPERATURE = 9
    DC_LINK_UNDER_VOLTAGE = 10
    DC_LINK_OVER_VOLTAGE = 11
    DRIVE_FAULT = 12
    DRIVE_LEFT_OPERATION = 13
    ENABLE_TIMEOUT = 14
    BUS_DOWN = 15
    SEND_FAILED = 16
    FOREIGN_COMMAND = 17
    LOG_FAILED = 18
    GUARD_PERSISTENT = 19
    LOOP_OVERRUN = 20
    CONTROLLER_ERROR = 21
    I2T = 22
    ENERGY = 23
    GUARDIAN = 24
    GUARDIAN_LOST = 25
    COMMAND_LOST = 26
    FROZEN_FEEDBACK = 27
    FOLLOWING_ERROR = 28
    CURRENT_UNCONTROLLED = 29
    STALE_STATUS = 30
    NODE_STOPPED = 31
    ANGLE_ERROR = 32
    ANGLE_JUMP = 33


class GuardFlag(IntEnum):
    """Bits of what the guard changed in this tick's command. SATURATED: the law was at a limit of its own."""

    NOT_A_NUMBER = 1 << 0
    VOLTAGE = 1 << 1
    VOLTAGE_STEP = 1 << 2
    LOAD_TORQUE = 1 << 3
    STATE_FORCES_ZERO = 1 << 4
    SOFT_START = 1 << 5
    DENORMAL = 1 << 6
    APPLIED_DEVIATES = 1 << 7
    SATURATED = 1 << 8


@dataclass(frozen=True, slots=True)
class Shown:
    """Where people see a field. Report, watch and ``hil replay --config`` draw and compare what stands here.

    ``plot``: key of a report's plot; a key that is not in :mod:`hil.report.curves` is a plot of its own.
    ``label``: what legends call it; ``place``: its order there. ``compared``: drawn where several runs are.
    ``until_stop``: means nothing once the run stops. ``live``: its plot in ``hil watch --web``.
    ``what_if``: compared between the logged and another controller. ``line``: what its line of ``hil watch``
    in the terminal is called; ``span``: the smallest range that fills its height, in the drawn unit.
    """

    plot: str = ""
    label: str = ""
    place: int = 0
    compared: bool = True
    until_stop: bool = False
    live: str = ""
    what_if: bool = False
    line: str = ""
    span: float = 1.0


HIDDEN: Final = Shown()


@dataclass(frozen=True, slots=True)
class Field:
    """One field of the tick record: protobuf number, name, kind, unit, role, meaning, where it is shown."""

    number: int
    name: str
    kind: Kind
    unit: str
    role: Role
    doc: str
    absent: float | None = None
    """Of an input newer than log format 1, and of an output that was a constant before: what a log without it
    stands for (docs/log-format.md)."""
    shown: Shown = HIDDEN

    @property
    def scale(self) -> float:
        """Factor to the unit in which it is drawn: times in us."""
        return 1e-3 if self.unit == "ns" else 1.0

    @property
    def drawn_unit(self) -> str:
        """Unit in which it is drawn."""
        return "us" if self.unit == "ns" else self.unit


FIELDS: Final[tuple[Field, ...]] = (
    Field(1, "k", "u8", "", "time", "tick index"),
    Field(2, "t_ns", "i8", "ns", "time", "deadline of the tick on the loop's clock"),
    Field(3, "lateness_ns", "i4", "ns", "time", "wake-up after the deadline",
          shown=Shown("lateness", "woken", 3, until_stop=True, live="lateness", line="lateness", span=10.0)),
    Field(4, "received_ns", "i4", "ns", "time",
          "newest feedback taken, after the deadline; paced by the timer it may be negative: its age",
          shown=Shown("lateness", "received", 2, False, True)),
    Field(5, "computed_ns", "i4", "ns", "time", "control law done, after the deadline",
          shown=Shown("lateness", "computed", 1, False, True)),
    Field(6, "sent_ns", "i4", "ns", "time", "command handed to the bus, after the deadline",
          shown=Shown("lateness", "sent", 0, False, True)),
    Field(7, "skipped", "u4", "", "time", "whole periods skipped before this tick",
          shown=Shown("bus", "skipped")),
    Field(8, "recorded_ns", "i4", "ns", "time", "previous tick's record stored, after that tick's deadline"),
    Field(9, "check", "u8", "", "check",
          "sum over the other fields when the record was written (docs/log-format.md)"),
    Field(16, "rx_flags", "u4", "", "input", "RxFlag bits"),
    Field(17, "gap", "u4", "", "input", "periods since the previous tick (1 unless periods were skipped)"),
    Field(18, "w", "f8", "rad/s", "input", "measured mechanical speed",
          shown=Shown("speed", "w", 1, live="speed", line="speed")),
    Field(19, "i_q", "f8", "A", "input", "measured q current",
          shown=Shown("current", "i_q", 1, live="current", line="current q", span=0.2)),
    Field(20, "i_d", "f8", "A", "input", "measured d current",
          shown=Shown("current", "i_d", 2, False, live="current", line="current d", span=0.2)),
    Field(21, "echo", "u4", "", "input", "counter of the command the drive applies from now on"),
    Field(22, "drive_state", "u4", "", "input", "DriveState of the drive",
          shown=Shown("state", "drive", 1, False)),
    Field(23, "limited", "u4", "", "input", "1 when the drive limited the voltage"),
    Field(24, "v_dc", "f8", "V", "input", "DC-link voltage of the newest status frame, NaN before it",
          shown=Shown("v_dc", "v_dc")),
    Field(25, "temperature_motor", "f8", "degC", "input", "motor temperature of the newest status frame",
          shown=Shown("temperature", "motor")),
    Field(26, "temperature_inverter", "f8", "degC", "input", "inverter temperature, newest status frame",
          shown=Shown("temperature", "inverter", 1, False)),
    Field(27, "drive_error", "u4", "", "input", "CiA 301/402 error code of the drive, 0 for none"),
    Field(28, "w_ref", "f8", "rad/s", "input", "reference speed",
          shown=Shown("speed", "w*", live="speed", line="reference")),
    Field(29, "dw_ref", "f8", "rad/s2", "input", "its derivative"),
    Field(30, "request", "u4", "", "input", "Request of the operator"),
    Field(31, "log_failed", "u4", "", "input", "1 when the writer reported a failure"),
    Field(32, "T_L_true", "f8", "N m", "input", "true load torque when the drive is an emulator, else NaN",
          shown=Shown("load", "true", live="load torque")),
    Field(33, "i_q_ref_in", "f8", "A", "input",
          "reference q current (controller fac), the one that another node's fac asks for (follow), else 0"),
    Field(34, "u_q_seen", "f8", "V", "input",
          "shadow run: q voltage of the other controller, applied from now on"),
    Field(35, "u_d_seen", "f8", "V", "input",
          "shadow run: d voltage of the other controller, applied from now on"),
    Field(36, "missing", "u4", "", "input",
          "bit i: the i-th slow message of the drive's map has not come since the previous tick",
          absent=0),
    Field(37, "T_L_in", "f8", "N m", "input",
          "fac over two nodes: the load machine's torque by its own measurement, NaN without one; else 0",
          absent=0),
    Field(38, "T_L_sent", "f8", "N m", "input",
          "fac over two nodes: the load machine's torque command of this tick, 0 when it is off; else 0",
          absent=0),
    Field(39, "theta_ref", "f8", "rad", "input",
          "reference angle from where it was armed (position), NaN for other laws", absent=math.nan,
          shown=Shown("angle", "θ*")),
    Field(69, "theta", "f8", "rad", "input", "measured mechanical angle, NaN where the drive reports none",
          absent=math.nan, shown=Shown("theta", "theta", compared=False)),
    Field(48, "state", "u4", "", "output", "DriveState of the supervisor",
          shown=Shown("state", "supervisor")),
    Field(49, "reason", "u4", "", "output", "Reason that latched, 0 while none"),
    Field(50, "guard_flags", "u4", "", "output", "GuardFlag bits"),
    Field(51, "controlword", "u4", "", "output", "CiA 402 controlword sent"),
    Field(52, "counter", "u4", "", "output", "counter of the command sent"),
    Field(53, "send", "u4", "", "output",
          "1 when a command goes out this tick; an event says when the bus refused it"),
    Field(54, "filled", "u4", "", "output", "observer memory filled with measurements, ticks",
          shown=Shown("filled", "filled")),
    Field(55, "ua_q", "f8", "V", "output", "q voltage applied over the past period",
          shown=Shown("voltage_q", "applied", 2)),
    Field(56, "ua_d", "f8", "V", "output", "d voltage applied over the past period",
          shown=Shown("voltage_d", "applied", 2)),
    Field(57, "d_hat_w", "f8", "rad/s2", "output", "estimated disturbance of the speed channel",
          shown=Shown("d_w", "d_hat_w", until_stop=True, what_if=True)),
    Field(58, "d_hat_q", "f8", "A/s", "output", "estimated disturbance of the q current channel",
          shown=Shown("d_i", "d_hat_q", until_stop=True, what_if=True)),
    Field(59, "d_hat_d", "f8", "A/s", "output", "estimated disturbance of the d current channel",
          shown=Shown("d_i", "d_hat_d", 1, False, True, what_if=True)),
    Field(60, "i_q_ref", "f8", "A", "output", "q current asked by the speed law, after its limit",
          shown=Shown("current", "i_q*", 0, False, live="current", what_if=True)),
    Field(61, "u_q_law", "f8", "V", "output", "q voltage asked by the control law, before the voltage circle",
          shown=Shown("voltage_q", "asked", 0, False, what_if=True)),
    Field(62, "u_d_law", "f8", "V", "output", "d voltage asked by the control law, before the voltage circle",
          shown=Shown("voltage_d", "asked", 0, False, what_if=True)),
    Field(63, "T_L_law", "f8", "N m", "output", "load torque asked by the control law (fac), else 0"),
    Field(64, "u_q", "f8", "V", "output", "q voltage sent: guarded and rounded to the wire",
          shown=Shown("voltage_q", "sent", 1, False, live="command")),
    Field(65, "u_d", "f8", "V", "output", "d voltage sent",
          shown=Shown("voltage_d", "sent", 1, False, live="command")),
    Field(66, "T_L", "f8", "N m", "output", "load torque sent (fac), else 0"),
    Field(67, "T_L_hat", "f8", "N m", "output", "load torque estimate -J d_hat_w",
          shown=Shown("load", "estimate", 1, until_stop=True, live="load torque", what_if=True,
                      line="load estimate", span=0.2)),
    Field(68, "i_d_ref", "f8", "A", "output", "d current asked for; 0 for most laws", absent=0,
          shown=Shown("current", "i_d*", 3, False, live="current", what_if=True)),
    Field(70, "theta_turned", "f8", "rad", "output",
          "angle from where it was armed, over turns (position), NaN for other laws",
          shown=Shown("angle", "θ", 1)),
    Field(71, "theta_error", "f8", "rad", "output",
          "following error of the angle, theta_ref - theta_turned (position), NaN for other laws",
          shown=Shown("angle_error", "θ* − θ", line="angle error", span=0.01)),
)  # fmt: skip


def tag(number: int, kind: Kind) -> bytes:
    """Protobuf tag of a field: varint of (number << 3 | wire type)."""
    value = number << 3 | _WIRE_TYPE[kind]
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _dtype() -> np.dtype[np.void]:
    """Packed layout: for each field its tag bytes, then its little-endian value."""
    parts: list[tuple[str, str]] = []
    for field in FIELDS:
        parts += [
            (f"_{field.number}", f"S{len(tag(field.number, field.kind))}"),
            (field.name, f"<{field.kind}"),
        ]
    return np.dtype(parts)


TICK: Final[np.dtype[np.void]] = _dtype()
INPUTS: Final = tuple(f.name for f in FIELDS if f.role == "input")
OUTPUTS: Final = tuple(f.name for f in FIELDS if f.role == "output")


_NONE: Final = (
    "v_dc", "temperature_motor", "temperature_inverter", "T_L_true", "theta", "theta_ref", "theta_turned",
    "theta_error",
)  # fmt: skip
"""What is no number until something writes it."""


def _new_tick() -> TickArray:
    tick = np.zeros(1, TICK)
    for field in FIELDS:
        tick[f"_{field.number}"] = tag(field.number, field.kind)
    for name in _NONE:
        tick[name] = np.nan
    return tick


_NEW: Final = _new_tick()


def new_ticks(count: int = 1) -> TickArray:
    """Return ``count`` zeroed tick records with their protobuf tags in place."""
    return np.repeat(_NEW, count)


Cell = Any
"""One integer field of one record, at index 0: a memoryview, which Python 3.11 has no generic type for."""


def cell(ticks: TickArray, name: str) -> Cell:
    """An integer field of the first record: 0.03 us to set, where the record's own field takes 0.5 us."""
    kind: Any
    kind, offset = TICK.fields[name][:2]  # type: ignore[index]
    code: Any = {"u8": "Q", "i8": "q", "u4": "I", "i4": "i"}[kind.str[1:]]
    of_bytes: Any = ticks.view("u1").data
    field: Cell = of_bytes[offset : offset + kind.itemsize].cast(code)
    return field


def ticks_from(raw: bytes) -> TickArray:
    """Tick records from their bytes."""
    return np.frombuffer(raw, TICK)
