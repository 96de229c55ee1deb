"""Tables of the loop: rate, pacing and clock, the operating system, the guardian, the bus and the log."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from hil.config.table import Seconds, Table

MOST_GUARDIAN_MS = 10_000
"""A guardian that waits longer is none."""


class LoopTable(Table):
    """Rate, pacing and clock of the loop."""

    rate_hz: Annotated[int, Field(ge=10, le=20_000)] = 1000
    """Ticks a second, 1 / T_s; divides 1e9, so that a period is a whole number of nanoseconds."""
    pacing: Literal["sync", "feedback", "timer"] = "sync"
    """What begins a tick: our SYNC, the drive's cyclic frame (feedback), or the loop's own clock (timer)."""
    clock: Literal["realtime", "lockstep"] = "realtime"
    """Real time, or lockstep with the emulator: as fast as it goes, the same bits each time."""
    duration_s: Seconds | None = None
    """The run stops after this time; left out: it goes on until it is stopped."""
    feedback_timeout_us: Annotated[int, Field(ge=10, le=100_000)] | None = None
    """How long after its deadline a tick waits for feedback; left out: 0.6 of the period."""
    max_gap_ticks: Annotated[int, Field(ge=1, le=64)] = 20
    """The run ends (LOOP_OVERRUN) when the loop is late by more periods than this."""
    shadow: bool = False
    """Listen and compute beside another controller, and send nothing."""

    @field_validator("rate_hz")
    @classmethod
    def _whole_nanoseconds(cls, value: int) -> int:
        if 1_000_000_000 % value:
            raise ValueError(f"{value} Hz has no whole number of nanoseconds; take one that divides 1e9")
        return value

    @model_validator(mode="after")
    def _shorter_than_the_gap(self) -> LoopTable:
        given, most = self.feedback_timeout_us, self.max_gap_ticks * self.period_ns // 1000
        if given is not None and given > most:
            raise ValueError(
                f"feedback_timeout_us = {given} is longer than max_gap_ticks periods, {most} us: one tick "
                "without feedback would end the run; take less, 0.6 of the period is the default"
            )
        return self

    @property
    def period_ns(self) -> int:
        """T_s in nanoseconds."""
        return 1_000_000_000 // self.rate_hz

    @property
    def timeout_ns(self) -> int:
        """How long after its deadline a tick waits for feedback (default 0.6 T_s)."""
        return self.feedback_timeout_us * 1000 if self.feedback_timeout_us else self.period_ns * 6 // 10


class RealtimeTable(Table):
    """What is asked of the operating system; what it does not grant is said, not assumed."""

    fifo_priority: Annotated[int, Field(ge=0, le=98)] = 50
    """Priority of the loop under SCHED_FIFO; 0: the system's usual scheduling."""
    cpu: Annotated[int, Field(ge=0, le=4095)] | None = None
    """Number of the processor that the loop stays on; left out: any."""
    lock_memory: bool = True
    """Keep all memory of the loop's process in RAM (mlockall) and in its place (no huge pages made of it)."""


class GuardianTable(Table):
    """The process that stops the drive when the loop falls silent for longer than any tolerated skip."""

    enabled: bool = True
    """Start the guardian beside the loop."""
    timeout_ms: Annotated[float, Field(ge=1, le=MOST_GUARDIAN_MS, allow_inf_nan=False)] | None = None
    """Silence of the loop after which it stops the drive; left out: five periods above loop.max_gap_ticks, at
    least 10 ms."""

    def timeout_ns(self, loop: LoopTable) -> int:
        """Default: five periods more than the gap at which the supervisor stops, at least 10 ms."""
        if self.timeout_ms is not None:
            return round(self.timeout_ms * 1e6)
        return max((loop.max_gap_ticks + 5) * loop.period_ns, 10_000_000)


class BusTable(Table):
    """The CAN bus, in python-can's terms."""

    interface: str = "hil-local"
    """Interface of python-can: hil-local (this machine alone), socketcan, kvaser, pcan and others."""
    channel: str = "demo"
    """Channel of that interface: any name for hil-local, vcan0 or can0 for socketcan."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """Bits a second of the arbitration phase, for interfaces that set it, and for the bus load."""
    data_bitrate: Annotated[int, Field(ge=10_000, le=8_000_000)] | None = None
    """Bits a second of the data phase of CAN FD; left out: as bitrate."""
    fd: bool = False
    """CAN FD."""
    sync: Literal["loop", "kernel"] = "loop"
    """Who sends SYNC: the loop, or the kernel by its own timer (socketcan alone, in real time)."""


class LogTable(Table):
    """Where the log goes."""

    folder: str = "../logs"
    """Folder of the logs, relative to this file."""
    name: str | None = None
    """Name of the log file; left out: this file's name and the time (UTC)."""
    frames: bool = True
    """Log every CAN frame beside the ticks."""
    compression: Literal["zstd", "lz4"] = "zstd"
    """Compression of the chunks."""
    split_s: Annotated[float, Field(ge=1, le=1e7, allow_inf_nan=False)] | None = None
    """Begin a new file after this time; left out: one file."""
    split_mb: Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False)] | None = None
    """Begin a new file after this size; left out: one file."""
