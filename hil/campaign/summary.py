"""What a campaign says: yield, distributions, which keys matter, worst cases, laws as paired differences.

Read column by column, so that memory is that of a few columns whatever the number of cases.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.campaign.figures import KEYS, NAMES
from hil.campaign.plan import PLANT, bundle
from hil.campaign.store import INPUTS, Folder
from hil.campaign.values import toml
from hil.config.toml import read_toml

F8 = npt.NDArray[np.float64]
Z95: Final = 1.959963984540054
"""Quantile 0.975 of the normal distribution."""
SHARES: Final = (0.0, 0.05, 0.5, 0.95, 1.0)
WORST: Final = 5
SMALLER_IS_WORSE: Final = (
    *("w_margin", "i_margin", "u_margin"),
    *("design_gain_margin", "design_phase_margin_deg", "design_delay_margin_ms"),
)
LAWS: Final = ("controller.", "observer.")
FEW: Final = 24
"""At most so many values make a key's axis in the map one of values, not of ranges."""


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over all cases: how many have it, least, 5 %, median, 95 % and largest, mean."""

    key: str
    count: int
    quantiles: tuple[float, ...]
    mean: float


@dataclass(frozen=True, slots=True)
class Difference:
    """A figure of one law less that of another over the same cases: mean with its 95 % interval."""

    key: str
    count: int
    mean: float
    low: float
    high: float
    smaller: float
    """Share of the pairs in which it is smaller."""


def interval(passed: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a share p = passed / n.

    (p + z^2/2n ± z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n)   [Wilson 1927]
    """
    if not count:
        return 0.0, 1.0
    share, extra = passed / count, Z95 * Z95 / count
    half = math.sqrt(extra * (share * (1.0 - share) + 0.25 * extra))
    low, high = ((share + 0.5 * extra + sign * half) / (1.0 + extra) for sign in (-1.0, 1.0))
    return max(0.0, low), min(1.0, high)


def ranks_of(values: npt.NDArray[Any]) -> F8:
    """Ranks from 1 on; values that are equal share the mean of theirs."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: F8 = np.cumsum(counts) - 0.5 * (counts - 1)
    return ranks[place]


def figure_of(held: Folder, key: str) -> F8:
    """A figure over the cases in order; NaN where a case has none."""
    values: F8 = held.columns(key)[key].astype(np.float64)
    return values


def spread(key: str, values: F8) -> Spread | None:
    """None for a figure that no case has, or that is the same in all."""
    known = values[~np.isnan(values)]
    if not len(known) or (known == known[0]).all():
        return None
    ordered = np.sort(known)  # quantiles of values that may be infinite: no interpolation
    places = [min(int(share * len(ordered)), len(ordered) - 1) for share in SHARES]
    finite = known[np.isfinite(known)]
    mean = float(finite.mean()) if len(finite) == len(known) else float("inf")
    return Spread(key, len(known), tuple(float(v) for v in ordered[places]), mean)


def spreads(held: Folder) -> list[Spread]:
    """Every figure that varies."""
    found = (spread(key, figure_of(held, key)) for key in KEYS)
    return [one for one in found if one is not None]


def varied(held: Folder) -> list[str]:
    """The keys of the plan, and the variant."""
    names = list(held.schema)
    keys = names[names.index("seed") + 1 : names.index("ended")]
    return [*(["variant"] if json.loads(held.about["plan"])["variants"] else []), *keys]


def importance(held: Folder, key: str, figure: F8) -> float:
    """How much a key matters: Spearman's rank correlation, or for words the ratio of correlation."""
    values = held.columns(key)[key]
    if held.schema.get(key) in ("i8", "f8"):
        numbers = values.astype(np.float64)
        good = ~np.isnan(numbers) & ~np.isnan(figure)
        return _correlation(ranks_of(numbers[good]), ranks_of(figure[good]))
    good = ~np.isnan(figure)
    words, ranks = values[good].astype(str), ranks_of(figure[good])
    if len(ranks) < 3 or ranks.var() == 0:
        return 0.0
    groups = [ranks[words == word] for word in np.unique(words)]
    between = sum(len(group) * (group.mean() - ranks.mean()) ** 2 for group in groups)
    return float(np.sqrt(between / (len(ranks) * ranks.var())))


def _correlation(a: F8, b: F8) -> float:
    if len(a) < 3 or a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def settings_of(held: Folder, row: dict[str, Any]) -> tuple[list[str], list[str]]:
    """What sets a case: of the configuration and of the plant, as ``hil simulate`` takes it."""
    table = json.loads(held.about["plan"])
    own, plant = list(table["set"]), list(table["plant_set"])
    own += [f"criteria.{key}={toml(value)}" for key, value in table["criteria"].items()]
    for key in varied(held):
        value = row[key]
        if key == "variant" or value is None or value != value:
            continue
        text = value if held.schema[key] == "text" else toml(_plain(value))
        place, name = (plant, key[len(PLANT) :]) if key.startswith(PLANT) else (own, key)
        place.append(f"{name}={text}")
    seed = row["seed"]
    if seed is not None and seed == seed and f"{PLANT}seed" not in held.schema:
        plant.append(f"seed={int(seed)}")
    return own, plant


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _on_bus(path: Path, plant: list[str]) -> bool:
    """True for a case with a fault script, as its settings or its plant's file have it."""
    given = [text for text in plant if text.partition("=")[0] == "fault"]
    if given:
        return given[-1] != "fault=[]"
    named = read_toml(path).get("emulator", {}).get("plant")
    return bool(named and read_toml(path.parent / named).get("fault"))


