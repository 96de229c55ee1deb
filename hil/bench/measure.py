"""One bench from beginning to end: runs, anchors, replay and simulation, as one dictionary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.bench.cyclictest import Anchor, cyclictest
from hil.bench.histogram import Histogram
from hil.bench.machine import machine_facts
from hil.bench.pieces import guard_ns
from hil.bench.processes import (
    BareRun,
    LoopRun,
    Stand,
    awake,
    bare_run,
    hil_run,
    metered_run,
    seconds_in_time,
    stand,
)
from hil.replay import replay
from hil.runtime.clock import RealClock
from hil.runtime.setup import Overrides, load_setup
from hil.signals import TickArray
from hil.sim.simulate import simulate

GOOD: Final = 0.999
METERED_S: Final = 5.0
TRIES: Final = 3
"""A stall of the whole machine spoils what either loop shows; each has so many probes to reach a rate."""
RATES: Final = (1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6250, 8000, 10_000)
"""A loop's period is a whole number of nanoseconds."""
LOOPS: Final = ("hil", "bare")
Say = Callable[[str], None]
Probe = Callable[[str, int], list[float]]
"""Shares in time of each second, of the loop by its name at a rate [Hz]."""


@dataclass(frozen=True, slots=True)
class Length:
    """How long each part takes [s] and which rates are tried [Hz]."""

    run_s: float
    probe_s: float
    simulated_s: float
    rates: tuple[int, ...]


FULL: Final = Length(20.0, 3.0, 60.0, RATES)
QUICK: Final = Length(2.0, 1.0, 10.0, ())


@dataclass(frozen=True, slots=True)
class Bench:
    """The result for people and ``--json``, and both histograms for the figure."""

    result: dict[str, Any]
    ours: Histogram
    anchor: Histogram | None


def bench(path: Path, overrides: Overrides, length: Length, say: Say, *, keep_awake: bool = False) -> Bench:
    """Measure everything on the bus of a configuration. Raises HilError with one clear line."""
    with stand(path, overrides) as one, awake(keep_awake):
        loop = one.setup.config.loop
        say(f"bench: {length.run_s:g} s at {loop.rate_hz} Hz beside the bare loop and cyclictest")
        floor = bare_run(one, loop.rate_hz, length.run_s)
        run = hil_run(one, loop.rate_hz, length.run_s)
        anchor = cyclictest(loop.period_ns, length.run_s, one.setup.config.realtime.fifo_priority, one.core)
        plain = _without_fifo(one, loop.rate_hz, length.run_s)
        tick_us = _tick_us(one, metered_run(one, loop.rate_hz, min(length.run_s, METERED_S)))
        replay_x = _replay_speed(run)
        rates = _rates(one, length, run, floor, say)
    say("bench: simulation")
    ours = Histogram.of(run.ticks["lateness_ns"].astype(np.int64))
    result = _result(run, floor, ours, anchor) | rates
    result |= {"tick_us": tick_us, "record_us": tick_us["record"]}
    result |= {"without_fifo": plain}
    result |= {"replay_x_realtime": replay_x, "simulate_x_realtime": simulate_speed(path, overrides, length)}
    result |= {"machine": machine_facts() | {"kept_awake": keep_awake}}
    return Bench(result, ours, anchor.lateness)


def _result(run: LoopRun, floor: BareRun, ours: Histogram, anchor: Anchor) -> dict[str, Any]:
    """What one run at the configured rate says."""
    processor, bare = float(run.said["processor_us"]), float(floor.said["processor_us"])
    theirs = anchor.lateness
    return {
        "run_rate_hz": run.rate_hz,
        "ticks": run.said["ticks"],
        "skipped": run.said["skipped"],
        "dropped": run.said["dropped"],
        "in_time": run.in_time,
        "processor_us": processor,
        "bare_processor_us": bare,
        "processor_ratio": processor / bare,
        "wall_us": phases(run.ticks),
        "lateness_us": ours.as_dict(),
        "cyclictest_us": theirs.as_dict() if theirs else None,
        "cyclictest": anchor.note,
        "lateness_ratio_p999": ours.percentile(GOOD) / max(1.0, theirs.percentile(GOOD)) if theirs else None,
        "start_s": run.armed_s,
        "growth_kib": run.growth_kib,
        "grants": run.said.get("grants", []),
    }


def phases(ticks: TickArray) -> dict[str, float]:
    """Median time of each phase [us], from the stamps in the log: wall time, not processor time.

    ``exchange`` is SYNC out to feedback in and holds the drive's own time; ``control`` is reference,
    supervisor, law and guard; ``record`` is the tick's record alone.
    """
    late, received, computed, sent = (
        ticks[f"{name}_ns"].astype(np.int64) for name in ("lateness", "received", "computed", "sent")
    )
    parts = {
        "exchange": received - late,
        "control": computed - received,
        "send": sent - computed,
        "record": ticks["recorded_ns"][1:].astype(np.int64) - sent[:-1],
    }
    return {name: float(np.median(value)) * 1e-3 if len(value) else 0.0 for name, value in parts.items()}


