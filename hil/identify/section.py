"""What `hil report` shows of runs of `hil identify`: parameters with intervals, fits, residuals.

All logs of a report are taken together, as the steps of one session are; a run by any other law has no part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final

import numpy as np

from hil.control.linalg import Array
from hil.errors import HilError
from hil.identify.estimate import Estimate
from hil.identify.innerloop import estimate_for
from hil.identify.model import Flags
from hil.log.reader import open_log
from hil.report.collect import Run
from hil.report.page import table
from hil.report.section import Section

MOST_TICKS: Final = 1_000_000
"""Of longer runs nothing is estimated for a page; no experiment is as long."""
WIDTH, HEIGHT, EDGE = 640, 150, 58
SHOWN: Final = 240
"""Samples of the excerpt in which the fit stands beside what was measured."""
UNITS: Final = {"w": "rad/s", "i_q": "A", "i_d": "A"}
Rows = list[tuple[str, ...]]


def identification(runs: Sequence[Run]) -> Sequence[Section]:
    """The section of runs by the law ``identify``; none where there is no such run."""
    own = [run for run in runs if run.config and run.config.controller.kind == "identify"]
    if not own:
        return ()
    try:
        found = _estimated(own)
    except (HilError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        text = f"nothing can be estimated from these runs: {error}"
        return (
            Section("identify", "Identification", f'<p class="note">{escape(text)}</p>', {"error": text}),
        )
    return (Section("identify", "Identification", shown(found, len(own)), found.as_dict()),)


def _estimated(runs: Sequence[Run]) -> Estimate:
    """All runs together, by the last one's configuration. Raises HilError."""
    configs = [run.config for run in runs if run.config]
    kinds = {(config.loop.rate_hz, config.motor.n_p, config.drive.takes) for config in configs}
    if len(kinds) > 1:
        raise HilError("they differ in loop.rate_hz, n_p or what the drive takes")
    if sum(run.totals.ticks for run in runs) > MOST_TICKS:
        raise HilError(f"more than {MOST_TICKS} ticks; hil identify --from takes them")
    ticks = [open_log(run.log.parts or run.log.path, frames=False, node=run.node).ticks for run in runs]
    return estimate_for(configs[-1], configs[-1].motor, ticks)


def shown(found: Estimate, runs: int) -> str:
    """The section's HTML."""
    notes = "".join(f'<p class="note">look first: {escape(fault)}</p>' for fault in found.faults)
    notes += "".join(f"<p>{escape(finding)}</p>" for finding in found.findings)
    count = f'<p class="soft small">from {runs} run{"s" if runs > 1 else ""}, intervals of 95 %</p>'
    head = ("parameter", "unit", "", "value", "from", "to")
    return f"{count}{notes}{table(head, _parameters(found), texts=3)}{_pictures(found)}"


def _parameters(found: Estimate) -> Rows:
    rows: Rows = []
    for name, p in found.parameters.items():
        known = math.isfinite(p.value)
        numbers = [f"{value:.5g}" if known else "–" for value in (p.value, p.low, p.high)]
        rows.append((escape(name), escape(p.unit), escape(p.why), *numbers))
    return rows


def _pictures(found: Estimate) -> str:
    """Of each output that was compared: measured and fitted where most happens, and what is left."""
    if found.samples is None or found.fit is None:
        return ""
    y, fit = found.samples.y, found.fit
    out = []
    for column, name in enumerate(found.white):
        counts = found.samples.free if column == 0 else np.ones(len(y), bool)
        sigma = float(fit.sigma[column])
        if not counts.any() or not math.isfinite(sigma):
            continue
        rows = _excerpt(np.where(counts, y[:, column], 0.0))
        unit, white = UNITS[name], found.white[name]
        title = f"{name} [{unit}]: measured (dots) and fit, samples {rows.start} to {rows.stop} of {len(y)}"
        picture = _fit(y[rows, column], fit.output[rows, column], found.samples.begins[rows])
        left = f"residual of {name} [{unit}], all samples: deviation {sigma:.3g}, {_said(white)}"
        residual = np.where(counts, fit.residual[:, column], np.nan)
        out += [_plot(title, picture), _plot(left, _residual(residual, 1.96 * sigma))]
    return f'<div class="columns">{"".join(out)}</div>'


def _said(white: float) -> str:
    word = "white" if white > 1e-3 else "not white: it holds more than noise"
    return f"{word} (p = {white:.2g})"


def _excerpt(column: Array) -> slice:
    """The stretch of SHOWN samples in which the output changes most."""
    change = np.append(0.0, np.cumsum(np.abs(np.diff(column))))
    if len(column) <= SHOWN:
        return slice(0, len(column))
    first = int(np.argmax(change[SHOWN:] - change[:-SHOWN]))
    return slice(first, first + SHOWN)


def _plot(title: str, picture: str) -> str:
    return f'<div class="plot"><h3>{escape(title)}</h3>{picture}</div>'


def _fit(measured: Array, fit: Array, begins: Flags) -> str:
    """Dots and a line that breaks where a segment begins."""
    low, high = _range(np.concatenate([measured, fit]))
    x, y, line = _across(len(fit)), _up(measured, low, high), _up(fit, low, high)
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x, y, strict=True))
    path = "".join(
        f"{'M' if begin or k == 0 else 'L'}{a:.1f} {b:.1f}"
        for k, (a, b, begin) in enumerate(zip(x, line, begins, strict=True))
    )
    return _svg(f'<path class="dots" d="{dots}"/><path class="fit" d="{path}"/>', low, high)


def _residual(residual: Array, band: float) -> str:
    """Least and largest of each column of pixels, between the lines that 95 % keep to."""
    columns = np.array_split(residual, min(WIDTH - EDGE, len(residual)))
    kept = [(k, c[np.isfinite(c)]) for k, c in enumerate(columns)]
    ends = [(k, float(c.min()), float(c.max())) for k, c in kept if len(c)]
    low, high = _range(np.array([-band, band, *(e for _, *both in ends for e in both)]))
    x = _across(len(columns))
    bars = "".join(f"M{x[k]:.1f} {_up(a, low, high):.1f}V{_up(b, low, high) - 0.5:.1f}" for k, a, b in ends)
    lines = "".join(f"M{EDGE} {_up(v, low, high):.1f}H{WIDTH}" for v in (-band, band))
    return _svg(f'<path class="left" d="{bars}"/><path class="band" d="{lines}"/>', low, high)


def _range(values: Array) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    room = 0.05 * (high - low) or 1.0
    return low - room, high + room


def _across(count: int) -> Array:
    return np.linspace(EDGE, WIDTH - 1, count)


def _up(value: Array | float, low: float, high: float) -> Array:
    return np.asarray(HEIGHT * (high - value) / (high - low))


def _svg(content: str, low: float, high: float) -> str:
    """A frame with the axis' ends and its zero."""
    marks = [v for v in (low, 0.0, high) if low <= v <= high]
    names = "".join(
        f'<text x="{EDGE - 6}" y="{min(max(_up(v, low, high) + 4, 10), HEIGHT - 2):.1f}">{v:.3g}</text>'
        for v in marks
        if v != 0.0 or min(abs(v - low), abs(high - v)) > 0.12 * (high - low)
    )
    zero = f'<path class="axis" d="M{EDGE} {_up(0.0, low, high):.1f}H{WIDTH}"/>' if low < 0.0 < high else ""
    frame = f'<path class="axis" d="M{EDGE} 0V{HEIGHT}H{WIDTH}"/>'
    return f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{frame}{zero}{content}{names}</svg>'
