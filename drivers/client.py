"""The drive client: one drive on a link, seen as a port of the control loop.

Fills a tick record in place by field name, so it needs no knowledge of who owns the record. What arrives
damaged, repeated or of the wrong length is flagged and not applied; a bus that is down is flagged and
nothing is sent until the client is closed.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from drivers.binding import Binding, bind
from drivers.bus import Frame, Link, SocketLink, unpack_frame
from drivers.codec import Database, Message
from drivers.errors import LinkDown, LinkError, QueueFull
from drivers.fast import DATA_AT, Maker, RawFrame, RawOut, Take, key_of, size_of, taker
from drivers.frames import (
    BUS_DOWN,
    EMERGENCY,
    ERROR_FRAME,
    FOREIGN_COMMAND,
    FRESH,
    LENGTH_ERROR,
    SEND_FAILED,
    STATUS,
    Incoming,
    Outgoing,
)
from drivers.local import ERR_FLAG, pack_frame
from drivers.mapping import MEASURED, DriveMap, house_map
from drivers.record import Cell, TranslatedCell, cell_of
from drivers.states import ENABLE_OPERATION, FAULT_RESET, translator

BUS_OFF: Final = 0x40  # error classes of SocketCAN, linux/can/error.h
RESTARTED: Final = 0x100
STOP_REPEATS: Final = 5
STOP_PAUSE_S: Final = 0.002
DRAIN_MOST: Final = 256
DOWN: Final = "the bus was down; nothing more is sent"
OnFrame = Callable[[bool, int, int, bytes], None]
Handler = Callable[[bytes], int]
_SENT_FIELDS: Final = ("counter", "controlword", "u_q", "u_d", "T_L")


def ignore_frame(received: bool, t_ns: int, can_id: int, data: bytes) -> None:
    """Take no note of a frame."""


class DriveClient:
    """A drive on a link. ``now`` stamps frames; ``on_frame`` sees each frame sent or received.

    ``drive_map`` says which frame plays which part; without one the DBC is of the house protocol.
    """

    def __init__(
        self,
        link: Link,
        database: Database,
        *,
        load: bool = False,
        on_frame: OnFrame = ignore_frame,
        now: Callable[[], int] = time.monotonic_ns,
        drive_map: DriveMap | None = None,
    ) -> None:
        self._link, self._on_frame, self._now = link, on_frame, now
        self._quiet = on_frame is ignore_frame
        self.binding: Binding = bind(drive_map or house_map(database), database, load=load)
        self.seen: Counter[int] = Counter()
        self._sync_counter = self._last_sent = self._last_controlword = 0
        self._pending_flags = 0
        self._down = self._late = False
        self._tick: Any = None
        self._sent_cells: list[Cell] = []
        self._incoming = [Incoming(bound) for bound in self.binding.incoming]
        self._outgoing = [Outgoing(bound) for bound in self.binding.outgoing]
        self._needed = self._got = 0
        self._handlers: dict[int, Handler] = {}
        self._makers: list[Maker] = []
        self._raw: dict[bytes, RawFrame] = {}
        self._raw_out: list[RawOut] = []
        self._raw_syncs: list[tuple[int, bytes, bytes]] = []
        self._register()
        self._prepare_raw(link)

    def _register(self) -> None:
        """Fill the table of who handles which identifier."""
        binding = self.binding
        alive = [bound.message for bound in binding.incoming]
        for bound, incoming in zip(binding.incoming, self._incoming, strict=True):
            bit = self._bit(incoming)
            self._needed |= bit
            self._handlers[bound.message.send_id] = self._handler(incoming, bit)
        foreign = [bound.message for bound in binding.outgoing] + [binding.sync] * (binding.sync is not None)
        self._handlers |= {message.send_id: self._on_foreign for message in foreign if message}
        if binding.emergency:
            self._handlers[binding.emergency.send_id] = self._on_emergency
        if binding.heartbeat:
            alive.append(binding.heartbeat)
        self._alive = {message.send_id for message in alive}
        self._has_echo = bool(binding.map.echo)

    def _prepare_raw(self, link: Link) -> None:
        """Where the link has a socket, frames go past the plain way; :meth:`_bind` fills in the cells."""
        self._raw_link = link if isinstance(link, SocketLink) else None
        if self._raw_link is None:
            return
        pairs = zip(self.binding.incoming, self._incoming, strict=True)
        self._makers = [taker(bound, FRESH if self._bit(i) else self._mark(i)) for bound, i in pairs]
        sync = self.binding.sync
        if sync is not None and sync.length == 1 and not sync.fd:
            every = [bytes((count,)) for count in range(1, 241)]
            self._raw_syncs = [(sync.send_id, data, pack_frame(sync.send_id, data)) for data in every]
        if all(self._raw_link.carries(out.fd) for out in self._outgoing):
            both = zip(self.binding.outgoing, self._outgoing, strict=True)
            self._raw_out = [RawOut(bound, out) for bound, out in both]

    def _bit(self, incoming: Incoming) -> int:
        """The bit of a message that measures, 0 for others."""
        return 1 << self._incoming.index(incoming) if set(incoming.parts) & set(MEASURED) else 0

    def _mark(self, incoming: Incoming) -> int:
        """The flag that a message of slow values raises."""
        return STATUS if "v_dc" in incoming.parts else 0

    def _bind_raw(self) -> None:
        """Takers over the cells of the bound tick."""
        for bound, incoming, maker in zip(self.binding.incoming, self._incoming, self._makers, strict=False):
            take = self._raw_taker(incoming, maker(incoming, incoming.cells))
            message = bound.message
            known = RawFrame(take, size_of(bound), message.send_id, DATA_AT + message.length)
            self._raw[key_of(bound)] = known

    def _raw_taker(self, incoming: Incoming, take: Take) -> Take:
        """What takes a raw frame of one message, as :meth:`_handler` takes its data."""
        bit = self._bit(incoming)
        if not bit:
            return lambda raw, late: take(raw, False)
        if bit == self._needed and self._has_echo:
            return take
        return lambda raw, late: self._complete(take(raw, late), bit)

    def _complete(self, flags: int, bit: int) -> int:
        """Flags of a measuring message: fresh once all of this tick's have come."""
        if not flags & FRESH:
            return flags
        self._got |= bit
        if self._got != self._needed:
            return flags & ~FRESH
        self._got = 0
        if not self._has_echo:
            self._echo_cell[0] = self._last_sent
        return flags

    def _handler(self, incoming: Incoming, bit: int) -> Handler:
        """What takes one message: a measurement (``bit``), or slow values that are applied when they come."""
        mark = self._mark(incoming)

        def measure(data: bytes) -> int:
            return self._complete(incoming.take(data, self._late), bit)

        def status(data: bytes) -> int:
            flags = incoming.take(data)
            return flags ^ FRESH | mark if flags & FRESH else flags

        return measure if bit else status

    def _bind(self, tick: Any) -> None:
        """Reach the fields of this tick record; the loop hands in the same one each time."""
        translate = translator(self.binding.map.states, lambda: self._last_controlword)
        for incoming in self._incoming:
            incoming.cells = [cell_of(tick, name) for name in incoming.fields]
            if translate is not None and "state" in incoming.parts:
                place = incoming.parts.index("state")
                incoming.cells[place] = TranslatedCell(incoming.cells[place], translate)
        self._flags_cell, self._echo_cell = cell_of(tick, "rx_flags"), cell_of(tick, "echo")
        self._error_cell = cell_of(tick, "drive_error")
        self._sent_cells = [cell_of(tick, name) for name in _SENT_FIELDS]
        self._tick = tick
        self._bind_raw()

    @property
    def command(self) -> Message:
        """The command's message."""
        return self.binding.command.message

    def sync(self, tick: Any) -> None:
        """Send SYNC with its counter 1..240, after what came since the last tick was taken as late."""
        self._got = 0
        if self._has_come(tick):
            self._take_late(tick)
        self._send_sync()

    def _has_come(self, tick: Any) -> bool:
        """True when there is something to take or to flag before the next SYNC."""
        if self._raw_link is None or self._pending_flags or self._down or tick is not self._tick:
            return True
        return self._raw_link.pending()

    def _take_late(self, tick: Any) -> None:
        self._late = True
        try:
            self.receive(tick, 0)
        finally:
            self._late = False
            self._got = 0

    def _send_sync(self) -> None:
        sync = self.binding.sync
        if sync is None:
            return
        self._sync_counter = self._sync_counter % 240 + 1
        if self._raw_syncs:
            self._send_raw(*self._raw_syncs[self._sync_counter - 1])
            return
        self._send(sync.send_id, bytes((self._sync_counter,)) if sync.length else b"", False)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until feedback came or the deadline passed; 0 drains what is there (newest wins).

        What is queued when the deadline has passed is still taken, up to a bound that a flood can't exceed.
        """
        if tick is not self._tick:
            self._bind(tick)
        flags, self._pending_flags = self._pending_flags, 0
        try:
            flags |= self._drain(deadline_ns)
        except LinkDown:
            self._down = True
        except LinkError:
            flags |= ERROR_FRAME
        self._flags_cell[0] = int(self._flags_cell[0]) | flags | (BUS_DOWN if self._down else 0)

    def _drain(self, deadline_ns: int) -> int:
        """Flags of all that came; on a socket frames are taken whole, without being taken apart first."""
        raw = self._raw_link
        receive: Callable[[int], Any] = self._link.receive if raw is None else raw.receive_raw
        take: Callable[[Any], int] = self._take if raw is None else self._take_raw
        flags, left, more = 0, 0, DRAIN_MOST
        while more:
            if deadline_ns and (left := deadline_ns - time.monotonic_ns()) < 0:
                left = 0
            more -= left == 0
            frame = receive(left)
            if frame is None:
                break
            flags |= take(frame)
            if deadline_ns and flags & FRESH:
                break
        return flags

    def _take_raw(self, raw: bytes) -> int:
        """Handle one frame as it came from the socket; return its flags."""
        known = self._raw.get(raw[:5])
        if known is None or len(raw) != known.size:
            return self._take_unknown(raw)
        if not self._quiet:
            self._on_frame(True, self._now(), known.send_id, raw[DATA_AT : known.end])
        return known.take(raw, self._late)

    def _take_unknown(self, raw: bytes) -> int:
        """Flags of what is no frame of ours, or none at all."""
        frame = unpack_frame(raw)
        return 0 if frame is None else self._take(frame)

    def _take(self, frame: Frame) -> int:
        """Handle one frame; return its flags. Remote and error frames match no identifier."""
        can_id, data, frame_flags, _ = frame
        if not self._quiet:
            self._on_frame(True, self._now(), can_id | frame_flags, data)
        handler = self._handlers.get(can_id | frame_flags)
        if handler is not None:
            return handler(data)
        return self._on_error(can_id) if frame_flags & ERR_FLAG else 0

    def _on_error(self, error_class: int) -> int:
        """A controller that went off the bus, or came back to it, is down for good: nothing more is sent."""
        if error_class & (BUS_OFF | RESTARTED):
            self._down = True
        return ERROR_FRAME

    def _on_emergency(self, data: bytes) -> int:
        """CiA 301: error code first; code 0 says that an error is gone."""
        if len(data) != 8:
            return LENGTH_ERROR
        code = data[0] | data[1] << 8
        self._error_cell[0] = code
        return EMERGENCY if code else 0

    def _on_foreign(self, data: bytes) -> int:
        return FOREIGN_COMMAND

    def warm_up(self, tick: Any) -> None:
        """Bind and encode once without sending, so that the first tick is like the others."""
        self._bind(tick)
        for out in self._outgoing:
            out.encode(0, (0, 0.0, 0.0, 0.0, False, False, 1))

    def send(self, tick: Any) -> None:
        """Send the tick's command. Raises EncodeError or LinkError; a queue that is full is flagged."""
        if tick is not self._tick:
            self._bind(tick)
        counter, controlword, u_q, u_d, T_L = self._sent_cells
        self._send_command(int(counter[0]), int(controlword[0]), float(u_q[0]), float(u_d[0]), float(T_L[0]))

    def _send_command(self, counter: int, controlword: int, u_q: float, u_d: float, T_L: float) -> None:
        """Encode all frames before the first is sent, then send them, the one with u_q last."""
        enable = controlword == ENABLE_OPERATION
        reset = controlword & FAULT_RESET != 0
        values = (controlword, u_q, u_d, T_L, enable, reset, 1)
        if self._raw_out:
            encoded = [(out, out.encode(counter, values)) for out in self._raw_out]
            for out, data in encoded:
                self._send_raw(out.send_id, data, out.head + data + out.tail)
        else:
            frames = [(out.send_id, out.encode(counter, values), out.fd) for out in self._outgoing]
            for can_id, data, fd in frames:
                self._send(can_id, data, fd)
        self._last_sent, self._last_controlword = counter, controlword

    def _send_raw(self, can_id: int, data: bytes, raw: bytes) -> None:
        assert self._raw_link is not None  # noqa: S101 - there is no raw frame without it
        if self._down:
            raise LinkDown(100, DOWN)
        try:
            self._raw_link.send_raw(raw)
        except LinkError as error:
            self._note_failure(error)
            raise
        if not self._quiet:
            self._on_frame(False, self._now(), can_id, data)

    def _note_failure(self, error: LinkError) -> None:
        """A bus that is down stays down; anything else is flagged in the next tick."""
        if isinstance(error, LinkDown):
            self._down = True
        else:
            self._pending_flags |= SEND_FAILED

    def _send(self, can_id: int, data: bytes, fd: bool) -> None:
        if self._down:
            raise LinkDown(100, DOWN)
        try:
            self._link.send(can_id, data, fd)
        except LinkError as error:
            self._note_failure(error)
            raise
        if not self._quiet:
            self._on_frame(False, self._now(), can_id, data)

    def stop_from(self, counter: int) -> None:
        """:meth:`stop` with counters after ``counter``: for another process than the one that sent."""
        self._last_sent = counter
        self.stop()

    def stop(self) -> None:
        """Zero voltage and disable, a few times with advancing counters and SYNC; never raises."""
        counter = self._last_sent
        for _ in range(STOP_REPEATS):
            counter = (counter + 1) % self.binding.counter_modulus
            try:
                self._send_command(counter, 0, 0.0, 0.0, 0.0)
                self._send_sync()
            except QueueFull:
                time.sleep(STOP_PAUSE_S)
            except LinkError:
                return

    def listen(self, seconds: float) -> Counter[int]:
        """Only listen; return how often each identifier was seen. Sends nothing."""
        end = time.monotonic_ns() + round(seconds * 1e9)
        self.seen.clear()
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None:
                self.seen[frame.can_id] += 1
        return self.seen

    def wait_for_drive(self, timeout_s: float) -> bool:
        """Wait for the drive's heartbeat or feedback; sends nothing."""
        end = time.monotonic_ns() + round(timeout_s * 1e9)
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None and frame.can_id | frame.flags in self._alive:
                return True
        return False

    def discard(self) -> None:
        """Throw away what was received before the run."""
        self._link.discard()

    def close(self) -> None:
        """Close the link."""
        self._link.close()
