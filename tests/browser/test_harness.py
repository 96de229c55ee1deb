"""The harness itself: what a page does wrong is seen, mouse and pictures work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.browser.chromium import BrowserError, Page

pytestmark = pytest.mark.alone

CLEAN = """<!doctype html><title>clean</title>
<style>body { margin: 0 } div { width: 200px; height: 100px }</style>
<div id="pad" style="background: #f00"></div><script>
const pad = document.getElementById("pad"); window.path = [];
pad.onmousemove = e => { if (e.buttons) path.push(e.clientX) };
pad.ondblclick = () => { document.title = "twice" };
</script>"""


def written(folder: Path, html: str) -> Path:
    path = folder / "page.html"
    path.write_text(html, encoding="utf-8")
    return path


def test_a_clean_page_has_no_problems_and_hears_the_mouse(page: Page, tmp_path: Path) -> None:
    page.open(written(tmp_path, CLEAN))
    page.drag("#pad", 0.25, 0.75)
    assert page.evaluate("path[0] > 50 && path.at(-1) === 150")
    page.click("#pad", count=2)
    assert page.wait_for("document.title") == "twice"
    assert page.problems == []
    assert [url.partition(":")[0] for url in page.requests] == ["file"]


def test_a_picture_shows_the_page(page: Page, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    page.open(written(tmp_path, CLEAN))
    page.picture(tmp_path / "page.png", clip=(0, 0, 300, 150))
    with image.open(tmp_path / "page.png") as picture:
        assert picture.size == (300, 150)
        assert picture.convert("RGB").getpixel((100, 50)) == (255, 0, 0)
        assert picture.convert("RGB").getpixel((250, 50)) == (255, 255, 255)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("throw new Error('first')", "first"),
        ("console.error('second')", "second"),
        ("Promise.reject(new Error('third'))", "third"),
    ],
)
def test_what_goes_wrong_is_seen(page: Page, tmp_path: Path, script: str, said: str) -> None:
    page.open(written(tmp_path, f"<!doctype html><title>bad</title><script>{script}</script>"))
    page.wait_for("true")
    assert any(said in problem for problem in page.problems), page.problems


def test_a_blocked_source_is_seen(page: Page, tmp_path: Path) -> None:
    policy = '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'">'
    page.open(written(tmp_path, f"<!doctype html>{policy}<title>x</title><script>window.ran = 1</script>"))
    assert page.evaluate("window.ran") is None
    assert page.problems


def test_errors_of_a_script_are_raised(page: Page) -> None:
    with pytest.raises(BrowserError, match="nowhere"):
        page.evaluate("nowhere.to.be.found")
    with pytest.raises(BrowserError, match="never true"):
        page.wait_for("false", timeout_s=0.2)
