"""One self-contained HTML page: figures inline as SVG, verdict table, how it was computed. Works offline."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

from hil.paper.items import CANNOT, CORRECTED, EQUAL, Item

COLUMNS: Final = ("item", "where", "printed", "computed", "verdict", "why")
CLASSES: Final = {EQUAL: "equal", CORRECTED: "corrected", CANNOT: "cannot"}
CSS: Final = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; width: 100%; font-size: .82rem }
td.n { font-family: ui-monospace, monospace }
td, th { text-align: left; vertical-align: top; padding: .3rem .5rem; border-bottom: 1px solid #ddd }
.equal::before { content: "= " } .corrected::before { content: "\\2248  " }
.cannot::before { content: "\\2715  " }
.verdict { font-weight: 600; white-space: nowrap } .equal { color: #1d6b2f } .corrected { color: #8a5a00 }
.cannot { color: #a8200d } figure { margin: 1.5rem 0; break-inside: avoid }
figure img { width: 100%; max-width: 46rem }
figcaption { font-size: .9rem; color: #444 } .scroll { overflow-x: auto }
@media print { body { max-width: none; font-size: 11px } }
"""
INTRO: Final = """
<p>Everything that the paper prints and draws, computed again: in its continuous form, eqs. (5) to (7),
integrated exactly with the delay (matrix exponentials on a grid that D is a multiple of), and in the exact
sampled form that the controller runs (circles in the figures). The yellow line is the disturbance, blue solid
the FTDOB, red dashed the conventional DOB (31).</p>
<p>Assumed, because the text does not say it: h before t<sub>0</sub> is held at h(t<sub>0</sub>); the random
signal of case 2 has levels of &plusmn;0.1 held for 1 s; the observers of Sect. 6 start at zero; the spans of
time that the figures show; the motor is a <em>reconstruction</em> from the printed &Pi; (Table 1 is missing):
n = 3 pole pairs, &psi;<sub>f</sub> = 0.8 Wb, R = 2.875 &Omega;, L = 33 mH, J = 0.011 kg m&sup2;,
B<sub>f</sub> = 2&middot;10<sup>-4</sup> N m s. The plant of Figs. 13 to 15 is the paper's own (34).</p>
"""
NO_BENCH: Final = "<p>The bench was not run: hand in the ticks of a run of configs/paper.toml.</p>"


def summary(items: Iterable[Item]) -> str:
    """How many rows have which verdict."""
    count = Counter(item.verdict for item in items)
    return ", ".join(f"{count[verdict]} {verdict}" for verdict in (EQUAL, CORRECTED, CANNOT))


def table(items: Iterable[Item]) -> str:
    """The verdict table."""
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(map(_row, items))}</table></div>'


def _row(item: Item) -> str:
    cells = item.as_dict()
    kinds = {"printed": "n", "computed": "n", "verdict": f"verdict {CLASSES[item.verdict]}"}
    return (
        "<tr>"
        + "".join(f'<td class="{kinds.get(c, "t")}">{escape(cells[c])}</td>' for c in COLUMNS)
        + "</tr>"
    )


def image(title: str, caption: str, svg: bytes) -> str:
    """A figure; the SVG is a data URI, so that ids of different figures can't meet."""
    data = base64.b64encode(svg).decode("ascii")
    return (
        f'<figure id="{title.split(".")[0].replace(" ", "").lower()}">'
        f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(caption)}">'
        f"<figcaption><strong>{escape(title)}</strong> {escape(caption)}</figcaption></figure>"
    )


def page(printed: Sequence[Item], errata: Sequence[Item], figures: Sequence[tuple[str, str, bytes]]) -> str:
    """The page; figures are (title, caption, svg)."""
    pictures = "\n".join(image(*figure) for figure in figures)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>The paper, recomputed</title><style>{CSS}</style></head><body>
<h1>The paper, recomputed</h1>
<p>Fixed-Time Disturbance Observer-Based Control for Uncertainty Systems Applied to Permanent-Magnet Speed
Control. {summary([*printed, *errata])}.</p>
{INTRO}
<h2>What is printed</h2>
{table(printed)}
<h2>Errata</h2>
<p>Where the paper is wrong, or says less than it seems to, by numbers.</p>
{table(errata)}
<h2>Figures</h2>
{pictures}
{"" if any(title == "Bench." for title, _, _ in figures) else NO_BENCH}
</body></html>
"""
