"""The bench as a picture and as one self-contained page."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import numpy as np

from hil.bench.histogram import Histogram
from hil.bench.measure import Bench


def write(bench: Bench, folder: Path) -> list[Path]:
    """Write lateness.png and bench.html; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    picture = draw(bench)
    paths = [folder / "lateness.png", folder / "bench.html"]
    paths[0].write_bytes(picture)
    paths[1].write_text(page(bench.result, picture), encoding="utf-8")
    return paths


def draw(bench: Bench) -> bytes:
    """Both histograms of lateness on logarithmic axes, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.2), dpi=130, layout="constrained")
    axes = figure.subplots()
    _steps(axes, bench.ours, "hil run", "C0")
    if bench.anchor is not None:
        _steps(axes, bench.anchor, f"cyclictest ({bench.result['cyclictest']})", "C1")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("wake-up after the deadline [us]")
    axes.set_ylabel("wake-ups")
    axes.set_title(f"Lateness at {bench.result['run_rate_hz']} Hz")
    axes.grid(True, which="both", alpha=0.25)
    axes.legend()
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()


def _steps(axes: Any, histogram: Histogram, label: str, colour: str) -> None:
    """Counts in ten bins a decade, with a line at the 99.9th percentile."""
    edges = np.unique(np.round(np.logspace(0, np.log10(len(histogram.counts)), 44)).astype(np.int64))
    edges = np.concatenate(([0], edges))
    sums = np.add.reduceat(histogram.counts, edges[:-1])
    shown = np.concatenate(([0.7], edges[1:].astype(float)))  # a bin from 0 has no left end on a log axis
    p999 = histogram.percentile(0.999)
    axes.stairs(sums, shown, label=f"{label}: p99.9 {p999:.0f} us", color=colour, linewidth=1.6)
    axes.axvline(p999, color=colour, linestyle=":", linewidth=1.2)


def page(result: dict[str, Any], picture: bytes) -> str:
    """One HTML file that needs nothing else."""
    from hil.bench.view import rows

    encoded = base64.b64encode(picture).decode("ascii")
    body = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows(result)
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><title>hil bench</title>'
        "<style>:root{color-scheme:light dark}body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;"
        "margin:2rem auto;padding:0 1rem}th{text-align:left;padding-right:1.5rem;vertical-align:top;"
        "font-weight:600}td,th{border-bottom:1px solid #8884;padding-block:.3rem}img{max-width:100%}"
        f"table{{border-collapse:collapse}}</style><h1>hil bench</h1><table>{body}</table>"
        f'<img alt="histogram of lateness, logarithmic" src="data:image/png;base64,{encoded}">'
    )
