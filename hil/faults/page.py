"""One self-contained HTML page: the table, and small plots of each run drawn as SVG."""

from __future__ import annotations

from html import escape
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.faults.judge import AS_EXPECTED, Result
from hil.faults.view import closing, number

WIDTH, HEIGHT = 300.0, 76.0
PANELS: Final = (("w", "w_ref", "speed [rad/s]"), ("i", None, "|i| [A]"), ("u", None, "|u| sent [V]"))
COLUMNS: Final = (
    "fault", "clock", "expected", "reaction", "safe after [ms]", "worst |w| [rad/s]", "worst |i| [A]",
    "worst |u| [V]", "log", "replay", "verdict",
)  # fmt: skip
CSS: Final = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 84rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; width: 100%; font-size: .8rem }
td, th { text-align: left; vertical-align: top; padding: .3rem .5rem; border-bottom: 1px solid #ddd }
td.n { text-align: right; font-variant-numeric: tabular-nums }
.good { color: #1d6b2f } .bad { color: #a8200d; font-weight: 600 } .scroll { overflow-x: auto }
.runs { display: grid; grid-template-columns: repeat(auto-fill, minmax(20rem, 1fr)); gap: 1rem }
figure { margin: 0; border: 1px solid #ddd; padding: .5rem; break-inside: avoid }
figcaption { font-size: .85rem; margin-bottom: .3rem } svg { width: 100%; display: block }
svg text { font: 9px system-ui, sans-serif; fill: #555 }
"""
INTRO: Final = """
<p>Each row is a run of its own: emulated drive, controller and log writer as processes on the embedded bus,
with the fault put in by script. Judged from the log and the emulated drive's black box. Worst values count
from the fault's beginning (speed and current under faults of the host: from the run's) and, for speed and
current, are the motor's true ones. <em>Safe after</em>: from the fault until no voltage was commanded any
more and none was at the motor, to a tick. In the plots the grey line is the reference, the orange mark the
fault, the red mark the stop.</p>
"""


def points(t: npt.NDArray[np.float64], y: npt.NDArray[np.float64], scale: tuple[float, ...]) -> str:
    """Points of a polyline; what is not finite is left out."""
    t_end, low, high = scale
    good = np.isfinite(y)
    x = t[good] / t_end * WIDTH
    v = HEIGHT - 4 - (np.clip(y[good], low, high) - low) / (high - low) * (HEIGHT - 18)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, v, strict=True))


def panel(result: Result, name: str, beside: str | None, label: str) -> str:
    """One signal over time."""
    traces = result.traces
    t, y = traces["t"], traces[name]
    other = traces[beside] if beside else y
    low = float(min(0.0, np.nanmin(y), np.nanmin(other, initial=0.0)))
    high = float(max(np.nanmax(y), np.nanmax(other, initial=0.0), low + 1e-3))
    scale = (max(float(t[-1]), 1e-9), low, high)
    lines = f'<polyline points="{points(t, other, scale)}" fill="none" stroke="#aaa"/>' if beside else ""
    lines += f'<polyline points="{points(t, y, scale)}" fill="none" stroke="#1f5fa8" stroke-width="1.2"/>'
    for at, colour in ((result.onset_s, "#e08a00"), (result.stop_s, "#c02010")):
        if at is not None and at > 0:
            x = at / scale[0] * WIDTH
            lines += f'<line x1="{x:.1f}" x2="{x:.1f}" y1="12" y2="{HEIGHT}" stroke="{colour}"/>'
    text = f'<text x="2" y="9">{label}: {low:.3g} to {high:.3g}</text>'
    return f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}">{lines}{text}</svg>'


def figure(result: Result) -> str:
    """The plots of a run."""
    if not result.traces:
        return ""
    span = f"0 to {result.traces['t'][-1]:.2f} s"
    caption = f"<strong>{escape(result.fault)}</strong><br>{escape(result.reaction)}, {span}"
    panels = "".join(panel(result, *p) for p in PANELS)
    return f"<figure><figcaption>{caption}</figcaption>{panels}</figure>"


def row(result: Result) -> str:
    """One row of the table."""
    good = result.verdict == AS_EXPECTED
    verdict = result.verdict if good else f"{result.verdict}: {'; '.join(result.why)}"
    texts: list[Any] = [result.fault, result.clock, result.expected, result.reaction]
    numbers = (
        number(result.time_to_safe_ms),
        number(result.w_worst_rad_s),
        number(result.i_worst_a, 2),
        number(result.u_worst_v, 0),
    )
    cells = [f"<td>{escape(text)}</td>" for text in texts]
    cells += [f'<td class="n">{text}</td>' for text in numbers]
    cells += [f"<td>{escape(text)}</td>" for text in (result.log, result.replay)]
    return f'<tr>{"".join(cells)}<td class="{"good" if good else "bad"}">{escape(verdict)}</td></tr>'


def page(results: list[Result]) -> str:
    """The page."""
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Fault matrix</title><style>{CSS}</style></head><body>
<h1>Fault matrix</h1><p><strong>{closing(results)}.</strong></p>{INTRO}
<div class="scroll"><table><tr>{head}</tr>{"".join(map(row, results))}</table></div>
<h2>Runs</h2><div class="runs">{"".join(map(figure, results))}</div>
</body></html>
"""
