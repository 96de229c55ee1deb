"""A CANopen CiA 402 drive: NMT, SDO, PDOs on SYNC as they are mapped, statusword, EMCY, heartbeat.

It speaks configs/drives/cia402.eds. A command that came is latched with the next SYNC; the answer is what is
mapped to the TPDOs. Torque (CST) goes to the drive's own current loop as it is; for velocity and position
(CSV, CSP) simple loops of its own make a torque of it. One that is not mapped has nothing but a heartbeat.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from drivers.bus import Frame
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Eds, Synchronous
from firmware_model.drive import gates_off, transition
from firmware_model.kernels import Kernels
from firmware_model.objects import OFF, RPDOS, TPDOS, Mapped, Objects, Sent
from firmware_model.plant import ErrorCode, State

OPERATIONAL, STOPPED, PRE_OPERATIONAL = 5, 4, 127
START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
CSP, CSV, CST = 8, 9, 10
MILLI_RPM: Final = math.pi / 30e3
"""Unit of 606Ch and 60FFh [rad/s], as 60A9h of the EDS says."""
INCREMENTS: Final = 4096
"""Of a turn, as 608Fh of the EDS says."""
INCREMENT: Final = 2.0 * math.pi / INCREMENTS
"""Unit of 6064h and 607Ah [rad]."""
WIRE: Final = Wire(
    MILLI_RPM, MILLI_RPM * (2.0**31 - 1.0), 1e-9, 1e6, 1e-9, 1e6, theta_lsb=INCREMENT, theta_counts=2.0**32
)
"""Resolution and range of the measured signals: speed and position; a torque is rounded where it is sent."""
SYNCHRONOUS: Final = 240
RPDO_TIMEOUT, RPDO_LENGTH, CONNECTION = 0x8250, 0x8210, 0x8100
"""Error codes of CiA 301: no RPDO in time, one too short, the connection left while it was enabled."""
WORDS: Final = {
    State.NOT_READY_TO_SWITCH_ON: 0x0000,
    State.SWITCH_ON_DISABLED: 0x0040,
    State.READY_TO_SWITCH_ON: 0x0021,
    State.SWITCHED_ON: 0x0033,
    State.OPERATION_ENABLED: 0x0037,
    State.QUICK_STOP_ACTIVE: 0x0017,
    State.FAULT_REACTION_ACTIVE: 0x001F,
    State.FAULT: 0x0008,
}
"""Statusword of each state, with bit 4 (voltage enabled)."""
REMOTE, LIMITED, FOLLOWS = 0x0200, 0x0800, 0x1000
AT_REST: Final = 1.0
"""Speed [rad/s] at which a quick-stop ramp is over."""
SPEED_GAIN, SPEED_TIME, POSITION_GAIN = 40.0, 0.05, 15.0
"""Of the drive's own loops: bandwidth of the speed [rad/s] by the inertia, reset time [s], position [1/s]."""
SHUTDOWN: Final = 0x06


