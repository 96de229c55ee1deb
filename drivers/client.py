"""The drive client: one drive on a link, seen as a port of the control loop.

Fills a tick record in place, its fields found by name, so it needs no knowledge of who owns the record. What
arrives damaged, repeated or of the wrong length is flagged and not applied; a bus that is down is flagged and
nothing is sent until the client is closed.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NoReturn

import numpy as np

from drivers.bcm import KernelSync, all_but
from drivers.binding import Binding, bind
from drivers.bus import RECEIVE_BYTES, Frame, Link, SocketLink, raise_link_error, unpack_frame
from drivers.codec import Database, Message
from drivers.drive import Drive, DriveKind, OnFrames, Opens
from drivers.errors import EncodeError, LinkDown, LinkError
from drivers.frames import (
    BUS_DOWN,
    EMERGENCY,
    ENABLE_OPERATION,
    ERROR_FRAME,
    FOREIGN_COMMAND,
    FRESH,
    LENGTH_ERROR,
    PLACES,
    SEND_FAILED,
    SENT_FIELDS,
)
from drivers.jit import COMPILED, entry
from drivers.local import ERR_FLAG
from drivers.mapping import RECEIVED, DriveMap, house_map
from drivers.oneshot import Expected, NoAnswer, Shot
from drivers.port import Compiled, Saved, SocketPort
from drivers.posix import (
    COMMANDED,
    DRAIN_MOST,
    EXCHANGED,
    FLAGS,
    LATE,
    PENDING,
    REFUSED_COMMAND,
    SEEN,
    SIZE,
    SYNC_COUNTS,
    UNSENT,
    command,
    drain,
    exchange,
    rest,
)
from drivers.rawlink import raw_link
from drivers.record import bytes_of, cell_of
from drivers.states import ENABLED, FAULT_RESET, codes_of, of_controlword, translator
from drivers.stops import STOP_PAUSE_S, Outgoing, try_all
from drivers.tables import command_values, incoming_tables, outgoing_tables, sent_offsets
from drivers.wire import DATA_AT, FD_BYTES, FRAME, ROOM, STATE, STATE_RAW, encode_command, note_sent, take

BUS_OFF: Final = 0x40  # error classes of SocketCAN, linux/can/error.h
RESTARTED: Final = 0x100
STOP_REPEATS: Final = 5
START: Final = 0x01
PRE_OPERATIONAL: Final = 0x80
"""NMT commands of CiA 301."""
DOWN: Final = "the bus was down; nothing more is sent"
_GOT, _NEEDED, _ECHO_AT, _LOGGED, _LAST_SENT, _CONTROLWORD, _SYNCS, _PENDING, _DOWN = range(9)
_MISSING_AT: Final = (STATE.names or ()).index("missing_at")
MAX_NS: Final = 2**63 - 1
ASK_EVERY_NS: Final = 500_000_000
"""How long an answer is waited for before a drive is asked again; in lockstep each request is a period."""
FLUSH_AT: Final = 64
"""Frames that are handed on together: one tick has about four."""


def _offset(tick: Any, name: str) -> int:
    """Where a field of a record is."""
    at: int = tick.dtype.fields[name][1]
    return at


def precompile(
    database: Database, drive_map: DriveMap | None, load: bool, tick: Any, opens: Opens | None = None
) -> None:
    """Compile every kernel of a client, or load it, on sockets that lead nowhere."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ends[0], ends[1]:
        link = SocketLink(None, *ends)
        (opens or DriveClient)(link, database, load=load, drive_map=drive_map).prepare(tick)


