"""The emulated drive as a node on a bus: frames in, kernels, frames out.

`lockstep`: each SYNC advances the plant by exactly one period. `realtime`: by the time that really passed;
a timer advances it when SYNC stays away, so that the watchdog trips. A cyclic drive (no SYNC) samples on its
own timer; its loads begin with the first command. Frames that are not whole, valid and fresh are counted and
ignored.
"""

from __future__ import annotations

import functools
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drivers.bus import Frame, Link, unpack_frame
from drivers.codec import Database
from drivers.errors import LinkError
from drivers.lockstep import tick_over
from firmware_model.config import Record, Wire, new_sample, new_state
from firmware_model.dialects import Eds, Frames, Sent, dialect
from firmware_model.drive import advance
from firmware_model.faulty_plant import PlantFaults, advance_open_phase
from firmware_model.kernels import Kernels
from firmware_model.plant import State
from firmware_model.station import (
    ANSWER,
    BEAT_NS,
    HEARTBEAT_NS,
    IDLE_NS,
    LAST_NS,
    STARTED,
    UNSENT,
    Station,
    station,
)

BLACK_BOX = "black box: "
LOOK_NS = 1_000_000_000
"""So long a busy drive serves the bus without asking whether to stop; a signal asks at once."""
RUN_OUT_NS = 500_000_000


def frames_of(
    database: Database, protocol: str = "house", truth: bool = True, eds: Eds | None = None
) -> Frames:
    """What a drive of this protocol reads and writes. Raises DatabaseError or PlantError."""
    return dialect(protocol).frames(database, truth, eds)


def wire_of(database: Database, protocol: str = "house") -> Wire:
    """Resolution and range of the measured signals."""
    return dialect(protocol).wire or frames_of(database, protocol).wire


def compile_kernels(params: Record, state: Record) -> None:
    """Run every kernel of a plant once, those of faults too; ``state`` is spoiled."""
    Kernels(params, state, new_sample())
    advance(params[0], state[0], 1000)
    advance_open_phase(params[0], state[0], np.zeros(1), 1000)