class Cia402Frames(Synchronous):
    """What the node reads and writes. ``ignored`` counts frames that it could not take."""

    sync_id: int | None = 0x080
    wire = WIRE
    counter_modulus = 16
    spoken: dict[int, int] | None = None
    """It speaks whatever it is set to."""

    def __init__(self, eds: Path, node_id: int, stored: dict[int, dict[int, bytes]]) -> None:
        self._node_id = node_id
        self._drive: Kernels | None = None
        self.ignored: Counter[str] = Counter()
        self._objects = Objects(eds, node_id, stored, self._live, self._written)
        self.due: Sequence[Sent] = ()
        self._reset()

    def _reset(self) -> None:
        """As after power-on."""
        self._nmt = PRE_OPERATIONAL
        self._objects.operational = False
        self._objects.restart()
        self._count, self._total = -1, 0.0
        self._error, self._told, self._ramping, self._cut = 0, 0, False, False
        self._stops = False
        self._since = dict.fromkeys(TPDOS, 0)
        self._mappings: dict[int, tuple[Mapped, ...]] = {}

    @property
    def beat_ns(self) -> int:
        """1017h [ns]; 0: no heartbeat."""
        return self._objects.get(0x1017) * 1_000_000

    def boot(self) -> list[Sent]:
        """The boot-up message."""
        return [(0x700 + self._node_id, b"\x00", False)]

    def beat(self) -> list[Sent]:
        """The heartbeat with the node's state."""
        return [(0x700 + self._node_id, bytes((self._nmt,)), False)]

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """NMT, SDO or an RPDO; what there is to answer goes to ``due``."""
        self._drive = drive
        if frame.flags:
            self.ignored["flags"] += 1
        elif frame.can_id == 0x000:
            self._on_nmt(frame.data, drive)
        elif self._objects.request(frame.can_id, frame.data):
            self.due = [*self.due, *self._objects.due]
        elif self._nmt == OPERATIONAL:
            self._on_rpdo(frame, drive, catch_up)

    def _on_nmt(self, data: bytes, drive: Kernels) -> None:
        """CiA 301: command and node, 0 for all."""
        if len(data) != 2 or data[1] not in (0, self._node_id):
            return
        wanted = {START: OPERATIONAL, STOP: STOPPED, ENTER_PRE_OPERATIONAL: PRE_OPERATIONAL}.get(data[0])
        if self._nmt == OPERATIONAL and wanted != OPERATIONAL:
            self._connection_lost(drive)
        if wanted is not None:
            self._nmt = wanted
        elif data[0] in (RESET_NODE, RESET_COMMUNICATION):
            self._reset()
            self.due = [*self.due, *self.boot()]
        self._objects.operational = self._nmt == OPERATIONAL
        self._mappings = {index: self._objects.mapping(index) for index in (*RPDOS, *TPDOS)}

    def _connection_lost(self, drive: Kernels) -> None:
        """6007h says what a drive does that is enabled when its connection is left."""
        code, state = self._objects.get(0x6007), drive.state
        if state["state"] != State.OPERATION_ENABLED or code == 0:
            return
        if code == 1:
            self._fault(CONNECTION, state)
        elif code == 2:
            self._step(0, state)
        else:
            self._quick_stop(state)

    def _fault(self, code: int, state: Any) -> None:
        state["state"], state["error"], state["emcy"] = State.FAULT.value, code, 1
        gates_off(state)

    def _step(self, controlword: int, state: Any) -> None:
        """A controlword that acts at once."""
        transition(state, controlword)
        state["pending"] = 0
        if state["state"] != State.OPERATION_ENABLED:
            gates_off(state)

    def _quick_stop(self, state: Any) -> None:
        """605Ah: 0 takes the voltage off, 2 ramps down and does so then, 6 stays there after the ramp."""
        if self._objects.get(0x605A) == 0:
            self._step(0, state)
        else:
            self._ramping = True

    def _on_rpdo(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        for index in RPDOS:
            cob_id = self._objects.get(index, 1)
            if cob_id & OFF or cob_id & 0x7FF != frame.can_id:
                continue
            mapped = self._mappings[index]
            if len(frame.data) < sum(one.size for one in mapped):
                self.ignored["length"] += 1
                self.due = [*self.due, self._emergency(RPDO_LENGTH)]
                return
            at = 0
            for one in mapped:
                raw = frame.data[at : at + one.size]
                self._objects.put(one.at, int.from_bytes(raw, "little", signed=one.signed), one.sub)
                at += one.size
            catch_up()
            self._command(drive)

    def _command(self, drive: Kernels) -> None:
        """What the objects ask for is latched with the next SYNC; it feeds the watchdog (1400h:5)."""
        self._count = (self._count + 1) % self.counter_modulus
        controlword, state = self._objects.get(0x6040), drive.state
        drive.params["watchdog_ns"] = self._objects.get(0x1400, 5) * 1_000_000
        self._stops = self._is_quick_stop(controlword) and state["state"] == State.OPERATION_ENABLED
        self._ramping = self._ramping and controlword & 0x02 != 0
        if self._stops or self._ramping:
            state["fed_ns"] = state["t_ns"]
        else:
            drive.command(self._count, controlword, self._torque(state), 0.0)

    @staticmethod
    def _is_quick_stop(controlword: int) -> bool:
        return controlword & 0x06 == 0x02

    def _torque(self, state: Any) -> float:
        """Torque [N m] that the mode asks for now, within 6072h."""
        mode = self._objects.get(0x6060)
        asked = self._objects.get(0x6071) * self._rated * 1e-3 if mode == CST else 0.0
        if mode in (CSV, CSP):
            asked = self._speed_loop(self._target(mode), state)
        top = self._objects.get(0x6072) * self._rated * 1e-3
        self._cut = abs(asked) > top
        return max(-top, min(top, asked))

    def _target(self, mode: int) -> float:
        """Speed [rad/s] that velocity or position mode asks for."""
        if mode == CSV:
            return self._objects.get(0x60FF) * MILLI_RPM
        assert self._drive is not None  # noqa: S101 - a command came
        error = self._objects.get(0x607A) * INCREMENT - float(self._drive.sample["theta"])
        return POSITION_GAIN * error

    def _speed_loop(self, w_ref: float, state: Any) -> float:
        """A PI of the drive's own, by the inertia of its motor."""
        assert self._drive is not None  # noqa: S101 - a command came
        J, error = float(self._drive.params["J"]), w_ref - float(state["x"][0])
        return SPEED_GAIN * J * (error + self._total / SPEED_TIME)

    @property
    def _rated(self) -> float:
        """6076h [N m]."""
        return self._objects.get(0x6076) * 1e-3

    def _written(self, index: int) -> None:
        """A controlword that came by SDO acts at once."""
        if index == 0x6040 and self._drive is not None:
            controlword, state = self._objects.get(0x6040), self._drive.state
            if self._is_quick_stop(controlword) and state["state"] == State.OPERATION_ENABLED:
                self._quick_stop(state)
            else:
                self._step(controlword, state)

    def _live(self, index: int) -> int | None:
        """What the drive measures, as its objects show it; None for all others."""
        if self._drive is None or index not in _LIVE:
            return 0x0040 if index == 0x6041 else None
        return int(_LIVE[index](self, self._drive))

    def statusword(self, drive: Kernels) -> int:
        """6041h."""
        state = State(int(drive.state["state"]))
        word = WORDS[State.QUICK_STOP_ACTIVE if self._ramping else state]
        word |= REMOTE if self._nmt == OPERATIONAL else 0
        word |= LIMITED if drive.state["limited"] or self._cut else 0
        return word | (FOLLOWS if state == State.OPERATION_ENABLED and not self._ramping else 0)

    def _torque_now(self, drive: Kernels) -> float:
        return float(drive.sample["i_q"] * drive.params["drive_k_t"])

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """EMCY if a fault arose or went, then each TPDO, the first last; out of operation EMCY alone."""
        drive = self._drive
        if drive is None:
            return []
        self._after_sync(drive)
        sent = [self._emergency(out["error"])] if out["emcy_due"] else []
        if not drive.state["error"] and self._told:
            sent.append(self._emergency(0))
        if self._nmt != OPERATIONAL:
            return sent
        return sent + [frame for index in reversed(TPDOS) for frame in self._tpdo(index)]

    def _after_sync(self, drive: Kernels) -> None:
        """What the drive's own loops and ramp do between two SYNCs."""
        state, period_s = drive.state, self._period_s()
        if self._stops and state["state"] == State.OPERATION_ENABLED:
            self._quick_stop(state)
        self._stops = False
        w = float(state["x"][0])
        enabled = state["state"] == State.OPERATION_ENABLED
        mode = self._objects.get(0x6060)
        if not enabled:
            self._total, self._ramping = 0.0, False
        elif self._ramping:
            self._ramp(drive, w)
        elif mode in (CSV, CSP):
            self._total += (self._target(mode) - w) * period_s
            state["next_q"] = self._torque(state)

    def _ramp(self, drive: Kernels, w: float) -> None:
        """A quick stop that brakes with rated torque; at rest 605Ah says whether it stays."""
        state = drive.state
        if abs(w) > AT_REST:
            state["next_q"] = -math.copysign(self._rated, w)
            return
        self._ramping = False
        self._step(0x02 if self._objects.get(0x605A) == 6 else 0x00, state)

    def _period_s(self) -> float:
        """60C2h."""
        return float(self._objects.get(0x60C2, 1) * 10.0 ** self._objects.get(0x60C2, 2))

    def _tpdo(self, index: int) -> list[Sent]:
        """A TPDO that is on, with every SYNC or every so many."""
        cob_id, every = self._objects.get(index, 1), self._objects.get(index, 2)
        if cob_id & OFF or not 1 <= every <= SYNCHRONOUS:
            return []
        self._since[index] += 1
        if self._since[index] < every:
            return []
        self._since[index] = 0
        data = b"".join(
            self._objects.get(one.at, one.sub).to_bytes(one.size, "little", signed=one.signed)
            for one in self._mappings[index]
        )
        return [(cob_id & 0x7FF, data, False)]

    def _emergency(self, code: int) -> Sent:
        """CiA 301: error code, error register; code 0 says that the error is gone."""
        code = RPDO_TIMEOUT if code == ErrorCode.COMMUNICATION_TIMEOUT else int(code)
        self._told = self._error = code
        register = 0x01 | (0x10 if code & 0xF000 == 0x8000 else 0) if code else 0
        return 0x080 + self._node_id, struct.pack("<HB5x", code, register), False


def _clipped(value: float, bits: int) -> int:
    """A rounded signed number that fits."""
    top = (1 << bits - 1) - 1
    return max(-top, min(top, round(value)))


_LIVE: Final[dict[int, Callable[[Cia402Frames, Kernels], float]]] = {
    0x2000: lambda node, drive: round(drive.sample["T_L_true"] * 1e3),
    0x1001: lambda node, drive: 1 if drive.state["error"] else 0,
    0x603F: lambda node, drive: node._error if drive.state["error"] else 0,
    0x6041: lambda node, drive: node.statusword(drive),
    0x6061: lambda node, drive: node._objects.get(0x6060),
    0x6064: lambda node, drive: round(drive.sample["theta"] / INCREMENT),
    0x606C: lambda node, drive: _clipped(drive.sample["w"] / MILLI_RPM, 32),
    0x6077: lambda node, drive: _clipped(1000.0 * node._torque_now(drive) / node._rated, 16),
    0x6078: lambda node, drive: _clipped(1e6 * drive.sample["i_q"] / node._objects.get(0x6075), 16),
    0x6079: lambda node, drive: round(drive.sample["v_dc"] * 1e3),
}
"""Objects that the drive measures or knows."""


def _frames(database: Any, _truth: bool, eds: Eds | None) -> Cia402Frames:
    path, stored = eds or (Path(), {})
    return Cia402Frames(path, database.node.node_id, stored)


MEMBER: Final = Dialect("CANopen, mute until hil configure has mapped its PDOs", _frames, eds=True, wire=WIRE)
