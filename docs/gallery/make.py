"""Makes the pictures of docs/gallery.md: `make gallery` all, `python docs/gallery/make.py watch` some.

Run it from the project's folder. It needs Chromium for the pages. What comes from a run in lockstep is the
same on every machine; the pictures of a live run, a check and a benchmark show the machine they come from.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
OUT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

from rich.console import Console, RenderableType  # noqa: E402 - the project's folder must be on the path first
from rich.text import Text  # noqa: E402

from hil.config.shipped import find_config  # noqa: E402
from hil.report.view import demo_table  # noqa: E402
from hil.runtime.registry import WatchError, choose  # noqa: E402
from hil.runtime.setup import Overrides  # noqa: E402
from hil.sim.demo import emulator_process  # noqa: E402
from hil.watch.look import Look  # noqa: E402
from hil.watch.terminal import frame  # noqa: E402
from tests.browser.chromium import Browser, Page, chromium  # noqa: E402

SIZE = (1300, 900)
CHANNEL = "gallery"
WIDTH = 110
LIVE = (
    f'bus.channel="{CHANNEL}"', "loop.duration_s=120.0", "loop.max_gap_ticks=64", "feedback.hold_ticks=150",
    "feedback.quick_stop_ticks=200", 'log.name="live"',
)  # fmt: skip
"""Settings of the live run: browser and run share the machine, so be patient."""


def command(*args: str) -> list[str]:
    """A command line of hil."""
    return [sys.executable, "-m", "hil.cli", *args]


def hil(*args: str, good: tuple[int, ...] = (0,)) -> str:
    """Run a command of hil as a terminal of WIDTH columns would; its standard output."""
    env = os.environ | {"FORCE_COLOR": "1", "TERM": "xterm-256color", "COLUMNS": str(WIDTH)}
    done = subprocess.run(
        command(*args), cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=900, env=env, check=False
    )
    if done.returncode not in good:
        raise SystemExit(f"hil {' '.join(args)}: exit code {done.returncode}")
    return done.stdout


def flags(settings: tuple[str, ...]) -> list[str]:
    """Settings as command line words."""
    return [part for setting in settings for part in ("--set", setting)]


def make_run(folder: Path, name: str, *settings: str) -> Path:
    """The demo over the bus in lockstep; its log."""
    chosen = (f'log.folder="{folder}"', f'log.name="{name}"', *settings)
    config = str(find_config("demo.toml"))
    (folder / f"{name}.json").write_text(hil("demo", config, "--lockstep", "--json", *flags(chosen)))
    return folder / f"{name}.mcap"


def joined(svg: str) -> str:
    """Rich's picture with letters as high as its lines and none cut, so that tables' frames have no gaps."""
    svg = svg.replace("font-size: 20px;\n", "font-size: 21.4px;\n", 1)
    return re.sub(r' clip-path="url\([^)]*-line-\d+\)"', "", svg)


def terminal(page: Page, folder: Path, what: RenderableType, title: str, picture: str) -> None:
    """What a terminal shows, as a picture."""
    console = Console(width=WIDTH, record=True, file=(folder / "discarded").open("w"))
    console.print(what)
    (folder / "terminal.html").write_text(
        f"<!doctype html><meta charset=utf-8><title>x</title>{joined(console.export_svg(title=title))}",
        encoding="utf-8",
    )
    page.open(folder / "terminal.html")
    page.picture(OUT / picture, clip=page.box("svg"))


def shot(page: Page, report: Path, picture: str, selector: str, script: str = "true") -> None:
    """A picture of a page from an element on."""
    page.open(report)
    page.evaluate(f"({script}, document.querySelector({json.dumps(selector)}).scrollIntoView())")
    page.picture(OUT / picture)


def reports(browser: Browser, folder: Path) -> None:
    """The demo's table, its report in light, dark and zoomed, and the comparison with another observer."""
    page = browser.page(*SIZE)
    run = make_run(folder, "demo")
    slow = make_run(folder, "slow-observer", "observer.speed.delay_ms=40.0")
    one, both = folder / "demo.html", folder / "both.html"
    hil("report", str(run), "-o", str(one))
    hil("report", str(run), str(slow), "-o", str(both))
    hil("report", str(run), "-o", str(OUT / "report-picture.png"))
    shot(page, one, "report.png", "h1")
    shot(page, one, "report-zoom.png", "#bar", "hilReport.show(2.45, 2.65)")
    shot(page, both, "report-compare.png", "#bar", "hilReport.show(2.4, 3.0)")
    page.dark()
    shot(page, one, "report-dark.png", "h1")
    page.dark(False)
    result = json.loads((folder / "demo.json").read_text())
    result["log"] = Path(result["log"]).name
    terminal(page, folder, demo_table(result), "hil demo --lockstep", "demo.png")


