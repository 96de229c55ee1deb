"""Makes the pictures of docs/gallery.md: a demo run in lockstep, its report, a comparison, the demo's table.

Run it from the project's folder (``make gallery``). It needs Chromium for the pages.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
OUT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

from rich.console import Console  # noqa: E402 - the project's folder must be on the path first

from hil.demo import find_config  # noqa: E402
from hil.view import demo_table  # noqa: E402
from tests.browser.chromium import Page, chromium  # noqa: E402

SIZE = (1300, 900)


def hil(*args: str) -> str:
    """Run a command of hil; its standard output."""
    command = [sys.executable, "-m", "hil.cli", *args]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=300, check=True)
    return done.stdout


def make_run(folder: Path, name: str, *settings: str) -> Path:
    """The demo over the bus in lockstep; its log."""
    chosen = [f'log.folder="{folder}"', f'log.name="{name}"', *settings]
    flags = [part for setting in chosen for part in ("--set", setting)]
    (folder / f"{name}.json").write_text(
        hil("demo", str(find_config("demo.toml")), "--lockstep", "--json", *flags)
    )
    return folder / f"{name}.mcap"


def table(page: Page, folder: Path, name: str) -> None:
    """The demo's table as a terminal shows it."""
    result = json.loads((folder / f"{name}.json").read_text())
    result["log"] = Path(result["log"]).name
    console = Console(width=110, record=True, file=(folder / "discarded").open("w"))
    console.print(demo_table(result))
    svg = console.export_svg(title="hil demo --lockstep")
    (folder / "table.html").write_text(f"<!doctype html><title>demo</title>{svg}", encoding="utf-8")
    page.open(folder / "table.html")
    page.picture(OUT / "demo.png", clip=page.box("svg"))


def shot(page: Page, report: Path, picture: str, selector: str, script: str = "true") -> None:
    """A picture of a report from an element on."""
    page.open(report)
    page.wait_for("window.hilReport")
    page.evaluate(f"({script}, document.querySelector({json.dumps(selector)}).scrollIntoView())")
    page.picture(OUT / picture)


def matrix(page: Page, folder: Path) -> None:
    """The fault matrix's page: rows in lockstep, the same on every machine."""
    names = ("bus-off", "encoder slip", "phase loss", "load step", "brown-out", "DC-link")
    only = [word for name in names for word in ("--only", name)]
    hil("faults", *only, "--html", str(folder / "faults.html"), "--folder", str(folder / "faults"))
    page.open(folder / "faults.html")
    page.picture(OUT / "faults.png")
    page.evaluate("document.querySelector('h2').scrollIntoView()")
    page.picture(OUT / "faults-runs.png")


def main() -> None:
    """Make all pictures."""
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder, page = Path(name), browser.page(*SIZE)
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
        table(page, folder, "demo")
        matrix(page, folder)


if __name__ == "__main__":
    main()
