"""A drive by strangers: the joint of am-sdk, plant and firmware, behind a bridge to hil-local.

Its frames are the maker's compact CAN FD profile: a command of 64 bytes with 16 for each of four joints, an
answer of 16 with the command's counter. Its objects answer by SDO. Each command is a cycle of 1 ms; it is
answered with what was sampled as it came. ``python -m tests.amdrive CHANNEL`` serves a channel of hil-local.
"""

from __future__ import annotations

import signal
import struct
import sys
import threading
from collections.abc import Callable

from am_sdk import AmBus, AmSessionConfig
from am_sdk.backends.sim import SimOptions
from am_sdk.backends.simwire import SimNode
from am_sdk.backends.transport import SdoAbort

from drivers.bus import BusSettings, Frame, Link, open_link

NODE, UNIT = 5, "M"
J, K_T, FRICTION_N_M = 0.0279, 0.136916 * 21.6 * 0.926, 1.47
"""Of the unit's data sheet: inertia at the output, N m there for an ampere of q current, dry friction."""
GROUP, ANSWER, REQUEST, RESPONSE = 0x1C0 + NODE // 4, 0x180 + NODE, 0x600 + NODE, 0x580 + NODE
SLOT = 16 * (NODE % 4)
LOAD_N_M, LOAD_S = 4.0, 0.5
SAG_S = 1.0
"""When the supply falls to 20 V, of a drive that is told to trip."""
UPLOAD = {1: 0x4F, 2: 0x4B, 4: 0x43}


def load(t: float, _q: float, _qd: float) -> float:
    """Torque on the output: a step."""
    return -LOAD_N_M if t >= LOAD_S else 0.0


class Drive:
    """The bridge."""

    def __init__(self, trips: bool = False) -> None:
        session = AmSessionConfig(bus=AmBus.CANFD, cycle_us=1000, telemetry_extended=False)
        self.node = SimNode(UNIT, NODE, session, SimOptions(external_torque=load))
        self.trips = trips
        self.sampled = self.node.compact(bytes(16), False)

    def take(self, frame: Frame) -> tuple[int, bytes] | None:
        """The answer to a frame; None for one that is not the drive's."""
        if frame.can_id == GROUP and len(frame.data) == 64:
            return ANSWER, self.cycle(frame.data[SLOT : SLOT + 16])
        return (RESPONSE, self.sdo(frame.data)) if frame.can_id == REQUEST else None

    def cycle(self, slot: bytes) -> bytes:
        """The sample that there is, with the counter of this command; then a cycle with it."""
        if self.trips and self.node.joint.t_ns >= SAG_S * 1e9:
            self.node.joint.set_bus_voltage(20.0)
        before, self.sampled = self.sampled, self.node.compact(slot, False)
        return before[:12] + self.sampled[12:13] + before[13:]

    def sdo(self, data: bytes) -> bytes:
        """Expedited transfer of CiA 301, or the abort that the drive's dictionary gives."""
        index, sub = struct.unpack_from("<HB", data, 1)
        try:
            if data[0] == 0x40:
                value = self.node.sdo_read(index, sub)
                return bytes((UPLOAD[len(value)],)) + data[1:4] + value.ljust(4, b"\x00")
            self.node.sdo_write(index, sub, data[4 : 8 - (data[0] >> 2 & 3)])
            return b"\x60" + data[1:4] + bytes(4)
        except SdoAbort as abort:
            return b"\x80" + data[1:4] + struct.pack("<I", abort.code)


def serve(link: Link, drive: Drive, stopped: Callable[[], bool]) -> None:
    """Frames as they come."""
    while not stopped():
        frame = link.receive(5_000_000)
        if frame is not None and not frame.flags and (answer := drive.take(frame)):
            link.send(*answer, len(answer[1]) > 8)


if __name__ == "__main__":
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    channel = open_link(BusSettings("hil-local", sys.argv[1], fd=True))
    print("ready", flush=True)
    serve(channel, Drive("trips" in sys.argv), over.is_set)
    channel.close()
