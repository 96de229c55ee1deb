"""Peer: the loop as it is usually written with python-can and cantools, on the same bus and drive.

recv and send of can.Message, decode and encode by cantools, a PI speed and current law in plain Python, and
time.sleep for what is left of the period, so that lateness adds up. It checks no CRC and no counter, and
logs nothing. Prints one JSON line. ``python -m benchmarks.python_can_loop INTERFACE CHANNEL DBC``
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import can
import cantools


@dataclass(slots=True)
class Counted:
    """What came of the run; ``late``: ticks whose work took longer than the period."""

    ticks: int
    lost: int
    late: int
    rate_hz: float
    processor_us: float


@dataclass(slots=True)
class Law:
    """PI for speed and both currents; its integrals are its state."""

    period_s: float
    speed: float = 0.0
    current_q: float = 0.0
    current_d: float = 0.0

    def command(self, w: float, i_q: float, i_d: float) -> tuple[float, float]:
        """(u_q, u_d) [V] for the speed 0."""
        self.speed += self.period_s * -w
        asked = 0.3 * -w + 2.0 * self.speed
        self.current_q += self.period_s * (asked - i_q)
        self.current_d += self.period_s * -i_d
        u_q = 8.0 * (asked - i_q) + 500.0 * self.current_q
        u_d = 8.0 * -i_d + 500.0 * self.current_d
        return max(-300.0, min(300.0, u_q)), max(-300.0, min(300.0, u_d))


def run(bus: can.BusABC, database: Any, period_s: float, ticks: int) -> Counted:
    """Run the loop: SYNC, wait for feedback, compute, command, sleep."""
    feedback = database.get_message_by_name("FEEDBACK")
    command = database.get_message_by_name("COMMAND")
    law, counted = Law(period_s), Counted(ticks, 0, 0, 0.0, 0.0)
    begin, processor = time.perf_counter(), time.thread_time()
    for k in range(ticks):
        start = time.perf_counter()
        bus.send(can.Message(arbitration_id=0x80, data=[k % 240 + 1], is_extended_id=False))
        message = bus.recv(0.02)
        while message is not None and message.arbitration_id != feedback.frame_id:
            message = bus.recv(0.02)
        if message is None:
            counted.lost += 1
            continue
        seen = feedback.decode(message.data, decode_choices=False)
        u_q, u_d = law.command(seen["Speed"], seen["CurrentQ"], seen["CurrentD"])
        data = command.encode(
            {"Crc": 0, "Counter": k % 16, "Mode": 0, "Controlword": 0, "VoltageQ": u_q, "VoltageD": u_d}
        )
        bus.send(can.Message(arbitration_id=command.frame_id, data=data, is_extended_id=False))
        left = period_s - (time.perf_counter() - start)
        counted.late += left < 0
        time.sleep(max(0.0, left))
    counted.processor_us = (time.thread_time() - processor) * 1e6 / ticks
    counted.rate_hz = ticks / (time.perf_counter() - begin)
    return counted


def main() -> None:
    """Run it and print the result as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.python_can_loop")
    parser.add_argument("interface")
    parser.add_argument("channel")
    parser.add_argument("dbc", type=Path)
    parser.add_argument("--rate", type=int, default=1000)
    parser.add_argument("--ticks", type=int, default=5000)
    args = parser.parse_args()
    database = cantools.database.load_file(args.dbc)
    with can.Bus(interface=args.interface, channel=args.channel) as bus:
        counted = run(bus, database, 1.0 / args.rate, args.ticks)
    sys.stdout.write(json.dumps(asdict(counted)) + "\n")


if __name__ == "__main__":
    main()
