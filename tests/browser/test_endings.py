"""Logs of runs that ended badly: each gives a page that says so in words, and every command takes it."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.cli import main
from hil.log.mcapfile import RunFile
from hil.log.reader import open_log
from hil.log.recover import recover
from hil.report.build import build
from hil.runtime.header import header_of
from hil.runtime.setup import Overrides, load_setup
from hil.sim.demo import emulator_process
from hil.sim.simulate import simulate
from tests.browser.chromium import Page
from tests.conftest import CONFIGS
from tests.process.test_run import flags, hil
from tests.process.test_split import writer_of

pytestmark = pytest.mark.process
Logs = dict[str, Path]


def killed(folder: Path, name: str, victim: Callable[[int], int]) -> Path:
    """The log of a run of whose processes one is killed while it ticks."""
    own = (
        f'bus.channel="endings-{name}-{os.getpid()}"', f'log.folder="{folder}"', f'log.name="{name}"',
        "realtime.lock_memory=false", "feedback.hold_ticks=150", "feedback.quick_stop_ticks=200",
        "loop.max_gap_ticks=64", "loop.duration_s=60.0",
    )  # fmt: skip
    config, log = CONFIGS / "demo.toml", folder / f"{name}.mcap"
    overrides = Overrides(settings=own)
    with (
        emulator_process(config, overrides, ("firmware.watchdog_ms=400.0",)),
        hil("run", str(config), *flags(own)) as process,
    ):
        end = time.monotonic() + 100
        while time.monotonic() < end and not (log.exists() and log.stat().st_size > 200_000):
            time.sleep(0.05)
        os.kill(victim(process.pid), signal.SIGKILL)
        process.communicate(timeout=60)
    while time.monotonic() < end and name == "controller" and not open_log(log).result:
        time.sleep(0.1)  # the writer finishes the file
    return log


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Logs:
    """One log of each kind."""
    folder = tmp_path_factory.mktemp("endings")
    settings = (f'log.folder="{folder}"', 'log.name="trip"', "limits.w_max_rad_s=70.0")
    setup = load_setup(CONFIGS / "demo.toml", Overrides(settings=settings))
    found = {"trip": Path(simulate(setup, [])["log"])}
    found["controller"] = killed(folder, "controller", lambda pid: pid)
    found["writer"] = killed(folder, "writer", writer_of)
    found["recovered"] = recover(found["writer"], folder / "recovered.mcap").path
    found["cut"], whole = folder / "cut.mcap", found["controller"].read_bytes()
    found["cut"].write_bytes(whole[: len(whole) * 2 // 3])
    found["empty"] = folder / "empty.mcap"
    with RunFile(found["empty"], header_of(setup, "run", "lockstep")) as file:
        file.finish({"ended": "enable_timeout", "ticks": 0, "skipped": 0})
    return found


SAID = {
    "trip": ("the run ended in a trip, over speed: too fast: 70.", "; its last tick is at 0.9"),
    "controller": ("the controller died, what it had handed over was still written; its last tick",),
    "writer": (
        "how the run ended is not known, its log breaks off",
        "ticks are good",
        "the summary is missing",
    ),
    "recovered": ("recovered from writer.mcap, damaged:", "the run ended: not known, recovered from"),
    "cut": ("how the run ended is not known, its log breaks off", "runs over the end of the file"),
    "empty": ("the run ended in a trip, enable timeout", "the log has no ticks: there is nothing to draw"),
}


@pytest.mark.parametrize("kind", SAID)
def test_a_page_says_how_it_ended(logs: Logs, page: Page, tmp_path: Path, kind: str) -> None:
    report = build([logs[kind]], tmp_path / "out.html")
    page.open(report.path)
    notes = page.evaluate("[...document.querySelectorAll('.note')].map(e => e.textContent).join(' | ')")
    for words in SAID[kind]:
        assert words in notes
    checks = {check["name"]: check["outcome"] for check in report.as_dict()["runs"][0]["checks"]}
    assert checks["ended"] == "fail" and checks["replay"] == ("no data" if kind == "empty" else "pass")
    assert checks["log"] == ("fail" if kind in ("writer", "cut") else "pass")
    assert kind == "empty" or page.evaluate("hilReport.charts.length") > 5
    assert page.problems == []


@pytest.mark.long
def test_a_picture_of_each(logs: Logs, tmp_path: Path) -> None:
    for kind, log in logs.items():
        picture = build([log], tmp_path / f"{kind}.png", verify=False).path
        assert picture.read_bytes().startswith(b"\x89PNG\r\n"), kind


@pytest.mark.parametrize("kind", SAID)
def test_every_command_takes_it(
    logs: Logs, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, log = str(logs[kind]), open_log(logs[kind])
    damaged = kind in ("writer", "cut")
    assert main(["info", path, "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert info["counts"]["/tick"] == len(log.ticks) and (info["damage"] is not None) == damaged
    assert main(["replay", path, "--json"]) == (2 if kind == "empty" else 0)
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["ticks"] == len(log.ticks) and bool(verdict["why"]) == (damaged or kind == "empty")
    for ending in (".csv", ".parquet", ".mat"):
        out = tmp_path / f"a{ending}"
        code = main(["export", path, "-o", str(out), "--json"])
        said = capsys.readouterr()
        if kind == "empty":
            assert code == 2 and said.err == f"hil: {path}: holds no ticks\n" and not out.exists()
        else:
            assert code == 0 and out.exists()
            found = json.loads(said.out)
            assert found["records"] == len(log.ticks) and (found["damage"] is not None) == damaged
