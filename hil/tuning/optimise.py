"""The optimiser, the same for every law: least worst-corner IAE under limits on noise and sensitivity.

Differential evolution over the logarithms of the free numbers, feasible before infeasible (Deb's rule), then
Nelder and Mead. The corners that decide are found as it goes: it begins with a few, judges the result by all,
and takes up the corner that broke a limit. Seeded: the same wish gives the same design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np
from scipy.optimize import differential_evolution, minimize

from hil.control.errors import ControlDesignError
from hil.control.law import ChannelSpec, LawSpec, design_law
from hil.control.linalg import Array
from hil.control.registry import complete, laws, observers
from hil.tuning.families import Family, Tables
from hil.tuning.loop import Plant, Record
from hil.tuning.measure import (
    Bench,
    Place,
    Verdict,
    judge,
    loops,
    noise,
    on_shaft,
    quiet,
    worst_of,
)

SLACK: Final = 0.002
"""Share by which a limit may be exceeded: below what its measure is exact to."""
FIRST_CORNERS: Final = 4
REPAIRS: Final = 3


@dataclass(frozen=True, slots=True)
class Limits:
    """Largest noise in the command [V, A, N m], Ms, that of the worst corner, dip [rad/s], recovery [ms]."""

    u_noise: float = math.inf
    ms: float = math.inf
    ms_worst: float = math.inf
    dip: float = math.inf
    recovery_ms: float = math.inf

    def excess(
        self, u: float, ms: float, ms_worst: float, dip: float, recovery_ms: float
    ) -> dict[str, float]:
        """By which share each is exceeded."""
        found = {"u_noise": u, "ms": ms, "ms_worst": ms_worst, "dip": dip, "recovery_ms": recovery_ms}
        return {name: max(0.0, value / getattr(self, name) - 1) for name, value in found.items()}


@dataclass(frozen=True, slots=True)
class Tuned:
    """A tuned law: its free numbers, tables, measures; ``feasible`` when it keeps every limit."""

    family: Family
    x: Array
    tables: Tables
    verdict: Verdict
    feasible: bool
    limits_it: tuple[str, ...]


def law_of(tables: Tables, base: LawSpec, T_s: float) -> Record:
    """The law's record for the tables, limits and motor as ``base`` has them. Raises ControlDesignError."""
    return design_law(spec_of(tables, base), T_s)


@dataclass(slots=True)
class _Search:
    """One law's search; ``corners`` are the plants that its cost looks at."""

    family: Family
    bench: Bench
    limits: Limits
    make: Any
    aim: str = "iae"
    best: float = math.inf
    corners: list[Plant] = field(default_factory=list)
    seen: dict[tuple[float, ...], float] = field(default_factory=dict)
    ringing: dict[tuple[float, ...], float] = field(default_factory=dict)
    nominal: Plant = field(init=False)
    every: list[Plant] = field(init=False)
    shafts: list[Place] = field(init=False)

    def __post_init__(self) -> None:
        self.nominal, *self.every = self.bench.plants()
        self.shafts = self.bench.shaft_places()

    def numbers(self, y: Array) -> Array:
        """Free numbers from their logarithms, ticks whole."""
        x: Array = np.exp(y)
        for index in self.family.whole:
            x[index] = max(1.0, round(x[index]))
        return x

    def law(self, y: Array) -> Record:
        """The record of a candidate. Raises ControlDesignError."""
        record: Record = self.make(self.family.tables(self.numbers(y).tolist(), self.bench))
        return record

    def cost(self, y: Array) -> float:
        """Worst IAE in the corners looked at; 10 and more for what breaks a limit, by how much."""
        key = self.key(y)
        if key not in self.seen:
            self.seen[key] = self._cost(y)
        return self.seen[key]

    def key(self, y: Array) -> tuple[float, ...]:
        """What tells one candidate from another."""
        return tuple(np.round(self.numbers(y), 9))

    def rings(self, y: Array, law: Record) -> float:
        """The share of the shafts' places in which it vibrates on; asked once of each candidate."""
        key = self.key(y)
        if key not in self.ringing:
            calm = quiet(law, self.bench, self.shafts)
            self.ringing[key] = calm.count(False) / max(len(calm), 1)
        return self.ringing[key]

    def _cost(self, y: Array) -> float:
        try:
            law = self.law(y)
        except ControlDesignError:
            return 1e6
        nominal = loops(law, self.bench, [self.nominal])[0]
        if not nominal.stable:
            return 1e5
        if self.bench.elastic:
            nominal = on_shaft(law, self.bench, self.bench.motor, self.bench.shafts[0], nominal)
        u, _ = noise(law, self.bench)
        first = self._over(u, nominal, nominal)
        if not math.isfinite(u) or first > 0.3:
            return 1e3 * (1 + min(first, 50.0))
        every = [nominal, *loops(law, self.bench, self.corners)]
        unstable = sum(not loop.stable for loop in every)
        if unstable:
            return 1e4 * (1 + unstable)
        over = self._over(u, nominal, worst_of(every))
        if over > SLACK:
            return 10.0 * (1 + over)
        value = min(u, 9.0) if self.aim == "noise" else min(worst_of(every).iae / self._scale, 9.0)
        if value < self.best:  # what is not the best need not be asked whether it may be
            if rings := self.rings(y, law):
                return 20.0 + 10.0 * rings
            self.best = value
        return value

    def _over(self, u: float, nominal: Any, worst: Any) -> float:
        return sum(self.limits.excess(u, nominal.ms, worst.ms, nominal.dip, nominal.recovery_ms).values())

    @property
    def _scale(self) -> float:
        """IAE of the order of one: so that it stays below 10, the least cost of what is not allowed."""
        return max(self.bench.load / self.bench.motor.J * self.bench.T_s, 1e-9) * 10

    def bounds(self) -> list[tuple[float, float]]:
        """Of the logarithms."""
        return [(math.log(low), math.log(high)) for low, high in self.family.free]

    def take_up(self, verdicts: Sequence[Any]) -> bool:
        """Look at the corners that are worst in IAE and Ms too; False when none is new."""
        before = len(self.corners)
        for name in ("iae", "ms"):
            worst = self.every[max(range(len(verdicts)), key=lambda j: getattr(verdicts[j], name))]
            if all(worst is not corner for corner in self.corners):
                self.corners.append(worst)
        return len(self.corners) > before


