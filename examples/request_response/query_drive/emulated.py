"""The drive's side, laid out by hand: a sign error shared with the controller would cancel in closed loop."""

import math
import struct
from collections import Counter

from firmware_model.config import Wire
from firmware_model.dialects import Dialect, Synchronous
from firmware_model.inverter import controlword
from firmware_model.plant import State

REQUEST, REPLY, TRUTH, COMMAND = 0x110, 0x210, 0x2F0, 0x310
ALL = bytes((0x52, 0x0F, 0x00))
OFF, ON, FAULTED = 0, 1, 2


class QueryFrames(Synchronous):
    """What this drive reads and writes. ``ignored`` counts frames that it did not take."""

    beat_ns = 0
    counter_modulus = 256
    sync_id = REQUEST
    spoken = {REPLY: 8, TRUTH: 8, COMMAND: 5}  # noqa: RUF012 - read only
    wire = Wire(1e-6, 1e5, 0.001, 32.767, 0.001, 32.767)

    def __init__(self, truth: bool) -> None:
        self._truth, self._count = truth, 0
        self.ignored = Counter()

    def boot(self):
        """It says nothing by itself."""
        return []

    def beat(self):
        """Nor does it beat."""
        return []

    def asks(self, data):
        """A request for all registers."""
        return data == ALL

    def take(self, frame, drive, catch_up):
        """Take a command, whole or not at all."""
        if frame.flags or frame.can_id != COMMAND:
            return
        torque, on = struct.unpack("<fB", frame.data) if len(frame.data) == 5 else (math.nan, 0)
        if not math.isfinite(torque):
            self.ignored["length" if len(frame.data) != 5 else "number"] += 1
            return
        catch_up()
        self._count = (self._count + 1) % self.counter_modulus
        drive.command(self._count, controlword(drive.state, on == 1, False), torque, 0.0)

    def answer(self, out):
        """What no real drive can tell, then the registers."""
        faulted = out["state"] in (State.FAULT, State.FAULT_REACTION_ACTIVE)
        mode = FAULTED if faulted else ON if out["state"] == State.OPERATION_ENABLED else OFF
        data = struct.pack("<fhBB", out["w"], round(out["i_q"] / 0.001), mode, round(out["v_dc"] / 4.0))
        truth = struct.pack("<ff", out["T_L_true"], out["w_true"])
        return [*([(TRUTH, truth, False)] if self._truth else []), (REPLY, data, False)]


MEMBER = Dialect("registers, by request", lambda database, truth, eds: QueryFrames(truth))
