"""What campaigns say: the page, its commands, two of them compared; fleets of logs."""

from __future__ import annotations

import html
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest, rankdata

import hil
from hil.campaign import store, summary
from hil.cli import main
from hil.report.build import build
from hil.report.criteria import figures
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate
from tests.conftest import CONFIGS

PLAN = f"""name = "two <laws>"
config = "{CONFIGS / "demo.toml"}"
samples = 12
set = ["loop.duration_s=1.7", "reference.at_s=0.05", "criteria.dip_max_rad_s=1.5"]
plant_set = ["load.0.at_s=1.2", "load.0.torque_n_m=2.0"]
[variants.shipped]
[variants.slow]
"controller.speed_pole_rad_s" = 15.0
[random]
"plant:load.0.torque_n_m" = [1.0, 3.0]
"plant:motor.R_s_ohm" = [2.8, 2.9]
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    hil.campaign(folder / "plan.toml", folder / "out", workers=0)
    return folder / "out"


def test_the_page_needs_nothing_and_lets_nothing_run(made: Path) -> None:
    page = (made / "report.html").read_text(encoding="utf-8")
    assert "two &lt;laws&gt;" in page and "<laws>" not in page and "<script" not in page
    assert "default-src 'none'" in page and not re.findall(r'(?:src|href)="', page)
    for words in ("yield", "Wilson", "Which keys matter", "slow − shipped", "Map of two keys", "Worst cases"):
        assert words in page
    held = store.open_folder(made)
    passed = int(held.columns("passed")["passed"].astype(bool).sum())
    assert f"{passed} of 24 cases pass" in page


def test_the_load_matters_for_the_dip_and_a_slower_law_dips_deeper(made: Path) -> None:
    held = store.open_folder(made)
    dip = summary.figure_of(held, "dip_rad_s")
    assert summary.importance(held, "plant:load.0.torque_n_m", dip) > 0.5
    assert abs(summary.importance(held, "plant:motor.R_s_ohm", dip)) < 0.5
    (found,) = summary.paired(held, "variant").values()
    dips = next(one for one in found if one.key == "dip_rad_s")
    assert dips.count == 12 and dips.low > 0 and dips.smaller == 0.0


def test_a_worst_case_runs_again_by_its_command_with_a_log(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = store.open_folder(made)
    worst = summary.worst(held, "dip_rad_s")[0]
    assert worst["dip_rad_s"] == summary.figure_of(held, "dip_rad_s").max()
    command = summary.command(held, worst)
    assert html.escape(command) in (made / "report.html").read_text(encoding="utf-8")
    assert main([*shlex.split(command)[1:], "--json"]) == 0
    log = Path(json.loads(capsys.readouterr().out)["log"])
    run = build([(log,)], made / "again.html").runs[0]
    assert figures(run)["dip_rad_s"] == pytest.approx(worst["dip_rad_s"], rel=1e-9)
    assert run.verdict.verdict == "same"


def test_wilsons_interval() -> None:
    assert summary.interval(50, 100) == pytest.approx((0.4038, 0.5962), abs=1e-4)
    assert summary.interval(0, 0) == (0.0, 1.0)
    assert summary.interval(10, 10)[0] == pytest.approx(0.7225, abs=1e-4)


def test_intervals_and_ranks_are_scipys() -> None:
    for passed, count in ((0, 7), (3, 7), (7, 7), (999, 1000), (9_000, 10_000)):
        low, high = binomtest(passed, count).proportion_ci(0.95, method="wilson")
        assert summary.interval(passed, count) == pytest.approx((low, high), abs=1e-14)
    values = np.array([3.0, -1.0, np.inf, 3.0, 0.0, -0.0, 3.0, 7.5])
    np.testing.assert_array_equal(summary.ranks_of(values), rankdata(values))


def test_rows_of_some_cases_are_those_of_their_columns_in_the_order_asked(made: Path) -> None:
    held = store.open_folder(made)
    found = held.columns(*held.schema)
    rows = summary.rows_at(held, [23, 0, 7, 0])
    wanted = [{name: values[case] for name, values in found.items()} for case in (23, 0, 7, 0)]
    assert repr(rows) == repr(
        [{k: getattr(v, "item", lambda v=v: v)() for k, v in w.items()} for w in wanted]
    )


def test_a_regression_is_found_case_by_case(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN.replace("dip_max_rad_s=1.5", "dip_max_rad_s=0.1"), encoding="utf-8")
    hil.campaign(plan, tmp_path / "after", workers=0)
    assert main(["campaign", "--compare", str(made), str(tmp_path / "after"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    before = store.open_folder(made).columns("passed")["passed"].astype(bool)
    assert found["paired"] and found["cases"] == 24 and found["yield"][1] == 0.0
    assert found["regressions"] == int(before.sum()) > 0
    assert found["regressed"][0]["command"].startswith("hil simulate ")
    assert found["figures"]["dip_rad_s"]["worse_in"] == 0  # the runs are the same, the limit is not
    assert main(["campaign", "--compare", str(made), str(made)]) == 0
    assert main(["campaign", "--compare", str(made)]) == 2
    assert main(["campaign", "--compare", str(made), str(tmp_path)]) == 2


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for number in (1, 2):
        settings = (f'log.folder="{folder}"', f'log.name="run{number}"', "loop.duration_s=0.4")
        simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), [f"seed={number}"])
    return folder


def test_a_fleet_has_a_row_for_every_log(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", "--fleet", str(logs), "-o", str(tmp_path / "fleet"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["logs"] == found["same"] == 2 and [row["verdict"] for row in found["rows"]] == ["same"] * 2
    assert all(row["tracking_rms_rad_s"] is not None for row in found["rows"])
    assert len(store.open_folder(tmp_path / "fleet").columns("case")["case"]) == 2
    (logs / "broken.mcap").write_bytes(b"no log")
    try:
        assert main(["replay", "--fleet", f"{logs}/*.mcap", "--json"]) == 2
        found = json.loads(capsys.readouterr().out)
        assert found["logs"] == 3 and found["cannot"] == 1
        assert [row["why"] != "" for row in found["rows"] if row["verdict"] == "cannot"] == [True]
    finally:
        (logs / "broken.mcap").unlink()
    assert main(["replay", "--fleet", str(tmp_path / "none")]) == 2
    assert "no log there" in capsys.readouterr().err


def test_what_if_over_a_fleet(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(CONFIGS / "demo.toml")
    assert main(["campaign", "--what-if", config, str(logs), "-o", str(tmp_path / "tried"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["logs"] == found["tried"] == 2 and found["open_loop"]
    assert [row["d_hat_w_rms"] for row in found["rows"]] == [0.0, 0.0]  # the controller that wrote them
    assert main(["campaign", "--what-if", str(tmp_path / "no.toml"), str(logs)]) == 2
