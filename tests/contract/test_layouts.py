"""The shipped layouts of other viewers: each curve is in the schema of a log, each file is in its form.

What PlotJuggler's own loader asks of a layout is held here: it looks curves up as TOPIC/FIELD, makes as many
docks as ``count`` says and reads a share of the height for each. Nothing of it was run.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader

from hil.manual.layouts import layouts, panels
from hil.signals import FIELDS, Field, Shown
from tests.conftest import CONFIGS
from tests.logfiles import some_frames, some_ticks, write_log

LAYOUTS = CONFIGS / "layouts"


@pytest.fixture(scope="module")
def fields(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Fields by topic, as the mcap package reads them out of a log."""
    path = tmp_path_factory.mktemp("layouts") / "run.mcap"
    write_log(path, some_ticks(100), some_frames(300))
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    out = {}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        files = FileDescriptorSet.FromString(schema.data).file
        messages = {f"{file.package}.{m.name}": m for file in files for m in file.message_type}
        out[channel.topic] = {field.name for field in messages[schema.name].field}
    return out


def test_every_layout_is_looked_at() -> None:
    assert {p.name for p in LAYOUTS.iterdir()} == {
        "lichtblick.json",
        "lichtblick-live.json",
        "plotjuggler.xml",
    }


@pytest.mark.parametrize("name", list(layouts()))
def test_the_layouts_are_made_of_the_fields_rows(name: str) -> None:
    assert (LAYOUTS / name).read_text() == layouts()[name], "make reference"


def test_a_new_signals_row_is_a_curve_of_its_panel() -> None:
    loss = Field(
        99, "p_loss", "f8", "W", "output", "copper loss", shown=Shown("p_loss", "copper", live="loss")
    )
    found = panels((*FIELDS, loss))
    assert found["Loss [W]"] == [loss] and list(found)[:-1] == list(panels())


@pytest.mark.parametrize("name", ["lichtblick", "lichtblick-live"])
def test_lichtblick_and_foxglove(name: str, fields: dict[str, set[str]]) -> None:
    layout = json.loads((LAYOUTS / f"{name}.json").read_text())
    panels = layout["configById"]
    paths = [p["value"] for panel in panels.values() for p in panel.get("paths", [])]
    assert len(paths) > 12
    for path in paths:
        topic, _, field = path.partition(".")
        assert field in fields[topic], path
    assert all(panel["topicPath"] in fields for panel in panels.values() if "topicPath" in panel)
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(panels)
    follow = {panel.get("followingViewWidth") for key, panel in panels.items() if key.startswith("Plot!")}
    assert follow == ({10} if name.endswith("live") else {None})  # live: the last 10 s; a log: all of it


def test_plotjuggler(fields: dict[str, set[str]]) -> None:
    root = ET.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = [curve.get("name", "") for curve in root.iter("curve")]
    assert len(curves) > 8 and len(set(curves)) == len(curves)
    assert set(curves) <= {f"{topic}/{field}" for topic in fields for field in fields[topic]}
    assert all(re.fullmatch(r"#[0-9a-f]{6}", curve.get("color", "")) for curve in root.iter("curve"))
    window = root.find("tabbed_widget")
    assert root.tag == "root" and window is not None
    assert (window.get("parent"), window.get("name")) == ("main_window", "Main Window")
    for tab in window.findall("Tab"):
        (splitter,) = tab.findall("Container/DockSplitter")
        areas, sizes = splitter.findall("DockArea"), splitter.get("sizes", "").split(";")
        assert splitter.get("orientation") == "-" and int(splitter.get("count", "")) == len(areas)
        assert len(sizes) == len(areas) and sum(map(float, sizes)) == pytest.approx(1.0)
        plots = [plot for area in areas for plot in area.findall("plot")]
        assert len(plots) == len(areas) and all(area.get("name") for area in areas)
        assert {(plot.get("mode"), plot.get("style")) for plot in plots} == {("TimeSeries", "Lines")}
