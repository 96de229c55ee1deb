"""The report of a campaign: one HTML page that needs nothing else and runs nothing."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from html import escape
from itertools import pairwise
from typing import Any, Final

import numpy as np

from hil.campaign import summary
from hil.campaign.store import Folder
from hil.campaign.summary import F8, name_of
from hil.report.criteria import number
from hil.report.page import asset, table

MOST_FIGURES: Final = 8
MAIN: Final = ("dip_rad_s", "recovery_s", "tracking_rms_rad_s", "overshoot_percent", "i_peak_a", "u_noise_v")
BINS, WIDTH, HEIGHT = 40, 420, 110
CSS: Final = """
.figures { display: grid; gap: 1rem 2rem;
  grid-template-columns: repeat(auto-fit, minmax(min(24rem, 100%), 1fr)) }
svg { width: 100%; max-width: 40rem; display: block }
svg text { font: 11px system-ui, sans-serif; fill: var(--soft) }
.bar { fill: var(--c0) } .mark { stroke: var(--bad); stroke-dasharray: 4 3 } .axis { stroke: var(--line) }
.pos { fill: var(--c1) } .neg { fill: var(--c0) } .cell { fill: var(--c1) } .void { fill: var(--card) }
code { font-size: .78rem; overflow-wrap: anywhere } td.c { white-space: normal; min-width: 24rem }
.big { font-size: 1.6rem; font-weight: 600 }
"""


def page(held: Folder) -> str:
    """The whole page."""
    title = held.about.get("name") or held.path.name
    styles = (asset("page.css"), CSS)
    policy = f"default-src 'none'; style-src {' '.join(map(_hash, styles))}; base-uri 'none'"
    found = summary.spreads(held)
    main = _main(held, found)
    sections = {
        "": _yield(held),
        "Figures over all cases": _spreads(held, found),
        "Which keys matter": _importance(held, main),
        "Laws, case by case": _laws(held),
        "Map of two keys": _map(held, main),
        "Worst cases": _worst(held, main),
        "Origin": _origin(held),
    }
    body = "".join(
        f"<section>{f'<h2>{name}</h2>' if name else ''}{text}</section>"
        for name, text in sections.items()
        if text
    )
    head = "".join(f"<style>{text}</style>" for text in styles)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>{head}</head>
<body><p class="soft small">Campaign</p><h1>{escape(title)}</h1>{body}</body></html>
"""


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def _main(held: Folder, found: Sequence[summary.Spread]) -> list[str]:
    """The figures that are shown: those that are judged, then the usual ones; of both what varies."""
    varies = [one.key for one in found]
    judged = [name.partition(":")[2] for name in held.schema if name.startswith("criteria:")]
    wanted = dict.fromkeys([*judged, *MAIN])
    return [key for key in wanted if key in varies][:MOST_FIGURES] or varies[:MOST_FIGURES]


def _yield(held: Folder) -> str:
    passed = held.columns("passed")["passed"].astype(bool)
    good, count = int(passed.sum()), len(passed)
    low, high = summary.interval(good, count)
    share = f"{100 * good / count:.2f} %" if count else "–"
    kind = "pass" if good == count else "fail"
    open_cases = held.count - count
    note = (
        f'<p class="note">{open_cases} cases are not done yet: go on with --resume</p>' if open_cases else ""
    )
    rows = [(escape(f"ended: {name.replace('_', ' ')}"), str(n)) for name, n in summary.endings(held).items()]
    rows += [(escape(f"not within: {name_of(k)}"), str(n)) for k, n in summary.failures(held).items()]
    return (
        f'<p class="big {kind}">yield {share}</p><p>{good} of {count} cases pass; 95 % confidence interval '
        f"{100 * low:.2f} to {100 * high:.2f} % (Wilson)</p>{note}{table(('', 'cases'), rows)}"
    )


def _spreads(held: Folder, found: Sequence[summary.Spread]) -> str:
    rows = (
        (escape(name_of(s.key)), str(s.count), *(number(v) for v in (*s.quantiles, s.mean))) for s in found
    )
    head = ("figure", "cases", "least", "5 %", "median", "95 %", "largest", "mean")
    plots = "".join(_histogram(held, key) for key in _main(held, found))
    return table(head, rows) + f'<div class="figures">{plots}</div>'


