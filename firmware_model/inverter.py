"""Frames of another maker's inverter: big endian, extended identifiers, CAN FD, no SYNC, an enable bit.

It speaks configs/drives/inverter_fd.dbc, laid out here by hand: speed in rpm, currents in mA, no CRC, no
echo; it sends by its own clock and is on or off. Its watchdog is fed by a demand with the right key and a new
counter. The house protocol shares nothing with it but the motor behind.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from drivers.bus import Frame
from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Sent, Synchronous
from firmware_model.kernels import Kernels
from firmware_model.plant import State

EXTENDED: Final = 0x80000000
STATE_ID, SUPPLY_ID, TRUTH_ID, DEMAND_ID = (
    EXTENDED | low for low in (0x18FF1000, 0x18FF1002, 0x18FF10F0, 0x18FF1100)
)
RPM: Final = 30.0 / math.pi
RPM_LSB, MILLIAMPERE_LSB, VOLT_LSB = 0.01, 0.1, 0.001
TOP: Final = (1 << 23) - 1
KEY: Final = 90
OFF, ON, FAULTED = 0, 1, 9
IN_FAULT: Final = int(State.FAULT)
STEPS: Final = {int(State.SWITCH_ON_DISABLED): 0x06, int(State.READY_TO_SWITCH_ON): 0x07}
"""Controlwords on the way to operation; 0x0F from there on."""


def int24(value: float) -> bytes:
    """A big-endian signed number of three bytes, saturated."""
    return int(min(max(round(value), -TOP), TOP)).to_bytes(3, "big", signed=True)


class InverterFrames(Synchronous):
    """What this inverter reads and writes. ``ignored`` counts frames that it did not take."""

    beat_ns = 0
    sync_id: int | None = None
    counter_modulus = 16

    def __init__(self, *, truth: bool) -> None:
        self._truth = truth
        self._alive = 0
        self._last = -1
        self.ignored: Counter[str] = Counter()

    @property
    def spoken(self) -> dict[int, int] | None:
        """Length of each message that it sends or takes, by identifier."""
        return {STATE_ID: 12, SUPPLY_ID: 8, TRUTH_ID: 8, DEMAND_ID: 12}

    @property
    def wire(self) -> Wire:
        """Resolution and range of the measured signals, in SI units."""
        w, i = RPM_LSB * (math.pi / 30), MILLIAMPERE_LSB * 1e-3
        return Wire(w, TOP * w, i, TOP * i, i, TOP * i)

    def boot(self) -> list[Sent]:
        """It sends nothing special when it starts."""
        return []

    def beat(self) -> list[Sent]:
        """It has no heartbeat."""
        return []

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """Take a demand, whole or not at all."""
        if frame.can_id | frame.flags != DEMAND_ID:
            return
        if len(frame.data) != 12 or not frame.fd:
            self.ignored["length"] += 1
            return
        bits, key, alive = frame.data[6], frame.data[7], frame.data[8] >> 4
        if key != KEY:
            self.ignored["key"] += 1
            return
        if alive == self._last:
            self.ignored["repeated"] += 1
            return
        self._last = alive
        catch_up()
        u_q, u_d = (int.from_bytes(frame.data[at : at + 3], "big", signed=True) * VOLT_LSB for at in (0, 3))
        drive.command(alive, controlword(drive.state, bool(bits & 0x80), bool(bits & 0x40)), u_q, u_d)

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """Supply when due, the true values, motor state last."""
        frames: list[Sent] = []
        if out["status_due"]:
            degrees = [int(out[name]) + 40 for name in ("temperature_motor", "temperature_inverter")]
            supply = struct.pack(">HBBH2x", round(out["v_dc"] / 0.1), *degrees, int(out["error"]))
            frames.append((SUPPLY_ID, supply, False))
        if self._truth:
            frames.append((TRUTH_ID, struct.pack(">ff", out["T_L_true"], out["w_true"]), False))
        self._alive = (self._alive + 1) % 16
        values = (
            out["w"] * RPM / RPM_LSB,
            out["i_q"] * 1e3 / MILLIAMPERE_LSB,
            out["i_d"] * 1e3 / MILLIAMPERE_LSB,
        )
        data = b"".join(map(int24, values)) + bytes((mode(out["state"]), self._alive << 4, 0))
        return [*frames, (STATE_ID, data, True)]


def mode(state: int) -> int:
    """How the inverter names its state: off, on or faulted."""
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        return FAULTED
    return ON if state == State.OPERATION_ENABLED else OFF


def controlword(state: Any, on: bool, clear: bool) -> int:
    """The step of the state machine inside that the enable bit leads to; one step a cycle."""
    inside = int(state["state"])
    if inside == IN_FAULT:
        return 0x80 if clear else 0x00
    return STEPS.get(inside, 0x0F) if on else 0x00


MEMBER: Final = Dialect(
    "CAN FD, 29-bit identifiers, no SYNC and no echo",
    lambda database, truth, eds: InverterFrames(truth=truth),
)
