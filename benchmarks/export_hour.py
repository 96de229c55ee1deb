"""Exports an hour's log at 1 kHz (3.6 million ticks, 10.8 million frames) in every format: seconds, memory.

python benchmarks/export_hour.py [ENDING ...]: only these formats. The log is made up with random values,
which compress worse than a run's.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hil.convert.export import FORMATS, MAT
from hil.log.mcapfile import RunFile
from hil.log.schema import FRAME
from hil.signals import FIELDS, new_ticks

TICKS, SLAB, PERIOD_NS = 3_600_000, 36_000, 1_000_000
FRAMES = ((0x080, 0, 1), (0x181, 1, 8), (0x201, 0, 8))  # identifier, received, bytes


def make_log(path: Path) -> None:
    """An hour of ticks and their three frames, through the bulk writer."""
    rng, ticks, frames = np.random.default_rng(1), new_ticks(SLAB), np.zeros(SLAB * len(FRAMES), FRAME)
    for at, (can_id, received, size) in enumerate(FRAMES):
        own = frames[at :: len(FRAMES)]
        own["can_id"], own["received"], own["size"] = can_id, received, size
        own["data"][:, :size] = rng.integers(0, 256, (SLAB, size))
    with RunFile(path, {"metadata": {"kind": "benchmark", "started": "2026-01-01T00:00:00+00:00"}}) as file:
        for first in range(0, TICKS, SLAB):
            for field in FIELDS:
                values = rng.normal(size=SLAB) if field.kind == "f8" else rng.integers(0, 100, SLAB)
                ticks[field.name] = values
            ticks["k"] = np.arange(first, first + SLAB)
            ticks["t_ns"], ticks["gap"] = ticks["k"] * PERIOD_NS, 1
            for at in range(len(FRAMES)):
                frames["t_ns"][at :: len(FRAMES)] = ticks["t_ns"] + at * 100_000
            file.add_ticks(ticks)
            file.add_frames(frames)
        file.finish({"ended": "benchmark"})


def exported(log: Path, out: Path) -> tuple[float, float, float]:
    """Seconds, processor seconds (what a shared machine leaves alone) and peak memory [MB] of one export."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "hil.cli", "export", str(log), "-o", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"export to {out.suffix} ended with {process.returncode}")
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3


def main() -> None:
    """Make the log, export it, print a table."""
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "hour.mcap"
        make_log(log)
        sys.stdout.write(f"log {log.stat().st_size / 1e6:.0f} MB\n")
        for ending in sys.argv[1:] or [*FORMATS, MAT]:
            out = log.with_suffix(ending)
            seconds, cpu, peak = exported(log, out)
            size = out.stat().st_size / 1e6
            text = f"{seconds:6.1f} s  cpu {cpu:6.1f} s  peak {peak:6.0f} MB  file {size:6.0f} MB"
            sys.stdout.write(f"{ending:9} {text}\n")
            sys.stdout.flush()
            out.unlink()


if __name__ == "__main__":
    main()