def command(held: Folder, row: dict[str, Any]) -> str:
    """The command that runs a case again, with a log."""
    own, plant = settings_of(held, row)
    path = held.path / INPUTS / held.about["config"]
    what = ["demo", str(path), "--lockstep"] if _on_bus(path, plant) else ["simulate", str(path)]
    words = ["hil", *what]
    words += [word for text in own for word in ("--set", text)]
    words += [word for text in plant for word in ("--plant-set", text)]
    return shlex.join(words)


def rows_at(held: Folder, cases: Sequence[int]) -> list[dict[str, Any]]:
    """The rows of some cases, in the order given."""
    found = held.rows(cases)
    return [found[int(case)] for case in cases]


def worst(held: Folder, key: str, most: int = WORST) -> list[dict[str, Any]]:
    """The rows of the cases that are worst in a figure."""
    values = figure_of(held, key)
    known = np.flatnonzero(~np.isnan(values))
    sign = 1.0 if key in SMALLER_IS_WORSE else -1.0
    order = known[np.argsort(sign * values[known], kind="stable")][:most]
    return rows_at(held, held.columns()["case"][order].tolist())


def endings(held: Folder) -> dict[str, int]:
    """How often a case ended in which way."""
    words, counts = np.unique(held.columns("ended")["ended"].astype(str), return_counts=True)
    return dict(sorted(zip(words.tolist(), counts.tolist(), strict=True), key=lambda item: -item[1]))


def failures(held: Folder) -> dict[str, int]:
    """How often each criterion was not met."""
    names = [name for name in held.schema if name.startswith("criteria:")]
    return {
        name.partition(":")[2]: int((held.columns(name)[name].astype(str) != "pass").sum()) for name in names
    }


def law_axis(held: Folder) -> str | None:
    """The axis whose values are compared: the variants, or the first key of the law with several values."""
    keys = varied(held)
    if "variant" in keys:
        return "variant"
    grid = json.loads(held.about["plan"])["grid"]
    laws = [key for key in keys if key.startswith(LAWS) and isinstance(grid.get(key), list)]
    return next((key for key in laws if len(grid[key]) > 1), None)


def paired(held: Folder, axis: str) -> dict[str, list[Difference]]:
    """For each law but the first, its figures less the first's, over cases that differ in nothing else."""
    labels = held.columns(axis)[axis].astype(str)
    other = [key for key in varied(held) if key != axis and not (axis == "variant" and follows(held, key))]
    same = _groups(held, [*other, "sample"])
    names = list(dict.fromkeys(labels.tolist()))
    out: dict[str, list[Difference]] = {}
    for name in names[1:]:
        a, b = _pairs(same, labels == names[0], labels == name)
        found = (difference(key, figure_of(held, key), a, b) for key in KEYS)
        out[f"{name} − {names[0]}"] = [one for one in found if one is not None]
    return out


def follows(held: Folder, key: str) -> bool:
    """Whether a key is set by the variant, so that it differs with it."""
    variants = json.loads(held.about["plan"])["variants"]
    return any(key in bundle(keys) for keys in variants.values())


def _groups(held: Folder, keys: Sequence[str]) -> npt.NDArray[np.int64]:
    """A number for each combination of values."""
    out = np.zeros(len(held.columns()["case"]), np.int64)
    for key in keys:
        values = held.columns(key)[key]
        codes = np.unique(values.astype(str) if values.dtype == object else values, return_inverse=True)[1]
        out = np.unique(out * (int(codes.max(initial=0)) + 1) + codes, return_inverse=True)[1]
    return out


def _pairs(same: npt.NDArray[np.int64], first: Any, second: Any) -> tuple[Any, Any]:
    """Rows of the first and of the second law that belong together."""
    rows_a, rows_b = np.flatnonzero(first), np.flatnonzero(second)
    _, a, b = np.intersect1d(same[rows_a], same[rows_b], return_indices=True)
    return rows_a[a], rows_b[b]


def difference(key: str, values: F8, a: Any, b: Any) -> Difference | None:
    """Rows ``b`` less rows ``a`` of a figure; None where no pair has both."""
    with np.errstate(invalid="ignore"):
        found = values[b] - values[a]
    found = found[np.isfinite(found)]
    if not len(found) or (found == 0).all():
        return None
    half = 1.96 * float(found.std()) / np.sqrt(len(found))
    mean = float(found.mean())
    return Difference(key, len(found), mean, mean - half, mean + half, float((found < 0).mean()))


def name_of(key: str) -> str:
    """What a figure is called, with its unit."""
    return NAMES.get(key, key)
