"""The report in a real browser: curves are there, zoom works on all of them, nothing of a log runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.tables import RunConfig, load_toml
from hil.log.mcapfile import RunFile
from hil.replay.whatif import what_if
from hil.report.build import build
from hil.runtime.header import header_of
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import TickArray, new_ticks
from hil.sim.simulate import simulate, simulate_ticks
from tests.browser.chromium import Page
from tests.conftest import CONFIGS

pytestmark = pytest.mark.alone

EVIL = "</script><script>window.ran = 1</script><img src=x onerror=window.ran=1>'\"<b id=evil>&amp;"


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    settings = (f'log.folder="{tmp_path_factory.mktemp("logs")}"', 'log.name="run"')
    return load_setup(CONFIGS / "demo.toml", Overrides(settings=settings))


@pytest.fixture(scope="module")
def ticks(setup: Setup) -> TickArray:
    return simulate_ticks(setup)


def written(path: Path, setup: Setup, ticks: TickArray, header: dict[str, Any] | None = None) -> Path:
    with RunFile(path, header or header_of(setup, "run", "lockstep")) as file:
        if len(ticks):
            file.add_ticks(ticks)
        file.finish({"ended": "stop_requested", "ticks": len(ticks), "skipped": 0})
    return path


def opened(page: Page, out: Path) -> None:
    page.open(out)
    page.wait_for("window.hilReport || document.querySelector('.note')")


def test_curves_are_drawn_and_zoom_together(page: Page, setup: Setup, tmp_path: Path) -> None:
    log = Path(simulate(setup, [])["log"])
    opened(page, build([log], tmp_path / "run.html").path)
    assert page.evaluate("hilReport.charts.length") == 13
    painted = """hilReport.charts.map(({u}) => {
        const c = u.ctx.canvas, d = u.ctx.getImageData(0, 0, c.width, c.height).data;
        let n = 0; for (let i = 3; i < d.length; i += 4) if (d[i]) n++; return n; })"""
    assert all(count > 500 for count in page.evaluate(painted))
    before = page.evaluate("hilReport.charts.map(({u}) => [u.scales.x.min, u.scales.x.max])")
    page.drag("#plot-speed .u-over", 0.4, 0.5)
    page.wait_for("hilReport.view.max < 4")
    after = page.evaluate("hilReport.charts.map(({u}) => [u.scales.x.min, u.scales.x.max])")
    assert len({tuple(x) for x in after}) == 1 and after != before
    assert after[0] == pytest.approx([2.4, 3.0], abs=0.05)
    page.click("#back")
    page.wait_for("hilReport.view.max > 6")
    page.click("button[data-t]", index=1)
    page.wait_for("hilReport.view.max - hilReport.view.min < 1.01")
    page.click("#plot-current .u-over", count=2)
    page.wait_for("hilReport.view.max > 6")
    assert page.problems == [] and all(url.startswith("file:") for url in page.requests)


def test_a_spike_of_one_tick_is_drawn_at_every_zoom(
    page: Page, setup: Setup, ticks: TickArray, tmp_path: Path
) -> None:
    many = np.tile(ticks[1000:2000], 80)
    many["k"] = np.arange(len(many))
    many["t_ns"] = many["k"] * 1_000_000
    many["i_d"][54_321] = 7.5
    log = written(tmp_path / "spike.mcap", setup, many)
    report = build([log], tmp_path / "spike.html", verify=False)
    assert report.runs[0].envelope.width > 1
    opened(page, report.path)
    top = "Math.max(...hilReport.charts.find(c => c.plot.key === 'current').u.data[3].filter(v => v != null))"
    assert page.evaluate(top) == 7.5
    page.evaluate("hilReport.show(54, 55)")
    assert page.evaluate(top) == 7.5
    page.evaluate("hilReport.show(50, 51)")
    assert page.evaluate(top) < 1
    assert page.problems == []


def test_nothing_of_a_log_runs(page: Page, setup: Setup, ticks: TickArray, tmp_path: Path) -> None:
    header = header_of(setup, "run", "lockstep")
    kept = header["metadata"]["format"]  # another format is refused
    header["metadata"] = {name: value + EVIL for name, value in header["metadata"].items()} | {"format": kept}
    header["metadata"][EVIL] = EVIL
    header["attachments"]["config.toml"] = EVIL
    header["attachments"][EVIL] = EVIL
    path = tmp_path / ("<img src=x onerror=window.ran=1>.mcap")
    with RunFile(path, header) as file:
        file.add_ticks(ticks)
        file.add_event(0, 0, EVIL, EVIL)
        file.finish({"ended": EVIL, "ticks": len(ticks), "skipped": 0})
    opened(page, build([path], tmp_path / "evil.html").path)
    assert page.evaluate("window.ran") is None
    assert page.evaluate("document.querySelectorAll('#evil, img').length") == 0
    assert page.evaluate("document.body.textContent.includes('onerror=window.ran=1')")
    assert page.problems == []


def test_an_inline_script_that_slipped_in_would_not_run(
    page: Page, setup: Setup, ticks: TickArray, tmp_path: Path
) -> None:
    out = build([written(tmp_path / "a.mcap", setup, ticks)], tmp_path / "a.html", verify=False).path
    out.write_text(out.read_text().replace("<h1>", "<script>window.ran = 1</script><h1>"))
    opened(page, out)
    assert page.evaluate("window.ran") is None and page.problems


def test_runs_are_compared_in_one_page(page: Page, setup: Setup, ticks: TickArray, tmp_path: Path) -> None:
    other = ticks.copy()
    other["w"] += 1.0
    logs = [written(tmp_path / f"{n}.mcap", setup, t) for n, t in (("first", ticks), ("second", other))]
    opened(page, build(logs, tmp_path / "both.html").path)
    text = page.evaluate("document.body.textContent")
    assert "second: w" in text and "second − first" in text
    assert "differs" in text or "same" in text
    assert page.problems == []


def test_what_another_controller_would_have_done_is_called_open_loop(
    page: Page, setup: Setup, ticks: TickArray, tmp_path: Path
) -> None:
    log, other = written(tmp_path / "run.mcap", setup, ticks), tmp_path / "other.mcap"
    path = CONFIGS / "demo.toml"
    what_if(log, path, load_toml(path, RunConfig, ["observer.speed.delay_ms=40.0"]), other)
    report = build([log, other], tmp_path / "both.html")
    opened(page, report.path)
    text = page.evaluate("document.body.textContent")
    assert "other (open loop): estimate" in text and "run (open loop)" not in text
    notes = page.evaluate("[...document.querySelectorAll('.note')].map(e => e.textContent)")
    assert len(notes) == 1 and notes[0].startswith("open loop") and "of run.mcap" in notes[0]
    own, others = (run["checks"] for run in report.as_dict()["runs"])
    assert [c["name"] for c in others] == ["ended", "log", "replay"] and len(own) > 3
    assert others[0]["outcome"] == "no data" and others[2]["outcome"] == "pass"  # it replays, too
    assert page.problems == []


def test_events_and_limits_are_told(page: Page, setup: Setup, ticks: TickArray, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RunFile(path, header_of(setup, "run", "lockstep")) as file:
        file.add_ticks(ticks)
        file.add_event(int(ticks["t_ns"][3000]), 3000, "note", "half-time")
        file.finish({"ended": "stop_requested", "ticks": len(ticks), "skipped": 0})
    opened(page, build([path], tmp_path / "run.html", verify=False).path)
    assert "i_max" in page.evaluate("document.querySelector('#plot-current h3').textContent")
    assert "u_max" in page.evaluate("document.querySelector('#plot-voltage_d h3').textContent")
    left, top, _, height = page.box("#plot-speed .u-over")
    x = page.evaluate("hilReport.charts[0].u.valToPos(3.0, 'x')")
    page.mouse("mouseMoved", left + x + 1, top + height / 2)
    page.wait_for("document.querySelector('#near').textContent === '3 s note: half-time'")
    page.mouse("mouseMoved", left + x + 40, top + height / 2)
    page.wait_for("document.querySelector('#near').textContent === ''")
    assert page.problems == []


def test_no_ticks_and_no_numbers(page: Page, setup: Setup, ticks: TickArray, tmp_path: Path) -> None:
    opened(page, build([written(tmp_path / "none.mcap", setup, new_ticks(0))], tmp_path / "none.html").path)
    assert "no ticks" in page.evaluate("document.body.textContent")
    gaps = ticks.copy()
    gaps["w"][1000:2000] = np.nan
    gaps["i_q"][:] = np.inf
    opened(page, build([written(tmp_path / "nan.mcap", setup, gaps)], tmp_path / "nan.html").path)
    assert "1000 ticks is no number" in page.evaluate("document.body.textContent")
    assert page.problems == []