def run_out(*nodes: Node) -> None:
    """Lockstep with faults: drives that are left alone meet their watchdogs, as they would in real time."""
    faults = [node.faults for node in nodes if node.faults is not None]
    for one in faults:
        one.box.closed = True  # a load may go on pushing a drive that is off
    for _ in range(RUN_OUT_NS // nodes[0].period_ns if faults else 0):
        for node in nodes:
            node.pass_time()


class Node:
    """One emulated drive on a link."""

    def __init__(
        self,
        link: Link,
        database: Database,
        params: Record,
        *,
        clock: Literal["realtime", "lockstep"],
        pacing: Literal["sync", "cyclic"],
        period_ns: int,
        truth: bool,
        protocol: str = "house",
        eds: Path | None = None,
        faults: PlantFaults | None = None,
        every: int = 1,
        ends_ticks: bool = False,
    ) -> None:
        """``every``: cycles from one measurement to the next; ``ends_ticks``: tell that a SYNC is answered.

        Who waits in lockstep knows then that no more comes.
        """
        self._link, self._clock, self._period_ns = link, clock, period_ns
        self._pacing = "sync" if dialect(protocol).steps and clock == "lockstep" else pacing
        self._make_frames = functools.partial(
            frames_of, database, protocol, truth, (eds, {}) if eds else None
        )
        self._frames, self._faults = self._make_frames(), faults
        self._every, self._cycles, self._ends_ticks = every, 0, ends_ticks
        self._params = params
        self._state = new_state(params, self._frames.counter_modulus - 1)
        records = params, self._state, new_sample()
        self._kernels = Kernels(*records)
        self._station: Station | None = None
        if pacing == "sync" and faults is None and every == 1 and not ends_ticks:
            self._station = station(link, self._frames, records, period_ns if clock == "lockstep" else 0)
        self._cells: Any = (self._station.cells if self._station else np.zeros(BEAT_NS + 1, np.int64)).data

    @property
    def ignored(self) -> Counter[str]:
        """Frames that were not whole, valid and fresh, counted by what was wrong."""
        return self._frames.ignored

    @property
    def now_ns(self) -> int:
        """Plant time."""
        return int(self.state["t_ns"])

    @property
    def state(self) -> Any:
        """The plant's state record."""
        return self._kernels.state

    def warm_up(self) -> None:
        """Compile on copies, before anything is on the bus, what the node was not made with."""
        if self._faults is not None:
            compile_kernels(self._params, self._state.copy())

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve the bus until ``stopped()``; boot-up message first, heartbeat every 100 ms."""
        self._send(self._frames.boot())
        self._cells[LAST_NS] = self._cells[BEAT_NS] = next_beat = next_cycle = time.monotonic_ns()
        while not stopped():
            now = time.monotonic_ns()
            if self._station is not None:
                self._attend(self._station, now + LOOK_NS)
                continue
            if now >= next_beat:
                next_beat = now + (self._frames.beat_ns or HEARTBEAT_NS)
                self._send(self._frames.beat() if self._frames.beat_ns else [])
            if self._pacing == "cyclic" and now >= next_cycle:
                next_cycle += self._period_ns * (1 + (now - next_cycle) // self._period_ns)
                self.sync(now)
            wake = min(next_beat, next_cycle) if self._pacing == "cyclic" else next_beat
            self._serve(min(max(wake - now, 0), IDLE_NS))
        run_out(self)

    @property
    def period_ns(self) -> int:
        """The loop's period."""
        return self._period_ns

    @property
    def faults(self) -> PlantFaults | None:
        """Its fault script or black box."""
        return self._faults

    def _serve(self, timeout_ns: int) -> None:
        try:
            self._after(self._link.receive(timeout_ns))
        except LinkError:
            self._bus_down()

    def _attend(self, station: Station, until_ns: int) -> None:
        """:meth:`_serve` over many frames in one call; what that does not judge is taken here."""
        code = station.attend(until_ns)
        if self._cells[UNSENT]:
            self.ignored["send"] += self._cells[UNSENT]
            self._cells[UNSENT] = 0
        if code == ANSWER:
            self._send(self._frames.answer(self._kernels.sampled()))
        elif code < 0:
            self._bus_down()
        else:
            self._after(unpack_frame(bytes(station.raw[:code])))

    def _after(self, frame: Frame | None) -> None:
        """Take a frame, if there is one, else the time that has passed."""
        if frame is not None:
            self.take(frame)
        flooded = time.monotonic_ns() - self._cells[LAST_NS] > IDLE_NS  # which must not stop the plant
        if frame is None or flooded:
            self._catch_up()

    def _bus_down(self) -> None:
        time.sleep(0.01)
        self._catch_up()

    def _catch_up(self) -> None:
        """Realtime: let the plant catch up with the clock, once its time has begun."""
        if self._clock == "realtime" and self._cells[STARTED]:
            self._advance_to(time.monotonic_ns())

    def _on_command(self) -> None:
        """Before a valid command is taken; a cyclic drive's plant stands still until its first."""
        if not self._cells[STARTED] and self._pacing == "cyclic":
            self._cells[STARTED], self._cells[LAST_NS] = 1, time.monotonic_ns()
        self._catch_up()

    def _advance_to(self, now_ns: int) -> None:
        self._advance(now_ns - self._cells[LAST_NS])
        self._cells[LAST_NS] = now_ns

    def _advance(self, dt_ns: int) -> None:
        """Move the plant on, then what its faults do."""
        if self._faults is None:
            self._kernels.advance(dt_ns)
        else:
            self._faults.advance(self.state, dt_ns)
            self._fail(self._faults)

    def _fail(self, faults: PlantFaults) -> None:
        """What faults do to the plant before it is sampled; a drive whose supply came back boots."""
        if faults.before(self.state):
            self._frames = self._make_frames()
            self._send(self._frames.boot())

    def pass_time(self) -> None:
        """Lockstep: a period has passed although its SYNC was lost."""
        if self._cells[STARTED] and self._clock == "lockstep":
            self._advance(self._period_ns)

    def take(self, frame: Frame) -> None:
        """Handle one frame, whole or not at all."""
        opens = frame.can_id | frame.flags == self._frames.sync_id
        if self._frames.answers_commands or not opens:
            self._frames.take(frame, self._kernels, self._on_command)
            if due := self._frames.due:
                self._frames.due = ()
                self._send(due)
        if opens and self._pacing == "sync":
            if self._frames.asks(frame.data):
                self.sync(time.monotonic_ns())
            else:
                self.ignored["length"] += 1
            if self._ends_ticks:
                self._send([(*tick_over(frame.data), False)])

    def sync(self, now_ns: int) -> None:
        """One SYNC (or cycle): advance, latch, sample, answer."""
        if not self._cells[STARTED]:
            self._cells[STARTED] = self._pacing == "sync"
            self._cells[LAST_NS] = now_ns
        elif self._clock == "lockstep":
            self._advance(self._period_ns)
        else:
            self._advance_to(now_ns)
        kernels = self._kernels
        kernels.sync()
        self._after_sampling()
        self._frames.feedback = self._cycles % self._every == 0
        self._cycles += 1
        self._send(self._frames.answer(kernels.sampled()))

    def _after_sampling(self) -> None:
        """What becomes of the sample before it is sent."""
        if self._faults is not None:
            self._faults.after(self._kernels.state, self._kernels.sample)

    def _send(self, frames: Sequence[Sent]) -> None:
        """A drive does not stop for a bus that is down; its watchdog does."""
        for can_id, data, fd in frames:
            try:
                self._link.send(can_id, data, fd)
            except LinkError:
                self.ignored["send"] += 1

    def summary(self) -> str:
        """State at the end and what was ignored; a second line for the black box."""
        state = State(int(self.state["state"])).name
        ignored = ", ".join(f"{count} {name}" for name, count in sorted(self.ignored.items())) or "none"
        error = int(self.state["error"])
        box = f"\n{BLACK_BOX}{json.dumps(self._faults.box.as_dict(self.state))}" if self._faults else ""
        return f"emulator stopped: state {state}, error 0x{error:04X}, ignored frames: {ignored}{box}"
