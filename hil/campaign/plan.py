"""The plan of a campaign: what is varied, and the settings of case number i as a function of i alone.

    case = (((variant . grid) . corner) . row of the list) . sample,   the sample running fastest

So every sample of [random], [lhs] and [sobol] meets every variant, grid point and corner: what differs
between two laws is a paired difference over the same motors, loads and noise.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from hil.campaign.normal import normal, root
from hil.campaign.values import FORMS, NAMES, Distribution, corners, distribution, number
from hil.config.table import Table
from hil.config.tables import validate
from hil.config.toml import read_toml
from hil.errors import ConfigError

PLANT: Final = "plant:"
MOST_CASES: Final = 100_000_000
MOST_LHS: Final = 20_000_000
"""Numbers of a Latin hypercube: it is one permutation of all samples, so each worker holds all of it."""
MOST_CORNERS: Final = 20
F8 = npt.NDArray[np.float64]
Method = Literal["random", "lhs", "sobol"]
METHODS: Final[tuple[Method, ...]] = ("random", "lhs", "sobol")
Settings = dict[str, Any]
Axes = dict[str, Any]


class CovarianceTable(Table):
    """Keys that vary together, normal with a covariance; ``mean`` left out: the config's own values."""

    keys: Annotated[list[str], Field(min_length=1)]
    """The keys that vary together."""
    covariance: list[list[float]]
    """Their covariance: symmetric, in the keys' units."""
    mean: list[float] | None = None
    """Their means; left out: the values of the configuration."""


class PlanTable(Table):
    """A plan as it stands in its file."""

    config: str
    """Path of the run's configuration, relative to this file."""
    name: str = ""
    """Name of the campaign, for its report."""
    samples: int | None = None
    """How many samples to draw; needed by [random], [lhs], [sobol] and [[covariance]]."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """Seed of all draws."""
    settings: Annotated[list[str], Field(alias="set", default_factory=list)]
    """Keys of the run's configuration for all cases, as --set."""
    plant_set: Annotated[list[str], Field(default_factory=list)]
    """Keys of the plant for all cases, as --plant-set."""
    grid: Annotated[Axes, Field(default_factory=dict)]
    """Every combination of these lists of values, by key."""
    rows: Annotated[Axes, Field(alias="list", default_factory=dict)]
    """Lists of one length, gone through side by side, by key."""
    corners: Annotated[Axes, Field(default_factory=dict)]
    """Every combination of low and high, by key."""
    random: Annotated[Axes, Field(default_factory=dict)]
    """Distributions that are drawn independently, by key."""
    lhs: Annotated[Axes, Field(default_factory=dict)]
    """Distributions that are drawn as a Latin hypercube, by key."""
    sobol: Annotated[Axes, Field(default_factory=dict)]
    """Distributions that are drawn along Sobol's sequence, by key."""
    covariance: Any = None
    """Keys that vary together: keys, covariance, mean."""
    variants: Annotated[dict[str, Axes], Field(default_factory=dict)]
    """Bundles of settings to compare, by name."""
    criteria: Annotated[Axes, Field(default_factory=dict)]
    """Criteria in place of those of the configuration."""


@dataclass(frozen=True, slots=True)
class Correlated:
    """Normal keys with a covariance: x = mean + ``root`` z."""

    keys: tuple[str, ...]
    mean: tuple[float, ...]
    root: tuple[tuple[float, ...], ...]

    def at(self, u: F8) -> Settings:
        """The values for one row of uniforms, one for each key."""
        z = [normal(x) for x in u.tolist()]
        spread = (math.fsum(a * b for a, b in zip(row, z, strict=True)) for row in self.root)
        return {key: mean + more for key, mean, more in zip(self.keys, self.mean, spread, strict=True)}


