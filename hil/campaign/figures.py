"""What a case is judged by: the report's own figures, fed from a simulation instead of a log.

Every figure and verdict is that of ``hil report`` over the log of the same run; only rounding may differ,
since a log's blocks end elsewhere. Added are peaks, the noise of the voltage, and the distance to the limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from hil.campaign.margins import DESIGN
from hil.config import LimitsTable, RunConfig
from hil.report.criteria import FIGURES, check_limit, demanded
from hil.report.excursions import Excursions
from hil.report.segments import Responses
from hil.report.statistics import Phases, Totals
from hil.signals import DriveState, Reason, TickArray

BLOCK: Final = 8192
COLUMNS: Final = (
    "k", "w", "w_ref", "dw_ref", "i_q", "i_d", "u_q", "u_d", "T_L_true", "T_L_hat", "state", "reason",
    "rx_flags", "guard_flags", "skipped", "gap",
)  # fmt: skip
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


class Columns:
    """Ticks as one plain array a field: what a figure reads of a record is 8 of its 389 bytes."""

    def __init__(self, parts: Sequence[dict[str, Any]]) -> None:
        self._of = {name: np.concatenate([part[name] for part in parts]) for name in COLUMNS}

    def __getitem__(self, name: str) -> Any:
        return self._of[name]

    def __len__(self) -> int:
        return len(self._of["k"])


@dataclass(slots=True)
class Judged:
    """The figures of one case, gathered block by block in bounded memory."""

    config: RunConfig
    N: int
    totals: Totals = field(default_factory=Totals)
    responses: Responses = field(default_factory=Responses)
    excursions: Excursions = field(default_factory=Excursions)
    phases: Phases = field(default_factory=Phases)
    reason: Reason = Reason.NONE
    state: DriveState = DriveState.SWITCH_ON_DISABLED
    _parts: list[dict[str, Any]] = field(default_factory=list)
    _held: int = 0
    _peaks: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("w", "i", "u"), 0.0))
    _noise: tuple[float, int] = (0.0, 0)

    def __post_init__(self) -> None:
        self.responses.N = self.N

    def feed(self, ticks: TickArray) -> None:
        """Take the next ticks, which the simulation will overwrite."""
        self.reason = Reason(int(ticks["reason"][-1]))
        self._parts.append({name: ticks[name].copy() for name in COLUMNS})
        self._held += len(ticks)
        if self._held >= BLOCK:
            self._flush()

    def _flush(self) -> None:
        if not self._parts:
            return
        found: Any = Columns(self._parts)
        self._parts, self._held = [], 0
        with np.errstate(all="ignore"):
            t = found["k"].astype(np.float64) * (self.config.loop.period_ns * 1e-9)
            self.totals.feed(t, found)
            self.responses.feed(t, found)
            self.excursions.feed(t, found)
            self._extra(found)

    def _extra(self, found: Any) -> None:
        i, u = np.hypot(found["i_q"], found["i_d"]), np.hypot(found["u_q"], found["u_d"])
        for name, values in (("w", np.abs(found["w"])), ("i", i), ("u", u)):
            self._peaks[name] = max(self._peaks[name], float(np.nanmax(values, initial=0.0)))
        rests = (found["state"] == int(DriveState.OPERATION_ENABLED)) & (found["dw_ref"] == 0.0)
        steps = np.diff(found["u_q"])[rests[1:] & rests[:-1]]
        self._noise = (self._noise[0] + float(np.sum(steps * steps)), self._noise[1] + len(steps))

    def finish(self) -> dict[str, Any]:
        """Every figure by its key, and the verdict on each criterion."""
        self._flush()
        with np.errstate(all="ignore"):
            self.responses.finish()
        ended = self.reason.name.lower()
        result = SimpleNamespace(result={"ended": ended, "ticks": self.totals.ticks, "skipped": 0})
        run: Any = SimpleNamespace(
            totals=self.totals,
            responses=self.responses,
            excursions=self.excursions,
            phases=self.phases,
            log=result,
            bus_load=lambda: None,
        )
        found = {figure.key: figure.of(run) for figure in FIGURES} | self._added(self.config.limits)
        limits = demanded(self.config.criteria)
        checks = [check_limit(run, f, limits[f.key]) for f in FIGURES if f.key in limits]
        verdicts = {f"criteria:{key}": check.outcome for key, check in zip(limits, checks, strict=True)}
        good = self.reason == Reason.STOP_REQUESTED and all(c.outcome == "pass" for c in checks)
        why = (
            ""
            if good
            else "; ".join(f"{c.name}: {c.found}, {c.wanted}" for c in checks if c.outcome != "pass")
        )
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
