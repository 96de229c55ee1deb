"""The controller over the frames of a recording: a run's own client of the bus, fed from a tape."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable
from typing import Final

from drivers.binding import Binding
from drivers.bus import Frame
from drivers.client import DriveClient
from drivers.mapping import MEASURED
from drivers.watch import CommandWatch
from hil.app import Setup
from hil.convert.periods import MOST_NS, Grid, Heard, Period, Roles
from hil.convert.recordings import ID_MASK
from hil.errors import HilError
from hil.loop import ENDED
from hil.shadow import ShadowDrive
from hil.signals import Request, RxFlag, new_ticks

FAR_NS: Final = 2**62
"""A deadline that does not come: a wait ends with feedback or with the period's frames."""


class NotOursError(HilError):
    """The recorded commands are not what this controller gives."""


class Tape:
    """A link whose frames are laid on it; what is sent is kept."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self._queue: deque[Heard] = deque()

    def lay(self, frames: Iterable[Heard]) -> None:
        """Frames to be received next."""
        self._queue.extend(frames)

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Keep a frame."""
        self.sent.append((can_id, data))

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None when there is none."""
        if not self._queue:
            return None
        _, can_id, _, fd, data = self._queue.popleft()
        return Frame(can_id & ID_MASK, data, can_id & ~ID_MASK, fd)

    def discard(self) -> int:
        """Throw away what was not read."""
        count = len(self._queue)
        self._queue.clear()
        return count

    def close(self) -> None:
        """Nothing is open."""


def roles_of(binding: Binding) -> Roles:
    """The identifiers of a binding by their parts."""
    measuring = (b.message.send_id for b in binding.incoming if {part for part, _ in b.parts} & set(MEASURED))
    commands = {bound.message.send_id for bound in binding.outgoing}
    return Roles(binding.sync.send_id if binding.sync else None, frozenset(measuring), commands)


class Run:
    """The controller over a recording's periods; one tick record is filled anew for each."""

    def __init__(self, setup: Setup) -> None:
        self._setup, self.tape = setup, Tape()
        config = setup.config
        self.shadow, self.roles = config.loop.shadow, roles_of(setup.binding)
        load = config.controller.kind == "fac"
        self._client = DriveClient(
            self.tape, setup.database, load=load, drive_map=setup.binding.map, now=lambda: 0
        )
        self._watch = CommandWatch(setup.binding) if self.shadow else None
        self._drive = ShadowDrive(self._client, self._watch.applied) if self._watch else self._client
        self._machine, self.ticks = setup.machine.fresh(), new_ticks()
        self._tick = self.ticks[0]  # one object for all: the client binds itself to it
        self._grid = Grid(config.loop.period_ns)
        self._asked = int(Request.ARM)
        self.fresh = self.skipped = 0

    def take(self, period: Period, ahead: list[int]) -> None:
        """Run the tick of a period; ``ahead``: stamps of those that follow. Raises NotOursError."""
        self._tick["rx_flags"] = 0
        if self.roles.sync is None:
            gap = self._newest(period)
        else:
            self.tape.lay(period.late)
            self._client.sync(self._tick)
            self.tape.lay(period.answers)
            self._drive.receive(self._tick, FAR_NS)
            gap = self._grid.gap(period.t_ns, ahead)
        self.fresh += bool(int(self._tick["rx_flags"]) & RxFlag.FRESH)
        gap = self._compute(period, gap)
        self.skipped += gap - 1
        self._stamp(period, gap)

    def _newest(self, period: Period) -> int:
        """Take measurements as the loop does that waits for them: the newest counts, others are skipped."""
        tick, heard = self._tick, 0
        self.tape.lay(period.answers)
        self._drive.receive(tick, FAR_NS)
        while int(tick["rx_flags"]) & RxFlag.FRESH:
            heard += 1
            tick["rx_flags"] = int(tick["rx_flags"]) & ~int(RxFlag.FRESH)
            self._drive.receive(tick, FAR_NS)
        if heard:
            tick["rx_flags"] = int(tick["rx_flags"]) | int(RxFlag.FRESH)
        return heard if heard and self._grid.k >= 0 else 1

    def _compute(self, period: Period, gap: int) -> int:
        """Run the controller; return the gap that the tick has."""
        if self._watch is None:
            return self._guess(period, gap)
        self._step(gap, int(Request.ARM))
        for frame in period.commands:
            if frame.can_id == self._setup.binding.command.message.send_id:
                self._watch.take(frame.data)
        return gap

    def _step(self, gap: int, request: int) -> None:
        self.ticks["gap"], self.ticks["request"] = gap, request
        self._machine.prepare(self.ticks)
        self._machine.step(self.ticks)

    def _guess(self, period: Period, expected: int) -> int:
        """Find the gap and the request under which this controller sends what was recorded."""
        states = (self._machine.safety_state, self._machine.law_state)
        before = [state.copy() for state in states]
        gaps = dict.fromkeys((expected, max(1, expected - 1), expected + 1))
        asked = [value for value in (Request.ARM, Request.STOP, Request.QUICK_STOP) if value >= self._asked]
        for gap, request in itertools.product(gaps, asked):
            for state, saved in zip(states, before, strict=True):
                state[:] = saved
            self._step(gap, int(request))
            if self._sends(period):
                self._asked = int(request)
                return gap
        raise NotOursError(f"at {period.t_ns * 1e-9:.6f} s this controller sends something else")

    def _sends(self, period: Period) -> bool:
        """Whether the tick's command is the recorded one; after the last come those that stop the drive."""
        sent = self.tape.sent
        sent.clear()
        if self._tick["send"]:
            self._client.send(self._tick)
        own, recorded = len(sent), [(frame.can_id, frame.data) for frame in period.commands]
        if recorded == sent or not self.over:
            return recorded == sent
        self._client.stop()
        stopping = [frame for frame in sent if frame[0] != self.roles.sync]
        return len(recorded) >= own and recorded == stopping[: len(recorded)]

    @property
    def over(self) -> bool:
        """True once this controller has ended its run; a shadow goes on to the recording's end."""
        tick = self._tick
        return not self.shadow and bool(tick["reason"] != 0 and int(tick["state"]) in ENDED)

    def _stamp(self, period: Period, gap: int) -> None:
        """The times of a tick, as far as the recording has them."""
        tick, deadline_ns = self._tick, self._grid.place(period.t_ns, gap)
        tick["k"], tick["t_ns"], tick["gap"], tick["skipped"] = self._grid.k, deadline_ns, gap, gap - 1
        lateness_ns = period.t_ns - deadline_ns
        since = {"received_ns": period.answered_ns, "computed_ns": period.sent_ns, "sent_ns": period.sent_ns}
        latest = tick["lateness_ns"] = max(-MOST_NS, min(lateness_ns, MOST_NS))
        for name, t_ns in since.items():
            latest = tick[name] = min(t_ns - deadline_ns, MOST_NS) if t_ns >= 0 else latest
