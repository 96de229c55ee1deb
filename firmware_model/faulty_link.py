"""Faults between the emulated drive and its bus: frames lost, late, twice, out of order, damaged.

A link around a link. In lockstep it also says when a tick is over (:mod:`drivers.lockstep`), so that a
controller whose feedback was lost does not wait, and lets the plant's time pass when a SYNC is lost.
"""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable, Sequence

from drivers.bus import Frame, Link, SocketLink
from drivers.codec import Database, Message
from drivers.local import ERR_FLAG, pack_frame
from drivers.lockstep import tick_over
from firmware_model.faults import (
    BrownOut,
    BusOff,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Fault,
    FrameFault,
    FrozenCounter,
    Reorder,
)

BUS_OFF_ERROR = 0x40 | ERR_FLAG
"""SocketCAN's error class CAN_ERR_BUSOFF."""


def nothing() -> None:
    """Do nothing."""


class Injector:
    """One frame fault at work: its random numbers, what it holds back, how many frames it changed."""

    def __init__(self, fault: FrameFault, message: Message) -> None:
        self.fault, self.message = fault, message
        self.acted = 0
        self._random = random.Random(fault.seed)
        self._held: Frame | None = None
        self._counter: float | None = None

    def apply(self, frame: Frame, t_ns: int) -> list[tuple[int, Frame]]:
        """What becomes of a frame: (due [ns of plant time], frame) in order."""
        frames = self._apply(frame, t_ns)
        self.acted += frames != [(t_ns, frame)]
        return frames

    def _apply(self, frame: Frame, t_ns: int) -> list[tuple[int, Frame]]:
        fault = self.fault
        if frame.can_id | frame.flags != self.message.send_id:
            return [(t_ns, frame)]
        held, self._held = self._held, None
        late = [(t_ns, held)] if held else []
        if not fault.active(t_ns) or self._random.random() >= fault.share:
            return [(t_ns, frame), *late]
        if isinstance(fault, Drop):
            return late
        if isinstance(fault, Delay):
            return [(t_ns + round(fault.delay_ms * 1e6), frame)]
        if isinstance(fault, Duplicate):
            return [(t_ns, frame), (t_ns, frame)]
        if isinstance(fault, Reorder) and held is None:
            self._held = frame
            return []
        if isinstance(fault, Corrupt):
            return [(t_ns, self._flipped(frame, fault.bits))]
        if isinstance(fault, FrozenCounter):
            return [(t_ns, self._with_frozen_counter(frame))]
        return [(t_ns, frame), *late]

    def _flipped(self, frame: Frame, bits: int) -> Frame:
        size = 8 * len(frame.data)
        value = int.from_bytes(frame.data, "little")
        for bit in self._random.sample(range(size), min(bits, size)):
            value ^= 1 << bit
        return frame._replace(data=value.to_bytes(len(frame.data), "little"))

    def _with_frozen_counter(self, frame: Frame) -> Frame:
        values = self.message.decode(frame.data)
        self._counter = values["Counter"] if self._counter is None else self._counter
        return frame._replace(data=self.message.encode({**values, "Counter": self._counter}))


class FaultyLink:
    """A link that does to frames what a script says. ``now_ns`` is plant time.

    ``acted`` counts by the fault's place in the script what each of them did. ``sync_id``: what moves the
    drive on where the DBC has no SYNC.
    """

    def __init__(
        self,
        link: Link,
        database: Database,
        faults: Sequence[Fault],
        *,
        lockstep: bool,
        now_ns: Callable[[], int] = lambda: 0,
        lost_sync: Callable[[], None] = nothing,
        acted: Counter[int] | None = None,
        sync_id: int | None = None,
    ) -> None:
        self._link, self._lockstep = link, lockstep
        self.now_ns, self.lost_sync = now_ns, lost_sync
        sync = database.optional("SYNC")
        self._sync_id = sync.send_id if sync else sync_id
        self._acted = Counter[int]() if acted is None else acted
        self._silent = [
            (place, fault) for place, fault in enumerate(faults) if isinstance(fault, (BusOff, BrownOut))
        ]
        self._injectors = [
            (place, Injector(fault, database.message(fault.message)))
            for place, fault in enumerate(faults)
            if isinstance(fault, FrameFault)
        ]
        self._outgoing: list[tuple[int, Frame]] = []
        self._incoming: list[tuple[int, Frame]] = []
        self._ready: deque[Frame] = deque()
        self._over: bytes | None = None
        self._said_bus_off = False

    def _through(self, frame: Frame) -> list[tuple[int, Frame]]:
        """A frame after all faults, with its due times."""
        frames = [(self.now_ns(), frame)]
        for place, injector in self._injectors:
            frames = [after for due, one in frames for after in injector.apply(one, due)]
            self._acted[place] = injector.acted
        return frames

    def _cut(self) -> bool:
        """True while nothing passes; the beginning of a bus-off is told by an error frame."""
        silent = [(place, fault) for place, fault in self._silent if fault.active(self.now_ns())]
        self._acted.update(place for place, _ in silent)
        if any(isinstance(fault, BusOff) for _, fault in silent) and not self._said_bus_off:
            self._said_bus_off = True
            if isinstance(self._link, SocketLink):  # laid out here: a link's send takes data frames alone
                self._link.send_raw(memoryview(pack_frame(BUS_OFF_ERROR, bytes(8))))
        return bool(silent)

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """A frame of the drive."""
        if self._cut():
            return
        self._release()
        self._outgoing += self._through(Frame(can_id, data, 0, fd))
        self._release()

    def _release(self) -> None:
        """Send what is due, in order."""
        for frame in take_due(self._outgoing, self.now_ns()):
            self._link.send(frame.can_id, frame.data, frame.fd)

    def receive(self, timeout_ns: int) -> Frame | None:
        """The next frame that reaches the drive."""
        self._end_tick()
        if not self._cut():
            self._release()
        self._ready += take_due(self._incoming, self.now_ns())
        if self._ready:
            return self._ready.popleft()
        frame = self._link.receive(timeout_ns)
        return None if frame is None else self._arrived(frame)

    def _end_tick(self) -> None:
        """Lockstep: all that the drive answers to the last SYNC is out."""
        if self._over is not None:
            self._link.send(*tick_over(self._over))
            self._over = None

    def _arrived(self, frame: Frame) -> Frame | None:
        sync = frame.can_id | frame.flags == self._sync_id
        if sync and self._lockstep:
            self._over = frame.data
        cut = self._cut()
        self._incoming += [] if cut else self._through(frame)
        self._ready += take_due(self._incoming, self.now_ns())
        if sync and not any(one.can_id == frame.can_id for one in self._ready):
            self.lost_sync()
        return self._ready.popleft() if self._ready else None

    def discard(self) -> int:
        """Throw away what is queued."""
        return self._link.discard()

    def close(self) -> None:
        """Close the link."""
        self._link.close()


def take_due(queue: list[tuple[int, Frame]], now_ns: int) -> list[Frame]:
    """Take the frames that are due out of a queue; they come in the order of their due times."""
    due = sorted((entry for entry in queue if entry[0] <= now_ns), key=lambda entry: entry[0])
    queue[:] = [entry for entry in queue if entry[0] > now_ns]
    return [frame for _, frame in due]
