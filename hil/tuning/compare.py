"""`hil compare`: laws, each tuned by the same optimiser to the same limits, then run on the same seeds.

Tuned on the linear loop (:mod:`hil.tuning.loop`), judged in `hil simulate`: dip, recovery, IAE and noise are
those of the simulated load step, the mean over the seeds; the worst dip is that of every corner of the
spread. Ms is the linear loop's. Every law sees the same seeds, so differences are of the laws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import HilError
from hil.runtime.setup import Overrides
from hil.sim.emulate import load_plant
from hil.tuning.bench import bench_of, plant_settings, simulated, spec_in, speed_drive
from hil.tuning.design import noise_wished
from hil.tuning.families import DEFAULT_LAWS, OWN_LOOP, Family, family, settings_of, toml
from hil.tuning.measure import Bench, judge, noise_in
from hil.tuning.optimise import Limits, Tuned, tune

AS_CONFIGURED = "as-configured"
"""The row of the configuration itself, as it is."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What to compare by: limits of the command line (None: those of the config itself), spread, seeds."""

    u_noise_mv: float | None = None
    ms: float | None = None
    ms_worst: float | None = None
    spread: float = 0.3
    seeds: int = 3
    effort: float = 1.5
    command_noise: float | None = None


def default_laws(own_loop: bool) -> list[str]:
    """What is compared when nothing is named."""
    return [name for name in DEFAULT_LAWS if not own_loop or name in OWN_LOOP]


def parse_laws(text: str, own_loop: bool = False) -> list[Family]:
    """The families of ``a,b,c``. Raises HilError for an unknown one, a repeated one and none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    found = [family(name, own_loop) for name in names]
    if not found or len({one.law for one in found}) != len(found):
        raise HilError(f"--laws: {text!r} names no law, or one twice")
    return found


def limits_of(wish: Wish, own: Any, given: float | None) -> Limits:
    """The limits for every law, ``given`` that of noise; the configuration itself tells what is left open."""

    def or_own(given: float | None, value: float, name: str) -> float:
        if given is None and not math.isfinite(value):
            raise HilError(f"the configuration itself is unstable in a corner: give --{name}")
        return value if given is None else given

    ms, ms_worst = or_own(wish.ms, own.nominal.ms, "ms"), or_own(wish.ms_worst, own.worst.ms, "ms-worst")
    return Limits(own.u_noise if given is None else given, ms, ms_worst)


def run_row(path: Path, overrides: Overrides, bench: Bench, seeds: Sequence[int]) -> dict[str, Any]:
    """One law in `hil simulate`: the mean over the seeds, and the worst corner with the first of them."""
    runs = [simulated(path, overrides, [f"seed={seed}"]) for seed in seeds]
    corners = [
        simulated(path, overrides, [f"seed={seeds[0]}", *plant]) for plant in plant_settings(bench)[1:]
    ]
    mean = {
        name: float(np.mean([getattr(run, name) for run in runs])) for name in ("dip", "recovery_ms", "iae")
    }
    return {
        **mean,
        **noise_in(bench.unit, float(np.mean([run.u_noise for run in runs]))),
        "worst_dip": max((run.dip for run in corners), default=mean["dip"]),
        "worst_recovery_ms": max((run.recovery_ms for run in corners), default=mean["recovery_ms"]),
        "dips": [run.dip for run in runs],
        "ended": next(
            (run.ended for run in (*runs, *corners) if run.ended != "stop_requested"), "stop_requested"
        ),
    }


def _tuned_row(
    path: Path, overrides: Overrides, one: Family, bench: Bench, limits: Limits, wish: Wish, seeds: list[int]
) -> dict[str, Any]:
    """Tune a law and run it."""
    setup = speed_drive(path, overrides)
    found = tune(one, bench, limits, spec_in(setup), effort=wish.effort)
    settings = settings_of(found.tables)
    seen = run_row(path, replace(overrides, settings=(*overrides.settings, *settings)), bench, seeds)
    return _row(one.law, one.doc, found, seen, bench.unit)


def _row(law: str, doc: str, found: Tuned, seen: dict[str, Any], unit: str) -> dict[str, Any]:
    linear = found.verdict.as_dict(unit)
    return {
        "law": law,
        "what": doc,
        **seen,
        "ms": linear["ms"],
        "ms_worst": linear["ms_worst"],
        "feasible": found.feasible,
        "limited_by": list(found.limits_it),
        "linear": linear,
        "toml": toml(found.tables),
    }


def compare(
    path: Path,
    overrides: Overrides,
    families: Sequence[Family],
    wish: Wish,
    seen: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Tune and run every law, on all cores; ``seen`` is told how many are done. Raises HilError."""
    setup = speed_drive(path, overrides)
    share = dict.fromkeys(("J", "psi_f", "R_s", "L"), wish.spread)
    bench = bench_of(path, setup, spread=share)
    plant, _ = load_plant(path, setup.config)
    seeds = [plant.seed + j for j in range(wish.seeds)]
    own = judge(setup.machine.law, bench)
    limits = limits_of(wish, own, noise_wished(setup, wish.u_noise_mv, wish.command_noise))
    itself = {
        "law": AS_CONFIGURED,
        "what": "the configuration as it is",
        **run_row(path, overrides, bench, seeds),
    }
    itself |= {"ms": own.nominal.ms, "ms_worst": own.worst.ms, "linear": own.as_dict(bench.unit)}
    rows = []
    with ProcessPoolExecutor() as pool:
        jobs = [pool.submit(_tuned_row, path, overrides, f, bench, limits, wish, seeds) for f in families]
        for job in jobs:
            rows.append(job.result())
            if seen:
                seen(len(rows))
    return {
        "config": str(path),
        "limits": {**noise_in(bench.unit, limits.u_noise), "ms": limits.ms, "ms_worst": limits.ms_worst},
        "bench": asdict(bench),
        "seeds": seeds,
        "as_configured": itself,
        "rows": rows,
    }