def _evolve(search: _Search, effort: float, start: Array | None, seed: int) -> Array:
    """The best logarithms."""
    bounds = search.bounds()
    if start is None:
        found = differential_evolution(
            search.cost, bounds, seed=seed, popsize=max(4, round(8 * effort)), maxiter=round(22 * effort),
            tol=1e-4, polish=False, init="sobol",
        )  # fmt: skip
        start = found.x
    return _polish(search, start, round(60 * effort))


def _polish(search: _Search, start: Array, evaluations: int) -> Array:
    """Nelder and Mead from there, and from the neighbours in whole ticks."""
    bounds = search.bounds()
    options = {"maxfev": evaluations, "xatol": 1e-3, "fatol": 1e-6, "initial_simplex": _simplex(start)}
    found = minimize(search.cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    y: Array = found.x if found.fun <= search.cost(start) else start
    return y


def _simplex(start: Array) -> Array:
    """Corners 12 % apart: over at least a tick of windows of 8 and more."""
    return np.vstack([start, start + 0.12 * np.eye(len(start))])


def tune(
    family: Family,
    bench: Bench,
    limits: Limits,
    base: LawSpec,
    *,
    effort: float = 1.0,
    aim: Literal["iae", "noise"] = "iae",
    start: Array | None = None,
    seed: int = 1,
) -> Tuned:
    """Tune one law; ``start`` (free numbers) spares the evolution, ``aim`` is what is made least.

    Raises ControlDesignError when nothing that was tried can be designed.
    """
    search = _Search(family, bench, limits, lambda tables: law_of(tables, base, bench.T_s), aim)
    search.corners = _decisive(search)
    y = _evolve(search, effort, None if start is None else np.log(start), seed)
    for _ in range(REPAIRS):
        every = loops(search.law(y), bench, search.every)
        if not search.take_up(every):
            break
        search.seen.clear()
        search.best = math.inf
        y = _polish(search, y, round(80 * effort))
    x = search.numbers(y)
    law = search.law(y)
    verdict = judge(law, bench)
    used = _use(verdict, limits)
    calm = not search.rings(y, law)
    near = tuple(name for name, share in used.items() if share > 0.985)
    return Tuned(
        family,
        x,
        family.tables(x.tolist(), bench),
        verdict,
        max(used.values()) <= 1 + 2 * SLACK and calm,
        near,
    )


def _use(verdict: Verdict, limits: Limits) -> dict[str, float]:
    """Which share of each limit is used."""
    n = verdict.nominal
    found = {"u_noise": verdict.u_noise, "ms": n.ms, "ms_worst": verdict.worst.ms, "dip": n.dip}
    found["recovery_ms"] = n.recovery_ms
    return {name: value / getattr(limits, name) for name, value in found.items()}


def _decisive(search: _Search) -> list[Plant]:
    """Corners to begin with: those in which the plant's gain of command to speed is largest and least."""
    gain = [float(plant.A[0, 1] * plant.b[1]) for plant in search.every]
    order = np.argsort(gain)
    half = FIRST_CORNERS // 2
    return [search.every[j] for j in (*order[:half], *order[len(order) - half :])] if len(order) else []


def spec_of(tables: Tables, base: LawSpec) -> LawSpec:
    """``base`` with another law and other observers; one that is given for the speed alone is of both."""
    controller = tables["controller"]
    law = complete(controller, laws()[controller["kind"]])
    speed, current = (_channel(tables.get(name, tables["speed"])) for name in ("speed", "current"))
    return replace(base, kind=controller["kind"], more=law, speed=speed, current=current)


def _channel(table: Mapping[str, Any]) -> ChannelSpec:
    return ChannelSpec(table["kind"], more=complete(table, observers()[table["kind"]]))
