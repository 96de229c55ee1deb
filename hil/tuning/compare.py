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

from hil.config.design import law_spec
from hil.errors import HilError
from hil.runtime.setup import Overrides
from hil.sim.emulate import load_plant
from hil.tuning.bench import bench_of, corner_settings, simulated, speed_drive
from hil.tuning.families import Family, family, settings_of, toml
from hil.tuning.measure import Bench, judge
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


def parse_laws(text: str) -> list[Family]:
    """The families of ``a,b,c``. Raises HilError for an unknown one, a repeated one and none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    found = [family(name) for name in names]
    if not found or len({one.law for one in found}) != len(found):
        raise HilError(f"--laws: {text!r} names no law, or one twice")
    return found


def limits_of(wish: Wish, own: Any) -> Limits:
    """The limits for every law; what the wish leaves open is what the configuration itself reaches."""

    def or_own(given: float | None, value: float, name: str) -> float:
        if given is None and not math.isfinite(value):
            raise HilError(f"the configuration itself is unstable in a corner: give --{name}")
        return value if given is None else given

    u_mv = or_own(wish.u_noise_mv, own.u_noise * 1e3, "u-noise-mv")
    return Limits(
        u_mv * 1e-3, or_own(wish.ms, own.nominal.ms, "ms"), or_own(wish.ms_worst, own.worst.ms, "ms-worst")
    )


def run_row(path: Path, overrides: Overrides, bench: Bench, seeds: Sequence[int]) -> dict[str, Any]:
    """One law in `hil simulate`: the mean over the seeds, and the worst corner with the first of them."""
    runs = [simulated(path, overrides, [f"seed={seed}"]) for seed in seeds]
    corners = [simulated(path, overrides, [f"seed={seeds[0]}", *plant]) for plant in corner_settings(bench)]
    mean = {
        name: float(np.mean([getattr(run, name) for run in runs])) for name in ("dip", "recovery_ms", "iae")
    }
    return {
        **mean,
        "u_noise_mv": float(np.mean([run.u_noise for run in runs])) * 1e3,
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
    found = tune(one, bench, limits, law_spec(setup.config), effort=wish.effort)
    settings = settings_of(found.tables)
    seen = run_row(path, replace(overrides, settings=(*overrides.settings, *settings)), bench, seeds)
    return _row(one.law, one.doc, found, seen)


def _row(law: str, doc: str, found: Tuned, seen: dict[str, Any]) -> dict[str, Any]:
    linear = found.verdict.as_dict()
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
    limits = limits_of(wish, own)
    itself = {
        "law": AS_CONFIGURED,
        "what": "the configuration as it is",
        **run_row(path, overrides, bench, seeds),
    }
    itself |= {"ms": own.nominal.ms, "ms_worst": own.worst.ms, "linear": own.as_dict()}
    rows = []
    with ProcessPoolExecutor() as pool:
        jobs = [pool.submit(_tuned_row, path, overrides, f, bench, limits, wish, seeds) for f in families]
        for job in jobs:
            rows.append(job.result())
            if seen:
                seen(len(rows))
    return {
        "config": str(path),
        "limits": {"u_noise_mv": limits.u_noise * 1e3, "ms": limits.ms, "ms_worst": limits.ms_worst},
        "bench": asdict(bench),
        "seeds": seeds,
        "as_configured": itself,
        "rows": rows,
    }
