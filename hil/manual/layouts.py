"""Layouts of other viewers, made from the rows of the fields: ``configs/layouts``.

    python -m hil.manual.layouts configs/layouts

A panel for each plot of ``hil watch --web``: its curves, and those of the report's plot of the same name, in
the unit of the log. Lichtblick and Foxglove Studio read the JSON files, PlotJuggler the XML file.
"""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, Final

from hil.signals import FIELDS, Field
from hil.watch.feed import COMMAND_UNIT, live_names

COLOURS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2")
STATES: Final = ("state", "drive_state", "reason")
LIVE_S: Final = 10
"""What the live layout shows of a run; that for logs shows all of it [s]."""


def panels(fields: tuple[Field, ...] = FIELDS) -> dict[str, list[Field]]:
    """Curves of each panel, by its title with the unit."""
    out = {}
    for name in live_names(fields):
        curves = [field for field in fields if name in (field.shown.live, field.shown.plot)]
        unit = COMMAND_UNIT if name == "command" else curves[0].unit
        out[f"{name.capitalize()} [{unit}]"] = curves
    return out


def _path(name: str) -> dict[str, Any]:
    return {"value": f"/tick.{name}", "enabled": True, "timestampMethod": "receiveTime", "label": name}


def _plot(title: str, curves: list[Field]) -> dict[str, Any]:
    """A plot of Studio."""
    return {
        "title": title,
        "paths": [_path(field.name) for field in curves],
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _split(first: Any, second: Any, direction: str, percent: int) -> dict[str, Any]:
    return {"first": first, "second": second, "direction": direction, "splitPercentage": percent}


def _column(names: list[Any]) -> Any:
    """Panels one below the other, of one height."""
    first, *others = names
    return _split(first, _column(others), "column", round(100 / len(names))) if others else first


def studio(live: bool) -> str:
    """Layout of Lichtblick and Foxglove Studio: two columns of plots, states and events below the second."""
    plots = {f"Plot!hil{n}": _plot(*panel) for n, panel in enumerate(panels().items())}
    if live:
        plots = {name: plot | {"followingViewWidth": LIVE_S} for name, plot in plots.items()}
    states = {"paths": list(map(_path, STATES)), "isSynced": True}
    events = {
        "topicPath": "/event",
        "diffEnabled": False,
        "diffMethod": "custom",
        "diffTopicPath": "",
        "showFullMessageForDiff": False,
    }
    names: list[Any] = list(plots)
    foot = _split("StateTransitions!hil", "RawMessages!hil", "row", 60)
    layout = {
        "configById": plots | {"StateTransitions!hil": states, "RawMessages!hil": events},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(_column(names[::2]), _column([*names[1::2], foot]), "row", 50),
    }
    return json.dumps(layout, indent=2) + "\n"


def plotjuggler() -> str:
    """Layout of PlotJuggler: all plots below each other."""
    found = panels()
    root = ET.Element("root")
    window = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    tab = ET.SubElement(window, "Tab", containers="1", tab_name="run")
    share = ";".join([f"{1 / len(found):.6g}"] * len(found))
    splitter = ET.SubElement(
        ET.SubElement(tab, "Container"), "DockSplitter", orientation="-", count=str(len(found)), sizes=share
    )
    for title, curves in found.items():
        area = ET.SubElement(splitter, "DockArea", name=title)
        plot = ET.SubElement(area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false")
        ET.SubElement(plot, "limitY")
        for colour, field in zip(COLOURS, curves, strict=False):
            ET.SubElement(plot, "curve", name=f"/tick/{field.name}", color=colour)
    ET.SubElement(window, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    for name in ("Plugins", "customMathEquations", "snippets"):
        ET.SubElement(root, name)
    ET.indent(root, " ")
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"


def layouts() -> dict[str, str]:
    """What is made, by the file's name."""
    return {
        "lichtblick.json": studio(live=False),
        "lichtblick-live.json": studio(live=True),
        "plotjuggler.xml": plotjuggler(),
    }


if __name__ == "__main__":
    for made, text in layouts().items():
        (Path(sys.argv[1]) / made).write_text(text, encoding="utf-8")
