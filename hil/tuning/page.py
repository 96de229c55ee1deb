"""Pages and pictures of a comparison and of a design: self-contained HTML, figures inline."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from hil.paper.page import CSS, image

COLUMNS: Final = {
    "law": ("law", "{}"),
    "dip": ("dip [rad/s]", "{:.2f}"),
    "recovery_ms": ("back in 0.5 rad/s [ms]", "{:.0f}"),
    "iae": ("IAE [rad]", "{:.3f}"),
    "u_noise_mv": ("noise of u_q [mV]", "{:.1f}"),
    "command_noise": ("noise of the command [{unit}]", "{:.3g}"),
    "ms": ("Ms", "{:.2f}"),
    "ms_worst": ("Ms, worst corner", "{:.2f}"),
    "worst_dip": ("dip, worst corner [rad/s]", "{:.2f}"),
}


def columns(found: dict[str, Any]) -> dict[str, str]:
    """Titles of the columns that a comparison or a design has, by their keys."""
    unit = found["bench"]["unit"]
    other = "u_noise_mv" if unit != "V" else "command_noise"
    return {key: title.format(unit=unit) for key, (title, _) in COLUMNS.items() if key != other}


def noise_of(found: dict[str, Any], unit: str) -> str:
    """The noise of a row, a design or a limit, with its unit."""
    return (
        f"u_q {found['u_noise_mv']:.1f} mV" if unit == "V" else f"command {found['command_noise']:.3g} {unit}"
    )


def cell(row: dict[str, Any], name: str) -> str:
    """One number of a row as text."""
    value = row.get(name)
    text = COLUMNS[name][1].format(value) if value is not None else "-"
    return text + (" (limits not kept)" if name == "law" and not row.get("feasible", True) else "")


def _svg(figure: Any) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    return out.getvalue()


def _html(title: str, body: str) -> str:
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
        f"<style>{CSS}</style></head><body><h1>{escape(title)}</h1>\n{body}\n</body></html>\n"
    )


def _drawn(value: float) -> float:
    """The length of a bar: none for a run that did not end as it should."""
    return value if math.isfinite(value) else 0.0


def bars(rows: Sequence[dict[str, Any]]) -> bytes:
    """Dip, nominal and in the worst corner, of every law."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.45 * len(rows) + 1.2))
    axes = figure.subplots()
    names, where = [row["law"] for row in rows], range(len(rows))
    worst, here = ([_drawn(row[key]) for row in rows] for key in ("worst_dip", "dip"))
    axes.barh(where, worst, color="#c9d8e8", label="worst corner")
    axes.barh(where, here, height=0.45, color="#2b6ca3", label="this plant")
    axes.set_yticks(where, names)
    axes.invert_yaxis()
    axes.set_xlabel("dip after the load step [rad/s]")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)


def comparison(found: dict[str, Any]) -> str:
    """The page of a comparison."""
    rows = [found["as_configured"], *found["rows"]]
    titles = columns(found)
    head = "".join(f"<th>{escape(title)}</th>" for title in titles.values())
    lines = "".join(
        "<tr>" + "".join(f"<td>{escape(cell(r, n))}</td>" for n in titles) + "</tr>" for r in rows
    )
    limits, bench = found["limits"], found["bench"]
    text = (
        f"<p>{escape(found['config'])}: load step of {bench['load']:g} N m. Every law is tuned by the same "
        f"optimiser for the least worst-corner IAE under the same limits: noise in "
        f"{noise_of(limits, bench['unit'])}, Ms {limits['ms']:.2f} nominal and {limits['ms_worst']:.2f} in "
        "the worst corner (linear loop); then run in the simulation with the same seeds "
        f"{found['seeds']}.</p>"
    )
    designs = "".join(
        f"<h3>{escape(row['law'])}: {escape(row['what'])}</h3><pre>{escape(row['toml'])}</pre>"
        for row in found["rows"]
    )
    table = f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'
    picture = image("Dip.", "Lower is better; pale: the worst corner of the spread.", bars(rows))
    return _html("Laws compared", text + table + picture + "<h2>The designs</h2>" + designs)


def front_picture(found: dict[str, Any], path: Path) -> None:
    """The front as a PNG: dip against the command's noise, nominal and worst corner, the design marked."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.5))
    axes = figure.subplots()
    key = "u_noise_mv" if found["bench"]["unit"] == "V" else "command_noise"
    title, form = columns(found)[key], "{:.0f}" if key == "u_noise_mv" else "{:.2g}"
    noise = [point[key] for point in found["front"]]
    for name, label, color in (("worst_dip", "worst corner", "#8a5a00"), ("dip", "nominal", "#2b6ca3")):
        axes.plot(
            noise, [point[name] for point in found["front"]], "o-", color=color, label=label, mfc="white"
        )
        axes.plot(found[key], found[name], "o", color=color, ms=9)
    for point in found["front"]:
        text = f"{point['recovery_ms']:.0f} ms"
        axes.annotate(text, (point[key], point["dip"]), (0, -14), textcoords="offset points", ha="center")
    axes.set_xscale("log")
    axes.set_xticks(noise, [form.format(value) for value in noise])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_xlabel(title.replace("]", " rms]"))
    axes.set_ylabel("dip after the load step [rad/s]")
    axes.set_title(
        f"{found['law']}: what noise buys (full: the design; below: back within 0.5 rad/s)", fontsize=10
    )
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130, bbox_inches="tight")
