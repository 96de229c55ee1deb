"""Two emulated drives on one link and one rigid shaft, served by one process.

Each is a :class:`firmware_model.node.Node` with its own frames and firmware; the first moves the shaft for
both (:mod:`firmware_model.shaft`). In lockstep one SYNC advances the shaft once, and both answer. Faults of a
node's frames are between it and the bus (:class:`Tap`); the end of a tick is told once, after both.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.bus import Frame, Link
from drivers.errors import LinkError
from drivers.lockstep import tick_over
from firmware_model.faulty_link import FaultyLink
from firmware_model.load import load_torque
from firmware_model.node import Node, run_out
from firmware_model.plant import ANGLE
from firmware_model.registry import PlantError
from firmware_model.shaft import Shaft, couple
from firmware_model.station import BEAT_NS, HEARTBEAT_NS, IDLE_NS, LAST_NS


class Tap:
    """The bus as one node hears it: frames are put in by who reads the bus, what it sends goes there."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.heard: deque[Frame] = deque()

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        self._link.send(can_id, data, fd)

    def receive(self, timeout_ns: int) -> Frame | None:
        """What was put in; nobody waits here."""
        return self.heard.popleft() if self.heard else None

    def discard(self) -> int:
        """Throw away what was put in."""
        count = len(self.heard)
        self.heard.clear()
        return count

    def close(self) -> None:
        """The bus is another's."""


class Coupled(Node):
    """A node whose plant is moved on by the shaft; ``shaft`` is None for all but the first.

    ``faulty``, where its frames have faults: a link around ``tap``, which then hears the bus for it.
    """

    faulty: FaultyLink | None = None
    tap: Tap | None = None
    shaft: Shaft | None = None
    lead: Coupled | None = None
    other: Coupled | None = None

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._station, self._cells = None, np.zeros(BEAT_NS + 1, np.int64).data
        self.records = self._params, self._state
        self.next_beat = 0

    @property
    def lockstep(self) -> bool:
        """Whether a SYNC is a period."""
        return self._clock == "lockstep"

    @property
    def sync_id(self) -> int | None:
        """Identifier of the SYNC that it answers."""
        return self._frames.sync_id

    def begin(self, now_ns: int) -> None:
        """Boot."""
        self._send(self._frames.boot())
        self._cells[LAST_NS] = now_ns

    def beat(self, now_ns: int) -> None:
        """The heartbeat, when it is due."""
        if now_ns >= self.next_beat:
            self.next_beat = now_ns + (self._frames.beat_ns or HEARTBEAT_NS)
            self._send(self._frames.beat() if self._frames.beat_ns else [])

    def hear(self, frame: Frame) -> None:
        """A frame of the bus, through the faults."""
        if self.faulty is None or self.tap is None:
            self.take(frame)
            return
        self.tap.heard.append(frame)
        while (through := self.faulty.receive(0)) is not None or self.tap.heard:
            if through is not None:
                self.take(through)

    def catch_up(self) -> None:
        """Realtime: the plant comes to now."""
        self._catch_up()

    def _advance_to(self, now_ns: int) -> None:
        """By the leading drive's clock: both began with the same SYNC."""
        if self.lead is not None:
            self.lead._advance_to(now_ns)
            self._advance(0)
            return
        super()._advance_to(now_ns)

    def _advance(self, dt_ns: int) -> None:
        """The shaft, once a period, then what this node's faults do."""
        if self.shaft is not None:
            self.shaft.advance(dt_ns)
        if self._faults is not None:
            self._fail(self._faults)

    def _after_sampling(self) -> None:
        """To this motor the other one is load: T_L = T_L1 + T_L2 - T_other."""
        super()._after_sampling()
        other, sample = self.other, self._kernels.sample
        assert other is not None  # noqa: S101 - the bench has named it
        p, x = other._kernels.params, other.state["x"]
        T = 1.5 * p["n_p"] * (p["psi_f"] * x[1] + (p["L_d"] - p["L_q"]) * x[1] * x[2])
        theta = float(other.state["series"][ANGLE, 0])
        loads = load_torque(p, self.now_ns * 1e-9, float(x[0]), theta) - float(T)
        sample["T_L_true"] = np.float64(np.float32(sample["T_L_true"] + loads))


class Bench:
    """Both nodes of a bench. Raises PlantError for what can't share a shaft."""

    def __init__(self, link: Link, nodes: Sequence[Coupled]) -> None:
        self._link, self._nodes = link, nodes
        first, second = nodes
        if first.sync_id is None or first.sync_id != second.sync_id:
            raise PlantError("two drives on one shaft must answer the same SYNC")
        couple(first.records[0], second.records[0])
        first.shaft, second.lead = Shaft(*first.records, *second.records), first
        first.other, second.other = second, first
        self._ends_ticks = any(node.faulty for node in nodes) and first.lockstep

    def warm_up(self) -> None:
        """All is compiled when it is made."""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve the bus until ``stopped()``."""
        for node in self._nodes:
            node.begin(time.monotonic_ns())
        while not stopped():
            now = time.monotonic_ns()
            for node in self._nodes:
                node.beat(now)
            self._serve(min(max(min(n.next_beat for n in self._nodes) - now, 0), IDLE_NS))
        run_out(*self._nodes)

    def _serve(self, timeout_ns: int) -> None:
        try:
            frame = self._link.receive(timeout_ns)
        except LinkError:
            time.sleep(0.01)
            frame = None
        if frame is not None:
            for node in self._nodes:
                node.hear(frame)
            if self._ends_ticks and frame.can_id | frame.flags == self._nodes[0].sync_id:
                self._link.send(*tick_over(frame.data))
        first = self._nodes[0]
        if frame is None or time.monotonic_ns() - first._cells[LAST_NS] > IDLE_NS:
            first.catch_up()

    def summary(self) -> str:
        """A line for each node."""
        return "\n".join(node.summary() for node in self._nodes)
