"""A minute at 5 kHz: no record may be dropped and nothing may grow.

    python -m benchmarks.endurance [--rate HZ] [--seconds S] [--json]

One `hil run` in real time against the emulated drive, on a bus of its own. Growth is the resident memory of
the controller between its first half second and its last. What was written is counted in the log itself. Exit
code 1 when a record is missing or memory grew by more than GROWTH_KIB.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import numpy as np

from hil.bench.histogram import Histogram
from hil.bench.machine import machine_facts
from hil.bench.measure import phases
from hil.bench.processes import LoopRun, hil_run, stand
from hil.config.shipped import find_config
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides

GROWTH_KIB = 512
"""Pages that the allocator still touches for the first time; one float a tick would be 9,000 KiB."""


def judged(run: LoopRun) -> dict[str, Any]:
    """What the run lost and how it went."""
    ticks, said = run.ticks, run.said
    missing = int(said["ticks"]) - len(ticks)
    return {
        "rate_hz": run.rate_hz,
        "ticks": said["ticks"],
        "in_log": len(ticks),
        "dropped": said["dropped"],
        "skipped": said["skipped"],
        "in_time": run.in_time,
        "growth_kib": run.growth_kib,
        "lateness_us": Histogram.of(ticks["lateness_ns"].astype(np.int64)).as_dict(),
        "tick_us": phases(ticks),
        "processor_us": said["processor_us"],
        "ended": said["ended"],
        "ok": missing == 0 and said["dropped"] == 0 and run.growth_kib <= GROWTH_KIB,
        "machine": machine_facts(),
    }


def rows(found: dict[str, Any]) -> dict[str, str]:
    """For people."""
    late = found["lateness_us"]
    return {
        "records": f"{found['in_log']} in the log of {found['ticks']} ticks, {found['dropped']} dropped",
        "memory": f"grew by {found['growth_kib']} KiB",
        "periods": f"{found['skipped']} skipped, {100 * found['in_time']:.3f} % in time",
        "lateness": f"{late['p50']:.0f} / {late['p99']:.0f} / {late['p999']:.0f} / {late['max']:.0f} us",
        "ended": found["ended"],
        "machine": ", ".join(f"{name} {value}" for name, value in found["machine"].items()),
    }


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.endurance", description=__doc__)
    parser.add_argument("--rate", type=int, default=5000, help="[Hz]")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with stand(find_config("demo.toml"), Overrides()) as one:
        found = judged(hil_run(one, args.rate, args.seconds))
    if args.json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
    else:
        show(key_values(f"{args.seconds:g} s at {args.rate} Hz", rows(found)))
    return 0 if found["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
