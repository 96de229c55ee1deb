"""The report as one HTML file that needs nothing else and lets nothing of a log run.

Every text that comes from a log is escaped; the policy in the page's head allows just the two scripts and the
two style sheets that stand in it, by their hashes, and no address at all.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any, Final

from hil.config.filtered import known
from hil.report.collect import Run, one_log
from hil.report.criteria import (
    FIGURES,
    SIGNS,
    Check,
    ending,
    figures,
    judge,
    number,
    open_loop,
    recovered,
    verdict_text,
)
from hil.report.curves import limits_text, plots_of
from hil.report.embed import MOST_EVENTS, charts, is_empty, lines_of, report_data, script_json
from hil.report.frames import REMOTE, id_text
from hil.report.section import Section
from hil.report.segments import Response
from hil.report.statistics import SPECTRUM_FIELDS

CLASSES: Final = {"pass": "pass", "fail": "fail", "no data": "none"}
CHART_TITLES: Final = {
    "lateness": "Lateness, ticks per bin",
    "spectrum0": f"Spectral density of {SPECTRUM_FIELDS[0]} [rad/s/√Hz]",
    "spectrum1": f"Spectral density of {SPECTRUM_FIELDS[1]} [A/√Hz]",
}
MOST_RESPONSES: Final = 60
EVENT_SPAN_S: Final = 1.0
Row = Iterable[str]


def asset(name: str) -> str:
    """A file that the package ships."""
    return (files("hil.report") / "assets" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def table(head: Sequence[str], rows: Iterable[Row], numbers: bool = True, texts: int = 1) -> str:
    """A table of cells that are HTML already; ``numbers``: all columns but the first ``texts`` are."""
    kinds = [' class="n"' if numbers and column >= texts else "" for column in range(len(head))]
    top = "".join(f"<th{kind}>{name}</th>" for kind, name in zip(kinds, head, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{kind}>{cell}</td>" for kind, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def _verdict(checks: Sequence[Check]) -> str:
    failed = [check for check in checks if check.outcome != "pass"]
    kind = "pass" if not failed else "fail" if any(c.outcome == "fail" for c in failed) else "none"
    text = f"all {len(checks)} checks passed" if not failed else f"{len(failed)} of {len(checks)} not passed"
    return f'<span class="verdict {kind}">{text}</span>'


def _outcome(check: Check) -> str:
    return f'<span class="{CLASSES[check.outcome]}">{SIGNS[check.outcome]}</span>'


def _swatch(index: int, several: bool) -> str:
    return f'<span class="swatch s{index % 8}"></span>' if several else ""


def summary(runs: Sequence[Run]) -> str:
    """Each run's verdict and checks."""
    out = []
    for index, run in enumerate(runs):
        checks = judge(run)
        rows = ((escape(c.name), _outcome(c), escape(c.found), escape(c.wanted)) for c in checks)
        title = f"<h3>{_swatch(index, True)}{escape(run.name)}</h3>" if len(runs) > 1 else ""
        out.append(
            f"<div>{title}<p>{_verdict(checks)}</p>{table(('check', '', 'found', 'wanted'), rows, False)}"
        )
        out.append(_notes(run) + "</div>")
    return f'<div class="columns">{"".join(out)}{_facts(runs[0]) if len(runs) == 1 else ""}</div>'


def _notes(run: Run) -> str:
    """How a run ended that was not asked to, and what is wrong with its log, said at the top."""
    texts = (ending(run), run.log.damage, recovered(run), run.config_problem, open_loop(run))
    notes = [text for text in texts if text]
    if run.totals.ticks == 0:
        notes.append("the log has no ticks: there is nothing to draw")
    if run.totals.missing:
        notes.append(f"{run.totals.missing} ticks are missing in the log")
    if run.totals.not_a_number:
        notes.append(f"the speed of {run.totals.not_a_number} ticks is no number")
    return "".join(f'<p class="note">{escape(note)}</p>' for note in notes)


def _facts(run: Run) -> str:
    totals, config = run.totals, run.config
    facts = {
        "length": f"{run.span_s:.3f} s, {totals.ticks} ticks at {run.rate_hz:g} Hz",
        "in operation": f"{totals.operating} ticks",
        "controller": f"{config.controller.kind}, window N = {run.N[0]} (speed), {run.N[1]} (current) ticks"
        if config
        else "–",
        "bus": f"{config.bus.interface}, {config.bus.channel}, {config.bus.bitrate} bit/s" if config else "–",
        "largest": ", ".join(f"|{name}| {number(value)}" for name, value in totals.peaks.items()),
        "seen": ", ".join(f"{name}: {n}" for name, n in totals.flags.items() if n and not _usual(name))
        or "nothing unusual",
        "states": ", ".join(f"{name} {count}" for name, count in totals.states.items() if count),
    }
    if config and config.drive.speed_filter.kind != "none":
        facts["speed filter"] = known(config.drive.speed_filter)
    rows = ((escape(name), escape(text)) for name, text in facts.items())
    return f"<div>{table(('run', ''), rows, False)}</div>"