class DriveClient:
    """A drive on a link. ``now`` stamps frames; ``on_frames`` sees each frame sent or received.

    ``drive_map`` says which frame plays which part; without one the DBC is of the house protocol. ``timed``
    sends SYNC for it; it is stopped with the client's own stop, and once the bus was down.
    """

    def __init__(
        self,
        link: Link,
        database: Database,
        *,
        load: bool = False,
        on_frames: OnFrames | None = None,
        now: Callable[[], int] = time.monotonic_ns,
        drive_map: DriveMap | None = None,
        timed: KernelSync | None = None,
    ) -> None:
        self._timed = timed
        self._link, self._on_frames, self._now = link, on_frames, now
        self.binding: Binding = bind(drive_map or house_map(database), database, load=load)
        self._raw_link = raw_link(link, any(bound.message.fd for bound in self.binding.outgoing))
        self.seen: Counter[int] = Counter()
        self._late = False
        self._tick: Any = None
        foreign = [bound.message for bound in self.binding.outgoing]
        self._foreign = {m.send_id for m in [*foreign, self.binding.sync] if m is not None}
        alive = [bound.message for bound in self.binding.incoming]
        self._alive = {m.send_id for m in [*alive, self.binding.heartbeat] if m is not None}
        self._make_buffers()
        self._make_senders()

    def _make_buffers(self) -> None:
        """The frame that came, the log of frames, and the state that the kernels share."""
        self._buffer = np.zeros(RECEIVE_BYTES, np.uint8)
        self._buffer_view = self._buffer.data
        self._words = np.zeros(2, np.uint32)
        self._log = np.zeros(ROOM if self._on_frames else 0, FRAME)
        self._log_bytes = self._log.view("u1").data if self._on_frames else memoryview(b"")
        self._state = np.zeros(1, STATE)
        self._cells: Any = self._state.view("i8").data
        self._last = np.full(max(len(self.binding.incoming), 1), -1, np.int64)
        link, real = self._raw_link, self._now is time.monotonic_ns
        shared = {"state": self._state, "words": self._words, "log": self._log}
        if self._timed is not None:
            shared["ear"] = self._timed.words
        self._port = SocketPort(link, shared) if COMPILED and real and isinstance(link, SocketLink) else None
        self._drain_socket: Callable[[int, bool], int] | None = None
        self._exchange: Callable[[int], int] | None = None
        self._command: Callable[[], int] | None = None

    def _make_senders(self) -> None:
        """What lays out and sends each command and SYNC."""
        messages, signals = outgoing_tables(self.binding)
        values = command_values()
        self._values: Any = values.data
        self._commanding = {"values": values, "messages": messages, "signals": signals}
        self._outgoing = [Outgoing(bound.message, i) for i, bound in enumerate(self.binding.outgoing)]
        self._raws = np.concatenate([out.raw for out in self._outgoing])
        for out, raw in zip(self._outgoing, np.split(self._raws, len(self._outgoing)), strict=True):
            out.lay(raw)
            args = (out.raw, values, out.index, messages, signals, self._state, self._words, self._log)
            out.encode = partial(entry(encode_command, *args, 0), *args)
            noting = (self._log, self._state, out.raw)
            out.note = partial(entry(note_sent, *noting, 0), *noting)
        on_change = self.binding.map.on_change
        self._seldom = np.array([out.message.name in on_change for out in self._outgoing], np.uint8)
        self._held = np.zeros_like(self._raws)
        """What was sent last of each message."""
        self._stops = [self._stop_frames(out) for out in self._outgoing]
        self._polls = self.binding.map.poll != ""
        self._sync = self._opening()
        self._started, self._left = (self._nmt_frame(command) for command in (START, PRE_OPERATIONAL))

    def _opening(self) -> Outgoing | None:
        """What begins the drive's cycle: SYNC, a request, or the command it answers, off until laid."""
        opener, self._asks = self.binding.opener, self.request()
        if opener is None:
            return None
        out = Outgoing(opener, 0)
        if self._polls:
            out.lay(np.tile(self._stops[-1][0].raw, 2))
        elif self._asks is not None:
            out.view[DATA_AT : DATA_AT + opener.length] = self._asks
        else:
            out.raw[4] = min(opener.length, 1)
        self._note_when_sent(out)
        return out

    def request(self) -> bytes | None:
        """The data with which the message ``sync`` asks the drive; None: it is CANopen's SYNC.

        What a request/response drive says of its own; it must command nothing.
        """
        return None

    def _stop_frames(self, out: Outgoing) -> list[Outgoing]:
        """The stop frames of one message, ready to be sent, by the command's counter. Raises EncodeError."""
        frames = []
        noting = entry(note_sent, self._log, self._state, out.raw, 0)
        for counter in range(self.binding.counter_modulus):
            self._lay(counter, 0, 0.0, 0.0, 0.0)
            if out.encode(0) < 0:
                self._refuse(out)
            frame = Outgoing(out.message, out.index)
            frame.raw[:] = out.raw
            frame.encode = partial(noting, self._log, self._state, frame.raw)
            frames.append(frame)
        return frames

    def _nmt_frame(self, command: int) -> Outgoing | None:
        """An NMT command to the drive's node, ready to be sent; None where no NMT is mapped."""
        message = self.binding.nmt
        if message is None:
            return None
        frame = Outgoing(message, 0)
        frame.view[DATA_AT : DATA_AT + 2] = bytes((command, self.binding.node_id))
        self._note_when_sent(frame)
        return frame

    def _note_when_sent(self, frame: Outgoing) -> None:
        """A frame that is laid out for good: all that is done when it is sent is to log it."""
        noting = (self._log, self._state, frame.raw)
        frame.encode = partial(entry(note_sent, *noting, 0), *noting)

    def prepare(self, tick: Any) -> None:
        """Reach this tick record, so that the first tick is like the others. Raises TypeError for another."""
        raw = bytes_of(tick)
        messages, signals, needed = incoming_tables(self.binding, tick.dtype)
        self._cells[_NEEDED] = needed
        self._cells[_ECHO_AT] = -1 if self.binding.map.echo else tick.dtype.fields["echo"][1]
        self._cells[_MISSING_AT] = _offset(tick, "missing") if "missing" in tick.dtype.fields else 0
        args = (self._buffer, messages, signals, self._last, self._state, self._words, raw, self._log)
        self._take: Callable[[int, bool, int], int] = partial(entry(take, *args, 0, False, 0), *args)
        self._translate = translator(self.binding.map.states, lambda: int(self._cells[_CONTROLWORD]))
        self._flags_cell, self._state_cell = cell_of(tick, "rx_flags"), cell_of(tick, "drive_state")
        self._error_cell = cell_of(tick, "drive_error")
        self._note_absent(tick)
        self._note_state(0)
        self._sent_cells = [cell_of(tick, name) for name in SENT_FIELDS]
        if self._timed is not None and isinstance(self._raw_link, SocketLink):
            all_but(self._raw_link.receiving, self._timed.send_id)  # not before: others were listened for
        if self._port is not None:
            incoming = {"raw": self._buffer, "messages": messages, "signals": signals, "last": self._last}
            own = {"tick": raw, **incoming, "codes": codes_of(self.binding.map.states)}
            self._drain_socket = self._port.drainer(
                own, _offset(tick, "rx_flags"), _offset(tick, "drive_state")
            )
            if self._sync is not None and self._asks is None:
                size = len(self._sync.view)
                self._exchange = self._port.exchanger(own | {"sync": self._sync.raw}, size)
            if len(self._outgoing) == 1 or not self._polls:
                own = {"tick": raw, "raw": self._raws, "fields": sent_offsets(tick.dtype)}
                own |= {"sync": self._sync.raw} if self._sync is not None and self._polls else {}
                own |= {"seldom": self._seldom, "held": self._held}
                self._command = self._port.commander(own | self._commanding)
        if self._sync is not None:
            rest(self._sync.raw)
        self._tick = tick

    def _note_absent(self, tick: Any) -> None:
        """What the drive does not report is no number."""
        reported = {RECEIVED[part].field for bound in self.binding.incoming for part, _ in bound.parts}
        for field in ("i_q", "i_d"):
            if field not in reported:
                tick[field] = float("nan")

    def compiled(self) -> Compiled | None:
        """For the record that it is prepared for; None where receiving and command are not compiled."""
        if self._port is None or self._command is None or self.binding.map.state == "":
            return None
        places, size = self._port.places, 0 if self._sync is None else len(self._sync.view)
        return Compiled(places.get(exchange), places[drain], places[command], size, self._log)

    @property
    def timed(self) -> KernelSync | None:
        """What sends SYNC for it, if anything."""
        return self._timed

    @property
    def command(self) -> Message:
        """The command's message."""
        return self.binding.command.message

    def sync(self, tick: Any) -> None:
        """Send SYNC with its counter 1..240, after what came since the last tick was taken as late."""
        if code := self._begun(EXCHANGED):
            self._conclude(code, 0)
        self._cells[_GOT] = 0
        self._take_late(tick)
        self._send_sync()

    def follow(self, tick: Any) -> None:
        """:meth:`sync` of a client beside another one, which sends SYNC for both."""
        self._cells[_GOT] = 0
        self._take_late(tick)

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """:meth:`sync` and :meth:`receive`, in one compiled call where nothing is late. Raises as they do."""
        code = PENDING
        if self._exchange is not None and tick is self._tick:
            code = self._begun(EXCHANGED) or self._exchange(deadline_ns)
        if code == PENDING:
            self.sync(tick)
            self.receive(tick, deadline_ns)
        elif code:
            self._conclude(code, deadline_ns)

    def _begun(self, what: int) -> int:
        """What a compiled tick has begun and left to be concluded here, 0 for nothing."""
        return 0 if self._port is None else self._port.begun(what)

    def _conclude(self, code: int, deadline_ns: int) -> None:
        """What :func:`drivers.posix.exchange` could not do itself. Raises LinkError when SYNC is not out."""
        if code <= UNSENT:
            self._fail(code - UNSENT)
        self._judge(code, deadline_ns)

    def _take_late(self, tick: Any) -> None:
        self._late = True
        try:
            if code := self._begun(LATE):
                self._judge(code, 0)
            else:
                self.receive(tick, 0)
        finally:
            self._late = False
            self._cells[_GOT] = 0

    def _send_sync(self) -> None:
        if self._sync is None:
            return
        self._cells[_SYNCS] = count = self._cells[_SYNCS] % SYNC_COUNTS + 1
        if self._asks is None and self._sync.raw[4] == 1:
            self._sync.view[DATA_AT] = count
        self._sync.encode(self._now())
        try:
            self._transmit(self._sync)
        finally:
            rest(self._sync.raw)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until feedback came or the deadline passed; 0 drains what is there (newest wins).

        What is queued when the deadline has passed is still taken, up to a bound that a flood can't exceed.
        """
        if tick is not self._tick:
            self.prepare(tick)
        if code := self._begun(EXCHANGED):
            self._conclude(code, deadline_ns)
            return
        drain = self._drain_socket
        code = 0 if drain is None else drain(deadline_ns, self._late)
        if code or drain is None or self._cells[_PENDING] or self._cells[_DOWN]:
            self._judge(code, deadline_ns)

    def _judge(self, code: int, deadline_ns: int) -> None:
        """Take what the kernel handed back, or all where there is none; the flags of it go into the tick."""
        drain = self._drain_socket
        flags, self._cells[_PENDING] = self._cells[_PENDING], 0
        try:
            flags |= self._drain(deadline_ns) if drain is None else self._go_on(code, drain, deadline_ns)
        except LinkDown:
            self._go_down()
        except LinkError:
            flags |= ERROR_FRAME
        self._flags_cell[0] |= flags | (BUS_DOWN if self._cells[_DOWN] else 0)

    def _drain(self, deadline_ns: int) -> int:
        """Flags of all that came."""
        receive, buffer, cells = self._raw_link.receive_into, self._buffer_view, self._cells
        flags, left, more = 0, 0, DRAIN_MOST
        while more:
            if deadline_ns and (left := deadline_ns - time.monotonic_ns()) < 0:
                left = 0
            more -= left == 0
            size = receive(buffer, left)
            if not size:
                break
            seen = self._take(size, self._late, self._now())
            flags |= seen if 0 <= seen < STATE_RAW else self._finish(seen, size)
            if cells[_LOGGED] >= ROOM - 1:
                self.flush()
            if flags & FRESH and deadline_ns:
                break
        return flags

    def _go_on(self, code: int, drain: Callable[[int, bool], int], deadline_ns: int) -> int:
        """:meth:`_drain` from where the compiled kernel has handed back what it can't judge."""
        port = self._port
        assert port is not None  # noqa: S101 - made together with the kernel
        io = port.io
        while code:
            if code < 0:
                port.restart()
                raise_link_error(OSError(-code, os.strerror(-code)), "receive")
            io[FLAGS] |= io[SEEN] if 0 <= io[SEEN] < STATE_RAW else self._finish(io[SEEN], io[SIZE])
            if self._cells[_LOGGED] >= ROOM - 1:
                self.flush()
            if deadline_ns and io[FLAGS] & FRESH:
                flags = int(io[FLAGS])
                port.restart()
                return flags
            code = drain(deadline_ns, self._late)
        return 0

    def _finish(self, seen: int, size: int) -> int:
        """Flags of a frame that the kernel leaves to be finished: one of no measurement, or a raw state."""
        if seen < 0:
            frame = unpack_frame(bytes(self._buffer_view[:size]))
            return 0 if frame is None else self._other(frame)
        assert self._translate is not None  # noqa: S101 - without a translation no state is raw
        self._state_cell[0] = self._translate(self._state_cell[0])
        return seen ^ STATE_RAW

    def _other(self, frame: Frame) -> int:
        """Flags of a frame that measures nothing. Remote frames match no identifier."""
        can_id, data, frame_flags, _ = frame
        if frame_flags & ERR_FLAG:
            return self._on_error(can_id)
        whole = can_id | frame_flags
        if whole in self._foreign:
            return FOREIGN_COMMAND
        emergency = self.binding.emergency
        return self._on_emergency(data) if emergency and whole == emergency.send_id else 0

    def _on_error(self, error_class: int) -> int:
        """A controller that went off the bus, or came back to it, is down for good: nothing more is sent."""
        if error_class & (BUS_OFF | RESTARTED):
            self._go_down()
        return ERROR_FRAME

    def _on_emergency(self, data: bytes) -> int:
        """CiA 301: error code first; code 0 says that an error is gone."""
        if len(data) != 8:
            return LENGTH_ERROR
        code = data[0] | data[1] << 8
        self._error_cell[0] = code
        return EMERGENCY if code else 0

    def send(self, tick: Any) -> None:
        """Send the tick's command. Raises EncodeError or LinkError; a queue that is full is flagged."""
        if tick is not self._tick:
            self.prepare(tick)
        if self._command is not None and not self._cells[_DOWN]:
            code = self._begun(COMMANDED) or self._command()
            if code:
                if code <= REFUSED_COMMAND:
                    self._refuse(self._outgoing[REFUSED_COMMAND - code])
                self._fail(code)
        else:
            counter, controlword, u_q, u_d, T_L = self._sent_cells
            self._send_command(counter[0], controlword[0], u_q[0], u_d[0], T_L[0])
            self._note_state(controlword[0])
        if self._cells[_LOGGED] >= FLUSH_AT:
            self.flush()

    def _fail(self, code: int) -> NoReturn:
        """Raise what -errno of sending means, and remember it."""
        try:
            raise_link_error(OSError(-code, os.strerror(-code)), "send")
        except LinkError as error:
            self._note_failure(error)
            raise

    def _send_command(self, counter: int, controlword: int, u_q: float, u_d: float, T_L: float) -> None:
        """Lay out all frames before the first is sent, then send them, the one with u_q last."""
        self._lay(counter, controlword, u_q, u_d, T_L)
        now_ns = self._now()
        for out in self._outgoing:
            if out.encode(now_ns) < 0:
                self._refuse(out)
        for out in self._outgoing:
            if self._polls and self._sync is not None:
                self._sync.raw[: len(out.raw)] = out.raw
            elif not (self._seldom[out.index] and (out.raw == self._last_sent(out)).all()):
                self._send_noted(out, now_ns)
                self._last_sent(out)[:] = out.raw
        self._cells[_LAST_SENT], self._cells[_CONTROLWORD] = counter, controlword

    def _last_sent(self, out: Outgoing) -> Any:
        """The frame of a message that was sent last."""
        return self._held[FD_BYTES * out.index : FD_BYTES * (out.index + 1)]

    def _send_noted(self, out: Outgoing, now_ns: int) -> None:
        """Send a command; of several the last that was laid out stands in the log's next place."""
        if len(self._outgoing) > 1:
            out.note(now_ns)
        self._transmit(out)

    def _note_state(self, controlword: int) -> None:
        """A drive that does not say its state is taken to be where the command leads."""
        if self.binding.map.state == "":
            on = controlword == ENABLE_OPERATION
            self._state_cell[0] = ENABLED if on else of_controlword(controlword)

    def _lay(self, counter: int, controlword: int, u_q: float, u_d: float, T_L: float) -> None:
        """Set what the encoder lays out."""
        values = self._values
        values[0], values[1], values[2], values[3], values[4] = counter, controlword, u_q, u_d, T_L
        values[5], values[6] = controlword == ENABLE_OPERATION, controlword & FAULT_RESET != 0

    def _refuse(self, out: Outgoing) -> NoReturn:
        """Raise with the codec's words what of a command can't be sent."""
        bound = self.binding.outgoing[out.index]
        names = dict(bound.parts)
        bound.encode({name: self._values[PLACES[part]] for part, name in names.items()})
        raise EncodeError(
            f"{out.message.name}: the frame would say something else than the command; not sent"
        )

    def _transmit(self, out: Outgoing) -> None:
        """Hand a frame that is laid out to the bus."""
        if self._cells[_DOWN]:
            raise LinkDown(100, DOWN)
        try:
            self._raw_link.send_raw(out.view)
        except LinkError as error:
            self._note_failure(error)
            raise
        if self._cells[_LOGGED] < len(self._log):
            self._cells[_LOGGED] += 1

    def _go_down(self) -> None:
        """For good: the kernel would go on with SYNC by itself on an interface that comes up again."""
        self._cells[_DOWN] = 1
        if self._timed is not None:
            self._timed.stop()

    def _note_failure(self, error: LinkError) -> None:
        """A bus that is down stays down; anything else is flagged in the next tick."""
        if isinstance(error, LinkDown):
            self._go_down()
        else:
            self._cells[_PENDING] |= SEND_FAILED

    def flush(self) -> None:
        """Hand the frames on that came and went since the last time."""
        count = self._cells[_LOGGED]
        if count and self._on_frames is not None:
            self._cells[_LOGGED] = 0
            self._on_frames(self._log_bytes[: count * FRAME.itemsize])

    def start(self) -> None:
        """Start the drive's node (NMT) and send its start frames; after arming.

        Raises LinkError, and NoAnswer when the drive does not say what a frame expects.
        """
        if self._started is not None:
            self._stop_with(self._started)
        for shot in self.binding.start:
            self._shoot(shot)
            time.sleep(shot.wait_s)
            self._await(shot)

    def _shoot(self, shot: Shot) -> None:
        """Send a frame that is sent once."""
        frame = Outgoing(shot.message, 0)
        frame.view[DATA_AT : DATA_AT + len(shot.data)] = shot.data
        self._note_when_sent(frame)
        self._stop_with(frame)

    def _await(self, shot: Shot) -> None:
        """Wait until the drive has said all that the frame expects. Raises NoAnswer."""
        missing: dict[Expected, float | None] = dict.fromkeys(shot.expected)
        end = time.monotonic_ns() + round(shot.within_s * 1e9)
        while missing and (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is None:
                continue
            for one in list(missing):
                said = one.said(frame.can_id | frame.flags, frame.data)
                missing[one] = missing[one] if said is None else said
                if said == one.value:
                    del missing[one]
        if missing:
            raise NoAnswer(shot.unanswered(missing))

    def leave(self) -> None:
        """Stop frames of the map, node back to pre-operational; never raises. A full queue is tried again."""
        for shot in self.binding.stop:
            with contextlib.suppress(Exception):  # the next must be tried
                self._shoot(shot)
        for _ in range(STOP_REPEATS if self._left is not None else 0):
            with contextlib.suppress(Exception):  # a bus that is down takes nothing at all
                assert self._left is not None  # noqa: S101 - or there was no round
                return self._stop_with(self._left)
            time.sleep(STOP_PAUSE_S)
        return None

    def stop_from(self, counter: int) -> None:
        """:meth:`stop` with counters after ``counter``: for another process than the one that sent."""
        self._cells[_LAST_SENT] = counter
        self.stop()

    def stop(self) -> None:
        """Zero voltage and disable, a few times with advancing counters and SYNC, then NMT; never raises.

        The frames are ready since before anything was armed: nothing that can be wrong with a command keeps
        one of them from being sent, and one that can't be sent keeps not the others.
        """
        if self._timed is not None:
            self._timed.stop()
        counter = self._cells[_LAST_SENT]
        opens = [] if self._polls else [self._send_sync]
        for _ in range(STOP_REPEATS):
            counter = (counter + 1) % self.binding.counter_modulus
            try_all([*(partial(self._stop_with, frames[counter]) for frames in self._stops), *opens])
            self._cells[_LAST_SENT], self._cells[_CONTROLWORD] = counter, 0
        self.leave()
        with contextlib.suppress(Exception):  # the log is not what matters now
            self.flush()

    def _stop_with(self, frame: Outgoing) -> None:
        with contextlib.suppress(Exception):  # a log that can't note it does not hold it back
            frame.encode(self._now())
        self._transmit(frame)

    def _note_length(self, frame: Frame) -> None:
        """Remember a frame that has another length than its message, as the kernel does."""
        whole = frame.can_id | frame.flags
        if any(
            b.message.send_id == whole and b.message.length != len(frame.data) for b in self.binding.incoming
        ):
            self._state["odd_id"], self._state["odd_length"] = whole, len(frame.data)

    def odd_length(self) -> str:
        """Which message came with another length than the DBC gives it, in words; empty when none did."""
        odd_id, length = (int(self._state[name][0]) for name in ("odd_id", "odd_length"))
        odd = [bound.message for bound in self.binding.incoming if bound.message.send_id == odd_id]
        return f"{odd[0].name}: length {length}, DBC {odd[0].length}" if odd else ""

    def listen(self, seconds: float) -> Counter[int]:
        """Only listen; return how often each identifier was seen. Sends nothing."""
        end = time.monotonic_ns() + round(seconds * 1e9)
        self.seen.clear()
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None:
                self.seen[frame.can_id] += 1
        return self.seen

    def wait_for_drive(self, timeout_s: float, ask: bool = False) -> bool:
        """Wait for the drive's heartbeat or feedback; sends nothing unless it is to ``ask``."""
        now = time.monotonic_ns()
        end, next_ns = now + round(timeout_s * 1e9), now if ask else MAX_NS
        while (now := time.monotonic_ns()) < end:
            if now >= next_ns:
                next_ns = now + ASK_EVERY_NS
                self._send_sync()
            frame = self._link.receive(min(end, next_ns) - now)
            if frame is not None and frame.can_id | frame.flags in self._alive:
                self._note_length(frame)
                return True
        return False

    def other_master(self, seconds: float) -> int | None:
        """Listen for SYNC and commands that only this client should send: the identifier heard, or None."""
        end = time.monotonic_ns() + round(seconds * 1e9)
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None and frame.can_id | frame.flags in self._foreign:
                return frame.can_id
        return None

    def saved(self) -> Saved:
        """What its frames have left in it, but for the tick; :meth:`restore` goes back there."""
        return Saved(self._state.tobytes(), self._last.tobytes())

    def restore(self, saved: Saved) -> None:
        """Be as one was when that was saved."""
        self._state.view("u1")[:] = np.frombuffer(saved.state, np.uint8)
        self._last.view("u1")[:] = np.frombuffer(saved.counters, np.uint8)

    def discard(self) -> None:
        """Throw away what was received before the run."""
        self._link.discard()

    def close(self) -> None:
        """Close the link."""
        if self._timed is not None:
            self._timed.close()
        self._link.close()


MEMBER: Final = DriveKind("CANopen's SYNC or the drive's own clock, as DBC and map say", DriveClient)
_IS_ONE: type[Drive] = DriveClient
