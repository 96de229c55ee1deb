"""The floor that a Python loop on this bus can't go below: three frames a tick, and nothing computed.

SYNC goes out at its deadline, FEEDBACK is waited for, a COMMAND of ready-made bytes goes back: no check, no
decoding, no control, no record. ``hil bench`` runs it as a process beside the product's own loop, with the
same drive answering, to say what the difference costs: ``python -m drivers.bare INTERFACE CHANNEL ...``.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import select
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from drivers.bcm import KernelSync
from drivers.codec import Database
from drivers.local import open_sockets, pack_frame

DEADLINE_WAIT_S: Final = 0.02
Sockets = tuple[socket.socket, socket.socket]


@dataclass(frozen=True, slots=True)
class Exchange:
    """The three frames: SYNC and COMMAND ready to send (one for each counter), FEEDBACK's first bytes."""

    syncs: list[bytes]
    commands: list[bytes]
    feedback: bytes


@dataclass(frozen=True, slots=True)
class BareResult:
    """What came of it. ``late``: ticks that ended after the next deadline; ``processor_us`` is a tick's."""

    ticks: int
    skipped: int
    late: int
    lost: int
    processor_us: float


def exchange_of(database: Database) -> Exchange:
    """The frames of the house protocol: commands that ask for no voltage. Raises DatabaseError."""
    sync, feedback = database.message("SYNC"), database.message("FEEDBACK")
    command = database.message("COMMAND")
    syncs = [pack_frame(sync.send_id, bytes((count,))) for count in range(1, 241)]
    encoded = [command.encode({"Counter": count}) for count in range(command.counter_modulus)]
    commands = [pack_frame(command.send_id, data, command.fd) for data in encoded]
    return Exchange(syncs, commands, feedback.send_id.to_bytes(4, sys.byteorder))


def open_raw(interface: str, channel: str) -> Sockets:
    """(receiving, sending) sockets of the bus. Raises OSError, or ValueError for a bus without sockets."""
    if interface == "hil-local":
        receiving, sending = open_sockets(channel, own=False)
        return receiving, sending
    if interface != "socketcan":
        raise ValueError(f"{interface}: has no socket to exchange frames on; use hil-local or socketcan")
    both = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    both.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    both.bind((channel,))
    both.setblocking(False)
    return both, both


def bare_loop(sockets: Sockets, frames: Exchange, period_ns: int, ticks: int) -> BareResult:
    """Exchange the frames ``ticks`` times, each tick at its absolute deadline; late periods are skipped."""
    send, wait = sockets[1].send, _waiter(sockets[0], frames.feedback)
    k = done = skipped = late = lost = 0
    start_ns, begin = time.monotonic_ns(), time.thread_time_ns()
    while done < ticks:
        deadline_ns = start_ns + k * period_ns
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        over = -left // period_ns
        skipped, k, deadline_ns = skipped + over, k + over, deadline_ns + over * period_ns
        send(frames.syncs[done % 240])
        lost += not wait()
        send(frames.commands[done % len(frames.commands)])
        late += time.monotonic_ns() - deadline_ns > period_ns
        k, done = k + 1, done + 1
    processor_ns = time.thread_time_ns() - begin
    return BareResult(ticks, skipped, late, lost, processor_ns * 1e-3 / ticks)


def bare_answers(sockets: Sockets, frames: Exchange, sync: KernelSync, ticks: int) -> float:
    """The same with SYNC by the kernel's timer: feedback is waited for and answered. Processor time [us]."""
    send, wait = sockets[1].send, _waiter(sockets[0], frames.feedback)
    sync.start()
    wait()
    begin = time.thread_time_ns()
    for done in range(ticks):
        wait()
        send(frames.commands[done % len(frames.commands)])
    processor_ns = time.thread_time_ns() - begin
    sync.close()
    return processor_ns * 1e-3 / ticks


def _waiter(receiving: socket.socket, feedback: bytes) -> Callable[[], bool]:
    """What waits for the next feedback: False when none comes in time."""
    receive, fds = receiving.recv, [receiving.fileno()]

    def wait() -> bool:
        while select.select(fds, [], [], DEADLINE_WAIT_S)[0]:
            if receive(128)[:4] == feedback:
                return True
        return False

    return wait


def _prefer(priority: int) -> None:
    """The rights that the controller's loop asks for, as far as they are granted."""
    gc.collect()
    gc.disable()
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            sys.stderr.write(f"bare loop: no FIFO scheduling ({error.strerror})\n")


def main() -> None:
    """Run it and print the result as JSON."""
    parser = argparse.ArgumentParser(prog="python -m drivers.bare", description=main.__doc__)
    parser.add_argument("interface")
    parser.add_argument("channel")
    parser.add_argument("dbc", type=Path)
    parser.add_argument("--rate", type=int, default=1000, help="[Hz]")
    parser.add_argument("--ticks", type=int, default=5000)
    parser.add_argument("--node", type=int, default=1)
    parser.add_argument("--fifo", type=int, default=50, help="FIFO priority, 0 for none")
    args = parser.parse_args()
    sockets = open_raw(args.interface, args.channel)
    frames = exchange_of(Database(args.dbc, args.node))
    _prefer(args.fifo)
    result = bare_loop(sockets, frames, 1_000_000_000 // args.rate, args.ticks)
    sys.stdout.write(json.dumps(asdict(result)) + "\n")


if __name__ == "__main__":
    main()
