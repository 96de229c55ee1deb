"""Whether a notch in the command pays on a soft shaft: the same search with and without one.

    python -m benchmarks.notch [CONFIG] [--shaft 60,120,200] [--generations 40]

Cascade over cubic windows in the linear loop of `hil design` (Ms 1.6, worst corner 2.2, 100 mV, 16 corners of
+-30 %, stable with half of the damping on the shaft, axes at rest), least worst-corner IAE. The notch is
    (s^2 + 2 z d w s + w^2) / (s^2 + 2 d w s + w^2)
sampled with its frequency exact, w at 0.8 to 1.25 times the resonance, width d and depth z free; the
observer is told what comes out of it. Of a shaft range LOW-HIGH its ends and its middle have to be stable.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import differential_evolution

from hil.config.shipped import find_config
from hil.control.errors import ControlDesignError
from hil.control.jit import jit
from hil.control.law import apply, command, new_law_state, observe, reset
from hil.control.linalg import Array
from hil.runtime.setup import Overrides
from hil.tuning.bench import bench_of, spec_in, speed_drive
from hil.tuning.families import family
from hil.tuning.loop import KICK, LOAD, NO_LIMIT, PULSE_I, PULSE_U, PULSE_W, QUIET, Plant, rigid, shaft, step
from hil.tuning.measure import RESTLESS, SPARE, Bench, free
from hil.tuning.optimise import law_of
from hil.tuning.sensitivity import peak_of

MS, MS_WORST, NOISE_V, DAMPING = 1.6, 2.2, 0.1, 0.01
VIBRATES: Final = 9
"""Kind of :func:`run` that begins with a kick."""
NOTCH: Final = ((0.8, 1.25), (0.05, 1.0), (0.02, 1.0))
"""Bounds of its frequency over the resonance, its width and its depth; of depth 1 it is none."""


def biquad(hz: float, width: float, depth: float, T_s: float) -> Array:
    """b0, b1, b2, a1, a2 of the notch, by the bilinear transform that keeps its frequency."""
    c = 1.0 / math.tan(math.pi * hz * T_s)
    over, under = (c * c + 2 * d * c + 1 for d in (depth * width, width))
    middle, ends = 2 * (1 - c * c), (c * c - 2 * depth * width * c + 1, c * c - 2 * width * c + 1)
    return np.array([over, middle, ends[0], middle, ends[1]]) / under


@jit
def run(p: Any, s: Any, A: Array, b: Array, e: Array, notch: Array, kind: int, out: Array) -> None:
    """Speed, voltage that acts and voltage after the notch (3, K), as :func:`hil.tuning.loop.respond`."""
    n, K = A.shape[0], out.shape[1]
    x, new = np.zeros(n), np.zeros(n)
    reset(s)
    apply(s, 0.0, 0.0, 0.0)
    u, first, second, rest = 0.0, 0.0, 0.0, QUIET
    if kind == VIBRATES:
        x[0], rest = KICK, 0
    for k in range(-rest, K):
        w = x[0] + (1.0 if kind == PULSE_W and k == 0 else 0.0)
        i_q = x[1] + (1.0 if kind == PULSE_I and k == 0 else 0.0)
        observe(p, s, w, i_q, 0.0, True, 1)
        apply(s, 0.0, u, 0.0)
        command(p, s, 0.0, 0.0, 0.0, NO_LIMIT)
        asked = s["u"][1]
        given = u + (1.0 if kind == PULSE_U and k == 0 else 0.0)
        u = notch[0] * asked + first
        first = notch[1] * asked - notch[3] * u + second
        second = notch[2] * asked - notch[4] * u
        load = 1.0 if kind == LOAD and k >= 0 else 0.0
        if k >= 0:
            out[0, k], out[1, k], out[2, k] = x[0], given, u
        step(A, b, e, given, load, x, new)


class Search:
    """Cost of a candidate on one shaft; ``hz`` are the resonances on which it has to be stable."""

    def __init__(self, path: Path, hz: Sequence[float], notched: bool) -> None:
        setup = speed_drive(path, Overrides())
        self.bench: Bench = bench_of(path, setup)
        self.base, self.family, self.notched = spec_in(setup), family("cubic"), notched
        self.middle = math.sqrt(min(hz) * max(hz))
        motors, T_s = (self.bench.motor, *self.bench.corners()), self.bench.T_s
        self.plants = [rigid(motor, T_s) for motor in motors]
        self.soft = [shaft(motor, T_s, f, SPARE * DAMPING) for motor in motors for f in hz]
        self.state = new_law_state()[0]
        self.found: dict[str, float] = {}

    def bounds(self) -> list[tuple[float, float]]:
        """Of the logarithms."""
        free_numbers = (*self.family.free, *(NOTCH if self.notched else ()))
        return [(math.log(low), math.log(high)) for low, high in free_numbers]

    def cost(self, y: Array) -> float:
        """Worst IAE; 1e3 and more for what breaks a limit, by how much."""
        x = np.exp(y)
        x[2:4] = np.maximum(1.0, np.round(x[2:4]))
        try:
            law = free(law_of(self.family.tables(x[:4].tolist(), self.bench), self.base, self.bench.T_s))[0]
        except ControlDesignError:
            return 1e9
        notch = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
        if self.notched:
            notch = biquad(self.middle * x[4], x[5], x[6], self.bench.T_s)
        with np.errstate(over="ignore", invalid="ignore"):
            return self.judged(law, notch, x)

    def judged(self, law: Any, notch: Array, x: Array) -> float:
        """Of :meth:`cost`."""
        rows = [self.loop(law, notch, plant) for plant in self.plants]
        unstable = sum(row is None for row in rows)
        if unstable:
            return 1e6 * (1 + unstable)
        dips, iaes, peaks = (np.array(column) for column in zip(*(row for row in rows if row), strict=True))
        noise = self.noise(law, notch)
        over = max(0.0, peaks[0] / MS - 1) + max(0.0, peaks.max() / MS_WORST - 1)
        over += max(0.0, noise / NOISE_V - 1)
        if over > 0.002:
            return 1e3 * (1 + over)
        rings = sum(self.rings(law, notch, plant) for plant in self.soft)
        if rings:
            return 500.0 + 400.0 * rings / len(self.soft)
        cost = float(iaes.max())
        if cost < self.found.get("worst_iae", math.inf):
            names = ("speed_pole", "current_pole", "N_w", "N_c", "notch_hz", "width", "depth")
            own = dict(zip(names, x.tolist(), strict=False))
            self.found = {"worst_iae": cost, "dip": dips[0], "worst_dip": dips.max(), "ms": peaks[0]}
            self.found |= {"ms_worst": peaks.max(), "u_noise_mv": noise * 1e3, **own}
        return cost

    def loop(self, law: Any, notch: Array, plant: Plant) -> tuple[float, float, float] | None:
        """Dip, IAE and Ms; None where it is unstable."""
        step, pulse = np.empty((2, 3, self.bench.ticks))
        for kind, out in ((LOAD, step), (PULSE_U, pulse)):
            run(law, self.state, plant.A, plant.b, plant.e, notch, kind, out)
        error, tail = np.abs(step[0]) * self.bench.load, self.bench.ticks // 10
        if not (np.isfinite(error).all() and np.isfinite(pulse).all()):
            return None
        if error[-tail:].max() > RESTLESS * error.max() or np.abs(pulse[1, -tail:]).max() > 0.01:
            return None
        return float(error.max()), float(error.sum() * self.bench.T_s), peak_of(pulse[1])

    def noise(self, law: Any, notch: Array) -> float:
        """Noise of u_q [V] at rest."""
        b, total, out = self.bench, 0.0, np.empty((3, self.bench.ticks))
        for kind, sigma in ((PULSE_W, b.w_noise), (PULSE_I, b.i_noise), (PULSE_U, b.u_noise)):
            run(law, self.state, *_parts(self.plants[0]), notch, kind, out)
            total += sigma**2 * float((out[2] ** 2).sum())
        return math.sqrt(total)

    def rings(self, law: Any, notch: Array, plant: Plant) -> bool:
        """Whether the vibration after a kick does not die away."""
        out = np.empty((3, 1200))
        run(law, self.state, *_parts(plant), notch, VIBRATES, out)
        before, after = np.std(out[0, 400:800]), np.std(out[0, 800:])
        return not (after < before or after < 1e-8)


def _parts(plant: Plant) -> tuple[Array, Array, Array]:
    return plant.A, plant.b, plant.e


def searched(path: Path, hz: Sequence[float], notched: bool, generations: int) -> dict[str, Any]:
    """The best of one search."""
    search = Search(path, hz, notched)
    differential_evolution(
        search.cost, search.bounds(), seed=1, popsize=8, maxiter=generations, tol=1e-6, polish=False
    )
    return {"shaft_hz": list(hz), "notch": notched, **search.found}


def shafts(text: str) -> list[list[float]]:
    """Each resonance, or three of each range LOW-HIGH."""
    ends = [[float(value) for value in part.split("-")] for part in text.split(",")]
    return [np.geomspace(*pair, 3).tolist() if len(pair) == 2 else pair for pair in ends]


def main() -> int:
    """Run it all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", nargs="?", default="demo.toml")
    parser.add_argument("--shaft", default="60,120,200,100-140")
    parser.add_argument("--generations", type=int, default=40)
    args = parser.parse_args()
    path, every = find_config(args.config), shafts(args.shaft)
    with ProcessPoolExecutor(2) as pool:
        cases = [(hz, notched) for hz in every for notched in (False, True)]
        jobs = [pool.submit(searched, path, *case, args.generations) for case in cases]
        for job in jobs:
            sys.stdout.write(json.dumps(job.result()) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