def _histogram(held: Folder, key: str) -> str:
    """Cases over a figure, with the limit of its criterion."""
    values = summary.figure_of(held, key)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return ""
    limit = _limits(held).get(key)
    low, high = float(finite.min()), float(finite.max())
    if limit is not None and low < limit < high + 0.5 * (high - low):
        high = max(high, limit)
    high = high if high > low else low + 1.0
    counts, _ = np.histogram(finite, BINS, (low, high))
    step, top = WIDTH / BINS, max(int(counts.max()), 1)
    bars = "".join(
        f'<rect class="bar" x="{i * step:.1f}" y="{HEIGHT - 90 * n / top:.1f}" '
        f'width="{step - 0.6:.1f}" height="{90 * n / top:.1f}"/>'
        for i, n in enumerate(counts.tolist())
        if n
    )
    if limit is not None and low <= limit <= high:
        x = (limit - low) / (high - low) * WIDTH
        bars += f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="8" y2="{HEIGHT}"/>'
    return _figure(
        name_of(key),
        f'{bars}<line class="axis" x1="0" x2="{WIDTH}" y1="{HEIGHT}" y2="{HEIGHT}"/>'
        f'<text x="0" y="{HEIGHT + 13}">{number(low)}</text>'
        f'<text x="{WIDTH}" y="{HEIGHT + 13}" text-anchor="end">{number(high)}</text>',
        HEIGHT + 18,
    )


def _figure(title: str, content: str, height: float, width: float = WIDTH) -> str:
    return (
        f'<div class="plot"><h3>{escape(title)}</h3>'
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img">{content}</svg></div>'
    )


def _limits(held: Folder) -> dict[str, float]:
    limits: dict[str, float] = held.about.get("limits", {})
    return limits


def _importance(held: Folder, main: Sequence[str]) -> str:
    """Bars of rank correlation, a plot a figure."""
    keys = [key for key in summary.varied(held) if not summary.follows(held, key)]
    plots = []
    for key in main if keys else []:
        figure = summary.figure_of(held, key)
        found = {name: summary.importance(held, name, figure) for name in keys}
        order = sorted(found, key=lambda name: -abs(found[name]))[:12]
        bars = "".join(_bar(row, name, found[name]) for row, name in enumerate(order))
        plots.append(_figure(name_of(key), bars, 18 * len(order) + 4))
    if not plots:
        return ""
    return (
        '<p class="soft small">Spearman’s rank correlation of key and figure over all cases, −1 to 1 '
        "(to the right: more of it, more of the figure); for words the correlation ratio, 0 to 1</p>"
        f'<div class="figures">{"".join(plots)}</div>'
    )


def _bar(row: int, name: str, value: float) -> str:
    y, middle, half = 18 * row, 310.0, 80.0
    x = middle + min(value, 0.0) * half
    return (
        f'<text x="0" y="{y + 13}">{escape(name)}</text>'
        f'<line class="axis" x1="{middle}" x2="{middle}" y1="{y}" y2="{y + 18}"/>'
        f'<rect class="{"pos" if value > 0 else "neg"}" x="{x:.1f}" y="{y + 3}" '
        f'width="{abs(value) * half:.1f}" height="12"/>'
        f'<text x="{WIDTH}" y="{y + 13}" text-anchor="end">{value:+.2f}</text>'
    )


def _laws(held: Folder) -> str:
    axis = summary.law_axis(held)
    if axis is None:
        return ""
    out = [f'<p class="soft small">by {escape(axis)}; each pair differs in nothing else</p>']
    for title, found in summary.paired(held, axis).items():
        rows = (
            (
                escape(name_of(d.key)),
                str(d.count),
                f"{d.mean:+.4g}",
                f"{d.low:+.4g} to {d.high:+.4g}",
                f"{100 * d.smaller:.0f} %",
            )
            for d in found
        )
        head = ("figure", "pairs", "mean difference", "95 % interval", "smaller in")
        out.append(f"<h3>{escape(title)}</h3>{table(head, rows)}")
    return "".join(out)


def _map(held: Folder, main: Sequence[str]) -> str:
    """The first figure over the two numeric keys that matter most for it."""
    keys = [key for key in summary.varied(held) if held.schema.get(key) in ("i8", "f8")]
    if not main or len(keys) < 2:
        return ""
    figure = summary.figure_of(held, main[0])
    weights = {key: abs(summary.importance(held, key, figure)) for key in keys}
    a, b = sorted(keys, key=lambda key: -weights[key])[:2]
    axes = [_places(held.columns(key)[key].astype(np.float64)) for key in (a, b)]
    return _cells(main[0], (a, b), axes, figure)