def _usual(flag: str) -> bool:
    return flag in ("bus: fresh", "bus: status")


def metrics(runs: Sequence[Run]) -> str:
    """Figures of all runs side by side, each with its difference from the first (of the same node)."""
    values = [figures(run) for run in runs]
    head = ["", *(_swatch(i, len(runs) > 1) + escape(run.name) for i, run in enumerate(runs))]
    bases = {run.node: index for index, run in reversed(list(enumerate(runs)))}
    pairs = [(bases[run.node], index) for index, run in enumerate(runs) if bases[run.node] != index]
    head += [f"{escape(runs[index].name)} − {escape(runs[base].name)}" for base, index in pairs]
    rows = []
    for figure in FIGURES:
        own = [value[figure.key] for value in values]
        if figure.special and not any(value is not None for value in own):
            continue
        cells = [number(value, figure.unit) for value in own]
        cells += [_difference(own[base], own[index], figure.unit) for base, index in pairs]
        rows.append((escape(figure.name), *map(escape, cells)))
    return table(head, rows)


def _difference(first: float | None, other: float | None, unit: str) -> str:
    if first is None or other is None or float("inf") in (first, other):
        return "–"
    share = f" ({100.0 * (other - first) / first:+.1f} %)" if first else ""
    return f"{other - first:+.4g} {unit}{share}"


def _go(t: float, span: float) -> str:
    return f'<button class="link" data-t="{t:.6f}" data-span="{span:g}">{t:.3f}</button>'


def responses(run: Run) -> str:
    """The step responses of a run, each a link to its place."""
    if not run.follows:
        return '<p class="soft">Its torque is commanded: no speed is asked of it.</p>'
    head = ("t [s]", "step", "dip [rad/s]", "recovery [ms]", "rise [ms]", "overshoot [%]", "settling [ms]",
            "IAE [rad]", "ripple [rad/s]", "ripple i_q [A]", "estimate off [N m]")  # fmt: skip
    shown = run.responses.kept[:MOST_RESPONSES]
    more = run.responses.count - len(shown)
    note = f'<p class="soft small">and {more} more</p>' if more > 0 else ""
    return (table(head, map(_response, shown)) if shown else '<p class="soft">No step was found.</p>') + note


def _response(r: Response) -> Row:
    unit = "N m load" if r.kind == "load" else "rad/s"
    ms = [None if v is None else 1e3 * v for v in (r.recovery_s, r.rise_s, r.settling_s)]
    cells: list[float | None] = [r.dip, ms[0], ms[1], r.overshoot_percent, ms[2], r.iae, r.ripple, r.ripple_i]
    cells.append(r.estimate_error)
    return (_go(r.t, EVENT_SPAN_S), f"{r.size:+.3g} {unit}", *map(number, cells))


def phases(run: Run) -> str:
    """What the parts of a tick cost."""
    rows = (
        (name, *(f"{value:.1f}" for value in part.as_dict().values()))
        for name, part in run.phases.parts.items()
    )
    return table(("phase [µs]", "mean", "p50", "p99", "p99.9", "max"), rows)


def _frames(runs: Sequence[Run]) -> str:
    """What was on each run's bus; that of several nodes is one, with the names of all their messages."""
    if not one_log(runs):
        return _each(runs, traffic)
    every = [run.message_names() for run in runs]
    names: dict[int, str] = {}
    for run, own in zip(runs, every, strict=True):
        names |= {
            n: name if all(n in one for one in every) else f"{run.node} {name}" for n, name in own.items()
        }
    return traffic(runs[0], names)


def traffic(run: Run, names: Mapping[int, str] | None = None) -> str:
    """Frames a direction and identifier, and the bus load; ``names``: of messages, else as its DBC says."""
    names = run.message_names() if names is None else names
    if not run.frames.traffic:
        return '<p class="soft">The log holds no frames.</p>'
    load = run.bus_load()
    rows = []
    for (can_id, received), t in sorted(run.frames.traffic.items()):
        length = f"{t.bytes_low}" if t.bytes_low == t.bytes_high else f"{t.bytes_low} to {t.bytes_high}"
        rate = "–" if t.rate is None else f"{t.rate:.4g}"
        spacing = ("–", "–") if t.count < 2 else (f"{t.shortest:.3f}", f"{t.longest:.3f}")
        way = "received" if received else "sent"
        rows.append(
            (
                id_text(can_id),
                escape(names.get(can_id & ~REMOTE, "")),
                way,
                str(t.count),
                length,
                rate,
                *spacing,
            )
        )
    head = ("identifier", "message", "", "frames", "bytes", "rate [1/s]", "closest [ms]", "widest [ms]")
    text = (
        ""
        if load is None
        else (
            f"<p>Bus load {load[0]:.1f} % in the mean, {load[1]:.1f} % in the busiest second, "
            "counting every stuff bit that could be.</p>"
        )
    )
    return (
        table(head, rows, texts=3)
        + text
        + ("<p>There are more identifiers.</p>" if run.frames.more_ids else "")
    )


