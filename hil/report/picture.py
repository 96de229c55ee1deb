"""The report as one PNG: the curves of the page, minima to maxima, under a line that says the verdict."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hil.report.collect import Run
from hil.report.criteria import judge
from hil.report.curves import KEYS, Plot, limits_text, plots_of
from hil.report.embed import FITTED, MOST_EVENTS, is_empty, lines_of, shown

COLOURS: Final = ("#0b62c4", "#d1570a", "#15803d", "#9333ea", "#b4235a", "#0e7c86", "#7a5c00", "#50555b")
INCHES: Final = (12.0, 2.0)
DPI: Final = 100


def picture(runs: Sequence[Run]) -> bytes:
    """PNG bytes of :func:`figure`."""
    out = io.BytesIO()
    figure(runs).savefig(out, format="png")
    return out.getvalue()


def figure(runs: Sequence[Run]) -> Figure:
    """The picture itself; two columns of plots."""
    plots = [plot for plot in plots_of(*(run.config for run in runs)) if not is_empty(runs, plot)]
    rows = max(1, -(-len(plots) // 2))
    with matplotlib.rc_context({"font.size": 8, "axes.grid": True, "grid.color": "#d8dde3"}):
        drawn = Figure(figsize=(INCHES[0], INCHES[1] * rows + 0.6), dpi=DPI, layout="constrained")
        FigureCanvasAgg(drawn)
        drawn.suptitle("\n".join(map(_headline, runs)), fontsize=10, parse_math=False)
        axes = drawn.subplots(rows, 2, squeeze=False, sharex=True).ravel()
        for axis in axes[len(plots) :]:
            axis.set_visible(False)
        for axis, plot in zip(axes, plots, strict=False):
            _draw(axis, plot, runs)
        for axis in axes[len(plots) - 2 : len(plots)]:  # the last of each column
            axis.tick_params(labelbottom=True)
            axis.set_xlabel("t [s]", fontsize=7)
    return drawn


def _headline(run: Run) -> str:
    checks = judge(run)
    bad = [f"{check.name}: {check.found}" for check in checks if check.outcome != "pass"]
    text = f"all {len(checks)} checks passed" if not bad else "not passed: " + ", ".join(bad)
    return f"{run.name}, {run.span_s:.2f} s: {text}"[:150]


def _draw(axis: Any, plot: Plot, runs: Sequence[Run]) -> None:
    several = len(runs) > 1
    for index, run in enumerate(runs):
        t, low, high = run.curves()
        chosen = shown(run, plot, several)
        for place, curve in enumerate(chosen):
            colour = COLOURS[(index if several else place) % len(COLOURS)]
            row = KEYS.index(curve.key)
            label = f"{run.name}: {curve.label}" if several else curve.label
            _envelope(axis, plot, t, low[row], high[row], colour, label[:40])
    lines = lines_of(runs, plot)
    for value, _ in lines if plot.key in FITTED else ():
        axis.axhline(value, color="#c4231c", linestyle="--", linewidth=0.7)
    limits = limits_text(lines)
    title = f"{plot.title} [{plot.unit}]" if plot.unit else plot.title
    axis.set_title(f"{title}   {limits}".rstrip(), loc="left", fontsize=8)
    if plot.names:
        axis.set_yticks(range(len(plot.names)), plot.names, fontsize=6)
        axis.set_ylim(-0.5, len(plot.names) - 0.5)
    elif not plot.unit:  # counts: none of them is no reason to look closer
        top = max(1.0, axis.get_ylim()[1])
        axis.set_ylim(-0.05 * top, 1.05 * top)
    for event in runs[0].events(MOST_EVENTS):
        axis.axvline(
            event["t"],
            color="#5b6570" if event["kind"] == "state" else "#c4231c",
            linestyle=":",
            linewidth=0.7,
        )
    axis.legend(loc="best", fontsize=6, framealpha=0.7)


def _envelope(axis: Any, plot: Plot, t: Any, low: Any, high: Any, colour: str, label: str) -> None:
    """Two points a bin, lowest and highest: a spike of one tick is drawn."""
    x, y = np.repeat(t, 2), np.stack([low, high], axis=1).ravel()
    y = np.where(np.isfinite(y), y, np.nan)
    style = "steps-post" if plot.held else "default"
    axis.plot(x, y, color=colour, linewidth=0.8, drawstyle=style, label=label)