@dataclass(frozen=True)
class Plan:
    """A plan that can be: every axis as values or a distribution."""

    name: str
    seed: int
    samples: int | None
    fixed: Settings = field(default_factory=dict)
    variants: tuple[tuple[str, Settings], ...] = ()
    grid: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    corners: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    rows: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    draws: Mapping[Method, Mapping[str, Distribution]] = field(default_factory=dict)
    correlated: tuple[Correlated, ...] = ()

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Lengths of all axes but the samples, the slowest first."""
        rows = [len(values) for values in list(self.rows.values())[:1]]
        crossed = [len(values) for values in (*self.grid.values(), *self.corners.values())]
        return (max(1, len(self.variants)), *crossed, *rows)

    @cached_property
    def count(self) -> int:
        """How many cases there are."""
        return math.prod(self.sizes) * (1 if self.samples is None else self.samples)

    @cached_property
    def keys(self) -> list[str]:
        """Every key that a case may set, in the order of the columns."""
        out: dict[str, None] = {}
        for _, settings in self.variants:
            out |= dict.fromkeys(settings)
        out |= dict.fromkeys([*self.grid, *self.corners, *self.rows])
        for method in METHODS:
            out |= dict.fromkeys(self.draws.get(method, {}))
        return [*out, *(key for group in self.correlated for key in group.keys)]

    def listed(self) -> dict[str, list[Any]]:
        """For each key the values that it takes; of a distribution its middle and both ends."""
        out: dict[str, list[Any]] = {}
        for _, settings in self.variants:
            for key, value in settings.items():
                out.setdefault(key, []).append(value)
        for axes in (self.grid, self.corners, self.rows):
            out |= {key: list(values) for key, values in axes.items()}
        for method in METHODS:
            out |= {key: axis.probes() for key, axis in self.draws.get(method, {}).items()}
        for group in self.correlated:
            out |= {key: [mean] for key, mean in zip(group.keys, group.mean, strict=True)}
        return out

    def split(self, case: int) -> tuple[tuple[int, ...], int]:
        """Place on each axis of :attr:`sizes`, and the sample."""
        place, sample = divmod(case, 1 if self.samples is None else self.samples)
        places = []
        for size in reversed(self.sizes):
            place, at = divmod(place, size)
            places.append(at)
        return tuple(reversed(places)), sample

    def variant(self, case: int) -> str:
        """Name of the case's variant; empty where there are none."""
        return self.variants[self.split(case)[0][0]][0] if self.variants else ""

    def settings(self, case: int) -> Settings:
        """What is set in a case: key and value."""
        place, sample = self.split(case)
        out = dict(self.variants[place[0]][1]) if self.variants else {}
        axes = [*self.grid.items(), *self.corners.items()]
        out |= {key: values[i] for (key, values), i in zip(axes, place[1:], strict=False)}
        if self.rows:
            out |= {key: values[place[-1]] for key, values in self.rows.items()}
        return out | self._drawn(sample)

    def _drawn(self, sample: int) -> Settings:
        out: Settings = {}
        for method in METHODS:
            axes = self.draws.get(method, {})
            if axes:
                row = uniforms(method, self.seed, len(axes), self.samples or 1, sample)
                out |= {key: axis.at(float(u)) for (key, axis), u in zip(axes.items(), row, strict=True)}
        for place, group in enumerate(self.correlated):
            out |= group.at(uniforms("random", self.seed + 1 + place, len(group.keys), 1, sample))
        return out

    def noise_seed(self, case: int) -> int | None:
        """Seed of the plant's noise, by the sample; None: the plant's own, where there are no samples."""
        if self.samples is None:
            return None
        return int(_raw(self.seed, 2**32, 1, self.split(case)[1])[0] >> np.uint64(33))


