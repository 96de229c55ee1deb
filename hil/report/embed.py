"""The data of a report as the page's script reads it: JSON, arrays in it as base64 of their bytes."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.report.collect import Run, one_log
from hil.report.curves import CURVES, F4, F8, KEYS, Curve, Plot, plots_of
from hil.report.statistics import SPECTRUM_FIELDS

MOST_EVENTS: Final = 500
GAP_PERIODS: Final = 3.5  # a longer silence breaks the line
OF_REFERENCE: Final = ("w_ref", "error")
"""Curves of a run that follows a speed reference."""
FITTED: Final = ("voltage_q", "filled")  # the axis reaches to the limits


def packed(values: npt.NDArray[Any]) -> str:
    """Base64 of an array's bytes."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def curve_of(low: F4, high: F4) -> dict[str, Any]:
    """A curve, as short as it can be said."""
    low, high = (np.where(np.isfinite(x), x, np.float32(np.nan)) for x in (low, high))
    if len(low) == 0 or np.isnan(low).all():
        return {"value": None}
    if (low == low[0]).all() and (high == low[0]).all():
        return {"value": float(low[0])}
    if np.array_equal(low, high, equal_nan=True):
        return {"low": packed(low)}
    return {"low": packed(low), "high": packed(high)}


def run_data(run: Run) -> dict[str, Any]:
    """All curves and events of one run."""
    t, low, high = run.curves()
    gap_s = GAP_PERIODS * run.envelope.width / run.rate_hz
    curves = {curve.key: curve_of(low[row], high[row]) for row, curve in enumerate(CURVES)}
    return {
        "name": run.name,
        "t": packed(t),
        "gap": gap_s,
        "curves": curves,
        "events": run.events(MOST_EVENTS),
    }


def is_empty(runs: Sequence[Run], plot: Plot) -> bool:
    """True when no curve of a plot has a number in any run."""
    if plot.key == "lateness" and not any(run.phases.lateness.max > 0 for run in runs):
        return True  # a lockstep run has no lateness
    return not any(
        np.isfinite(run.envelope.bins()[1][KEYS.index(curve.key)]).any()
        for run in runs
        for curve in shown(run, plot, several=False)
    )


def lines_of(runs: Sequence[Run], plot: Plot) -> list[tuple[float, str]]:
    """The limits of a plot; of nodes that differ in them each by its name."""
    every = [run.lines().get(plot.key, []) for run in runs]
    if not one_log(runs) or all(lines == every[0] for lines in every):
        return every[0]
    return [
        (value, f"{run.node} {name}" if name else "")
        for run, lines in zip(runs, every, strict=True)
        for value, name in lines
    ]


def shown(run: Run, plot: Plot, several: bool) -> list[Curve]:
    """The curves of a run in a plot, beside those of others or alone."""
    own = [curve for curve in plot.curves if curve.compared or not several]
    return [curve for curve in own if run.follows or curve.key not in OF_REFERENCE]


def plot_data(runs: Sequence[Run], plot: Plot) -> dict[str, Any]:
    """A plot: of one run all its curves, of several runs those that are compared, a colour for each run."""
    several, curves = len(runs) > 1, []
    for index, run in enumerate(runs):
        chosen = shown(run, plot, several)
        for place, curve in enumerate(chosen):
            label = f"{run.name}: {curve.label}" if several else curve.label
            colour, dash = (index, len(chosen) - 1 - place) if several else (place, 0)
            curves.append(
                {"run": index, "key": curve.key, "label": label, "colour": colour % 8, "dash": dash % 4}
            )
    return {
        "key": plot.key,
        "curves": curves,
        "held": plot.held,
        "names": list(plot.names),
        "lines": lines_of(runs, plot),
        "fit": plot.key in FITTED,
    }


def _lateness(runs: Sequence[Run]) -> dict[str, Any]:
    curves = []
    for index, run in enumerate(runs):
        late = run.phases.lateness
        used = np.nonzero(late.counts)[0]
        rows = slice(int(used[0]), int(used[-1]) + 2) if len(used) else slice(0, 0)
        counts = np.append(late.counts, 0)[rows]
        ys = np.where(counts > 0, counts, 0.1).tolist()  # a logarithmic axis has no 0
        curves.append({"label": run.name, "colour": index % 8, "xs": _rounded(late.edges()[rows]), "ys": ys})
    return {"key": "lateness", "x": "woken after the deadline [µs]", "steps": True, "curves": curves}


def _spectrum(runs: Sequence[Run], row: int) -> dict[str, Any]:
    curves = []
    for index, run in enumerate(runs):
        if not (run.follows or row):
            continue  # row 0 is the speed error
        frequencies, density = run.spectrum.density(run.rate_hz)
        xs, ys = (frequencies, density[row]) if run.spectrum.windows else (frequencies[:0], frequencies[:0])
        curves.append(
            {
                "label": run.name,
                "colour": index % 8,
                "xs": _rounded(xs),
                "ys": _rounded(np.maximum(ys, 1e-12)),
            }
        )
    return {"key": f"spectrum{row}", "x": "frequency [Hz]", "steps": False, "curves": curves}


def _rounded(values: F8) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


def charts(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Histogram and spectra that have something to show."""
    out = [
        _spectrum(runs, row) for row in range(len(SPECTRUM_FIELDS)) if any(r.spectrum.windows for r in runs)
    ]
    timed = runs[:1] if one_log(runs) else runs
    return ([_lateness(timed)] if any(run.phases.lateness.max > 0 for run in runs) else []) + out


def report_data(runs: Sequence[Run]) -> dict[str, Any]:
    """Everything that the script draws."""
    drawn, plots = [run_data(run) for run in runs], plots_of(*(run.config for run in runs))
    for again in drawn[1:] if one_log(runs) else ():
        again["events"] = []  # they are the log's, and the first has them
    return {
        "runs": drawn,
        "plots": [plot_data(runs, plot) for plot in plots if not is_empty(runs, plot)],
        "charts": charts(runs),
    }


def script_json(value: Any) -> str:
    """JSON that can stand inside a script element: nothing in it can end the element or open a comment."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
