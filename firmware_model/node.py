"""The emulated drive as a node on a bus: frames in, kernels, frames out.

`lockstep`: each SYNC advances the plant by exactly one period. `realtime`: by the time that really passed;
a timer advances it when SYNC stays away, so that the watchdog trips. A cyclic drive (no SYNC) samples on its
own timer. Frames that are not whole, valid and fresh are counted and ignored.
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Literal

from drivers.bus import Frame, Link
from drivers.codec import Database, Message
from drivers.errors import LinkError
from firmware_model.config import Record, Wire, new_sample, new_state
from firmware_model.drive import advance, on_command, on_load_command, on_sync
from firmware_model.plant import State

PROTOCOL_VERSION = 1
VOLTAGE_MODE = 0
HEARTBEAT_NS = 100_000_000
IDLE_NS = 5_000_000


def wire_of(database: Database) -> Wire:
    """Resolution and range of the measured signals in a DBC of the house protocol."""
    signals = database.message("FEEDBACK", "Speed", "CurrentQ", "CurrentD").signals
    speed, i_q, i_d = signals["Speed"], signals["CurrentQ"], signals["CurrentD"]
    return Wire(speed.scale, speed.top, i_q.scale, i_q.top, i_d.scale, i_d.top)


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
    ) -> None:
        self._link, self._clock, self._pacing, self._period_ns = link, clock, pacing, period_ns
        self._truth = truth
        self._feedback: Message = database.message("FEEDBACK")
        self._command = database.message("COMMAND")
        self._status = database.messages.get("STATUS")
        self._load = database.messages.get("LOAD_COMMAND")
        self._truth_id = database.message("TRUTH").can_id
        self._emergency_id = database.message("EMCY").can_id
        self._heartbeat_id = database.message("HEARTBEAT").can_id
        self._sync_id = database.message("SYNC").can_id
        self._read_load = self._load.reader("Counter", "Enable", "LoadTorque") if self._load else None
        self._read_mode = self._command.reader("Mode")
        self._inline_load = "LoadTorque" in self._command.signals
        self._read_command = self._command.reader("Counter", "Controlword", "VoltageQ", "VoltageD")
        self._read_inline = self._command.reader("LoadEnable", "LoadTorque") if self._inline_load else None
        self._params = params
        self._state = new_state(params, self._command.counter_modulus - 1)
        self._sample = new_sample()
        self._counter = self._status_counter = 0
        self._last_command = self._last_load = -1
        self._last_ns = 0
        self._started = False
        self.ignored: Counter[str] = Counter()

    @property
    def state(self) -> Any:
        """The plant's state record."""
        return self._state[0]

    def warm_up(self) -> None:
        """Compile the kernels on copies, before anything is on the bus."""
        state = self._state.copy()
        advance(self._params[0], state[0], 1000)
        on_command(state[0], 0, 0, 0.0, 0.0)
        on_load_command(state[0], 0.0)
        on_sync(self._params[0], state[0], self._sample[0])

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve the bus until ``stopped()``; boot-up message first, heartbeat every 100 ms."""
        self._send(self._heartbeat_id, b"\x00")
        self._last_ns = next_beat = next_cycle = time.monotonic_ns()
        while not stopped():
            now = time.monotonic_ns()
            if now >= next_beat:
                next_beat = now + HEARTBEAT_NS
                self._send(self._heartbeat_id, b"\x05")
            if self._pacing == "cyclic" and now >= next_cycle:
                next_cycle += self._period_ns * (1 + (now - next_cycle) // self._period_ns)
                self.sync(now)
            wake = min(next_beat, next_cycle) if self._pacing == "cyclic" else next_beat
            self._serve(min(max(wake - now, 0), IDLE_NS))

    def _serve(self, timeout_ns: int) -> None:
        try:
            frame = self._link.receive(timeout_ns)
        except LinkError:
            time.sleep(0.01)
            frame = None
        if frame is not None:
            self.take(frame)
        if frame is None or time.monotonic_ns() - self._last_ns > IDLE_NS:  # a flood must not stop the plant
            self._catch_up()

    def _catch_up(self) -> None:
        """Realtime: let the plant catch up with the clock, once its time has begun."""
        if self._clock == "realtime" and self._started:
            self._advance_to(time.monotonic_ns())

    def _advance_to(self, now_ns: int) -> None:
        advance(self._params[0], self.state, now_ns - self._last_ns)
        self._last_ns = now_ns

    def take(self, frame: Frame) -> None:
        """Handle one frame, whole or not at all."""
        if frame.flags:
            self.ignored["flags"] += 1
        elif frame.can_id == self._command.can_id:
            self._on_command(frame.data)
        elif frame.can_id == self._sync_id and self._pacing == "sync":
            if len(frame.data) > 1:  # CANopen: no data or the counter
                self.ignored["length"] += 1
            else:
                self.sync(time.monotonic_ns())
        elif self._load and frame.can_id == self._load.can_id:
            self._on_load(frame.data)

    def _acceptable(self, message: Message, data: bytes) -> bool:
        if len(data) != message.length:
            self.ignored["length"] += 1
            return False
        if not message.valid(data):
            self.ignored["crc"] += 1
            return False
        return True

    def _on_command(self, data: bytes) -> None:
        if not self._acceptable(self._command, data):
            return
        counter, controlword, u_q, u_d = self._read_command(data)
        if self._read_mode(data)[0] != VOLTAGE_MODE:
            self.ignored["mode"] += 1
            return
        if counter == self._last_command:
            self.ignored["repeated"] += 1
            return
        self._last_command = int(counter)
        self._catch_up()
        if self._read_inline:
            enable, T_L = self._read_inline(data)
            on_load_command(self.state, T_L if enable else 0.0)
        on_command(self.state, int(counter), int(controlword), u_q, u_d)

    def _on_load(self, data: bytes) -> None:
        assert self._load is not None and self._read_load is not None  # noqa: S101 - set together
        if not self._acceptable(self._load, data):
            return
        counter, enable, T_L = self._read_load(data)
        if counter == self._last_load:
            self.ignored["repeated"] += 1
            return
        self._last_load = int(counter)
        on_load_command(self.state, T_L if enable else 0.0)

    def sync(self, now_ns: int) -> None:
        """One SYNC (or cycle): advance, latch, sample, answer."""
        if not self._started:
            self._started = True
            self._last_ns = now_ns
        elif self._clock == "lockstep":
            advance(self._params[0], self.state, self._period_ns)
        else:
            self._advance_to(now_ns)
        on_sync(self._params[0], self.state, self._sample[0])
        self._answer(self._sample[0])

    def _answer(self, out: Any) -> None:
        """EMCY if a fault arose, TRUTH, STATUS when due, FEEDBACK last."""
        if out["emcy_due"]:
            self._send(self._emergency_id, struct.pack("<HB5x", int(out["error"]), 1))
        if self._truth:
            self._send(self._truth_id, struct.pack("<ff", out["T_L_true"], out["w_true"]))
        status = {
            "ProtocolVersion": PROTOCOL_VERSION,
            "DcLinkVoltage": float(out["v_dc"]),
            "TemperatureMotor": float(out["temperature_motor"]),
            "TemperatureInverter": float(out["temperature_inverter"]),
            "ErrorCode": int(out["error"]),
        }
        if self._status and out["status_due"]:
            self._status_counter = (self._status_counter + 1) % self._status.counter_modulus
            self._send(self._status.can_id, self._status.encode({"Counter": self._status_counter, **status}))
        self._counter = (self._counter + 1) % self._feedback.counter_modulus
        values = {
            "Counter": self._counter,
            "Echo": int(out["echo"]),
            "Speed": float(out["w"]),
            "CurrentQ": float(out["i_q"]),
            "CurrentD": float(out["i_d"]),
            "State": int(out["state"]),
            "Limited": int(out["limited"]),
        }
        if not self._status:
            values |= status
        self._send(self._feedback.can_id, self._feedback.encode(values), self._feedback.fd)

    def _send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """A drive does not stop for a bus that is down; its watchdog does."""
        try:
            self._link.send(can_id, data, fd)
        except LinkError:
            self.ignored["send"] += 1

    def summary(self) -> str:
        """One line: state at the end and what was ignored."""
        state = State(int(self.state["state"])).name
        ignored = ", ".join(f"{count} {name}" for name, count in sorted(self.ignored.items())) or "none"
        error = int(self.state["error"])
        return f"emulator stopped: state {state}, error 0x{error:04X}, ignored frames: {ignored}"
