"""Everything that is computed once for the verdicts, the figures and the page."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hil.control.linalg import Array
from hil.control.observer import bounds, ftdob
from hil.paper.continuous import Trace, initial_h, simulate
from hil.paper.examples import (
    PHI,
    Case,
    case_1,
    case_2,
    case_3,
    levels,
    pmsm_as_printed,
    pmsm_corrected,
    reference_terms,
    section_5,
    section_6,
)
from hil.paper.sampled import Convergence, convergence, simulate_sampled
from hil.signals import TickArray

DT: Final = 0.01
"""Grid of the continuous form and tick of the sampled form beside it [s]."""

T_S_PMSM: Final = 1e-3
"""Tick of the sampled form where the paper's design meets the real motor [s]."""


@dataclass(frozen=True, slots=True)
class Run:
    """A case in the paper's continuous form and in our sampled form."""

    case: Case
    continuous: Trace
    sampled: Trace

    def at(self, t: float) -> int:
        """Row of the time t."""
        return round(t / DT)


@dataclass(frozen=True, slots=True)
class Study:
    """All results. ``runs``: by name of the case; ``bench``: ticks of configs/paper.toml, if it was run."""

    runs: dict[str, Run]
    zero_fill: Trace
    misled: Trace
    convergence: Convergence
    bench: TickArray | None


def make_study(bench: TickArray | None = None) -> Study:
    """Compute everything."""
    cases = (case_1(), case_2(), case_3(), pmsm_as_printed(), pmsm_corrected())
    runs = {case.name: Run(case, simulate(case, DT), simulate_sampled(case, DT)) for case in cases}
    first = cases[0]
    return Study(
        runs,
        zero_fill=simulate(replace(first, end=3.0), DT, fill=np.zeros_like(initial_h(first))),
        misled=misled_run(),
        convergence=convergence(section_5(), DT),
        bench=bench,
    )


def misled_run() -> Trace:
    """The controller of Sect. 6 as printed (wrong sign of a1 b1) on the motor that has the right one."""
    right = section_6(torque_sign=1.0)
    truth = levels([0], [(reference_terms(right) + PHI).tolist()])
    return simulate_sampled(replace(pmsm_as_printed(), d=truth), T_S_PMSM, plant_A=right.A)


def noise_gain(g_D: tuple[float, float], D: float = 0.5, ticks: int = 2000) -> float:
    """sigma(d_hat) / sigma(x) times D, for white noise on x, of a window with poles g_D / D."""
    T_s = D / ticks
    window = ftdob(np.array([g_D[0] / D]), np.array([g_D[1] / D]), D, T_s)
    gain = bounds(window, np.eye(1), np.eye(1) * T_s, T_s, np.zeros(1)).noise
    return float(gain[0]) * D


def after(trace: Trace, start: float, end: float = np.inf) -> slice:
    """Rows with start <= t < end."""
    low, high = np.searchsorted(trace.t, [start - 1e-9, end - 1e-9])
    return slice(int(low), int(high))


def after_levels(run: Run) -> Array:
    """Rows of case 2 at which D has passed since each change of level, one by one."""
    breaks = run.case.d.breaks[1:]
    return np.array([run.at(t + run.case.example.D) for t in breaks if t + run.case.example.D < run.case.end])
