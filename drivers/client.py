"""The drive client: one drive of the house protocol on a link, seen as a port of the control loop.

Fills a tick record in place by field name, so it needs no knowledge of who owns the record. What arrives
damaged, repeated or of the wrong length is flagged and not applied; a bus that is down is flagged and
nothing is sent until the client is closed.
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from drivers.bus import Frame, Link
from drivers.codec import Database, Message
from drivers.errors import LinkDown, LinkError
from drivers.local import ERR_FLAG

FRESH: Final = 1 << 0
CRC_ERROR: Final = 1 << 1
COUNTER_REPEATED: Final = 1 << 2
COUNTER_JUMP: Final = 1 << 3
LENGTH_ERROR: Final = 1 << 4
STATUS: Final = 1 << 5
EMERGENCY: Final = 1 << 6
ERROR_FRAME: Final = 1 << 7
BUS_DOWN: Final = 1 << 8
FOREIGN_COMMAND: Final = 1 << 9
SEND_FAILED: Final = 1 << 10

STOP_REPEATS: Final = 5
OnFrame = Callable[[bool, int, int, bytes], None]
Handler = Callable[[Any, Frame], int]


def ignore_frame(received: bool, t_ns: int, can_id: int, data: bytes) -> None:
    """Take no note of a frame."""


class DriveClient:
    """A drive on a link. ``now`` stamps frames; ``on_frame`` sees each frame sent or received."""

    def __init__(
        self,
        link: Link,
        database: Database,
        *,
        load: bool = False,
        on_frame: OnFrame = ignore_frame,
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._link, self._on_frame, self._now = link, on_frame, now
        self.seen: Counter[int] = Counter()
        self._sync_id = database.message("SYNC").can_id
        self._sync_counter = 0
        self._command = database.message("COMMAND", "Counter", "Controlword", "VoltageQ", "VoltageD")
        self._feedback = database.message(
            "FEEDBACK", "Counter", "Echo", "Speed", "CurrentQ", "CurrentD", "State"
        )
        self._load = (
            database.message("LOAD_COMMAND") if load and "LoadTorque" not in self._command.signals else None
        )
        self._with_load = load and self._load is None
        self._counter_modulus = self._feedback.counter_modulus
        self._last_counter = -1
        self._last_sent = 0
        self._pending_flags = 0
        self._down = False
        self._late = False
        self._prepare(database)

    def _prepare(self, database: Database) -> None:
        """Compile the readers and the table of who handles which identifier."""
        names = ["Counter", "Echo", "Speed", "CurrentQ", "CurrentD", "State", "Limited"]
        extra = ["DcLinkVoltage", "TemperatureMotor", "TemperatureInverter", "ErrorCode"]
        self._status_inside = all(name in self._feedback.signals for name in extra)
        self._read_feedback = self._feedback.reader(*names)
        self._handlers: dict[int, Handler] = {self._command.can_id: self._on_foreign}
        if self._status_inside:
            self._read_status = self._feedback.reader(*extra)
        elif "STATUS" in database.messages:
            self._status = database.message("STATUS", *extra)
            self._read_status = self._status.reader(*extra)
            self._handlers[self._status.can_id] = self._on_status
        if "TRUTH" in database.messages:
            self._handlers[database.message("TRUTH").can_id] = self._on_truth
        self._emergency_id = database.message("EMCY").can_id if "EMCY" in database.messages else -1
        self._handlers[self._emergency_id] = self._on_emergency
        self.heartbeat_id = database.message("HEARTBEAT").can_id if "HEARTBEAT" in database.messages else -1
        self.feedback_id, self.command_id = self._feedback.can_id, self._command.can_id

    @property
    def command(self) -> Message:
        """The command's message."""
        return self._command

    def sync(self, tick: Any) -> None:
        """Send SYNC with its counter 1..240, after what came since the last tick was taken as late."""
        self._late = True
        self.receive(tick, 0)
        self._late = False
        self._send_sync()

    def _send_sync(self) -> None:
        self._sync_counter = self._sync_counter % 240 + 1
        self._send(self._sync_id, bytes((self._sync_counter,)), False)

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until feedback came or the deadline passed; 0 drains what is there (newest wins)."""
        flags = self._pending_flags
        self._pending_flags = 0
        wait = deadline_ns != 0
        try:
            while True:
                frame = self._link.receive(max(0, deadline_ns - time.monotonic_ns()) if wait else 0)
                if frame is None:
                    break
                flags |= self._take(tick, frame)
                if wait and flags & FRESH:
                    break
        except LinkDown:
            self._down = True
        except LinkError:
            flags |= ERROR_FRAME
        tick["rx_flags"] = int(tick["rx_flags"]) | flags | (BUS_DOWN if self._down else 0)

    def _take(self, tick: Any, frame: Frame) -> int:
        """Handle one frame; return its flags."""
        self.seen[frame.can_id] += 1
        self._on_frame(True, self._now(), frame.can_id | frame.flags, frame.data)
        if frame.flags:
            return ERROR_FRAME if frame.flags & ERR_FLAG else 0
        if frame.can_id == self.feedback_id:
            return self._on_feedback(tick, frame)
        handler = self._handlers.get(frame.can_id)
        return handler(tick, frame) if handler else 0

    def _on_feedback(self, tick: Any, frame: Frame) -> int:
        if len(frame.data) != self._feedback.length:
            return LENGTH_ERROR
        if not self._feedback.valid(frame.data):
            return CRC_ERROR
        counter, echo, w, i_q, i_d, state, limited = self._read_feedback(frame.data)
        last, self._last_counter = self._last_counter, int(counter)
        if counter == last:
            return COUNTER_REPEATED
        if self._late:
            return 0
        tick["w"], tick["i_q"], tick["i_d"] = w, i_q, i_d
        tick["echo"], tick["drive_state"], tick["limited"] = echo, state, limited
        if self._status_inside:
            self._apply_status(tick, frame.data)
        jumped = last >= 0 and counter != (last + 1) % self._counter_modulus
        return FRESH | (COUNTER_JUMP if jumped else 0)

    def _apply_status(self, tick: Any, data: bytes) -> None:
        v_dc, motor, inverter, error = self._read_status(data)
        tick["v_dc"], tick["drive_error"] = v_dc, error
        tick["temperature_motor"], tick["temperature_inverter"] = motor, inverter

    def _on_status(self, tick: Any, frame: Frame) -> int:
        if len(frame.data) != self._status.length:
            return LENGTH_ERROR
        if not self._status.valid(frame.data):
            return CRC_ERROR
        self._apply_status(tick, frame.data)
        return STATUS

    def _on_truth(self, tick: Any, frame: Frame) -> int:
        if len(frame.data) == 8:
            tick["T_L_true"] = struct.unpack_from("<f", frame.data)[0]
        return 0

    def _on_emergency(self, tick: Any, frame: Frame) -> int:
        if len(frame.data) == 8:
            tick["drive_error"] = frame.data[0] | frame.data[1] << 8
        return EMERGENCY

    def _on_foreign(self, tick: Any, frame: Frame) -> int:
        return FOREIGN_COMMAND

    def send(self, tick: Any) -> None:
        """Send the tick's command. Raises EncodeError or LinkError; a queue that is full is flagged."""
        self._last_sent = int(tick["counter"])
        self._send_command(
            self._last_sent,
            int(tick["controlword"]),
            float(tick["u_q"]),
            float(tick["u_d"]),
            float(tick["T_L"]),
        )

    def _send_command(self, counter: int, controlword: int, u_q: float, u_d: float, T_L: float) -> None:
        values = {"Counter": counter, "Controlword": controlword, "VoltageQ": u_q, "VoltageD": u_d}
        if self._with_load:
            values |= {"LoadTorque": T_L, "LoadEnable": 1}
        if self._load is not None:
            load = self._load.encode({"Counter": counter, "Enable": 1, "LoadTorque": T_L})
            self._send(self._load.can_id, load, self._load.fd)
        self._send(self._command.can_id, self._command.encode(values), self._command.fd)

    def _send(self, can_id: int, data: bytes, fd: bool) -> None:
        if self._down:
            raise LinkDown(100, "the bus was down; nothing more is sent")
        try:
            self._link.send(can_id, data, fd)
        except LinkDown:
            self._down = True
            raise
        except LinkError:
            self._pending_flags |= SEND_FAILED
            raise
        self._on_frame(False, self._now(), can_id, data)

    def stop(self) -> None:
        """Zero voltage and disable, a few times with advancing counters and SYNC; never raises."""
        modulus = self._command.counter_modulus
        for _ in range(STOP_REPEATS):
            self._last_sent = (self._last_sent + 1) % modulus
            try:
                self._send_command(self._last_sent, 0, 0.0, 0.0, 0.0)
                self._send_sync()
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
            if (
                frame is not None
                and not frame.flags
                and frame.can_id in (self.heartbeat_id, self.feedback_id)
            ):
                return True
        return False

    def discard(self) -> None:
        """Throw away what was received before the run."""
        self._link.discard()

    def close(self) -> None:
        """Close the link."""
        self._link.close()
