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
BIT = 8 * SLOT
UPLOAD = {1: 0x4F, 2: 0x4B, 4: 0x43}

DBC = f"""VERSION "1"
NS_ :
BS_:
BU_: Controller Drive
BO_ {GROUP} GROUP: 64 Controller
 SG_ Torque : {BIT + 48}|16@1- (0.01,0) [-327.68|327.67] "Nm" Drive
 SG_ Enable : {BIT + 96}|1@1+ (1,0) [0|1] "" Drive
 SG_ FaultReset : {BIT + 98}|1@1+ (1,0) [0|1] "" Drive
 SG_ Mode : {BIT + 100}|4@1+ (1,0) [0|15] "" Drive
 SG_ Counter : {BIT + 104}|8@1+ (1,0) [0|255] "" Drive
BO_ {ANSWER} ANSWER: 16 Drive
 SG_ Velocity : 32|16@1- (0.01,0) [-327.68|327.67] "rad/s" Controller
 SG_ State : 80|3@1+ (1,0) [0|7] "" Controller
 SG_ Limited : 86|1@1+ (1,0) [0|1] "" Controller
 SG_ Echo : 96|8@1+ (1,0) [0|255] "" Controller
 SG_ Winding : 104|8@1+ (1,-40) [-40|215] "degC" Controller
 SG_ Supply : 112|16@1+ (0.01,0) [0|655.35] "V" Controller
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";
"""

CONFIG = f"""[loop]
rate_hz = 1000
pacing = "sync"
clock = "lockstep"
duration_s = 1.4
[bus]
interface = "hil-local"
channel = "am"
fd = true
data_bitrate = 5000000
[drive]
dbc = "am.dbc"
torque_constant_n_m_a = {K_T}
current_limit_a = 27.0
speed_filter = {{ kind = "first-order", pole_rad_s = 1885.0 }} # its vel_filter_hz, 300
[drive.signals]
poll = "GROUP"
speed = "ANSWER.Velocity"
state = "ANSWER.State"
limited = "ANSWER.Limited"
echo = "ANSWER.Echo"
temperature_motor = "ANSWER.Winding"
v_dc = "ANSWER.Supply"
torque_ref = "GROUP.Torque"
enable = "GROUP.Enable"
reset = "GROUP.FaultReset"
counters = ["GROUP.Counter"]
[drive.signals.states] # one bit enables it; it walks the states between by itself
0 = "off"
1 = "off"
2 = "off"
3 = "off"
4 = "operation enabled"
5 = "quick stop active"
6 = "fault reaction active"
7 = "fault"
[drive.signals.constants]
"GROUP.Mode" = 1 # CST
[motor] # its torque constant is 1.5 n_p psi_f, at the output
R_s_ohm = 1.0
L_d_h = 1e-3
L_q_h = 1e-3
psi_f_wb = {K_T / 31.5}
n_p = 21
J_kg_m2 = {J}
B_f_n_m_s = 0.0
[controller]
kind = "speed"
speed_pole_rad_s = 30.0
[observer.speed]
kind = "ftdob"
gamma_1_rad_s = 25.0
gamma_2_rad_s = 58.0
delay_ms = 12.0
[limits]
w_max_rad_s = 10.0
i_max_a = 12.0
i_trip_a = 25.0
dtorque_max_n_m = 20.0
v_dc_min_v = 40.0
v_dc_max_v = 55.0
temperature_max_c = 120.0
i_continuous_a = 12.0
i2t_max_a2s = 400.0
[reference]
kind = "s-curve"
w_rad_s = 5.0
rate_rad_s2 = 20.0
jerk_rad_s3 = 1000.0
at_s = 0.05
down_at_s = 1.1
"""


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


def main(channel: str, interface: str = "hil-local", trips: bool = False) -> int:
    """The drive on a bus until SIGTERM."""
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    link = open_link(BusSettings(interface, channel, fd=True))
    print("ready", flush=True)
    serve(link, Drive(trips), over.is_set)
    link.close()
    return 0


if __name__ == "__main__":
    main(sys.argv[1], trips="trips" in sys.argv)
