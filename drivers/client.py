"""The drive client: one drive on a link, seen as a port of the control loop.

Fills a tick record in place, its fields found by name, so it needs no knowledge of who owns the record. What
arrives damaged, repeated or of the wrong length is flagged and not applied; a bus that is down is flagged and
nothing is sent until the client is closed. What is received, sent and logged when, on any bus, are the
kernels of :mod:`drivers.posix`; here is what they leave: what has to be judged, told or raised.
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
from drivers.drive import Drive, DriveKind, OnFrames, Opens, Seen
from drivers.errors import EncodeError, LinkDown, LinkError
from drivers.frames import (
    BUS_DOWN,
    EMERGENCY,
    ERROR_FRAME,
    FOREIGN_COMMAND,
    FRESH,
    LENGTH_ERROR,
    PLACES,
    SEND_FAILED,
)
from drivers.jit import COMPILED, entry
from drivers.local import ERR_FLAG
from drivers.mapping import RECEIVED, DriveMap, house_map
from drivers.oneshot import Expected, NoAnswer, Shot
from drivers.port import Arrays, Compiled, Port, Saved
from drivers.posix import (
    ASKS,
    BEFORE,
    FLAGS,
    FLAGS_AT,
    HANDED_BACK,
    PENDING,
    RAISED,
    REFUSED_COMMAND,
    SEEN,
    SILENT,
    SIZE,
    STATE_AT,
    UNSENT,
    begin,
    command,
    drain,
    exchange,
)
from drivers.rawlink import raw_link
from drivers.record import bytes_of, cell_of
from drivers.states import codes_of, of_controlword
from drivers.stops import STOP_PAUSE_S, Outgoing, try_all
from drivers.tables import command_values, incoming_tables, outgoing_tables, sent_offsets
from drivers.wire import DATA_AT, FRAME, ROOM, STATE, encode_command, note_sent

BUS_OFF: Final = 0x40  # error classes of SocketCAN, linux/can/error.h
RESTARTED: Final = 0x100
STOP_REPEATS: Final = 5
START: Final = 0x01
PRE_OPERATIONAL: Final = 0x80
"""NMT commands of CiA 301."""
DOWN: Final = "the bus was down; nothing more is sent"
_GOT, _NEEDED, _ECHO_AT, _LOGGED, _LAST_SENT, _CONTROLWORD, _, _PENDING, _DOWN = range(9)
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


def is_before(code: int) -> bool:
    """Whether a kernel's code is of the frames that came before SYNC."""
    return code <= BEFORE + HANDED_BACK


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
        shared = {"state": self._state, "words": self._words, "log": self._log}
        if self._timed is not None and COMPILED:
            shared["ear"] = self._timed.words
        self._seen = np.zeros(0)
        self._port = Port(self._raw_link, shared, self._buffer_view, self._now)

    def _make_senders(self) -> None:
        """What lays out and sends each command and SYNC."""
        messages, signals = outgoing_tables(self.binding)
        values = command_values()
        self._values: Any = values.data
        self._commanding = {"values": values, "messages": messages, "signals": signals}
        self._outgoing = [Outgoing(bound.message, i) for i, bound in enumerate(self.binding.outgoing)]
        noting = self._log, self._state, self._outgoing[0].raw
        self._note: Callable[..., int] = entry(note_sent, *noting, 0)
        self._stops = [self._stop_frames(out) for out in self._outgoing]
        on_change = self.binding.map.on_change
        self._commanding["seldom"] = np.array([out.message.name in on_change for out in self._outgoing], "u1")
        self._commanding["raw"] = np.concatenate([out.raw for out in self._outgoing])
        self._commanding["held"] = np.zeros_like(self._commanding["raw"])
        self._polls = self.binding.map.poll != ""
        self._sync = self._opening()
        self._opens = {} if self._sync is None else {"sync": self._sync.raw}
        self._sync_bytes = 0 if self._sync is None else len(self._sync.view)
        self._begin = self._port.over(begin, self._opens, self._sync_bytes)
        self._started, self._left = (self._nmt_frame(command) for command in (START, PRE_OPERATIONAL))

    def _opening(self) -> Outgoing | None:
        """What begins the drive's cycle: SYNC, a request, or the command it answers, off until laid."""
        opener, asks = self.binding.opener, self.request()
        if opener is None:
            return None
        out = Outgoing(opener, 0)
        if self._polls:
            out.lay(np.tile(self._stops[-1][0].raw, 2))
        elif asks is not None:
            out.view[DATA_AT : DATA_AT + opener.length] = asks
            self._port.io[ASKS] = 1
        else:
            out.raw[4] = min(opener.length, 1)
        return out

    def request(self) -> bytes | None:
        """The data with which the message ``sync`` asks the drive; None: it is CANopen's SYNC.

        What a request/response drive says of its own; it must command nothing.
        """
        return None

    def _stop_frames(self, out: Outgoing) -> list[Outgoing]:
        """The stop frames of one message, ready to be sent, by the command's counter. Raises EncodeError."""
        values, messages, signals = (self._commanding[name] for name in ("values", "messages", "signals"))
        args = out.raw, values, out.index, messages, signals, self._state, self._words, self._log
        encode, frames = entry(encode_command, *args, 0), []
        for counter in range(self.binding.counter_modulus):
            values[0] = counter
            if encode(*args, 0) < 0:
                self._refuse(out)
            frame = Outgoing(out.message, out.index)
            frame.raw[:] = out.raw
            frames.append(frame)
        return frames

    def _nmt_frame(self, command: int) -> Outgoing | None:
        """An NMT command to the drive's node, ready to be sent; None where no NMT is mapped."""
        message = self.binding.nmt
        if message is None:
            return None
        frame = Outgoing(message, 0)
        frame.view[DATA_AT : DATA_AT + 2] = bytes((command, self.binding.node_id))
        return frame

    def overhear(self) -> Seen:
        """From now on another's commands are what the drive applies, no second master's; before a tick.

        Raises DatabaseError where one message does not say all of a command.
        """
        rows = self.binding.counter_modulus if self.binding.map.echo else 1
        self._seen = np.zeros(2 * rows)
        self._port.share("seen", self._seen)
        return self._seen

    def prepare(self, tick: Any) -> None:
        """Reach this tick record, so that the first tick is like the others. Raises TypeError for another."""
        raw = bytes_of(tick)
        messages, signals, needed = incoming_tables(self.binding, tick.dtype, len(self._seen) > 0)
        self._cells[_NEEDED] = needed
        self._cells[_ECHO_AT] = -1 if self.binding.map.echo else tick.dtype.fields["echo"][1]
        self._cells[_MISSING_AT] = _offset(tick, "missing") if "missing" in tick.dtype.fields else 0
        self._flags_cell, self._error_cell = cell_of(tick, "rx_flags"), cell_of(tick, "drive_error")
        self._note_absent(tick)
        if self._timed is not None and isinstance(self._raw_link, SocketLink):
            all_but(self._raw_link.receiving, self._timed.send_id)  # not before: others were listened for
        port = self._port
        port.io[FLAGS_AT], port.io[STATE_AT] = _offset(tick, "rx_flags"), _offset(tick, "drive_state")
        own: Arrays = {"tick": raw, "messages": messages, "signals": signals}
        own |= {"raw": self._buffer, "last": self._last, "codes": codes_of(self.binding.map.states)}
        self._drain = port.over(drain, own, free=(0, False))
        self._exchange = port.over(exchange, own | self._opens, self._sync_bytes, free=(0,))
        own = {"tick": raw, "fields": sent_offsets(tick.dtype)} | self._commanding
        self._command = port.over(command, own | (self._opens if self._polls else {}))
        self._tick = tick

    def _note_absent(self, tick: Any) -> None:
        """What the drive does not report is no number."""
        reported = {RECEIVED[part].field for bound in self.binding.incoming for part, _ in bound.parts}
        for field in ("i_q", "i_d"):
            if field not in reported:
                tick[field] = float("nan")
        if self.binding.map.state == "":
            self._port.io[SILENT] = 1
            tick["drive_state"] = of_controlword(0)

    def compiled(self) -> Compiled | None:
        """For the record that it is prepared for; None with the compiler off."""
        if not COMPILED:
            return None
        places = self._port.places
        return Compiled(places[exchange], places[drain], places[command], self._sync_bytes, self._log)

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
        self.follow(tick)
        self._send_sync()

    def follow(self, tick: Any) -> None:
        """:meth:`sync` of a client beside another one, which sends SYNC for both."""
        if tick is not self._tick:
            self.prepare(tick)
        self._follow(self._port.left())

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """:meth:`sync` and :meth:`receive`, in one compiled call where nothing is late. Raises as they do."""
        if tick is not self._tick:
            self.prepare(tick)
        code = self._port.left() or self._exchange(deadline_ns)
        if code == PENDING or is_before(code):
            self._follow(0 if code == PENDING else code)
            self._send_sync()
            code = self._drain(deadline_ns, False)
        self._conclude(code, deadline_ns)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until feedback came or the deadline passed; 0 drains what is there (newest wins).

        What is queued when the deadline has passed is still taken, up to a bound that a flood can't exceed.
        """
        if tick is not self._tick:
            self.prepare(tick)
        if is_before(code := self._port.left()):
            self._follow(code)
            code = 0
        self._conclude(code or self._drain(deadline_ns, False), deadline_ns)

    def _follow(self, code: int) -> None:
        """Take what came before SYNC as late; ``code``: what a compiled tick has left of that."""
        self._cells[_GOT] = 0
        if is_before(code):
            code -= BEFORE
        self._conclude(code or self._drain(0, True), 0, late=True)
        self._cells[_GOT] = 0

    def _send_sync(self) -> None:
        if self._cells[_DOWN]:
            raise LinkDown(100, DOWN)
        if code := self._begin():
            self._fail(code - UNSENT)

    def _conclude(self, code: int, deadline_ns: int, late: bool = False) -> None:
        """Do what a kernel could not; the flags of it go into the tick. Raises LinkError without SYNC."""
        if not (code or self._cells[_PENDING] or self._cells[_DOWN]):
            return
        if code <= UNSENT:
            self._fail(code - UNSENT)
        flags, self._cells[_PENDING] = self._cells[_PENDING], 0
        try:
            self._go_on(code, deadline_ns, late)
        except LinkDown:
            self._go_down()
        except LinkError:
            flags |= ERROR_FRAME
        self._flags_cell[0] |= flags | (BUS_DOWN if self._cells[_DOWN] else 0)

    def _go_on(self, code: int, deadline_ns: int, late: bool) -> None:
        """Judge the frame that :func:`drivers.posix.drain` has handed back, and so on until it is done."""
        io = self._port.io
        while code:
            if code < 0:
                self._port.restart()
                self._raise(code, "receive")
            io[FLAGS] |= self._judge(io[SIZE]) if io[SEEN] < 0 else io[SEEN]
            if self._cells[_LOGGED] >= ROOM - 1:
                self.flush()
            if deadline_ns and io[FLAGS] & FRESH:
                self._flags_cell[0] |= io[FLAGS]
                self._port.restart()
                return
            code = self._drain(deadline_ns, late)

    def _judge(self, size: int) -> int:
        """Flags of a frame that the kernel can't judge."""
        frame = unpack_frame(bytes(self._buffer_view[:size]))
        return 0 if frame is None else self._other(frame)

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
        code = self._port.left()
        if self._cells[_DOWN]:
            raise LinkDown(100, DOWN)
        if code := code or self._command():
            if code <= REFUSED_COMMAND:
                self._refuse(self._outgoing[REFUSED_COMMAND - code])
            self._fail(code)
        if self._cells[_LOGGED] >= FLUSH_AT:
            self.flush()

    def _fail(self, code: int) -> NoReturn:
        """Raise what -errno of sending means, and remember it."""
        try:
            self._raise(code, "send")
        except LinkError as error:
            self._note_failure(error)
            raise

    def _raise(self, code: int, action: str) -> NoReturn:
        """Raise what -errno means, or what a bus that is no descriptor has raised."""
        if code == RAISED and self._port.raised is not None:
            raise self._port.raised
        raise_link_error(OSError(-code, os.strerror(-code)), action)

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
            self._note(self._log, self._state, frame.raw, self._now())
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
        return Saved(self._state.tobytes(), self._last.tobytes(), self._seen.tobytes())

    def restore(self, saved: Saved) -> None:
        """Be as one was when that was saved."""
        self._state.view("u1")[:] = np.frombuffer(saved.state, np.uint8)
        self._last.view("u1")[:] = np.frombuffer(saved.counters, np.uint8)
        self._seen.view("u1")[:] = np.frombuffer(saved.seen, np.uint8)

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
