"""The look of every figure: colours, line styles, panels; what is drawn is left to hil.paper.figures.

The paper's colours (disturbance yellow, FTDOB blue, conventional DOB red) in tones that stay apart in print
and for the colour-blind, each with a line style and a width of its own.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hil.control.linalg import Array

Line = dict[str, Any]
DISTURBANCE: Final[Line] = {"color": "#d9a400", "lw": 3.2, "ls": "-", "label": "disturbance $d$"}
FTDOB: Final[Line] = {"color": "#1f4fa3", "lw": 1.5, "ls": "-", "label": "FTDOB"}
CONVENTIONAL: Final[Line] = {"color": "#c2331d", "lw": 1.5, "ls": "--", "label": "conventional DOB"}
SAMPLED: Final[Line] = {
    "color": "#0b1f47", "ls": "", "marker": "o", "ms": 3.6, "mfc": "white", "mew": 1.0,
    "label": "FTDOB, sampled form",
}  # fmt: skip
CHANNELS: Final[tuple[Line, ...]] = (
    {"color": "#1f4fa3", "lw": 1.5, "ls": "-"},
    {"color": "#c2331d", "lw": 1.5, "ls": "--"},
    {"color": "#3a7d2c", "lw": 1.7, "ls": ":"},
)
STYLE: Final[Any] = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
    "svg.hashsalt": "hil-paper",
    "svg.fonttype": "path",
    "path.simplify": True,
}


@dataclass(frozen=True, slots=True)
class Curve:
    """One line: abscissa, ordinate and its look."""

    t: Array
    y: Array
    look: Line


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes. ``log_y``, ``log_x``: logarithmic; ``inset``: part of t enlarged in a corner."""

    curves: Sequence[Curve]
    ylabel: str
    log_y: bool = False
    log_x: bool = False
    inset: tuple[float, float] | None = None
    title: str = ""
    vertical: Sequence[tuple[float, str]] = ()


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure: name of its file, caption, panels from top to bottom, label of the abscissa."""

    name: str
    caption: str
    panels: Sequence[Panel]
    xlabel: str = "time [s]"


def thin(curve: Curve, most: int = 4000) -> tuple[Array, Array]:
    """At most about ``most`` points, so that an SVG stays small; markers are placed by the caller."""
    step = max(1, curve.t.size // most)
    return curve.t[::step], curve.y[::step]


def picture(figure: Figure) -> dict[str, bytes]:
    """The figure as {"png": ..., "svg": ...}; the same bytes each time (no date, no random ids)."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        canvas = _draw(figure)
        canvas.draw_without_rendering()  # lays out once; each saving would do it again
        canvas.set_layout_engine("none")
        buffers = {"png": io.BytesIO(), "svg": io.BytesIO()}
        canvas.savefig(buffers["png"], format="png", metadata={"Software": None})
        canvas.savefig(buffers["svg"], format="svg", metadata={"Date": None})
    return {kind: buffer.getvalue() for kind, buffer in buffers.items()}


def _draw(figure: Figure) -> Any:
    """Draw with matplotlib's object interface (no global state, no display)."""
    from matplotlib.figure import Figure as Canvas

    count = len(figure.panels)
    canvas = Canvas(figsize=(6.4, 1.0 + 1.75 * count if count > 1 else 3.2))
    rows = np.atleast_1d(canvas.subplots(count, 1, sharex=True))
    for i, (axes, panel) in enumerate(zip(rows, figure.panels, strict=True)):
        _draw_panel(axes, panel)
        if count > 1:
            axes.set_title(f"({'abcdef'[i]}) {panel.title}", loc="left", fontsize=9, fontweight="bold")
    rows[-1].set_xlabel(figure.xlabel)
    handles, labels = rows[0].get_legend_handles_labels()
    if labels:
        canvas.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 5))
    return canvas


def _draw_panel(axes: Any, panel: Panel) -> None:
    for curve in panel.curves:
        axes.plot(*thin(curve), **curve.look)
    axes.set_ylabel(panel.ylabel)
    if panel.log_y:
        axes.set_yscale("log")
    if panel.log_x:
        axes.set_xscale("log")
    axes.margins(x=0.01)
    for at, text in panel.vertical:
        axes.axvline(at, color="#555555", lw=0.8, ls=(0, (2, 2)))
        axes.annotate(text, (at, 0.97), xycoords=("data", "axes fraction"), xytext=(3, 0),
                      textcoords="offset points", va="top", fontsize=8, color="#555555")  # fmt: skip
    if panel.inset:
        _draw_inset(axes, panel, panel.inset)


def _draw_inset(axes: Any, panel: Panel, window: tuple[float, float]) -> None:
    """The part of the panel between two times, enlarged on the right, above or below its curves."""
    shown = panel.curves[-1].y[(panel.curves[-1].t >= window[0]) & (panel.curves[-1].t <= window[1])]
    high = float(shown.mean()) > 0.5 * sum(axes.get_ylim())
    inset = axes.inset_axes((0.4, 0.14 if high else 0.5, 0.57, 0.45))
    for curve in panel.curves:
        inside = (curve.t >= window[0] - 1e-9) & (curve.t <= window[1] + 1e-9)
        inset.plot(curve.t[inside], curve.y[inside], **{**curve.look, "label": "_"})
    inset.set_xlim(*window)
    inset.tick_params(labelsize=7)
    inset.patch.set_alpha(0.92)
