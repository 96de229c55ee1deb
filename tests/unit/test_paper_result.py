"""The verdict table, JSON, pictures and page; a changed verdict fails against the golden list."""

from __future__ import annotations

import base64
import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from rich.console import Console

from hil.paper import PaperResult, run
from hil.paper.figures import bench as bench_figures
from hil.paper.figures import fixed_time
from hil.paper.items import CANNOT, CORRECTED, EQUAL, judged, numbers, same_digits
from hil.paper.page import page
from hil.paper.plots import picture
from hil.paper.printed import _bench_item
from hil.paper.study import make_study
from hil.signals import new_ticks
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

GOLDEN = ROOT / "tests/golden/paper_verdicts.json"
NAMES = [*(f"fig{i:02d}" for i in range(1, 16)), "fixed_time", "corrected", "price", "bench"]


def bench(phi_1: float = 0.1) -> np.ndarray:
    """Ticks as configs/paper.toml leaves them, as far as the paper reads them."""
    ticks = new_ticks(10_000)
    ticks["t_ns"] = np.arange(10_000) * 1_000_000
    ticks["d_hat_w"], ticks["d_hat_q"] = phi_1, 0.2001
    return ticks


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> PaperResult:
    return run(tmp_path_factory.mktemp("paper"), bench())


@pytest.mark.long
def test_verdicts_are_the_golden_ones(result: PaperResult) -> None:
    golden = [tuple(row) for row in json.loads(GOLDEN.read_text(encoding="utf-8"))]
    assert [(i.where, i.item, i.verdict) for i in result.items] == golden


def test_every_point_of_the_errata_has_a_row(result: PaperResult) -> None:
    points = {match[1] for i in result.items if (match := re.match(r"errata (\d+):", i.where))}
    assert points == {str(i) for i in range(1, 11)}


def test_json_has_the_promised_keys(result: PaperResult) -> None:
    content = json.loads(result.to_json())
    assert len(content["items"]) == len(result.items)
    for item in content["items"]:
        assert set(item) == {"item", "where", "printed", "computed", "verdict", "why"}
        assert item["verdict"] in (EQUAL, CORRECTED, CANNOT)
        assert all(item.values())


def test_the_terminal_table_shows_every_row(result: PaperResult) -> None:
    console = Console(width=200, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    with console.file:
        console.print(result.table())
    text = console.export_text()
    assert text.count("Figs. 1, 2") == 5
    assert "1204 / 404" in text


def test_every_figure_is_there_as_png_and_svg(result: PaperResult) -> None:
    folder = result.page.parent
    assert {p.name for p in result.pictures} == {f"{n}.{e}" for n in NAMES for e in ("png", "svg")}
    for name in NAMES:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        root = ET.fromstring((folder / f"{name}.svg").read_text(encoding="utf-8"))
        assert root.tag.endswith("svg")


def test_the_page_stands_alone(result: PaperResult) -> None:
    text = result.page.read_text(encoding="utf-8")
    inline = re.findall(r"data:image/svg\+xml;base64,([A-Za-z0-9+/=]+)", text)
    assert [base64.b64decode(data) for data in inline] == [
        (result.page.parent / f"{name}.svg").read_bytes() for name in NAMES
    ]
    without = re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    assert "http" not in without
    assert "<script" not in without
    assert 'src="data:' in without
    assert all(f"Fig. {i}." in text for i in range(1, 16))
    assert "not run" not in text


def test_pictures_are_the_same_each_time(result: PaperResult) -> None:
    study = make_study(bench())
    for figure in (fixed_time(study), *bench_figures(study)):
        for kind, content in picture(figure).items():
            assert content == (result.page.parent / f"{figure.name}.{kind}").read_bytes(), figure.name


def test_without_a_bench_run_the_page_says_so() -> None:
    study = make_study()
    assert bench_figures(study) == []
    assert _bench_item(study) == []
    assert "The bench was not run" in page([], [], [])


def test_a_bench_that_misses_phi_is_no_success() -> None:
    study = make_study(bench(phi_1=0.11))
    assert [item.verdict for item in _bench_item(study)] == [CANNOT]


def test_a_bench_run_that_ended_early_is_no_success() -> None:
    study = make_study(bench()[:400])
    assert [item.verdict for item in _bench_item(study)] == [CANNOT]


def test_helpers_can_fail() -> None:
    assert same_digits([0.0031], [0.00314], 4)
    assert not same_digits([0.0031], [0.00316], 4)
    assert judged(True) == EQUAL
    assert judged(False) == CANNOT
    assert numbers([-0.00001, 1.23456]) == "0.0000, 1.2346"