def _raw(seed: int, stream: int, count: int, sample: int) -> npt.NDArray[np.uint64]:
    """``count`` words of the counter-based generator Philox at the place of a sample."""
    block, row = divmod(sample, RAW)
    return _raw_block(seed, stream, -(-count // 4), block)[row, :count]


RAW: Final = 256
"""Samples whose words are drawn at once: neighbours are wanted next, and to begin takes the longest."""


@lru_cache(maxsize=8)
def _raw_block(seed: int, stream: int, blocks: int, block: int) -> npt.NDArray[np.uint64]:
    """So many times four words of Philox for each of :data:`RAW` samples."""
    generator = np.random.Philox(key=seed, counter=[block * RAW * blocks, stream, 0, 0])
    words: npt.NDArray[np.uint64] = generator.random_raw(RAW * 4 * blocks).reshape(RAW, -1)
    return words


def uniforms(method: Method, seed: int, count: int, samples: int, sample: int) -> F8:
    """``count`` numbers in (0, 1) of one sample: a function of its number, and for [lhs] of their count."""
    if method == "random":
        raw = _raw(seed, count, count, sample)
        out: F8 = ((raw >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
        return out
    block, row = divmod(sample, BLOCK)
    table = _hypercube(seed, count, samples) if method == "lhs" else _sobol(seed, count, block)
    inside: F8 = np.clip(table[sample if method == "lhs" else row], 2.0**-54, 1.0 - 2.0**-53)
    return inside


BLOCK: Final = 1024


@lru_cache(maxsize=2)
def _hypercube(seed: int, count: int, samples: int) -> F8:
    from scipy.stats import qmc  # half a second, which few plans need

    points: F8 = qmc.LatinHypercube(count, rng=np.random.default_rng(seed)).random(samples)
    return points


@lru_cache(maxsize=4)
def _sobol(seed: int, count: int, block: int) -> F8:
    """A block of points of Owen's scrambled sequence."""
    from scipy.stats import qmc  # as above

    sequence = qmc.Sobol(count, scramble=True, rng=np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that a part of the sequence is not balanced
        if block:
            sequence.fast_forward(block * BLOCK)
        points: F8 = sequence.random(BLOCK)
    return points


def read_plan(path: Path) -> PlanTable:
    """Read a plan's file. Raises ConfigError."""
    return validate(read_toml(path), PlanTable, str(path), path.parent)


class Builder:
    """Turns a plan's table into a :class:`Plan`; gathers mistakes. ``own``: a key's value in the config."""

    def __init__(self, where: str, own: Any) -> None:
        self.where, self.own = where, own
        self.problems: list[str] = []
        self._seen: dict[str, str] = {}

    def build(self, table: PlanTable) -> Plan:
        """Raises ConfigError that names every mistake."""
        self._samples(table)
        plan = Plan(
            table.name,
            table.seed,
            table.samples,
            {f"criteria.{key}": value for key, value in table.criteria.items()},
            tuple((name, bundle(keys)) for name, keys in table.variants.items()),
            self._lists("grid", table.grid),
            self._axes("corners", table.corners, lambda given, key: corners(given, self.own(key))),
            self._lists("list", table.rows),
            {name: self._distributions(name, getattr(table, name)) for name in METHODS},
            self._correlated(table.covariance),
        )
        self._sizes(table, plan)
        if self.problems:
            raise ConfigError(self.where, self.problems)
        return plan

    def _samples(self, table: PlanTable) -> None:
        drawn = [name for name in (*METHODS, "covariance") if getattr(table, name)]
        if drawn and table.samples is None:
            self.problems.append(f"samples: missing; [{drawn[0]}] needs how many to draw")
        if table.samples is not None and table.samples < 1:
            self.problems.append(f"samples = {table.samples}: a plan of 0 cases; take at least 1")

    def _sizes(self, table: PlanTable, plan: Plan) -> None:
        if len({len(values) for values in plan.rows.values()}) > 1:
            self.problems.append("list: its keys go side by side, so all need as many values")
        if len(plan.corners) > MOST_CORNERS:
            self.problems.append(
                f"corners: 2^{len(plan.corners)} cases; at most {MOST_CORNERS} keys, or take [sobol]"
            )
        elif not self.problems and plan.count > MOST_CASES:
            self.problems.append(f"{plan.count} cases; at most {MOST_CASES}: fewer samples or values")
        elif not self.problems and plan.count < 1:
            self.problems.append("a plan of 0 cases; give samples or an axis")
        if (plan.samples or 0) * len(plan.draws["lhs"]) > MOST_LHS:
            self.problems.append(f"lhs: more than {MOST_LHS} numbers; take [sobol], which needs no memory")

    def _take(self, table: str, key: str) -> bool:
        """Note a key; False where another table has it."""
        before = self._seen.setdefault(key, table)
        if before != table:
            self.problems.append(f"{table}: {key} is in [{before}] too; leave one")
        return before == table

    def _axes(self, table: str, given: Axes, read: Any, leaf: Any = None) -> dict[str, Any]:
        out = {}
        for key, value in flat(given, leaf or _is_leaf).items():
            try:
                if self._take(table, key):
                    out[key] = read(value, key)
            except ValueError as error:
                self.problems.append(f"{table}: {key}: {error}")
        return out

    def _lists(self, table: str, given: Axes) -> dict[str, Any]:
        return self._axes(table, given, lambda value, _: _values(value))

    def _distributions(self, table: str, given: Axes) -> dict[str, Distribution]:
        return self._axes(table, given, lambda value, key: distribution(value, self.own(key)))

    def _correlated(self, given: Any) -> tuple[Correlated, ...]:
        groups = [given] if isinstance(given, dict) else given or []
        if not isinstance(groups, list):
            self.problems.append("covariance: is [[covariance]] with keys, covariance and perhaps mean")
            return ()
        return tuple(found for group in groups if (found := self._group(group)) is not None)

    def _group(self, given: Any) -> Correlated | None:
        try:
            group = validate(given, CovarianceTable, f"{self.where}: covariance", Path())
            for key in group.keys:
                self._take("covariance", key)
            mean = group.mean or [number(self.own(key), f"the config's {key}") for key in group.keys]
            return Correlated(tuple(group.keys), tuple(mean), _root(group, len(mean)))
        except ConfigError as error:
            self.problems += [f"covariance: {problem}" for problem in error.problems]
        except ValueError as error:
            self.problems.append(f"covariance: {error}")
        return None


def _root(group: CovarianceTable, means: int) -> tuple[tuple[float, ...], ...]:
    """A root of a covariance: that of the correlations, times the standard deviations. Raises ValueError."""
    size = len(group.keys)
    if means != size or [len(row) for row in group.covariance] != [size] * size:
        raise ValueError(f"{size} keys need as many means and a square matrix of that size")
    matrix = np.array(group.covariance)
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
        raise ValueError("must be finite and symmetric")
    scale = np.sqrt(np.diag(matrix)) if (np.diag(matrix) > 0).all() else None
    if scale is None:
        raise ValueError("its diagonal, the variances, must be above 0")
    rows = root((matrix / np.outer(scale, scale)).tolist())
    return tuple(tuple(size * x for x in row) for size, row in zip(scale.tolist(), rows, strict=True))


def _values(given: Any) -> tuple[Any, ...]:
    if not isinstance(given, list) or not given:
        raise ValueError(f"needs a list of values, not {given!r}")
    if any(isinstance(value, float) and not math.isfinite(value) for value in given):
        raise ValueError(f"needs finite values, not {given!r}")
    return tuple(given)


def _is_leaf(value: Any) -> bool:
    """Whether a table is a distribution or a corner, and not the tables of a key."""
    words = {*NAMES, "percent", "kind", "dist", "distribution", "type", "low", "high", "min", "max"}
    return isinstance(value, dict) and bool(words & set(value))


def bundle(given: Mapping[str, Any]) -> Settings:
    """The settings of a variant; a table with a ``kind`` is a law or an observer as a whole."""
    return flat(given, lambda value: "kind" in value)


def flat(given: Mapping[str, Any], leaf: Any = lambda _: False, before: str = "") -> Settings:
    """Keys with dots: quoted, then what they have is a value, or as tables of tables."""
    out: Settings = {}
    for name, value in given.items():
        key = before + name.strip()
        deeper = isinstance(value, dict) and value and "." not in name and not leaf(value)
        out |= flat(value, leaf, f"{key}.") if deeper else {key: value}
    return out


__all__ = ["FORMS", "Builder", "Plan", "PlanTable", "read_plan"]
