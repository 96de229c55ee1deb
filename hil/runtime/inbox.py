"""Live set-points from other processes of this user: a page of shared memory that the loop looks at.

A client writes values and the place of the node they are for, then their number and a check of all; the loop
takes a set-point once, judges it by that node's range and answers with a code. It never waits, and what does
not fit its check is not there.
Like the rings the page is a memfd: no name, only this user's processes can open it.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import mmap
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from hil.config.design import Machine
from hil.config.tables import COMMANDED
from hil.errors import HilError
from hil.runtime.clock import RealClock
from hil.signals import DriveState, Request

NAME: Final = "memfd:hil-setpoint"
MAGIC: Final = 0x68696C5345545031
MAGIC_AT, ASKED, HAS, W, I_Q, CHECK, ANSWERED, CODE, NODE = range(9)
WHO_AT, WHO_BYTES = 128, 200
PARTS: Final = {"w": (1, W, "rad/s"), "i_q": (2, I_Q, "A")}
"""Bit, place and unit of what can be set."""
ANSWER_S: Final = 2.0
LOOK_NS: Final = 2_000_000
MASK: Final = (1 << 63) - 1
Takes = dict[str, tuple[float, float, float]]
"""What may be set, by name: least, most, rate [SI]."""
OPERATING, STOP = int(DriveState.OPERATION_ENABLED), int(Request.STOP)


class SetpointError(HilError, RuntimeError):
    """The run does not take the set-point."""


class Answer(IntEnum):
    """What a run made of a set-point."""

    NONE = 0
    TAKEN = 1
    NOT_OPERATING = 2
    STOPPING = 3
    OUT_OF_RANGE = 4
    NO_NODE = 5


WORDS: Final = {
    Answer.NONE: f"the run did not answer within {ANSWER_S:g} s; it may hang or have ended",
    Answer.NOT_OPERATING: "the drive is not in operation yet; ask again once the run says operation enabled",
    Answer.STOPPING: "the run is stopping; start another one",
    Answer.OUT_OF_RANGE: "out of the run's range",
    Answer.NO_NODE: "the run has no such node",
}


def _bits(value: float) -> int:
    return int.from_bytes(struct.pack("<d", value), "little", signed=True)


def _value(bits: int) -> float:
    return float(struct.unpack("<d", bits.to_bytes(8, "little", signed=True))[0])


def _check(number: int, has: int, w: int, i_q: int, node: int) -> int:
    """What ties values and node to their number, so that the loop never takes half of a set-point."""
    return (number * 0x9E3779B97F4A7C15 ^ has ^ w * 3 ^ i_q * 5 ^ node * 7) & MASK


def ranges(machine: Machine, law: str) -> Takes:
    """What a law takes, by name: least, most, rate [SI]; nothing for a commanded torque, which has no w*."""
    if law in COMMANDED:
        return {}
    p = machine.setpoint[0]
    found = {"w": (float(p["w_min"]), float(p["w_max"]), float(p["w_rate"]))}
    if law == "fac":
        found["i_q"] = (-float(p["i_q_max"]), float(p["i_q_max"]), float(p["i_q_rate"]))
    return found


@dataclass(frozen=True, slots=True)
class Place:
    """A node's controller, what may be set of it, and its name: none for the first and for one drive."""

    machine: Machine
    takes: Takes
    name: str = ""


