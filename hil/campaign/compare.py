"""Two campaigns side by side: today's against yesterday's, case by case where they are of one plan."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.campaign import summary
from hil.campaign.figures import KEYS
from hil.campaign.store import Folder, open_folder
from hil.campaign.summary import SMALLER_IS_WORSE
from hil.errors import HilError

SHOWN: Final = 20
"""Cases that are named of those that passed before and do not any more."""


def compare(before: Path, after: Path) -> dict[str, Any]:
    """Yields, verdicts that turned, and every figure of ``after`` less that of ``before``. Raises HilError.

    Campaigns of the same cases are compared case by case, others by their medians alone.
    """
    a, b = open_folder(before), open_folder(after)
    cases, rows_a, rows_b = _common(a, b)
    same = _same_cases(a, b, rows_a, rows_b)
    out: dict[str, Any] = {
        "before": str(before),
        "after": str(after),
        "paired": same,
        "cases": len(cases),
        "yield": [_share(a), _share(b)],
        "figures": {key: found for key in KEYS if (found := _figure(a, b, key, rows_a, rows_b, same))},
    }
    if same:
        out |= _turned(a, b, cases, rows_a, rows_b)
    return out


def _common(a: Folder, b: Folder) -> tuple[Any, Any, Any]:
    """Cases that both have, and their rows in each."""
    first, second = a.columns()["case"], b.columns()["case"]
    if not len(first) or not len(second):
        raise HilError(f"{(a if not len(first) else b).path}: has no rows; run or --resume it first")
    cases, rows_a, rows_b = np.intersect1d(first, second, return_indices=True)
    return cases, rows_a, rows_b


def _same_cases(a: Folder, b: Folder, rows_a: Any, rows_b: Any) -> bool:
    """Whether a number means the same settings in both."""
    keys = summary.varied(a)
    if keys != summary.varied(b) or a.count != b.count:
        return False
    for key in [*keys, "sample"]:
        own, other = a.columns(key)[key][rows_a], b.columns(key)[key][rows_b]
        if not np.array_equal(own.astype(str), other.astype(str)):
            return False
    return True


def _share(held: Folder) -> float:
    passed = held.columns("passed")["passed"].astype(bool)
    return float(passed.mean())


def _figure(a: Folder, b: Folder, key: str, rows_a: Any, rows_b: Any, paired: bool) -> dict[str, Any] | None:
    """A figure in both: medians, extremes; over pairs the mean difference and how many are worse."""
    if key not in a.schema or key not in b.schema:
        return None
    own, other = summary.figure_of(a, key), summary.figure_of(b, key)
    spreads = [summary.spread(key, values) for values in (own, other)]
    if spreads[0] is None and spreads[1] is None:
        return None
    out: dict[str, Any] = {
        "median": [_median(own), _median(other)],
        "worst": [_worst(key, own), _worst(key, other)],
    }
    if paired:
        both = np.concatenate([own[rows_a], other[rows_b]])
        half = np.arange(len(rows_a))
        found = summary.difference(key, both, half, half + len(half))
        sign = -1.0 if key in SMALLER_IS_WORSE else 1.0
        with np.errstate(invalid="ignore"):
            worse = sign * (other[rows_b] - own[rows_a]) > 0
        out |= {"worse_in": int(worse.sum()), "difference": asdict(found) if found else None}
    return out


def _median(values: Any) -> float | None:
    known = values[~np.isnan(values)]
    return float(np.sort(known)[len(known) // 2]) if len(known) else None


def _worst(key: str, values: Any) -> float | None:
    known = values[~np.isnan(values)]
    if not len(known):
        return None
    return float(known.min() if key in SMALLER_IS_WORSE else known.max())


def _turned(a: Folder, b: Folder, cases: Any, rows_a: Any, rows_b: Any) -> dict[str, Any]:
    """Cases that passed and do not any more, with their commands, and the other way about."""
    before = a.columns("passed")["passed"].astype(bool)[rows_a]
    after = b.columns("passed")["passed"].astype(bool)[rows_b]
    broken, mended = cases[before & ~after], cases[~before & after]
    rows = summary.rows_at(b, broken[:SHOWN].tolist()) if len(broken) else []
    named = [{"case": r["case"], "why": r["why"], "command": summary.command(b, r)} for r in rows]
    return {"regressions": len(broken), "mended": len(mended), "regressed": named}
