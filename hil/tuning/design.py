"""`hil design`: from motor, rate, noise, spread and a wish to windows and poles, with what they will do.

The wish is a set of limits: noise in the command, Ms, dip, recovery. With a dip or a recovery wished for,
noise is made least; else the worst corner's IAE is. The front is the same design at other budgets of
noise. A soft shaft makes the design slower until it is stable on it, or it is refused. A drive with a current
loop of its own is commanded in A or N m; its loop and the filter of its speed are part of the plant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.control.law import LawSpec
from hil.errors import HilError
from hil.runtime.setup import Overrides, Setup
from hil.tuning.bench import bench_of, findings_of, lsb_of, spec_in, speed_drive, takes_voltage
from hil.tuning.families import Family, family, toml
from hil.tuning.measure import Bench, Elastic, margins, noise_text, quiet
from hil.tuning.optimise import Limits, Tuned, law_of, spec_of, tune
from hil.tuning.windows import figures, own_loop_figures

WINDOWS: Final = ("ftdob", "least-noise", "cubic")
"""What is tried when no law is named."""
BUDGETS: Final = (0.25, 0.5, 2.0, 4.0)
"""Noise in the command of the front's other points, times that of the design."""
NOISE_MV: Final = 100.0
NOISE_SHARE: Final = 0.01
"""Noise of a command that nothing else bounds: of a voltage, and of what an own loop's command may be."""
CHECKED_HZ: Final = 24
SEARCHED_HZ: Final = 8
SHAFT_REPAIRS: Final = 3
CHECK_S: Final = 4.0
AMPLIFIES: Final = 1.05
"""Peak |H| past which a window is one with a lead; of the others it is 1."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What is wished for; ``shaft_hz`` is one resonance or a range (low, high).

    ``command_noise`` [A or N m] is of a drive with its own current loop what ``u_noise_mv`` is of voltages.
    """

    u_noise_mv: float | None = None
    ms: float = 1.6
    ms_worst: float = 2.2
    dip: float | None = None
    recovery_ms: float | None = None
    shaft_hz: tuple[float, float] | None = None
    shaft_damping: float = 0.01
    shaft_share: float = 0.5
    laws: tuple[str, ...] = WINDOWS
    effort: float = 0.5
    command_noise: float | None = None

    @property
    def aims_at_noise(self) -> bool:
        """Whether noise is to be least, not IAE."""
        return self.dip is not None or self.recovery_ms is not None

    def limits(self, setup: Setup) -> Limits:
        """Of the search; NOISE_MV or NOISE_SHARE where nothing else bounds the noise. Raises HilError."""
        noise = noise_wished(setup, self.u_noise_mv, self.command_noise)
        if noise is None:
            own = NOISE_MV * 1e-3 if takes_voltage(setup) else NOISE_SHARE * setup.config.command.most
            noise = math.inf if self.aims_at_noise else own
        dip, recovery = (math.inf if wish is None else wish for wish in (self.dip, self.recovery_ms))
        return Limits(noise, self.ms, self.ms_worst, dip, recovery)

    def shafts(self, count: int) -> tuple[tuple[float, float, float], ...]:
        """The resonances to look at."""
        if self.shaft_hz is None:
            return ()
        low, high = self.shaft_hz
        hz = [low] if low == high else np.geomspace(low, high, count).tolist()
        return tuple((f, self.shaft_damping, self.shaft_share) for f in hz)


def noise_wished(setup: Setup, u_noise_mv: float | None, command_noise: float | None) -> float | None:
    """The noise that is wished for [V, A, N m]. Raises HilError for one in the unit of another drive."""
    voltage, command = takes_voltage(setup), setup.config.command
    if voltage and command_noise is not None:
        raise HilError("--command-noise: this drive takes voltages; give --u-noise-mv in mV")
    if not voltage and u_noise_mv is not None:
        raise HilError(
            f"--u-noise-mv: this drive takes a {command.takes}; give --command-noise in {command.unit}"
        )
    return command_noise if u_noise_mv is None else u_noise_mv * 1e-3


def _tune(
    one: Family, bench: Bench, limits: Limits, base: LawSpec, effort: float, aim: Any, start: Any
) -> Tuned:
    return tune(one, bench, limits, base, effort=effort, aim=aim, start=start)


def _best(found: Sequence[Tuned], noise: bool, unit: str) -> Tuned:
    """The best that keeps all limits. Raises HilError when none does."""
    kept = [one for one in found if one.feasible]
    if not kept:
        raise HilError(f"no design keeps these limits; {_why(found, unit)}")
    return min(kept, key=lambda one: one.verdict.u_noise if noise else one.verdict.worst.iae)


def _why(found: Sequence[Tuned], unit: str) -> str:
    """How near the nearest came."""
    if not any(one.verdict.worst.stable for one in found):
        return (
            "every design tried is unstable in a corner or on the shaft: narrow the spread, stiffen the shaft"
        )
    near = min(found, key=lambda one: one.verdict.worst.ms)
    v = near.verdict
    return (
        f"{near.family.law} came to {noise_text(v.u_noise, unit)}, Ms {v.nominal.ms:.2f}/{v.worst.ms:.2f}, "
        f"dip {v.nominal.dip:.2f} rad/s, back in {v.nominal.recovery_ms:.0f} ms: loosen one of them"
    )


def nothing() -> None:
    """Nothing to do meanwhile."""


