"""The processes that are measured: the emulated drive, `hil run`, and the bare loop on the same bus."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.bench.machine import resident_kib
from hil.errors import HilError
from hil.log.reader import open_log
from hil.runtime.bus import is_emulated_bus
from hil.runtime.clock import RealClock
from hil.runtime.session import compile_kernels
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import RxFlag, TickArray
from hil.sim.demo import emulator_process

SLACK_S: Final = 60.0
SETTLED_S: Final = 1.0
CALM_PLANT: Final = ("load=[]", "truth=false", "firmware={watchdog_ms=400.0}")
"""The same drive answers all loops of a bench: no load that moves the motor while nobody drives it, and
FEEDBACK alone, as from a real drive, without the true values that only an emulator can tell."""


@dataclass(frozen=True, slots=True)
class Stand:
    """Where everything runs: configuration with its bus, and the folder of the logs."""

    path: Path
    overrides: Overrides
    setup: Setup
    folder: Path
    core: int | None
    """Core of the loops, the drive has another one; None where there is but one."""

    def overrides_at(self, rate_hz: int, seconds: float, limited: bool = True) -> Overrides:
        """Settings of one run: its rate and length, patient with what a loaded machine does to it."""
        more = [f"loop.rate_hz={rate_hz}", f"loop.duration_s={seconds}", 'loop.clock="realtime"']
        more += [f"loop.feedback_timeout_us={800_000 // rate_hz}", f'log.folder="{self.folder}"']
        more += ["feedback.hold_ticks=900", "feedback.quick_stop_ticks=1000", "loop.max_gap_ticks=64"]
        more += ["feedback.error_budget=10000"]
        more += [] if self.core is None else [f"realtime.cpu={self.core}"]
        return replace(self.overrides, settings=(*self.overrides.settings, *more))


def in_time(ticks: TickArray, rate_hz: int) -> npt.NDArray[np.bool_]:
    """Which ticks' commands went out before the next deadline, on fresh feedback."""
    fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
    return np.asarray(fresh & (ticks["sent_ns"] < 1_000_000_000 // rate_hz))


def share_in_time(ticks: TickArray, rate_hz: int) -> float:
    """Share of all periods, the skipped ones too, whose tick was :func:`in_time`."""
    good = np.count_nonzero(in_time(ticks, rate_hz))
    return float(good) / max(1, int(ticks["k"][-1]) + 1) if len(ticks) else 0.0


def seconds_in_time(ticks: TickArray, rate_hz: int) -> list[float]:
    """:func:`share_in_time` of each whole second."""
    if not len(ticks):
        return []
    second = ticks["k"][in_time(ticks, rate_hz)] // rate_hz
    whole = (int(ticks["k"][-1]) + 1) // rate_hz
    return [float(np.count_nonzero(second == place)) / rate_hz for place in range(whole)]


@dataclass(frozen=True, slots=True)
class LoopRun:
    """One `hil run`: its ticks, what it said, and from its start to arming [s]."""

    rate_hz: int
    ticks: TickArray
    said: dict[str, Any]
    armed_s: float
    log: Path
    growth_kib: int

    @property
    def in_time(self) -> float:
        """:func:`share_in_time` of the run."""
        return share_in_time(self.ticks, self.rate_hz)


@dataclass(frozen=True, slots=True)
class BareRun:
    """One bare loop: what it said."""

    rate_hz: int
    said: dict[str, Any]

    @property
    def in_time(self) -> float:
        """The same share as :attr:`LoopRun.in_time`."""
        ticks, bad = self.said["ticks"], self.said["late"] + self.said["lost"]
        return float(max(0, ticks - bad) / (ticks + self.said["skipped"]))


@contextlib.contextmanager
def stand(path: Path, overrides: Overrides) -> Iterator[Stand]:
    """A bus of its own with an emulated drive on it; its logs go when it ends. Raises HilError."""
    if overrides.channel is None and load_setup(path, overrides).config.bus.interface == "hil-local":
        overrides = replace(overrides, channel=f"bench-{uuid.uuid4().hex[:8]}")
    setup = load_setup(path, overrides)
    if not is_emulated_bus(setup.config):
        raise HilError(
            f"{setup.config.bus.interface}:{setup.config.bus.channel}: a bench runs the emulated drive; "
            "name a bus without a real one (hil-local or vcan)"
        )
    with tempfile.TemporaryDirectory(prefix="hil-bench-") as folder:
        loop_core, drive_core = two_cores(setup.config.realtime.cpu)
        one = Stand(path, overrides, setup, Path(folder), loop_core)
        compile_kernels(setup)  # else the first run would be timed with the compiler in it
        with emulator_process(path, one.overrides_at(setup.config.loop.rate_hz, 1.0), CALM_PLANT) as pid:
            if drive_core is not None:
                os.sched_setaffinity(pid, {drive_core})
            yield one


@contextlib.contextmanager
def awake(wanted: bool) -> Iterator[None]:
    """Keep every core from idling, as the kernel's idle=poll would, by processes that give way to all others.

    A virtual machine that idles is given back to the host, and gets its processor again when the host likes.
    """
    command = [sys.executable, "-c", "while True: pass"]
    spinning: list[subprocess.Popen[bytes]] = []
    try:
        for core in sorted(os.sched_getaffinity(0)) if wanted else ():
            spinning.append(subprocess.Popen(command))
            os.sched_setaffinity(spinning[-1].pid, {core})
            os.sched_setscheduler(spinning[-1].pid, os.SCHED_IDLE, os.sched_param(0))
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def two_cores(wanted: int | None) -> tuple[int | None, int | None]:
    """A core for the loops (the configured one, if any) and another for the drive, where there are two."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return wanted, None
    loop = cores[0] if wanted is None else wanted
    return loop, next(core for core in reversed(cores) if core != loop)


def _run_words(stand: Stand, rate_hz: int, seconds: float, more: tuple[str, ...] = ()) -> list[str]:
    words = ["run", str(stand.path), "--json"]
    for setting in (*stand.overrides_at(rate_hz, seconds).as_settings(), *more):
        words += ["--set", setting]
    return words


def metered_run(stand: Stand, rate_hz: int, seconds: float) -> dict[str, float]:
    """Processor time a tick [us] of each phase, from a run with :mod:`hil.bench.meter` in it."""
    report = stand.folder / "metered.json"
    words = ("-m", "hil.bench.meter", str(report), *_run_words(stand, rate_hz, seconds))
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, timeout=seconds + SLACK_S, check=False
    )
    if not report.is_file():
        raise HilError(f"metered run at {rate_hz} Hz: {done.stderr.strip()}")
    found: dict[str, float] = json.loads(report.read_text(encoding="utf-8"))
    return {name: ns * 1e-3 for name, ns in found.items()}


def hil_run(stand: Stand, rate_hz: int, seconds: float, more: tuple[str, ...] = ()) -> LoopRun:
    """Run the controller as a process and read its log. Raises HilError when it refused or has lost ticks."""
    clock = RealClock()
    command = [sys.executable, "-m", "hil.cli", *_run_words(stand, rate_hz, seconds, more)]
    begin_ns = clock.now_ns()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None  # noqa: S101 - PIPE was asked for
    try:
        heard = []
        for line in process.stderr:
            heard.append(line)
            if ": arming;" in line:
                break
        armed_ns = clock.now_ns()
        growth = _growth_kib(process.pid, armed_ns, seconds)
        out, error = process.communicate(timeout=seconds + SLACK_S)
    finally:
        process.kill()
    if not out.startswith("{"):
        raise HilError(f"hil run at {rate_hz} Hz: {(''.join(heard) + error).strip()}")
    said = json.loads(out)
    log = Path(said["log"])
    return LoopRun(
        rate_hz, open_log(log, frames=False).ticks, said, (armed_ns - begin_ns) * 1e-9, log, growth
    )


def _growth_kib(pid: int, armed_ns: int, seconds: float) -> int:
    """What the process grew [KiB] between its first second, in which it locks its pages, and its last."""
    clock = RealClock()
    clock.sleep_until(armed_ns + round(SETTLED_S * 1e9))
    before = resident_kib(pid)
    clock.sleep_until(armed_ns + round(max(SETTLED_S, seconds - 0.2) * 1e9))
    after = resident_kib(pid)
    return after - before if before and after else 0


def bare_run(stand: Stand, rate_hz: int, seconds: float) -> BareRun:
    """Run the bare loop on the same bus with the same drive. Raises HilError."""
    config = stand.setup.config
    command = [sys.executable, "-m", "drivers.bare", config.bus.interface, config.bus.channel]
    command += [str(stand.setup.database.path), "--rate", str(rate_hz)]
    command += ["--ticks", str(round(rate_hz * seconds)), "--node", str(config.drive.node_id)]
    command += ["--fifo", str(config.realtime.fifo_priority)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        if stand.core is not None:
            os.sched_setaffinity(process.pid, {stand.core})
        out, error = process.communicate(timeout=seconds * 10 + SLACK_S)
    finally:
        process.kill()
    if process.returncode != 0:
        raise HilError(f"bare loop at {rate_hz} Hz: {error.strip()}")
    return BareRun(rate_hz, json.loads(out))
