"""Lateness as counts per microsecond, whoever measured it, and its percentiles."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt

TOP_US: Final = 20_000
SHARES: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


@dataclass(frozen=True, slots=True)
class Histogram:
    """``counts[n]``: wake-ups that were n to n + 1 us late, the last one holds all above; ``max`` [us]."""

    counts: npt.NDArray[np.int64]
    max: float

    @classmethod
    def of(cls, late_ns: npt.NDArray[np.int64]) -> Histogram:
        """Of wake-ups after the deadline [ns]."""
        us = np.clip(late_ns // 1000, 0, TOP_US - 1).astype(np.int64)
        worst = float(late_ns.max()) * 1e-3 if len(late_ns) else 0.0
        return cls(np.bincount(us, minlength=TOP_US), worst)

    def percentile(self, share: float) -> float:
        """The lateness [us] that at least that share of the wake-ups does not exceed, to 1 us."""
        total = int(self.counts.sum())
        if not total:
            return 0.0
        at = int(np.searchsorted(np.cumsum(self.counts), np.ceil(share * total)))
        return min(float(at + 1), self.max)

    def as_dict(self) -> dict[str, Any]:
        """Percentiles, and the counts in octaves of lateness: ``[from_us, to_us, count]``."""
        out: dict[str, Any] = {name: self.percentile(share) for name, share in SHARES.items()}
        return out | {"max": self.max, "samples": int(self.counts.sum()), "histogram": self._octaves()}

    def _octaves(self) -> list[list[int]]:
        edges = [0, *(1 << n for n in range(15))]
        return [[a, b, int(self.counts[a:b].sum())] for a, b in pairwise([*edges, TOP_US])]
