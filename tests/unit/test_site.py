"""The documentation as a site: it builds with every link right, has all pages, and fetches nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.slow

NAV = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1]
LOADED = re.compile(
    r"""<(?:script|img|iframe)[^>]*\ssrc="(https?:[^"]*)|<link rel="stylesheet" href="(https?:[^"]*)"""
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, timeout=250,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_is_in_it(site: Path) -> None:
    pages = sorted(path.name for path in (ROOT / "docs").glob("*.md"))
    assert len(pages) > 15
    for name in pages:
        assert name in NAV and (site / name).with_suffix(".html").is_file(), name


def test_it_fetches_nothing_from_elsewhere(site: Path) -> None:
    for page in site.glob("*.html"):
        assert LOADED.findall(page.read_text(encoding="utf-8")) == [], page.name


def test_functions_come_from_their_docstrings(site: Path) -> None:
    text = (site / "reference-python.html").read_text(encoding="utf-8")
    assert 'id="hil.api.runs.simulate"' in text and "as fast as the machine goes" in text
    assert ":class:" not in text and ":func:" not in text


def test_a_broken_link_fails_the_build(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[gone](gone.md)")
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[0]
    (tmp_path / "mkdocs.yml").write_text(re.sub(r"  - mkdocstrings:\n(    +.*\n)+", "", config))
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build"], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode != 0 and "gone.md" in done.stderr
