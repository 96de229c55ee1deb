"""The report of runs of `hil identify`: parameters, intervals, fits, residuals, for either kind of drive."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.api.figures import report
from hil.cli import main
from hil.config.tables import RunConfig, load_toml
from hil.identify.section import SHOWN, identification, shown
from hil.identify.session import Session, planned, setup_for
from hil.report.collect import collect
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate
from tests.conftest import CONFIGS

pytestmark = pytest.mark.compiled
KINDS = {
    "demo": ({"R_s": 3.45, "L_d": 0.0297}, ("i_q", "i_d")),
    "current": ({"k_t_over_J": 270.36, "lag": 1e-3}, ("w", "i_q")),
}


def logged(tmp_path: Path, name: str) -> Path:
    """The log of the standstill step."""
    path = CONFIGS / f"{name}.toml"
    config = load_toml(path, RunConfig, (f'log.folder="{tmp_path}"',))
    session = Session(path, config, config.motor)
    (step,) = planned(session, ("standstill",))
    return Path(simulate(setup_for(session, step), ["load=[]"])["log"])


@pytest.mark.parametrize("name", KINDS)
def test_a_run_of_identify_shows_fits_residuals_and_intervals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    true, compared = KINDS[name]
    log, out = logged(tmp_path, name), tmp_path / "run.html"
    assert main(["report", str(log), "--no-replay", "--json", "-o", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)["identify"]
    page = out.read_text(encoding="utf-8")
    section = page[page.index("<h2>Identification</h2>") : page.index("<h2>Figures</h2>")]
    for key, value in true.items():
        p = found["parameters"][key.lower()]
        assert p["low"] <= p["value"] <= p["high"] and p["value"] == pytest.approx(value, rel=0.02)
        assert f"<td>{key}</td>" in section and f"{p['low']:.5g}</td>" in section
    assert "intervals of 95 %" in section and "it takes run-down" in section
    for output in compared:
        assert f"<h3>{output} [" in section and f"<h3>residual of {output} [" in section
    pictures = re.findall(r"<svg.*?</svg>", section)
    assert len(pictures) == 2 * len(found["white"])
    assert re.search(r'class="fit" d="M[\d.]+ [\d.]+[LM]', pictures[0])
    assert pictures[0].count("h0") <= SHOWN and 'class="band"' in pictures[1]
    assert ">nan" not in section and "style=" not in section  # the page's policy lets no such style be


def test_the_residuals_that_are_drawn_are_those_of_the_fit(tmp_path: Path) -> None:
    """The largest one is the end of the axis, a twentieth of the range beyond it."""
    (section,) = identification([collect(logged(tmp_path, "demo"), verify=False)])
    left = section.html[section.html.index("residual of i_q") :]
    low, zero, high = (float(text) for text in re.findall(r"<text[^>]*>([^<]+)<", left)[:3])
    sigma = float(section.data["parameters"]["i_q_noise"]["value"])
    assert zero == 0.0 and low < -1.96 * sigma and high > 1.96 * sigma and high < 8.0 * sigma


def test_runs_that_are_of_no_one_motor_are_told_so(tmp_path: Path) -> None:
    runs = [collect(logged(tmp_path, name), verify=False) for name in KINDS]
    (section,) = identification(runs)
    assert "differ in loop.rate_hz, n_p or what the drive takes" in section.html
    assert "error" in section.data


def test_a_run_of_a_law_has_no_such_part(tmp_path: Path) -> None:
    given = (f'log.folder="{tmp_path}"', "loop.duration_s=0.3")
    log = simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=given)), [])["log"]
    found = report(log, path=tmp_path / "run.html")
    assert "identify" not in found.as_dict()
    assert "Identification" not in (tmp_path / "run.html").read_text(encoding="utf-8")


def test_what_a_log_says_is_text() -> None:
    from hil.identify.estimate import Estimate

    estimate: Any = Estimate(faults=["<b>1</b>"], findings=["<i>2</i>"])
    estimate.put("R_s", np.nan, np.nan, "<u>3</u>")
    page = shown(estimate, 1)
    assert "&lt;b&gt;1" in page and "&lt;i&gt;2" in page and "&lt;u&gt;3" in page and "<b>" not in page