def events(run: Run) -> str:
    """The log's events, each a link to its place."""
    shown = run.events(MOST_EVENTS)
    rows = ((_go(e["t"], EVENT_SPAN_S), escape(e["kind"]), escape(e["text"])) for e in shown)
    more = len(run.log.events) - len(shown)
    note = f'<p class="soft small">and {more} more</p>' if more > 0 else ""
    return table(("t [s]", "event", ""), rows, False) + note if shown else '<p class="soft">No events.</p>'


def origin(run: Run) -> str:
    """Where a log comes from: file, versions, config, design."""
    found = {"file": str(run.log.path.name), **run.log.metadata.get("run", {})}
    rows = ((escape(k), escape(v)) for k, v in found.items())
    texts = "".join(
        f"<details><summary>{escape(name)}</summary><pre>{escape(text[:100_000])}</pre></details>"
        for name, text in run.log.attachments.items()
        if name != "controller.json" and not any(name.endswith(f" of {node}") for node in run.log.nodes)
    )
    return table(("", ""), rows, False) + texts


def _plots(runs: Sequence[Run]) -> str:
    return "".join(
        f'<div class="plot" id="plot-{plot.key}"><h3>{escape(plot.title)}'
        f"{f' [{escape(plot.unit)}]' if plot.unit else ''}"
        f'<span class="soft small">{escape(limits_text(lines_of(runs, plot)))}</span></h3></div>'
        for plot in plots_of(*(run.config for run in runs))
        if not is_empty(runs, plot)
    )


def _charts(runs: Sequence[Run]) -> str:
    return "".join(
        f'<div class="plot" id="chart-{chart["key"]}"><h3>{escape(CHART_TITLES[chart["key"]])}</h3></div>'
        for chart in charts(runs)
    )


def _each(runs: Sequence[Run], what: Any) -> str:
    """A section's content for each run, with its name where there are several."""
    if len(runs) == 1:
        return str(what(runs[0]))
    return "".join(
        f"<h3>{_swatch(index, True)}{escape(run.name)}</h3>{what(run)}" for index, run in enumerate(runs)
    )


def page(runs: Sequence[Run], more: Sequence[Section] = ()) -> str:
    """The whole page; ``more``: sections after the curves."""
    scripts = (asset("uPlot.iife.min.js"), asset("page.js"))
    styles = (asset("uPlot.min.css"), asset("page.css"))
    policy = (
        f"default-src 'none'; script-src {' '.join(map(_hash, scripts))}; "
        f"style-src {' '.join(map(_hash, styles))}; base-uri 'none'; form-action 'none'"
    )
    sections = "".join(f"<section><h2>{escape(s.title)}</h2>{s.html}</section>\n" for s in more)
    nodes, names = one_log(runs), " · ".join(run.name for run in runs)
    title = escape(f"{runs[0].log.path.stem}: {names}" if nodes else names)
    kind = f"Run of {len(runs)} nodes" if nodes else "Comparison of runs" if len(runs) > 1 else "Run"
    head = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>{"".join(f"<style>{text}</style>" for text in styles)}</head><body>"""
    body = f"""
<p class="soft small">{kind}</p><h1>{title}</h1>
<section>{summary(runs)}</section>
<div id="bar"><button id="all">whole run</button><button id="back" disabled>back</button>
<span id="range" class="small"></span><span class="hint soft small">drag across any plot to zoom all of them,
double-click for the whole run; click a name under a plot to hide its curve</span>
<span id="near" class="small"></span></div>
<section><h2>Curves</h2><div id="plots">{_plots(runs)}</div></section>
{sections}<section><h2>Figures</h2>{metrics(runs)}</section>
<section><h2>Step responses</h2>{_each(runs, responses)}</section>
<section><h2>Time of a tick, spectra</h2>{_each(runs[:1] if nodes else runs, phases)}
<div class="columns">{_charts(runs)}</div></section>
<section><h2>Frames on the bus</h2>{_frames(runs)}</section>
<section><h2>Events</h2>{_each(runs[:1] if nodes else runs, events)}</section>
<section><h2>Replay</h2>{_each(runs, lambda run: f"<p>{escape(verdict_text(run))}</p>")}</section>
<section><h2>Origin</h2>{_each(runs, origin)}</section>
<script type="application/json" id="report">{script_json(report_data(runs))}</script>"""
    tail = "".join(f"<script>{text}</script>" for text in scripts)
    return f"{head}{body}{tail}</body></html>\n"
