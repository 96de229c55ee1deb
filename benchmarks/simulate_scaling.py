"""How the time of `hil simulate` grows: with simulated time, the observer's memory, the number of cases.

    python -m benchmarks.simulate_scaling [--json]

Each is a straight line fitted through the fastest of a few runs at each point; slope and R^2 are printed. It
runs the compiled loop of controller and motor alone, without a log, with kernels compiled before. What counts
is this process's own processor time, so that other load on the machine matters little.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from hil.bench.machine import machine_facts
from hil.config.shipped import find_config
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import make_simulation

REPEATS = 3
CASE_S = 2.0
MEMORY_S = 40.0


@dataclass(frozen=True, slots=True)
class Line:
    """time [s] = intercept + slope x, with the coefficient of determination and the points."""

    slope: float
    intercept: float
    r2: float
    points: list[tuple[float, float]]


def fit(points: Sequence[tuple[float, float]]) -> Line:
    """Least squares; R^2 = 1 - residual / total sum of squares."""
    x, y = np.array(points).T
    slope, intercept = np.polyfit(x, y, 1)
    residual = float(np.sum((y - intercept - slope * x) ** 2))
    total = float(np.sum((y - y.mean()) ** 2))
    return Line(float(slope), float(intercept), 1.0 - residual / total, list(points))


def seconds_of(*settings: str, cases: int = 1) -> float:
    """Processor time [s] of simulating that many cases one after the other: the fastest of a few runs."""
    setup = load_setup(find_config("demo.toml"), Overrides(settings=settings))
    simulations = [make_simulation(setup, []) for _ in range(cases * REPEATS)]
    simulations[0].warm_up()
    best = float("inf")
    for n in range(REPEATS):
        begin = time.process_time()
        for simulation in simulations[n * cases : (n + 1) * cases]:
            for _ in simulation.blocks():
                pass
        best = min(best, time.process_time() - begin)
    return best


def with_time() -> Line:
    """Over simulated seconds."""
    return fit([(s, seconds_of(f"loop.duration_s={s}")) for s in (10.0, 20.0, 40.0, 80.0, 160.0)])


def with_memory() -> Line:
    """Over the observer's memory N [ticks] of the speed channel, for a run of fixed length."""
    points = []
    for n in (5, 10, 20, 40, 60):
        delay = f"observer.speed.delay_ms={float(n)}"
        points.append((float(n), seconds_of(f"loop.duration_s={MEMORY_S}", delay)))
    return fit(points)


def with_cases() -> Line:
    """Over the number of cases."""
    return fit([(float(n), seconds_of(f"loop.duration_s={CASE_S}", cases=n)) for n in (1, 2, 4, 8, 16)])


def _words(line: Line, what: str) -> str:
    return f"{1e3 * line.slope:.4g} ms for {what}, R^2 {line.r2:.5f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulate_scaling", description=__doc__)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    measured: dict[str, tuple[Callable[[], Line], str]] = {
        "simulated time": (with_time, "a simulated second"),
        "observer memory N": (with_memory, f"a tick of memory, for {MEMORY_S:g} simulated seconds"),
        "number of cases": (with_cases, f"a case of {CASE_S:g} s"),
    }
    lines = {name: (function(), what) for name, (function, what) in measured.items()}
    if args.json:
        out = {name: asdict(line) for name, (line, _) in lines.items()}
        sys.stdout.write(json.dumps(out | {"machine": machine_facts()}, indent=2) + "\n")
        return
    rows = {name: _words(line, what) for name, (line, what) in lines.items()}
    show(key_values("how hil simulate grows (processor time)", rows))


if __name__ == "__main__":
    main()
