"""A log of two nodes for those who look at it: report, picture, info, export, recover, the fleet's rows."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import hil
from hil.campaign.fleet import fleet
from hil.cli import main
from hil.log.mcapfile import RunFile
from hil.log.reader import open_log
from hil.log.recover import recover
from hil.log.schema import FRAME
from hil.report.build import build
from hil.report.collect import collect_nodes
from hil.report.criteria import figures
from hil.report.curves import PLOTS
from hil.report.embed import lines_of
from hil.runtime.nodesession import nodes_header
from hil.runtime.nodesetup import load_node_setups
from hil.runtime.setup import Overrides
from hil.signals import DriveState, Reason, TickArray, new_ticks
from tests.conftest import CONFIGS

PERIOD_NS = 1_000_000
TICKS = 400
RESULT = {
    "ended": "over_speed", "node": "load", "ticks": TICKS, "skipped": 0,
    "nodes": {"motor": {"ended": "node_stopped"}, "load": {"ended": "over_speed"}},
}  # fmt: skip


def ticks_of(w: float, torque: float, reason: Reason) -> TickArray:
    """A motor at a constant speed and torque that stops in its last tick."""
    ticks = new_ticks(TICKS)
    ticks["k"] = np.arange(TICKS)
    ticks["t_ns"] = ticks["k"] * PERIOD_NS
    ticks["gap"], ticks["rx_flags"], ticks["w"], ticks["u_q"] = 1, 1, w, torque
    ticks["state"] = int(DriveState.OPERATION_ENABLED)
    ticks["reason"][-1] = int(reason)
    return ticks


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The header of a run of configs/dyno.toml, ticks of both nodes, their frames, an event each."""
    setups = load_node_setups(CONFIGS / "dyno.toml", Overrides())
    assert setups is not None
    path = tmp_path_factory.mktemp("nodes") / "bench.mcap"
    frames = np.zeros(4, FRAME)
    frames["can_id"], frames["received"] = (0x185, 0x186, 0x080, 0x206), (1, 1, 0, 0)
    frames["size"], frames["t_ns"] = (8, 8, 0, 4), np.arange(4) * PERIOD_NS
    with RunFile(path, nodes_header(setups, "lockstep")) as file:
        file.add_ticks(ticks_of(40.0, 5.0, Reason.NODE_STOPPED))
        file.add_ticks(ticks_of(-7.0, -3.0, Reason.OVER_SPEED), "load")
        file.add_frames(frames)
        file.add_event(0, 0, "state", "operation enabled")
        file.add_event(0, 0, "state", "load: operation enabled")
        file.finish(RESULT)
    return path


def test_the_report_has_both_nodes_on_one_page(log: Path, tmp_path: Path) -> None:
    report = build([log], tmp_path / "bench.html", verify=False)
    said = {run["node"]: run for run in report.as_dict()["runs"]}
    assert [run.name for run in report.runs] == ["motor", "load"] and list(said) == ["motor", "load"]
    ended = {
        name: next(c["found"] for c in one["checks"] if c["name"] == "ended") for name, one in said.items()
    }
    assert ended == {"motor": "node stopped", "load": "over speed"}, "each its own end, not the run's"
    assert said["motor"]["figures"]["tracking_rms_rad_s"] == 40.0
    follows = [key for key in said["motor"]["figures"] if "rad" in key or key.endswith(("_s", "_n_m"))]
    assert {said["load"]["figures"][key] for key in follows} == {None}, (
        "no speed is asked of the load machine"
    )
    page = (tmp_path / "bench.html").read_text(encoding="utf-8")
    assert '<p class="soft">Its torque is commanded: no speed is asked of it.</p>' in page
    assert "<h1>bench: motor · load</h1>" in page and "Run of 2 nodes" in page
    data = json.loads(re.findall(r'id="report">(.*?)</script>', page)[0])
    labels = {plot["key"]: [curve["label"] for curve in plot["curves"]] for plot in data["plots"]}
    assert labels["speed"] == ["motor: w*", "motor: w", "load: w"]
    assert labels["error"] == ["motor: w − w*"]
    assert [curve.split(":")[0] for curve in labels["voltage_q"]] == ["motor", "load"], (
        "torques of both in one plot"
    )
    assert [run["curves"]["w"]["value"] for run in data["runs"]] == [40.0, -7.0]
    assert [len(run["events"]) for run in data["runs"]] == [2, 0], "the log's events once"


def test_frames_and_origin_are_told_apart(log: Path, tmp_path: Path) -> None:
    build([log], tmp_path / "bench.html", verify=False)
    page = (tmp_path / "bench.html").read_text(encoding="utf-8")
    names = re.findall(r"<td>[0-9A-F]{3}</td><td>(.*?)</td>", page)
    assert names == ["SYNC", "motor TPDO1", "load TPDO1", "load RPDO1"]
    assert page.count("<h2>Events</h2>") == 1 and page.count("load: operation enabled") == 2  # table, data
    assert " of load</summary>" not in page and page.count("<summary>config.json</summary>") == 2


