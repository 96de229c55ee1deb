"""What a case is judged by: the report's own figures, fed from a simulation instead of a log.

Every figure and verdict is that of ``hil report`` over the log of the same run; only rounding may differ,
since a log's blocks end elsewhere. Added are peaks, the noise of the voltage, and the distance to the limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np

from hil.campaign.margins import DESIGN
from hil.config.limits import LimitsTable
from hil.config.tables import RunConfig
from hil.report.angles import Angles
from hil.report.criteria import FIGURES, check_limit, demanded, outcome_of
from hil.report.curves import F8
from hil.report.excursions import Excursions
from hil.report.segments import Responses, largest
from hil.report.statistics import Phases, Totals, usual_step
from hil.signals import DriveState, Reason
from hil.sim.columns import Columns

EXTRA: Final = {
    "w_peak_rad_s": "largest |w|, rad/s",
    "i_peak_a": "largest current, A",
    "u_peak_v": "largest voltage commanded, V",
    "u_noise_v": "noise of u_q while the reference rests, rms, V",
    "w_margin": "share of w_max that was left",
    "i_margin": "share of i_trip that was left",
    "u_margin": "share of u_max that was left",
}
KEYS: Final = (*(figure.key for figure in FIGURES), *EXTRA, *DESIGN)
NAMES: Final = {f.key: f"{f.name}{f', {f.unit}' if f.unit else ''}" for f in FIGURES} | EXTRA | DESIGN

NO_PHASES: Final = Phases()
"""A simulation has none."""


wanted = lru_cache(maxsize=64)(demanded)
"""What criteria demand; most cases of a campaign share them."""


@lru_cache(maxsize=8)
def times(first: int, count: int, period_ns: int) -> tuple[F8, float]:
    """Times [s] of ticks that follow one another, and the usual step: most cases of a campaign share them."""
    t: F8 = np.arange(first, first + count).astype(np.float64) * (period_ns * 1e-9)
    t.flags.writeable = False
    return t, usual_step(t)


def longest(x: F8, y: F8) -> float:
    """Largest hypot(x, y), of which only those are computed that may be it."""
    squares = x * x + y * y
    most = float(np.fmax.reduce(squares))
    if 1e-200 < most < math.inf:
        near = squares >= most * (1.0 - 1e-12)
        x, y = x[near], y[near]
    return largest(np.hypot(x, y))


@dataclass(slots=True)
class Judged:
    """The figures of one case, gathered block by block in bounded memory."""

    config: RunConfig
    N: int
    totals: Totals = field(default_factory=Totals)
    responses: Responses = field(default_factory=Responses)
    excursions: Excursions = field(default_factory=Excursions)
    angles: Angles = field(default_factory=Angles)
    phases: Phases = NO_PHASES
    reason: Reason = Reason.NONE
    state: DriveState = DriveState.SWITCH_ON_DISABLED
    _peaks: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("w", "i", "u"), 0.0))
    _noise: tuple[float, int] = (0.0, 0)

    def __post_init__(self) -> None:
        self.responses.N = self.N

    def feed(self, ticks: Columns) -> None:
        """Take the next ticks, which the simulation will overwrite."""
        self.reason, found = Reason(ticks.last()["reason"]), cast(Any, ticks)
        with np.errstate(all="ignore"):
            t, step = times(int(found["k"][0]), len(found), self.config.loop.period_ns)
            self.totals.feed(t, found, step)
            self.responses.feed(t, found)
            self.excursions.feed(t, found)
            if self.config.follows_angle:
                self.angles.feed(t, found)
            self._extra(found)

    def _extra(self, found: Columns) -> None:
        i, u = longest(found["i_q"], found["i_d"]), longest(found["u_q"], found["u_d"])
        for name, value in (("w", largest(np.abs(found["w"]))), ("i", i), ("u", u)):
            self._peaks[name] = max(self._peaks[name], value)
        rests = (found["state"] == int(DriveState.OPERATION_ENABLED)) & (found["dw_ref"] == 0.0)
        steps = np.diff(found["u_q"])[rests[1:] & rests[:-1]]
        self._noise = (self._noise[0] + float(np.sum(steps * steps)), self._noise[1] + len(steps))

    def finish(self) -> dict[str, Any]:
        """Every figure by its key, and the verdict on each criterion."""
        with np.errstate(all="ignore"):
            self.responses.finish()
        ended = self.reason.name.lower()
        result = SimpleNamespace(result={"ended": ended, "ticks": self.totals.ticks, "skipped": 0})
        run: Any = SimpleNamespace(
            totals=self.totals,
            responses=self.responses,
            excursions=self.excursions,
            angles=self.angles,
            phases=self.phases,
            log=result,
            bus_load=lambda: None,
            follows=self.config.follows_speed,
        )
        found = {figure.key: figure.of(run) for figure in FIGURES} | self._added(self.config.limits)
        limits = wanted(self.config.criteria)
        verdicts = {f"criteria:{key}": outcome_of(found[key], most) for key, most in limits.items()}
        bad = [f for f in FIGURES if f.key in limits and verdicts[f"criteria:{f.key}"] != "pass"]
        good = self.reason == Reason.STOP_REQUESTED and not bad
        checks = [check_limit(run, figure, limits[figure.key]) for figure in bad]
        why = "; ".join(f"{c.name}: {c.found}, {c.wanted}" for c in checks)
        if self.reason != Reason.STOP_REQUESTED:
            why = f"ended by {ended.replace('_', ' ')} at {self.totals.ticks * self._period_s:.3f} s"
        return {"ended": ended, "passed": good, "why": why} | found | verdicts

    @property
    def _period_s(self) -> float:
        return self.config.loop.period_ns * 1e-9

    def _added(self, limits: LimitsTable) -> dict[str, float | None]:
        w, i, u = (self._peaks[name] for name in ("w", "i", "u"))
        total, count = self._noise
        return {
            "w_peak_rad_s": w,
            "i_peak_a": i,
            "u_peak_v": u,
            "u_noise_v": float(np.sqrt(0.5 * total / count)) if count else None,
            "w_margin": 1.0 - w / limits.w_max_rad_s,
            "i_margin": 1.0 - i / limits.i_trip_a,
            "u_margin": 1.0 - u / self.config.command.most,
        }
