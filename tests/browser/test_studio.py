"""The shipped layout in the real Foxglove Studio: every panel draws what is in a log. Skipped without it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest

from hil.manual.layouts import panels
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate
from tests.browser.chromium import Browser, Page
from tests.browser.studio import studio
from tests.conftest import CONFIGS
from tests.node import MISSING, has_packages, modules

pytestmark = pytest.mark.alone

TITLES = tuple(panels())
PATIENT_S = 240.0  # it is a big program
LEGEND, MARKER = 128, 20  # height of title and legend, and pixels of a curve below them
COLOUR = 0.15  # largest less smallest of red, green, blue: curves that lie on each other still have it
OWN = "useMessageReducer addMessages() is changing frequently"
"""What the app tells its own developers on a busy host; it is not about the layout."""
SAYS = "(document.body?.innerText ?? '').includes"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("studio")
    settings = (f'log.folder="{folder}"', 'log.name="run"')
    return Path(simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), [])["log"])


def coloured(page: Page, folder: Path) -> Any:
    """Where on the page something is in colour, as curves are and axes are not: boolean (height, width)."""
    page.picture(folder / "seen.png")
    seen = matplotlib.image.imread(io.BytesIO((folder / "seen.png").read_bytes()), format="png")[..., :3]
    return seen.max(axis=-1) - seen.min(axis=-1) > COLOUR


def boxes(page: Page) -> list[list[float]]:
    """Left, top, right, bottom of each panel with a plot."""
    found: list[list[float]] = page.evaluate(
        "[...document.querySelectorAll('[data-testid^=\"panel-mouseenter-container\"]')]"
        ".map(e => [e.innerText, e.getBoundingClientRect()])"
        ".filter(([text]) => / \\[.*\\]/.test(text)).map(([_, r]) => [r.left, r.top, r.right, r.bottom])"
    )
    return found


@pytest.mark.long
def test_a_log_in_every_panel(browser: Browser, log: Path, tmp_path: Path) -> None:
    if not has_packages("@foxglove/studio-base/package.json", "react", "react-dom"):
        pytest.skip(MISSING)
    page = browser.page(1400, 900)
    with studio(modules(), layout_json=CONFIGS / "layouts" / "lichtblick.json", run_mcap=log) as url:
        page.call("Page.navigate", url=f"{url}?layoutId=shipped&ds=remote-file&ds.url={url}files/run.mcap")
        page.wait_for(f"{SAYS}('hil.Tick')", PATIENT_S)
        for title in TITLES:
            page.wait_for(f"{SAYS}({title!r})", PATIENT_S)
        assert not page.evaluate(f"{SAYS}('Unknown panel') || {SAYS}('encountered an unexpected error')")
        for _ in range(60):
            inked, places = coloured(page, tmp_path), boxes(page)
            counts = [int(inked[int(t) + LEGEND : int(b), int(x) : int(r)].sum()) for x, t, r, b in places]
            if len(counts) == len(TITLES) and min(counts) > MARKER:
                break
            browser.listen(3.0)  # each picture keeps the app from its work
        else:
            raise AssertionError(f"not every panel draws: {counts}")
        for word in ("drive_state", "OPERATION_ENABLED"):
            page.wait_for(f"{SAYS}('{word}')", PATIENT_S)
    assert [problem for problem in page.problems if not problem.startswith(OWN)] == []