def _tick_us(one: Stand, metered: dict[str, float]) -> dict[str, float]:
    """Processor time a tick by phase [us]; the guard, which is compiled into the step, is told apart."""
    guard = guard_ns(one.setup.machine) * 1e-3
    both = metered.pop("control and guard")
    return metered | {"control": both - guard, "guard": guard}


def _without_fifo(one: Stand, rate_hz: int, seconds: float) -> dict[str, Any]:
    """Share in time without FIFO rights, of each try and the best; the first that holds is the last."""
    tried: list[float] = []
    while len(tried) < TRIES and max(tried, default=0.0) < GOOD:
        tried.append(hil_run(one, rate_hz, seconds, ("realtime.fifo_priority=0",)).in_time)
    return {"rate_hz": rate_hz, "in_time": max(tried), "tried": tried}


def _rates(one: Stand, length: Length, run: LoopRun, floor: BareRun, say: Say) -> dict[str, Any]:
    """The highest rates that hold, ours and the bare loop's."""

    def probe(loop: str, rate_hz: int) -> list[float]:
        if loop == "hil":
            shares = seconds_in_time(hil_run(one, rate_hz, length.probe_s).ticks, rate_hz)
        else:
            shares = [bare_run(one, rate_hz, 1.0).in_time for _ in range(round(length.probe_s))]
        seconds = ", ".join(f"{100 * share:.2f}" for share in shares)
        say(f"bench: {loop} at {rate_hz} Hz: {seconds} % in time, second by second")
        return shares

    known = {"hil": run.in_time, "bare": floor.in_time}
    rates = [rate for rate in length.rates if rate > run.rate_hz]
    found, tried = rates_that_hold(rates, probe)
    own, bare = (found[loop] or (run.rate_hz if known[loop] >= GOOD else 0) for loop in LOOPS)
    ratio = own / bare if bare else None
    medians = {"in_time_at": at_rates(tried)}
    return {"rate_hz": own, "bare_rate_hz": bare, "rate_ratio": ratio, "tried": tried} | medians


def rates_that_hold(rates: Sequence[int], probe: Probe) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """(highest rate that holds by loop, 0 for none; every probe).

    A rate holds when in one second of up to :data:`TRIES` probes enough ticks were in time: what else the
    machine does only takes away, so the quietest second says most of the loop. Both loops are probed by
    turns at a rate that either needs, until both hold: the machine is another one a minute later.
    """
    tried: list[dict[str, Any]] = []
    holding: dict[int, set[str]] = {}

    def holds(loop: str, rate_hz: int) -> bool:
        if rate_hz not in holding:
            held = holding[rate_hz] = set()
            for _ in range(TRIES):
                for name in LOOPS:
                    shares = probe(name, rate_hz)
                    tried.append({"loop": name, "rate_hz": rate_hz, "in_time": shares})
                    held |= {name} if max(shares, default=0.0) >= GOOD else set()
                if held == set(LOOPS):
                    break
        return loop in holding[rate_hz]

    return {loop: highest(rates, partial(holds, loop)) for loop in LOOPS}, tried


def at_rates(tried: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """By rate [Hz], of each loop, how many ticks were in time in the median second of all its probes."""
    seconds: dict[tuple[int, str], list[float]] = {}
    for one in tried:
        seconds.setdefault((one["rate_hz"], one["loop"]), []).extend(one["in_time"])
    rates = sorted({rate_hz for rate_hz, _ in seconds})
    return {str(rate): {loop: float(np.median(seconds[rate, loop])) for loop in LOOPS} for rate in rates}


def highest(rates: Sequence[int], holds: Callable[[int], bool]) -> int:
    """The highest of ascending rates that holds, by bisection; 0 when none does."""
    low, high = -1, len(rates)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(rates[middle]) else (low, middle)
    return rates[low] if low >= 0 else 0


def _replay_speed(run: LoopRun) -> float:
    """Logged seconds per second of replay, from file to verdict, kernels warm."""
    clock, span_s = RealClock(), int(run.ticks["k"][-1]) / run.rate_hz
    replay(run.log)
    begin_ns = clock.now_ns()
    replay(run.log)
    return float(span_s / ((clock.now_ns() - begin_ns) * 1e-9))


def simulate_speed(path: Path, overrides: Overrides, length: Length) -> float:
    """Simulated seconds per second, log included, kernels warm."""
    import tempfile

    with tempfile.TemporaryDirectory(prefix="hil-bench-") as folder:
        for seconds in (0.1, length.simulated_s):
            settings = (*overrides.settings, f'log.folder="{folder}"', f"loop.duration_s={seconds}")
            result = simulate(load_setup(path, Overrides(settings=settings)), [])
    return float(result["x_realtime"])
