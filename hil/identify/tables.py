"""What `hil identify` shows on the terminal."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table

from hil.report.view import words


def shown(result: dict[str, Any]) -> list[Table]:
    """The parameters, the steps or runs, the drift."""
    tables = [_parameters(result)]
    if "steps" in result:
        tables.append(_steps(result))
    if len(result.get("runs", [])) > 1:
        tables.append(_drift(result))
    return tables


def _parameters(result: dict[str, Any]) -> Table:
    table = Table(title="hil identify", title_justify="left")
    for column in ("parameter", "value", "95 %", "unit", ""):
        table.add_column(column, overflow="fold")
    for name, p in result["parameters"].items():
        known = math.isfinite(p["value"])
        value = f"{p['value']:.5g}" if known else "-"
        interval = f"{p['low']:.5g} .. {p['high']:.5g}" if known else "-"
        table.add_row(name, value, interval, p["unit"], words(p.get("why", "")))
    table.add_row("file", words(result["file"] or "none was written"), "", "", "")
    return table


def _steps(result: dict[str, Any]) -> Table:
    table = Table(title=f"steps, {result['motor_s']:.1f} s of the motor", title_justify="left")
    for column in ("step", "ended", "log"):
        table.add_column(column, overflow="fold")
    for row in result["steps"]:
        table.add_row(row["step"], words(row.get("ended") or row["skipped"]), words(row.get("log", "-")))
    return table


def _drift(result: dict[str, Any]) -> Table:
    table = Table(title=f"drift over {len(result['runs'])} runs", title_justify="left")
    for column in ("parameter", "runs", "change", ""):
        table.add_column(column)
    for name, d in result["drift"].items():
        share = "" if d["change_percent"] is None else f" ({d['change_percent']:+.2f} %)"
        table.add_row(
            name, str(d["runs"]), f"{d['change']:+.3g}{share}", "drifts" if d["drifts"] else "stays"
        )
    return table