def _places(values: F8) -> tuple[Any, list[str]]:
    """Each case's place on an axis, and what stands at its places."""
    single = np.unique(values[~np.isnan(values)])
    if len(single) <= summary.FEW:
        return np.searchsorted(single, values), [number(v) for v in single.tolist()]
    edges = np.quantile(values[~np.isnan(values)], np.linspace(0, 1, 13))
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, 11)
    return place, [f"{number(p)} to {number(q)}" for p, q in pairwise(edges)]


def _cells(key: str, names: tuple[str, str], axes: list[tuple[Any, list[str]]], figure: F8) -> str:
    (x, x_names), (y, y_names) = axes
    shape = (len(y_names), len(x_names))
    good = np.isfinite(figure) & (x < shape[1]) & (y < shape[0])
    flat = y[good] * shape[1] + x[good]
    count = np.bincount(flat, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(flat, figure[good], shape[0] * shape[1]) / count
    known = mean[count > 0]
    if not len(known):
        return ""
    low, span = float(known.min()), float(np.ptp(known)) or 1.0
    w, h, left = 300 / shape[1], 260 / shape[0], 110
    cells = ""
    for i, value in enumerate(mean.tolist()):
        row, column = divmod(i, shape[1])
        at = (
            f'x="{left + column * w:.1f}" y="{(shape[0] - 1 - row) * h:.1f}" width="{w:.1f}" height="{h:.1f}"'
        )
        tip = f"<title>{escape(names[0])} {x_names[column]}, {escape(names[1])} {y_names[row]}: "
        if count[i]:
            share = 0.06 + 0.94 * (value - low) / span
            cells += f'<rect class="cell" fill-opacity="{share:.3f}" {at}>{tip}{number(value)}, '
            cells += f"{count[i]} cases</title></rect>"
        else:
            cells += f'<rect class="void" {at}>{tip}no case</title></rect>'
    cells += f'<text x="{left}" y="275">{x_names[0]}</text>'
    cells += f'<text x="410" y="275" text-anchor="end">{x_names[-1]}</text>'
    cells += f'<text x="240" y="288" text-anchor="middle">{escape(names[0])}</text>'
    cells += f'<text x="0" y="256">{y_names[0]}</text><text x="0" y="12">{y_names[-1]}</text>'
    title = f"{name_of(key)}, mean of the cases: pale {number(low)}, full {number(low + span)}"
    return _figure(title, cells, 292) + f'<p class="soft small">upwards: {escape(names[1])}</p>'


def _worst(held: Folder, main: Sequence[str]) -> str:
    """The worst cases of each figure with the command that runs each again, and some that could not run."""
    out = []
    for key in main:
        rows = (_case(held, row, number(row[key])) for row in summary.worst(held, key))
        out.append(f"<h3>{escape(name_of(key))}</h3>{_commands('', rows)}")
    failed = _failed(held)
    if failed:
        rows = (_case(held, row, str(row["why"])) for row in failed)
        out.insert(0, f"<h3>did not pass</h3>{_commands('why', rows)}")
    return "".join(out)


def _failed(held: Folder) -> list[dict[str, Any]]:
    found = held.columns("passed")
    cases = found["case"][~found["passed"].astype(bool)][: summary.WORST]
    return summary.rows_at(held, cases.tolist()) if len(cases) else []


def _case(held: Folder, row: dict[str, Any], text: str) -> tuple[str, ...]:
    return str(row["case"]), escape(text), f"<code>{escape(summary.command(held, row))}</code>"


def _commands(what: str, rows: Iterable[tuple[str, ...]]) -> str:
    return table(("case", what, "again, with a log"), rows, numbers=False)


def _origin(held: Folder) -> str:
    made = held.about.get("made_by", {})
    facts = {"folder": str(held.path), "cases": str(held.count), **made}
    rows = ((escape(str(k)), escape(str(v))) for k, v in facts.items())
    plan = escape(str(held.about["plan"]))
    return table(("", ""), rows, False) + f"<details><summary>plan</summary><pre>{plan}</pre></details>"
