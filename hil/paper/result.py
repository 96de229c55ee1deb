"""From the study to files: figures as PNG and SVG, the page, the table and JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hil.paper.errata import errata_items
from hil.paper.figures import all_figures
from hil.paper.items import CANNOT, CORRECTED, EQUAL, Item
from hil.paper.page import page, summary
from hil.paper.plots import Figure, picture
from hil.paper.printed import printed_items
from hil.paper.study import Study, make_study
from hil.signals import TickArray

COLOURS: Final = {EQUAL: "green", CORRECTED: "yellow", CANNOT: "red"}


@dataclass(frozen=True, slots=True)
class PaperResult:
    """What `hil paper` hands back: rows of the table, path of the page and of the pictures."""

    items: tuple[Item, ...]
    page: Path
    pictures: tuple[Path, ...]

    def to_json(self) -> str:
        """{"items": [...], "page": ..., "pictures": [...]}."""
        content = {
            "items": [item.as_dict() for item in self.items],
            "page": str(self.page),
            "pictures": [str(path) for path in self.pictures],
        }
        return json.dumps(content, indent=2, ensure_ascii=False)

    def table(self) -> Any:
        """A rich table for the terminal."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=f"The paper, recomputed: {summary(self.items)}", show_lines=True)
        for name, ratio in (("item", 3), ("where", 2), ("printed", 2), ("computed", 2), ("why", 4)):
            table.add_column(name, ratio=ratio, overflow="fold")
        for item in self.items:
            why = Text(item.verdict, style=f"bold {COLOURS[item.verdict]}").append(
                f"\n{item.why}", style="not bold"
            )
            table.add_row(*(Text(c) for c in (item.item, item.where, item.printed, item.computed)), why)
        return table


def run(out: Path, bench: TickArray | None = None) -> PaperResult:
    """Compute everything and write the page and the pictures into ``out``.

    ``bench``: ticks of a run or simulation of configs/paper.toml; without it the bench is left out.
    Raises OSError when ``out`` can't be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    study = make_study(bench)
    printed, errata = printed_items(study), errata_items(study)
    figures = all_figures(study)
    pictures = [path for figure in figures for path in _write(figure, out)]
    inline = [(_title(f), f.caption, (out / f"{f.name}.svg").read_bytes()) for f in figures]
    path = out / "paper.html"
    path.write_text(page(printed, errata, inline), encoding="utf-8")
    return PaperResult((*printed, *errata), path, tuple(pictures))


def verdicts(study: Study) -> list[Item]:
    """All rows, without writing anything."""
    return [*printed_items(study), *errata_items(study)]


def _title(figure: Figure) -> str:
    number = figure.name.removeprefix("fig")
    return f"Fig. {int(number)}." if number.isdigit() else f"{figure.name.replace('_', ' ').capitalize()}."


def _write(figure: Figure, out: Path) -> list[Path]:
    """PNG and SVG of a figure."""
    paths = []
    for kind, content in picture(figure).items():
        paths.append(out / f"{figure.name}.{kind}")
        paths[-1].write_bytes(content)
    return paths
