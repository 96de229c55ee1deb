"""A CiA 402 drive on durand, a CANopen slave of strangers: their SDO server, NMT, heartbeat, PDOs on SYNC.

What is ours is the glue: the state machine of a drive, a shaft with inertia and a load step, a torque that
follows with a lag. It moves by one period a SYNC. ``python -m tests.durand402 CHANNEL EDS`` serves hil-local.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import durand
from durand.datatypes import DatatypeEnum as Type
from durand.network import NetworkABC
from durand.scheduler import VirtualScheduler

from drivers.bus import BusSettings, Link, open_link

NODE, T_S, J, LAG_S = 5, 1e-3, 0.01265, 1e-3
RATED_N_M, MILLI_RPM = 13.68, math.pi / 30e3
LOAD_N_M, LOAD_S = 5.4, (1.0, 2.0)
STEPS = {(1, 0x06): 2, (2, 0x07): 3, (3, 0x0F): 4}
WORDS = {1: 0x0240, 2: 0x0221, 3: 0x0233, 4: 0x1237}
MOST_US = 5000
"""The longest period of SYNC that it takes (1006h)."""
OBJECTS = (
    (0x1006, Type.UNSIGNED32, "rw", 0, "Communication cycle period"),
    (0x6040, Type.UNSIGNED16, "rw", 0, "Controlword"), (0x6041, Type.UNSIGNED16, "ro", 0x240, "Statusword"),
    (0x6060, Type.INTEGER8, "rw", 0, "Modes of operation"), (0x6061, Type.INTEGER8, "ro", 0, "Mode display"),
    (0x606C, Type.INTEGER32, "ro", 0, "Velocity actual"), (0x6071, Type.INTEGER16, "rw", 0, "Target torque"),
    (0x6076, Type.UNSIGNED32, "ro", 13680, "Rated torque"), (0x6077, Type.INTEGER16, "ro", 0, "Torque"),
    (0x60A9, Type.UNSIGNED32, "ro", 0xFDB44700, "SI unit velocity"),
    (0x6502, Type.UNSIGNED32, "ro", 0x200, "Supported modes"),
)  # fmt: skip


class Wire(NetworkABC):  # type: ignore[misc]  # durand has no types
    """durand over a link of ours."""

    def __init__(self, link: Link) -> None:
        self.link, self.callbacks = link, dict[int, Callable[[int, bytes], None]]()

    def add_subscription(self, cob_id: int, callback: Any) -> None:
        self.callbacks[cob_id] = callback

    def remove_subscription(self, cob_id: int, callback: Any = None) -> None:
        self.callbacks.pop(cob_id, None)

    def send(self, cob_id: int, msg: bytes) -> None:
        self.link.send(cob_id, bytes(msg))

    def serve(self, stopped: Callable[[], bool], clock: VirtualScheduler) -> None:
        """Frames as they come; durand's own timers by the time that passes."""
        last = time.monotonic()
        while not stopped():
            frame = self.link.receive(5_000_000)
            if frame is not None and not frame.flags and (call := self.callbacks.get(frame.can_id)):
                call(frame.can_id, frame.data)
            now = time.monotonic()
            clock.run(now - last)
            last = now


class Drive:
    """The glue: what a SYNC does to state, shaft and objects."""

    def __init__(self, wire: Wire) -> None:
        self.state, self.w, self.torque, self.ticks = 1, 0.0, 0.0, 0
        self.node = durand.MinimalNode(wire, NODE)
        od = self.od = self.node.object_dictionary
        for index, kind, access, value, name in OBJECTS:
            most = MOST_US if index == 0x1006 else None
            od[index] = durand.Variable(kind, access, value, maximum=most, name=name)
        period = durand.Record(name="Interpolation time period")
        period[1] = durand.Variable(Type.UNSIGNED8, "rw", 1, name="Value")
        period[2] = durand.Variable(Type.INTEGER8, "rw", -3, name="Index")
        od[0x60C2] = period
        od.update_callbacks[0x6060, 0].add(lambda mode: od.write(0x6061, 0, mode))
        od.update_callbacks[0x6040, 0].add(self.control)
        self.node.nmt.state_callbacks.add(self.leave)
        self.node.sync.callbacks.add(self.step)
        od.write(0x1017, 0, 100)

    def control(self, word: int) -> None:
        """One step of CiA 402's state machine."""
        self.state = STEPS.get((self.state, word & 0x0F), self.state if word & 0x06 == 0x06 else 1)
        self.state = min(self.state, {0x06: 2, 0x07: 3}.get(word & 0x0F, 4))

    def leave(self, nmt: Any) -> None:
        """A connection that is left switches off."""
        self.state = self.state if int(nmt) == 5 else 1

    def step(self) -> None:
        """A period of the shaft, then the objects that it is measured by; the command comes after."""
        asked = self.od.read(0x6071, 0) * 1e-3 * RATED_N_M if self.state == 4 else 0.0
        self.torque = asked + (self.torque - asked) * math.exp(-T_S / LAG_S) if self.state == 4 else 0.0
        load = LOAD_N_M if LOAD_S[0] <= self.ticks * T_S < LOAD_S[1] else 0.0
        self.w += (self.torque - load) / J * T_S if self.state == 4 else 0.0
        self.ticks += self.state == 4
        self.od.write(0x606C, 0, round(self.w / MILLI_RPM))
        self.od.write(0x6077, 0, round(1e3 * self.torque / RATED_N_M))
        self.od.write(0x6041, 0, WORDS[self.state])


OWN = ("tpdo", "rpdo_timeout_ms", "load_true", "[drive.signals.units]")


def config_of(shipped: str) -> str:
    """The shipped configuration without what durand's drive has not: objects by the mode alone."""
    return "".join(line for line in shipped.splitlines(keepends=True) if not line.startswith(OWN))


def serve(channel: str, eds: Path, stopped: Callable[[], bool], interface: str = "hil-local") -> None:
    """A drive on a bus until it is to stop; its EDS, as durand makes it, goes to a file."""
    durand.set_scheduler(clock := VirtualScheduler())
    link = open_link(BusSettings(interface, channel))
    wire = Wire(link)
    drive = Drive(wire)
    eds.write_text(drive.node.eds.content, encoding="utf-8")
    print("ready", flush=True)
    try:
        wire.serve(stopped, clock)
    finally:
        link.close()


def main(channel: str, eds: Path, interface: str = "hil-local") -> int:
    """The drive on a bus until SIGTERM."""
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    serve(channel, eds, over.is_set, interface)
    return 0


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
