"""The controller over the frames of a recording: a run's own client of the bus, fed from a tape."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from drivers.binding import Binding
from drivers.bus import Frame
from drivers.drive import drive_kind
from drivers.mapping import MEASURED
from drivers.port import Saved
from hil.exchange.periods import MOST_NS, Grid, Heard, Period, Roles, around
from hil.exchange.readers.recorded import ID_MASK
from hil.runtime.loop import ENDED
from hil.runtime.rules import COUNTER_JUMP, missed
from hil.runtime.setup import Setup
from hil.runtime.shadow import ShadowDrive
from hil.signals import ALL_MISSING, Request, RxFlag, new_ticks

FAR_NS: Final = 2**62
"""A deadline that does not come: a wait ends with feedback or with the period's frames."""


READINGS_MOST: Final = 64
UNLIKELY_GAPS: Final = 6
"""Gaps that are tried with a reading that is not the likely one."""
STOPS: Final = (Request.RAMP_DOWN, Request.STOP, Request.QUICK_STOP)


class Reading(NamedTuple):
    """Which of the frames that came since the last read were read before SYNC, and which by the command."""

    sync: int
    end: int
    likely: bool = False


class Tape:
    """A link whose frames are laid on it; what is sent is kept."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self._queue: deque[Heard] = deque()

    def lay(self, frames: Iterable[Heard]) -> None:
        """Frames to be received next."""
        self._queue.extend(frames)

    def saved(self) -> tuple[Heard, ...]:
        """What was not read yet."""
        return tuple(self._queue)

    def restore(self, saved: tuple[Heard, ...]) -> None:
        """Have that to be received, and nothing else."""
        self._queue = deque(saved)

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
    slow = frozenset(bound.message.send_id for bound in binding.slow)
    return Roles(binding.sync.send_id if binding.sync else None, frozenset(measuring), commands, slow)


class Before(NamedTuple):
    """All that a tick changes, as it was before it; records as bytes, ten times as fast as by fields."""

    records: list[bytes]
    client: Saved
    queue: tuple[Heard, ...]
    left: list[Heard]
    grid: tuple[int, int, int, int]
    arrived_ns: int
    reply_ns: int
    asked: int


class Run:
    """The controller over a recording's periods; one tick record is filled anew for each."""

    def __init__(self, setup: Setup) -> None:
        self._setup, self.tape = setup, Tape()
        config = setup.config
        self.shadow, self.roles = config.loop.shadow, roles_of(setup.binding)
        load = config.commands_load
        self._client = drive_kind(config.drive.kind).open(
            self.tape, setup.database, load=load, drive_map=setup.binding.map, now=lambda: 0
        )
        self._drive = ShadowDrive(self._client, self._client.overhear()) if self.shadow else self._client
        self._machine, self.ticks = setup.machine.fresh(), new_ticks()
        machine = self._machine
        records = machine.safety_state, machine.law_state, machine.setpoint_state, self.ticks
        self._records = [record.view(np.uint8) for record in records]
        self._tick = self.ticks[0]  # one object for all: the client binds itself to it
        self._drive.prepare(self._tick)
        self.period_ns = config.loop.period_ns
        self._grid = Grid(self.period_ns)
        self._left: list[Heard] = []
        self._read_ns = self._arrived_ns = self._reply_ns = 0
        self._asked = int(Request.ARM)
        self.tries = 0

    def before(self) -> Before:
        """What :meth:`restore` takes to go back to now."""
        return Before(
            [record.tobytes() for record in self._records],
            self._client.saved(),
            self.tape.saved(),
            self._left,
            self._grid.saved(),
            self._arrived_ns,
            self._reply_ns,
            self._asked,
        )

    def restore(self, before: Before) -> None:
        """Go back to before a tick."""
        for record, saved in zip(self._records, before.records, strict=True):
            record[:] = np.frombuffer(saved, np.uint8)
        self._client.restore(before.client)
        self.tape.restore(before.queue)
        self._grid.restore(before.grid)
        self._left, self._asked = before.left, before.asked
        self._arrived_ns, self._reply_ns = before.arrived_ns, before.reply_ns

    def take(self, before: Before, period: Period, ahead: list[int]) -> Iterator[None]:
        """Run the tick of a period once for each way in which this controller sends what was recorded.

        The likeliest first. ``before``: where it begins, and where it must stand when the first is asked for;
        ``ahead``: stamps of the periods that follow.
        """
        for reading in self._readings(period):
            gaps = self._read(reading, period, ahead)
            for gap, request in self._ways(gaps, reading):
                self.tries += 1
                self._step(period, gap, request)
                if self._sends(period):
                    self._asked = request
                    self._stamp(period, gap)
                    yield
                self.restore(before)
                self._read(reading, period, ahead)
            self.restore(before)

    def _readings(self, period: Period) -> Iterator[Reading]:
        """What the loop may have read: all; or less, since it was held up between reading and sending.

        What came meanwhile is on the wire before what was sent, but read after it: before the command, the
        next tick reads it; before SYNC, it is no late answer but this tick's.
        """
        frames = [*self._left, *period.late, *period.answers, *period.after]
        end = len(frames) - len(period.after)
        sync = 0 if self.roles.sync is None else end - len(period.answers)
        yield Reading(sync, end, likely=True)
        if self.shadow or not period.commands:
            return
        if any(frame.can_id in self.roles.slow for frame in period.after):
            yield Reading(sync, len(frames))
        for at in self._ends(frames[:end]):
            yield Reading(sync, at) if at >= sync else Reading(at, end)

    def _ends(self, frames: list[Heard]) -> list[int]:
        """Where the loop may have stopped reading: before the newest measurement first.

        A drive sends its status in one go with the measurement that follows, so that most likely both were
        read or none.
        """
        measured, ends = 0, []
        for at, frame in enumerate(frames):
            if frame.can_id in self.roles.measuring | self.roles.slow:
                ends.append((measured, at))
            measured -= frame.can_id in self.roles.measuring
        return [at for _, at in sorted(ends)[:READINGS_MOST]]

    def _ways(self, gaps: list[int], reading: Reading) -> Iterator[tuple[int, int]]:
        """Gap and request, the likeliest first: a stop that is asked for shows whatever the gap."""
        if self.shadow:
            yield gaps[0], int(Request.ARM)
            return
        yield gaps[0], self._asked
        if reading.likely:
            yield from ((gaps[0], int(asked)) for asked in STOPS if asked > self._asked)
        for gap in gaps[1:] if reading.likely else gaps[1:UNLIKELY_GAPS]:
            yield gap, self._asked

    def _read(self, reading: Reading, period: Period, ahead: list[int]) -> list[int]:
        """Read what the loop has read; return the gaps that the tick may have, the likeliest first."""
        self._tick["rx_flags"], self._tick["missing"] = 0, ALL_MISSING
        frames = [*self._left, *period.late, *period.answers, *period.after]
        late, read, self._left = (
            frames[: reading.sync],
            frames[reading.sync : reading.end],
            frames[reading.end :],
        )
        measured = (frame.t_ns for frame in reversed(read) if frame.can_id in self.roles.measuring)
        self._read_ns = next(measured, -1)
        if self.roles.sync is None:
            self.tape.lay(read)
            return self._newest(period)
        self.tape.lay(late)
        self._client.sync(self._tick)
        self.tape.lay(read)
        self._drive.receive(self._tick, FAR_NS)
        return self._grid.gaps(period.t_ns, ahead, self._arrived_ns)

    def _newest(self, period: Period) -> list[int]:
        """Take measurements as the loop does that waits for them: the newest counts, others are skipped.

        When the loop had read is known where it took a measurement; else it was as late before the command as
        it was last time.
        """
        tick, heard = self._tick, 0
        self._drive.receive(tick, FAR_NS)
        while int(tick["rx_flags"]) & RxFlag.FRESH:
            heard += 1
            tick["rx_flags"] = int(tick["rx_flags"]) & ~int(RxFlag.FRESH)
            self._drive.receive(tick, FAR_NS)
        if heard:
            tick["rx_flags"] = int(tick["rx_flags"]) | int(RxFlag.FRESH)
        if self._grid.k < 0:
            return [1]
        jumped = int(tick["rx_flags"]) & COUNTER_JUMP
        if heard and not jumped and self._setup.config.loop.pacing == "feedback":
            return [heard]
        due_ns = self._arrived_ns + self.period_ns
        least_ns = max(self._read_ns, due_ns if heard else due_ns + self.period_ns // 2)
        most_ns = max(period.sent_ns, least_ns)
        likely_ns = least_ns if heard else max(most_ns - self._reply_ns, least_ns)
        likely, least, most = (
            1 + missed(heard, jumped, now_ns - due_ns, self.period_ns)
            for now_ns in (likely_ns, least_ns, most_ns)
        )
        return around(likely, least, most)

    def _step(self, period: Period, gap: int, request: int) -> None:
        orderly = request == Request.RAMP_DOWN
        self.ticks["gap"], self.ticks["request"] = gap, int(Request.STOP if orderly else Request.ARM)
        self._machine.prepare(self.ticks)
        if not orderly:
            self.ticks["request"] = request
        self._machine.step(self.ticks)
        if self.shadow:  # it hears what answers this tick before the next one's feedback
            self._left = [*period.commands, *self._left]

    def _sends(self, period: Period) -> bool:
        """Whether the tick's command is the recorded one; after the last come those that stop the drive."""
        if self.shadow:
            return True
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
        self._note_arrival(period, gap)
        tick, deadline_ns = self._tick, self._grid.place(period.t_ns, gap)
        tick["k"], tick["t_ns"], tick["gap"], tick["skipped"] = self._grid.k, deadline_ns, gap, gap - 1
        lateness_ns = period.t_ns - deadline_ns
        since = {"received_ns": period.answered_ns, "computed_ns": period.sent_ns, "sent_ns": period.sent_ns}
        latest = tick["lateness_ns"] = max(-MOST_NS, min(lateness_ns, MOST_NS))
        for name, t_ns in since.items():
            latest = tick[name] = min(t_ns - deadline_ns, MOST_NS) if t_ns >= 0 else latest

    def _note_arrival(self, period: Period, gap: int) -> None:
        """From when the next tick counts: with SYNC the last frame of this one, else as the loop does."""
        fresh = bool(int(self._tick["rx_flags"]) & RxFlag.FRESH)
        if self.roles.sync is not None:
            self._arrived_ns = max(period.t_ns, period.answered_ns, period.sent_ns)
        elif fresh or self._grid.k < 0:
            self._arrived_ns = self._read_ns if self._read_ns >= 0 else period.t_ns
            self._reply_ns = min(max(period.sent_ns - self._arrived_ns, 0), self.period_ns // 4)
        else:
            self._arrived_ns += gap * self.period_ns