def watched() -> Look:
    """The live run, some seconds after its start."""
    for _ in range(1200):
        try:
            look = Look(choose(CHANNEL))
        except WatchError:
            time.sleep(0.1)
            continue
        if len(newest := look.latest(1)) and newest["k"][0] > 3200:
            return look
        look.close()
        time.sleep(0.1)
    raise SystemExit("the live run does not begin")


def watch(browser: Browser, folder: Path) -> None:
    """A live run, after its load step, in the terminal and in the browser."""
    page, config = browser.page(*SIZE), find_config("demo.toml")
    settings = (*LIVE, f'log.folder="{folder}"')
    web = subprocess.Popen(
        command("watch", "--web", CHANNEL, "--port", "0"), stderr=subprocess.PIPE, text=True
    )
    try:
        assert web.stderr is not None  # noqa: S101 - PIPE was asked for
        page.open(re.findall(r"http://\S+", web.stderr.readline())[0])
        with emulator_process(config, Overrides(settings=settings)):
            run = subprocess.Popen(
                command("run", str(config), *flags(settings)), cwd=ROOT, stdout=subprocess.DEVNULL
            )
            look = watched()
            look.entry = replace(look.entry, log="logs/live.mcap")
            seen = frame(look, WIDTH)
            look.close()
            web.send_signal(
                signal.SIGSTOP
            )  # the page keeps still: it is taken when the machine is free again
            run.terminate()
            run.wait(60)
        page.evaluate("document.querySelector('#run').style.visibility = 'hidden'")  # where the log is
        page.picture(OUT / "watch-web.png", clip=(0, 0, SIZE[0], page.evaluate("document.body.scrollHeight")))
    finally:
        web.kill()
        web.communicate(timeout=30)
    terminal(page, folder, seen, "hil watch", "watch-terminal.png")


def check(browser: Browser, folder: Path) -> None:
    """`hil check` with the emulated drive there."""
    config = find_config("demo.toml")
    settings = (f'bus.channel="{CHANNEL}"', 'log.folder="/tmp"')
    with emulator_process(config, Overrides(settings=settings)):
        found = hil("check", str(config), *flags(settings), good=(0, 1))
    terminal(browser.page(*SIZE), folder, Text.from_ansi(found), "hil check configs/demo.toml", "check.png")


def bench(browser: Browser, folder: Path) -> None:
    """`hil bench --quick`: the lateness of loop, bare loop and cyclictest."""
    hil("bench", "--quick", "-o", str(folder))
    (OUT / "bench.png").write_bytes((folder / "lateness.png").read_bytes())


def paper(browser: Browser, folder: Path) -> None:
    """The top of `hil paper`'s page."""
    hil("paper", "-o", str(folder), good=(0, 1))
    page = browser.page(*SIZE)
    shot(page, next(folder.glob("*.html")), "paper.png", "body")


def matrix(browser: Browser, folder: Path) -> None:
    """The fault matrix's page: rows in lockstep, the same on every machine."""
    names = ("bus-off", "encoder slip", "phase loss", "load step", "brown-out", "DC-link")
    only = [word for name in names for word in ("--only", name)]
    hil("faults", *only, "--html", str(folder / "faults.html"), "--folder", str(folder / "faults"))
    page = browser.page(*SIZE)
    page.open(folder / "faults.html")
    page.picture(OUT / "faults.png")
    page.evaluate("document.querySelector('h2').scrollIntoView()")
    page.picture(OUT / "faults-runs.png")


PARTS: dict[str, Callable[[Browser, Path], Any]] = {
    "reports": reports, "watch": watch, "check": check, "bench": bench, "paper": paper, "faults": matrix,
}  # fmt: skip


def main() -> None:
    """Make the pictures that were asked for, or all."""
    with chromium() as browser:
        for name in sys.argv[1:] or PARTS:
            with tempfile.TemporaryDirectory() as folder:
                PARTS[name](browser, Path(folder))


if __name__ == "__main__":
    main()
