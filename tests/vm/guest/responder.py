"""CiA 402 nodes that answer SYNC at once, without a motor: one and two are counted against them.

The emulated shaft of two drives takes too long for virtual time. These walk the states by the controlword and
say a speed near 0 that is never twice the same; their frames are ready before they are asked for.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from pathlib import Path

from drivers.bare import open_raw
from drivers.codec import Database
from drivers.local import CLASSIC, pack_frame

SYNC, NMT = 0x080, 0x000
TPDO1, RPDO1, HEARTBEAT = 0x180, 0x200, 0x700
STATUSWORD = {0x00: 0x40, 0x06: 0x21, 0x07: 0x23, 0x0F: 0x27}
"""By controlword."""
VARIETY = 35
BEAT_S = 0.1
PRIORITY = 40
"""FIFO, below the loop's."""


def frames_of(dbc: Path, node: int) -> dict[int, list[bytes]]:
    """TPDO1 by statusword."""
    message = Database(dbc, node).message("TPDO1")

    def frame(state: int, n: int) -> bytes:
        values = {"Statusword": state, "Velocity": 0.01 * (n % 7), "Torque": 0.01 * (n % 5)}
        return pack_frame(TPDO1 + node, message.encode(values))

    return {state: [frame(state, n) for n in range(VARIETY)] for state in STATUSWORD.values()}


class Nodes:
    """Some nodes on one socket."""

    def __init__(self, sockets: tuple[socket.socket, socket.socket], dbc: Path, ids: tuple[int, ...]) -> None:
        self._receiving, self._sending = sockets
        self._frames = {node: frames_of(dbc, node) for node in ids}
        self._state = dict.fromkeys(ids, STATUSWORD[0x00])
        self._operational = dict.fromkeys(ids, False)
        self._syncs = 0

    def take(self, raw: bytes) -> None:
        can_id, _, data = CLASSIC.unpack(raw[: CLASSIC.size])
        if can_id == SYNC:
            self._syncs += 1
            for node, state in self._state.items():
                if self._operational[node]:
                    self._sending.send(self._frames[node][state][self._syncs % VARIETY])
        elif can_id - RPDO1 in self._state:
            node = can_id - RPDO1
            self._state[node] = STATUSWORD.get(data[0] | data[1] << 8, STATUSWORD[0x00])
        elif can_id == NMT and data[1] in self._state:
            self._operational[data[1]] = data[0] == 1

    def beat(self) -> None:
        for node, operational in self._operational.items():
            self._sending.send(pack_frame(HEARTBEAT + node, bytes((5 if operational else 0x7F,))))

    def serve(self) -> None:
        """Until SIGTERM."""
        due = time.monotonic()
        while True:
            if (left := due - time.monotonic()) <= 0.0:
                self.beat()
                due += BEAT_S
            elif select.select([self._receiving], [], [], left)[0]:
                self.take(self._receiving.recv(128))


def serve(interface: str, dbc: Path, *ids: int) -> int:
    """Serve nodes on a bus until SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    nodes = Nodes(open_raw("socketcan", interface), dbc, ids)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    nodes.serve()
    return 0