class Inbox:
    """The run's end of the page; ``places``: its nodes, in the configuration's order."""

    def __init__(self, *places: Place) -> None:
        self._places, self._seen = places, 0
        self._fd = os.memfd_create(NAME.partition(":")[2], os.MFD_CLOEXEC)
        os.fchmod(self._fd, 0o600)
        os.posix_fallocate(self._fd, 0, mmap.PAGESIZE)
        page = mmap.mmap(self._fd, mmap.PAGESIZE, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self._page = memoryview(page)
        self.cells: Any = self._page.cast("q")
        self.cells[MAGIC_AT] = MAGIC
        self.number: Any = self.cells[ASKED : ASKED + 1]

    def take(self, states: Sequence[int], asked: int) -> str:
        """Judge the set-point that waits; return the text of its event, empty while it is not whole.

        ``states``: of each node's supervisor.
        """
        cells = self.cells
        number, has, w, i_q, node = (cells[at] for at in (ASKED, HAS, W, I_Q, NODE))
        if number == self._seen or cells[CHECK] != _check(number, has, w, i_q, node):
            return ""
        self._seen = number
        values = {name: _value(cells[at]) for name, (bit, at, _) in PARTS.items() if has & bit}
        code, name = Answer.NO_NODE, ""
        if 0 <= node < len(self._places):
            place = self._places[node]
            code, name = _judged(values, place, states[node], asked), place.name
        if code is Answer.TAKEN:
            state: Any = self._places[node].machine.setpoint_state[0]
            for part, value in values.items():
                state[f"live_{part}"], state[f"{part}_target"] = 1, value
        cells[CODE], cells[ANSWERED] = int(code), number
        who = bytes(self._page[WHO_AT : WHO_AT + WHO_BYTES]).partition(b"\0")[0].decode(errors="replace")
        said = f"{shown(values)}: {code.name.lower().replace('_', ' ')}, asked by {who}"
        return f"{name}: {said}" if name else said

    def close(self) -> None:
        """Let go of the page."""
        self.number.release()
        self.cells.release()
        os.close(self._fd)


def _judged(values: dict[str, float], place: Place, state: int, asked: int) -> Answer:
    if asked >= STOP:
        return Answer.STOPPING
    if state != OPERATING:
        return Answer.NOT_OPERATING
    return Answer.OUT_OF_RANGE if outside(values, place.takes) else Answer.TAKEN


def shown(values: dict[str, float]) -> str:
    """Values with their units."""
    return ", ".join(f"{name} = {value:g} {PARTS[name][2]}" for name, value in values.items()) or "nothing"


def outside(values: dict[str, float], takes: Takes) -> str:
    """Why a run does not take the values, empty when it does."""
    for name, value in values.items():
        if name not in takes:
            known = ", ".join(takes)
            return f"this run's law takes {known}, not {name}" if known else "this run takes no set-point"
        least, most, _ = takes[name]
        if not (math.isfinite(value) and least <= value <= most):
            return f"{name} = {value:g} {PARTS[name][2]} is out of range: {least:g} to {most:g}"
    return "" if values else "nothing to set"


@contextlib.contextmanager
def _opened(pid: int) -> Iterator[tuple[Any, memoryview]]:
    """Another process's page, held alone. Raises SetpointError when it has none."""
    try:
        links = list(Path(f"/proc/{pid}/fd").iterdir())
    except OSError as error:
        raise SetpointError(f"process {pid}: can't be looked into ({error.strerror})") from error
    for link in links:
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            if str(link.readlink()) == f"/{NAME} (deleted)":
                fd = os.open(link, os.O_RDWR | os.O_CLOEXEC)
                try:
                    fcntl.flock(fd, fcntl.LOCK_EX)  # one client at a time; the loop never locks
                    page = mmap.mmap(fd, mmap.PAGESIZE, flags=mmap.MAP_SHARED)
                    yield memoryview(page).cast("q"), memoryview(page)
                finally:
                    os.close(fd)
                return
    raise SetpointError(
        f"process {pid} takes no set-point; it runs with setpoint.enabled = false, or as a shadow"
    )


def ask(pid: int, values: dict[str, float], who: str, timeout_s: float = ANSWER_S, node: int = 0) -> None:
    """Ask a run for set-points and wait for its answer. Raises SetpointError with the reason of a refusal.

    ``node``: place of the node they are for, in the configuration's order.
    """
    with _opened(pid) as (cells, page):
        number = cells[ASKED] + 1
        numbers = {at: _bits(values.get(name, 0.0)) for name, (_, at, _) in PARTS.items()}
        has = sum(PARTS[name][0] for name in values)
        page[WHO_AT : WHO_AT + WHO_BYTES] = who.encode(errors="replace")[: WHO_BYTES - 1].ljust(
            WHO_BYTES, b"\0"
        )
        cells[W], cells[I_Q], cells[HAS], cells[NODE] = numbers[W], numbers[I_Q], has, node
        cells[CHECK] = _check(number, has, numbers[W], numbers[I_Q], node)
        cells[ASKED] = number
        clock = RealClock()
        code, now_ns = Answer.NONE, clock.now_ns()
        end_ns = now_ns + round(timeout_s * 1e9)
        while code is Answer.NONE and now_ns < end_ns:
            now_ns = clock.sleep_until(now_ns + LOOK_NS)
            code = Answer(cells[CODE]) if cells[ANSWERED] == number else Answer.NONE
    if code is not Answer.TAKEN:
        raise SetpointError(f"{shown(values)}: {WORDS[code]}")