def design(
    path: Path, overrides: Overrides, wish: Wish, given: dict[str, float | None], spread: dict[str, float],
    meanwhile: Callable[[], None] = nothing,
) -> tuple[dict[str, Any], Tuned]:  # fmt: skip
    """Find the design and its front. Raises HilError when none keeps the limits.

    ``meanwhile`` is called while workers search and a core is likely to be free.
    """
    setup = speed_drive(path, overrides)
    base, own = spec_in(setup), not takes_voltage(setup)
    bench = bench_of(path, setup, given, spread=spread, shafts=wish.shafts(SEARCHED_HZ))
    limits, families = wish.limits(setup), [family(name, own) for name in wish.laws]
    with ProcessPoolExecutor() as pool:
        best = _holding(families, bench, base, wish, limits, pool, meanwhile)
        free = wish.aims_at_noise or "u_noise" not in best.limits_it
        at = best.verdict.u_noise if free else limits.u_noise
        budgets = [
            replace(limits, u_noise=at * share, dip=math.inf, recovery_ms=math.inf) for share in BUDGETS
        ]
        jobs = [pool.submit(_tune, best.family, bench, b, base, wish.effort, "iae", best.x) for b in budgets]
        front = [best, *(job.result() for job in jobs)]
    spec = spec_of(best.tables, base)
    found = _result(best, front, spec, bench, np.array(lsb_of(setup)))
    findings = [*findings_of(setup), *leading(found["windows"])]
    found |= {"config": str(path), "wish": asdict(wish), "findings": findings}
    return found, best


def leading(windows: dict[str, dict[str, float]]) -> list[str]:
    """What is said of windows that amplify: they are tried only when they are named."""
    return [
        f"{name} window: peak |H| {own['peak_H']:.2f}: it amplifies noise and what is wrong in the model, "
        "so it is opt-in (--law); it was judged with the spread that was given, and bears little more"
        for name, own in windows.items()
        if own["peak_H"] > AMPLIFIES
    ]


def _holding(
    families: Sequence[Family], bench: Bench, base: LawSpec, wish: Wish, limits: Limits,
    pool: ProcessPoolExecutor, meanwhile: Callable[[], None],
) -> Tuned:  # fmt: skip
    """The best of the families, made to hold on the shafts.

    While the last family is searched that is begun with the best of the others, which mostly stays the best.
    """
    aim, noise = "noise" if wish.aims_at_noise else "iae", wish.aims_at_noise
    jobs = [pool.submit(_tune, f, bench, limits, base, wish.effort, aim, None) for f in families[::-1]]
    ahead: tuple[Tuned, Future[Tuned]] | None = None
    for _ in as_completed(jobs):
        found = [job.result() for job in jobs[::-1] if job.done()]
        if len(found) == len(jobs) - 1 and any(one.feasible for one in found):
            early = _best(found, noise, bench.unit)
            ahead = early, pool.submit(_on_the_shafts, early, bench, base, wish, limits)
    best = _best([job.result() for job in jobs[::-1]], noise, bench.unit)
    meanwhile()
    if ahead and best.family is ahead[0].family:
        return ahead[1].result()
    return _on_the_shafts(best, bench, base, wish, limits)


def _on_the_shafts(best: Tuned, bench: Bench, base: LawSpec, wish: Wish, limits: Limits) -> Tuned:
    """The design, slower for resonances between those of the search. Raises HilError when none holds."""
    aim: Any = "noise" if wish.aims_at_noise else "iae"
    for _ in range(SHAFT_REPAIRS):
        bad = _unstable(best, bench, base, wish)
        if not bad:
            return best
        bench = replace(bench, shafts=(*bench.shafts, *bad))
        again = tune(best.family, bench, limits, base, effort=wish.effort, aim=aim, start=best.x)
        best = _best([again], wish.aims_at_noise, bench.unit)
    if bad := _unstable(best, bench, base, wish):
        raise HilError(
            "unstable in a corner on a shaft with half the damping and resonance at "
            f"{', '.join(f'{one[0]:.0f}' for one in bad)} Hz: "
            f"wish for less ({'--u-noise-mv' if bench.inner is None else '--command-noise'}, --ms), stiffen "
            "or damp the shaft"
        )
    return best


def _unstable(best: Tuned, bench: Bench, base: LawSpec, wish: Wish) -> list[Elastic]:
    """The shafts on which it is unstable in a corner, on a finer grid and for longer than the search."""
    law = law_of(best.tables, base, bench.T_s)
    fine = [
        (one, replace(bench, shafts=(one,)).shaft_places()) for one in wish.shafts(CHECKED_HZ) or bench.shafts
    ]
    return [one for one, places in fine if not all(quiet(law, bench, places, CHECK_S))]


def _front(found: Sequence[Tuned]) -> list[Tuned]:
    """By noise; a point that buys nothing with its noise is left out."""
    kept: list[Tuned] = []
    for one in sorted((one for one in found if one.feasible), key=lambda one: one.verdict.u_noise):
        if not kept or one.verdict.worst.iae < kept[-1].verdict.worst.iae * 0.995:
            kept.append(one)
    return kept


def _result(best: Tuned, front: Sequence[Tuned], spec: LawSpec, bench: Bench, lsb: Any) -> dict[str, Any]:
    """The JSON form of a design."""
    law, verdict = law_of(best.tables, spec, bench.T_s), best.verdict
    points = _front(front)
    return {
        "law": best.family.law,
        "tables": best.tables,
        "poles": {key: value for key, value in best.tables["controller"].items() if key != "kind"},
        "windows": figures(spec, bench, lsb) if bench.inner is None else own_loop_figures(law, bench, lsb),
        **verdict.as_dict(bench.unit),
        "margins": margins(law, bench, bench.plant(bench.motor)),
        "limited_by": list(best.limits_it),
        "bench": asdict(bench),
        "front": [{"toml": toml(one.tables), **one.verdict.as_dict(bench.unit)} for one in points],
        "toml": toml(best.tables),
    }
