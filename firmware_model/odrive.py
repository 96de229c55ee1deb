"""Frames of an ODrive (CAN Simple, firmware 0.6), laid out here by hand: identifier node << 5 | command.

It sends by its own clock. A torque acts in control mode 1, input mode 1 and axis state 8 alone; an error puts
the axis to state 1 and stays until it is cleared. Its watchdog is fed by torques. Facts: the maker's protocol
page and DBC (PyPI odrive-can 2.1.0, odrive-cansimple-0.6.10.dbc). TRUTH and STEP are the emulator's own.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from drivers.bus import Frame
from drivers.local import EFF_FLAG
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Sent, Synchronous
from firmware_model.inverter import controlword
from firmware_model.kernels import Kernels
from firmware_model.plant import ErrorCode, State

HEARTBEAT, SET_AXIS_STATE, ESTIMATES, SET_CONTROLLER_MODE = 0x01, 0x07, 0x09, 0x0B
SET_INPUT_TORQUE, GET_IQ, TEMPERATURE, BUS, CLEAR_ERRORS = 0x0E, 0x14, 0x15, 0x17, 0x18
STEP, TRUTH = (EFF_FLAG | 0x1FFFF800 | low for low in (0, 1))
LENGTHS: Final = {
    HEARTBEAT: 8, SET_AXIS_STATE: 8, ESTIMATES: 8, SET_CONTROLLER_MODE: 8, SET_INPUT_TORQUE: 8, GET_IQ: 8,
    TEMPERATURE: 8, BUS: 8, CLEAR_ERRORS: 1,
}  # fmt: skip
IDLE, CLOSED_LOOP = 1, 8
TORQUE_MODE: Final = (1, 1)
"""Control mode torque, input mode passthrough."""
ERRORS: Final = {
    int(ErrorCode.NONE): 0,
    int(ErrorCode.DC_LINK_OVER_VOLTAGE): 0x100,
    int(ErrorCode.DC_LINK_UNDER_VOLTAGE): 0x200,
    int(ErrorCode.OVER_CURRENT): 0x1000,
    int(ErrorCode.OVER_TEMPERATURE_MOTOR): 0x2000,
    int(ErrorCode.OVER_TEMPERATURE_DRIVE): 0x4000,
    int(ErrorCode.OVER_SPEED): 0x8000,
    int(ErrorCode.COMMUNICATION_TIMEOUT): 0x1000000,
}
"""Axis_Error of each error of the drive behind."""
BEAT_EVERY: Final = 10
"""Periods from one heartbeat to the next, as the shipped configuration sets heartbeat_msg_rate_ms."""
TURN: Final = 2.0 * math.pi


class ODriveFrames(Synchronous):
    """What this drive reads and writes. ``ignored`` counts frames that it did not take."""

    beat_ns = 100_000_000
    counter_modulus = 256
    wire = Wire(1e-6, 1e5, 1e-6, 1e4, 1e-6, 1e4, 1e-6)
    """Of float32 on the wire: rounded before to what its bits hold."""

    def __init__(self, node_id: int, *, truth: bool) -> None:
        self._node, self._truth = node_id, truth
        self._mode = (0, 0)
        self._on = self._clear = False
        self._cycles = self._counter = self._beaten = self._error = 0
        self.sync_id: int | None = self._id(STEP)
        self.ignored: Counter[str] = Counter()

    def _id(self, command: int) -> int:
        return command & ~(0x3F << 5) | self._node << 5

    @property
    def spoken(self) -> dict[int, int] | None:
        """Length of each message that it sends or takes, by identifier."""
        own = {self._id(command): length for command, length in LENGTHS.items()}
        return own | {self._id(TRUTH): 8}

    def boot(self) -> list[Sent]:
        """It sends nothing special when it starts."""
        return []

    def beat(self) -> list[Sent]:
        """While its time stands still, in lockstep with nobody, an idle axis is heard by the clock alone."""
        stands, self._beaten = self._cycles == self._beaten, self._cycles
        return [self._heartbeat(IDLE)] if stands and not self._on else []

    def _heartbeat(self, state: int) -> Sent:
        beat = struct.pack("<IBBBx", ERRORS.get(self._error, 0x2), state, 0, 0)
        return self._id(HEARTBEAT), beat, False

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """Take a command, whole or not at all."""
        command = frame.can_id & 0x1F
        if frame.flags or frame.can_id != self._id(command) or command not in LENGTHS:
            return
        if len(frame.data) != LENGTHS[command]:
            self.ignored["length"] += 1
        elif command == SET_AXIS_STATE:
            self._on = struct.unpack_from("<I", frame.data)[0] == CLOSED_LOOP
            if not self._on:
                catch_up()
                drive.command(self._next(), 0, 0.0, 0.0)
        elif command == SET_CONTROLLER_MODE:
            self._mode = struct.unpack("<II", frame.data)
        elif command == CLEAR_ERRORS:
            self._clear = True
        elif command == SET_INPUT_TORQUE:
            catch_up()
            self._torque(struct.unpack_from("<f", frame.data)[0], drive)

    def _next(self) -> int:
        self._counter = (self._counter + 1) % self.counter_modulus
        return self._counter

    def _torque(self, torque: float, drive: Kernels) -> None:
        """A torque, which feeds the watchdog; an error that was cleared leaves the axis idle."""
        if not math.isfinite(torque):
            self.ignored["number"] += 1
            return
        if self._mode != TORQUE_MODE:
            self.ignored["mode"] += 1
            torque = 0.0
        if drive.state["state"] == State.FAULT:
            self._on = False
        word = controlword(drive.state, self._on, self._clear)
        self._clear = self._clear and drive.state["state"] != State.FAULT
        drive.command(self._next(), word, torque, 0.0)

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """Heartbeat, temperatures and supply when due, truth; current and speed last, where they are."""
        pack, frames, self._cycles = struct.pack, [], self._cycles + 1
        self._error = int(out["error"])
        if self._cycles % BEAT_EVERY == 1:
            state = CLOSED_LOOP if out["state"] == State.OPERATION_ENABLED else IDLE
            frames.append(self._heartbeat(state))
            degrees = pack("<ff", out["temperature_inverter"], out["temperature_motor"])
            frames.append((self._id(TEMPERATURE), degrees, False))
            frames.append((self._id(BUS), pack("<ff", out["v_dc"], 0.0), False))
        if self._truth:
            frames.append((self._id(TRUTH), pack("<ff", out["T_L_true"], out["w_true"]), False))
        if self.feedback:
            angle = pack("<ff", out.get("theta", 0.0) / TURN, out["w"] / TURN)
            frames.append((self._id(GET_IQ), pack("<ff", 0.0, out["i_q"]), False))
            frames.append((self._id(ESTIMATES), angle, False))
        return frames


MEMBER: Final = Dialect(
    "CAN Simple",
    lambda database, truth, eds: ODriveFrames(database.node.node_id, truth=truth),
    steps=True,
)