def test_limits_that_differ_have_their_nodes_name(log: Path) -> None:
    runs = collect_nodes(log, verify=False)
    lines = {plot.key: lines_of(runs, plot) for plot in PLOTS}
    assert lines["speed"] == [(150.0, "trip"), (-150.0, "")], "the same of both: once"
    assert [name for _, name in lines["current"] if name] == [
        "motor i_max", "motor trip", "load i_max", "load trip",
    ]  # fmt: skip


def test_two_logs_of_two_nodes_are_compared_node_by_node(log: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(log.read_bytes())
    report = build([log, other], tmp_path / "both.html", verify=False)
    assert [run.name for run in report.runs] == ["bench motor", "bench load", "other motor", "other load"]
    page = (tmp_path / "both.html").read_text(encoding="utf-8")
    pairs = re.findall(r"<th class=\"n\">([\w ]+ − [\w ]+)</th>", page)
    assert pairs == ["other motor − bench motor", "other load − bench load"] and "Comparison of runs" in page
    with pytest.raises(hil.HilError, match="10 nodes: a report compares at most 8"):
        build([log] * 5, tmp_path / "many.html", verify=False)


def test_the_picture_has_both(log: Path) -> None:
    drawn = hil.plot(log)
    legend = {
        text.get_text() for axis in drawn.axes if (own := axis.get_legend()) for text in own.get_texts()
    }
    assert {"motor: w", "load: w"} <= legend and "load: w*" not in legend
    assert figures(collect_nodes(log, verify=False)[1])["lost_feedback"] == 0


def said(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict[str, object], str]:
    code = main([*map(str, words), "--json"])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else {}, out.err


def test_info_names_both(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = {
        "motor": {"ticks": TICKS, "ended": "node_stopped"}, "load": {"ticks": TICKS, "ended": "over_speed"}
    }  # fmt: skip
    assert said(capsys, "info", log)[1]["nodes"] == wanted
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-2000])
    code, found, _ = said(capsys, "info", cut)
    assert code == 0 and found["damage"]
    assert {name: one["ticks"] for name, one in found["nodes"].items()} == {"motor": TICKS, "load": TICKS}  # type: ignore[attr-defined]


def test_export_writes_a_file_for_each(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ticks.parquet"
    code, found, _ = said(capsys, "export", log, "-o", out)
    assert code == 0 and found["written"] == str(out)
    assert {name: one["written"] for name, one in found["nodes"].items()} == {  # type: ignore[attr-defined]
        "motor": str(out), "load": str(tmp_path / "ticks.load.parquet"),
    }  # fmt: skip
    assert set(pq.read_table(out)["w"].to_pylist()) == {40.0}
    assert set(pq.read_table(tmp_path / "ticks.load.parquet")["w"].to_pylist()) == {-7.0}


@pytest.mark.parametrize(("node", "w"), [("motor", 40.0), ("load", -7.0)])
def test_export_of_one_node(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], node: str, w: float
) -> None:
    out = tmp_path / "own.parquet"
    code, found, _ = said(capsys, "export", log, "-o", out, "--node", node)
    assert (
        code == 0 and "nodes" not in found and [path.name for path in tmp_path.iterdir()] == ["own.parquet"]
    )
    assert set(pq.read_table(out)["w"].to_pylist()) == {w}


@pytest.mark.parametrize("name", ["frames.log", "frames.mf4"])
def test_frames_are_exported_once(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    words = ["export", log, "-o", tmp_path / name, *(["--frames"] if name.endswith("mf4") else [])]
    code, found, _ = said(capsys, *words)
    assert code == 0 and found["records"] == 4 and [path.name for path in tmp_path.iterdir()] == [name]
    code, _, error = said(capsys, *words, "--force", "--node", "load")
    assert code == 2 and "the frames are those of all nodes; leave out --node load" in error


def test_export_refuses_before_it_writes(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.load.csv").write_text("mine")
    code, _, error = said(capsys, "export", log, "-o", tmp_path / "t.csv")
    assert code == 2 and "t.load.csv: exists already; --force replaces it" in error
    assert not (tmp_path / "t.csv").exists() and (tmp_path / "t.load.csv").read_text() == "mine"
    code, _, error = said(capsys, "export", log, "-o", tmp_path / "u.csv", "--node", "other")
    assert code == 2 and "has no node 'other'; it has motor and load" in error
    assert not (tmp_path / "u.csv").exists()


def test_recover_keeps_both(log: Path, tmp_path: Path) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(log.read_bytes()[:-2000])
    recover(cut, out)
    for node in ("motor", "load"):
        before, after = open_log(log, node=node), open_log(out, node=node)
        assert after.damage is None and after.ticks.tobytes() == before.ticks.tobytes()
        assert after.attachments == before.attachments and after.metadata["run"] == before.metadata["run"]
    assert open_log(out).nodes == ("motor", "load")


def test_a_row_of_the_fleet_judges_both(log: Path) -> None:
    (row,) = fleet([str(log)])[0]
    assert row["passed"] is False and "motor ended: node stopped; " in row["why"]
    assert "load ended: over speed; " in row["why"]
