"""Campaigns: what a plan means, what it refuses, a case alone and among others, the folder, the report."""

from __future__ import annotations

import errno
import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

import hil
from hil.campaign import store
from hil.campaign.case import job_of, with_settings
from hil.campaign.engine import batches
from hil.campaign.figures import longest
from hil.campaign.margins import DESIGN, design_margins
from hil.campaign.normal import between, normal, root
from hil.campaign.plan import Plan, read_plan
from hil.campaign.run import one_case
from hil.campaign.values import distribution, toml
from hil.cli import main
from hil.errors import ConfigError
from hil.report.build import build
from hil.report.criteria import figures
from hil.runtime.setup import Overrides, load_setup
from hil.sim.columns import FLOATS, INTEGERS, Columns
from hil.sim.simulate import simulate
from hil.tuning.bench import bench_of
from hil.tuning.loop import rigid
from hil.tuning.measure import margins
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

SHORT = 'set = ["loop.duration_s=0.6", "reference.at_s=0.05"]\nplant_set = ["load.0.at_s=0.3"]\n'
J = '"plant:motor.J_kg_m2"'


def plan_file(folder: Path, text: str, short: bool = True) -> Path:
    path = folder / "plan.toml"
    path.write_text(
        f'config = "{CONFIGS / "demo.toml"}"\n' + (SHORT if short else "") + text, encoding="utf-8"
    )
    return path


def plan_of(folder: Path, text: str) -> Plan:
    path = plan_file(folder, text)
    return job_of(path, read_plan(path))[1].plan


def rows_of(folder: Path) -> list[dict[str, Any]]:
    held = store.open_folder(folder)
    found = held.columns(*held.schema)
    return [dict(zip(found, v, strict=True)) for v in zip(*(c.tolist() for c in found.values()), strict=True)]


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["campaign", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    return err


def test_every_sample_meets_every_corner_and_grid_point(tmp_path: Path) -> None:
    plan = plan_of(
        tmp_path,
        f"""samples = 5
[grid]
"controller.speed_pole_rad_s" = [20.0, 30.0]
[corners]
"plant:motor.psi_f_wb" = {{ percent = 10 }}
"plant:motor.R_s_ohm" = [2.0, 4.0]
[random]
{J} = {{ normal = [0.011, 0.001] }}
""",
    )
    assert plan.count == 2 * 4 * 5
    every = [plan.settings(case) for case in range(plan.count)]
    assert len({tuple(s.values()) for s in every}) == plan.count
    drawn = [s["plant:motor.J_kg_m2"] for s in every]
    assert drawn[:5] == drawn[5:10] == drawn[35:]  # paired: the same motors in every combination
    assert [plan.noise_seed(case) for case in range(5)] == [plan.noise_seed(case) for case in range(5, 10)]
    assert len({plan.noise_seed(case) for case in range(5)}) == 5
    assert {s["plant:motor.R_s_ohm"] for s in every} == {2.0, 4.0}


def test_rows_of_a_list_go_side_by_side_and_variants_are_bundles(tmp_path: Path) -> None:
    plan = plan_of(
        tmp_path,
        f"""[list]
{J} = [0.010, 0.012]
"plant:motor.R_s_ohm" = [2.0, 3.0]
[variants.soft]
"controller.speed_pole_rad_s" = 20.0
[variants.dob]
"observer.speed" = {{ kind = "dob", gamma_1_rad_s = 60.0 }}
""",
    )
    assert plan.count == 4
    assert plan.settings(1) == {
        "controller.speed_pole_rad_s": 20.0, "plant:motor.J_kg_m2": 0.012, "plant:motor.R_s_ohm": 3.0
    }  # fmt: skip
    assert [plan.variant(case) for case in range(4)] == ["soft", "soft", "dob", "dob"]


@pytest.mark.parametrize(
    ("given", "low", "middle", "high"),
    [
        ({"uniform": [1.0, 3.0]}, 1.0, 2.0, 3.0),
        ({"kind": "uniform", "low": 1, "high": 3}, 1.0, 2.0, 3.0),
        ([1.0, 3.0], 1.0, 2.0, 3.0),
        ({"loguniform": [1.0, 100.0]}, 1.0, 10.0, 100.0),
        ({"dist": "log-uniform", "min": 1.0, "max": 100.0}, 1.0, 10.0, 100.0),
        ({"percent": 50}, 1.0, 2.0, 3.0),
        ("50 %", 1.0, 2.0, 3.0),
    ],
)
def test_forms_of_a_distribution(given: Any, low: float, middle: float, high: float) -> None:
    found = distribution(given, 2.0)
    assert found.at(1e-12) == pytest.approx(low) and found.at(1 - 1e-12) == pytest.approx(high)
    assert found.at(0.5) == pytest.approx(middle)


def test_a_normal_distribution_is_one() -> None:
    for given in ({"normal": [5.0, 2.0]}, {"kind": "normal", "mean": 5.0, "sd": 2.0}):
        found = distribution(given, None)
        assert found.at(0.5) == 5.0 and found.at(0.8413447460685429) == pytest.approx(7.0)
    assert [distribution({"choice": ["a", "b"]}, None).at(u) for u in (0.1, 0.6)] == ["a", "b"]
    assert {distribution({"integers": [2, 4]}, None).at(u) for u in (0.01, 0.5, 0.99)} == {2, 3, 4}


def test_draws_without_libm_are_those_of_the_libraries() -> None:
    shares = np.random.default_rng(3).random(3000) ** np.arange(1, 4).repeat(1000) * (1 - 1e-15)
    for u in [*shares.tolist(), *(1 - shares).tolist(), 1e-300, 1e-12, 0.075, 0.925, 1 - 1e-16]:
        assert normal(u) == pytest.approx(float(ndtri(u)), rel=3e-15, abs=1e-16)
        assert between(1e-3, 50.0, u) == pytest.approx(1e-3 * 5e4**u, rel=1e-14)
    assert normal(0.5) == 0.0 and normal(0.25) == -normal(0.75)
    assert between(2.0, 8.0, 0.5) == 4.0 and between(0.1, 7.0, 0.0) == 0.1


@pytest.mark.parametrize("rank", [1, 2, 3, 4])
def test_the_root_of_a_correlation_is_one_also_when_it_is_singular(rank: int) -> None:
    factors = np.random.default_rng(rank).normal(size=(4, rank))
    factors /= np.linalg.norm(factors, axis=1)[:, None]
    wanted = factors @ factors.T
    found = np.array(root(wanted.tolist()))
    np.testing.assert_allclose(found @ found.T, wanted, atol=1e-7)
    assert (np.triu(found, 1) == 0).all() and (np.diag(found) >= 0).all()


@pytest.mark.parametrize("table", ["random", "lhs", "sobol"])
def test_a_draw_depends_on_its_number_alone_and_fills_its_range(tmp_path: Path, table: str) -> None:
    plan = plan_of(tmp_path, f"samples = 2000\nseed = 7\n[{table}]\n{J} = [1.0, 2.0]\n")
    late = plan.settings(1999)["plant:motor.J_kg_m2"]
    values = np.array([plan.settings(case)["plant:motor.J_kg_m2"] for case in range(2000)])
    assert late == values[-1]
    counts = np.histogram(values, 10, (1.0, 2.0))[0]
    assert counts.sum() == 2000
    worst = {"random": 60, "lhs": 0, "sobol": 2}[table]
    assert np.abs(counts - 200).max() <= worst


def test_correlated_keys_have_the_covariance_that_was_given(tmp_path: Path) -> None:
    plan = plan_of(
        tmp_path,
        """samples = 4000
[[covariance]]
keys = ["plant:motor.R_s_ohm", "plant:motor.psi_f_wb"]
mean = [3.0, 0.8]
covariance = [[0.04, 0.0036], [0.0036, 0.0004]]
""",
    )
    drawn = np.array([list(plan.settings(case).values()) for case in range(4000)])
    assert drawn.mean(axis=0) == pytest.approx([3.0, 0.8], rel=0.01)
    assert np.cov(drawn.T) == pytest.approx(np.array([[0.04, 0.0036], [0.0036, 0.0004]]), rel=0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[grid]\n"plant:motor.J_kg" = [1.0]', "plant:motor.J_kg: unknown key; did you mean 'J_kg_m2'?"),
        ('[grid]\n"controller.pole" = [1.0, 2.0]', "controller.pole: unknown key"),
        ('samples = 3\n[random]\n"nothing.here" = [1.0, 2.0]', "nothing.here"),
        (
            'samples = 3\n[random]\n"plant:motor.J_kg" = { percent = 20 }',
            "plant:motor.J_kg: the config has no such key to be about; is it spelt right?",
        ),
        ('[grid]\n"plant:load.7.torque_n_m" = [1.0]', "plant:load.7.torque_n_m"),
        (f"samples = 3\n[random]\n{J} = {{ normal = [0.01, -1.0] }}", "standard deviation above 0, not -1"),
        (f"samples = 3\n[random]\n{J} = {{ uniform = [2.0, 1.0] }}", "needs low < high"),
        (f"samples = 3\n[lhs]\n{J} = {{ loguniform = [0.0, 1.0] }}", "low above 0"),
        (f"samples = 3\n[lhs]\n{J} = {{ gumbel = [0.0, 1.0] }}", "'gumbel' is no distribution; there are"),
        (f"samples = 3\n[random]\n{J} = {{ normal = [nan, 1.0] }}", "finite number"),
        (f"samples = 3\n[random]\n{J} = 0.01", "is no distribution"),
        (f"[corners]\n{J} = [0.02, 0.01]", "finite low < high"),
        (f"[grid]\n{J} = []", "needs a list of values"),
        (f"[grid]\n{J} = 0.01", "needs a list of values"),
        (f"[random]\n{J} = [0.01, 0.02]", "samples: missing"),
        (f"samples = 0\n[random]\n{J} = [0.01, 0.02]", "a plan of 0 cases"),
        (f"samples = -4\n[random]\n{J} = [0.01, 0.02]", "a plan of 0 cases"),
        (f"samples = 1000000000000\n[random]\n{J} = [0.01, 0.02]", "1000000000000 cases; at most"),
        (f"samples = 3\n[random]\n{J} = [0.01, 0.02]\n[grid]\n{J} = [0.01]", "is in [grid] too"),
        ("samples = 3\n[randm]\n", "randm: unknown key; did you mean 'random'?"),
        (
            'samples = 9\n[[covariance]]\nkeys = ["plant:motor.R_s_ohm", "plant:motor.psi_f_wb"]\n'
            "covariance = [[1.0, 2.0], [2.0, 1.0]]",
            "no covariance can be that",
        ),
        (f"[grid]\n{J} = [-1.0, 0.0]", "none of its first 2 cases can be"),
        (f'[list]\n{J} = [0.01]\n"plant:motor.R_s_ohm" = [1.0, 2.0]', "need as many values"),
    ],
)
def test_what_no_plan_can_be_is_named_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    err = refusal(capsys, str(plan_file(tmp_path, text)), "-o", str(tmp_path / "out"), "--json")
    assert words in err and err.startswith("hil: ") and "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_case_alone_is_the_case_of_the_campaign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = plan_file(tmp_path, f"samples = 6\n[random]\n{J} = {{ percent = 20 }}\n")
    assert main(["campaign", str(path), "-o", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cases"] == 6 and found["passed"] + found["failed"] == 6
    assert found["folder"] == str(tmp_path / "out") and found["cases_per_s"] > 0 and found["seconds"] > 0
    rows = rows_of(tmp_path / "out")
    assert main(["campaign", str(path), "--case", "4", "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["plant:motor.J_kg_m2"] == rows[4]["plant:motor.J_kg_m2"]
    assert {k: alone[k] for k in ("dip_rad_s", "iae_rad", "u_noise_v", "seed", "ended")} == {
        k: rows[4][k] for k in ("dip_rad_s", "iae_rad", "u_noise_v", "seed", "ended")
    }
    assert main(["campaign", str(path), "--case", "6"]) == 2


def test_figures_are_those_of_the_report_over_the_log_of_the_same_run(tmp_path: Path) -> None:
    path = plan_file(tmp_path, "[grid]\n" + J + " = [0.012]\n", short=False)
    row = hil.campaign(path, tmp_path / "out").rows()[0]
    settings = (f'log.folder="{tmp_path / "logs"}"',)
    found = simulate(load_setup(CONFIGS / "demo.toml", Overrides(settings=settings)), ["motor.J_kg_m2=0.012"])
    report = build([(Path(found["log"]),)], tmp_path / "r.html")
    for key, value in figures(report.runs[0]).items():
        if value is not None:
            assert row[key] == pytest.approx(value, rel=1e-6), key
    assert row["passed"] and row["criteria:dip_rad_s"] == "pass"


BEFORE = {
    "tracking_rms_rad_s": (0.37678205996053754, 0.26001530569156694),
    "dip_rad_s": (6.1000000000000085, 4.769999999999996),
    "recovery_s": (0.13400000000000034, 0.07000000000000028),
    "rise_s": (0.6379999999999999, 0.639),
    "overshoot_percent": (0.4250000000000087, 0.35000000000000586),
    "settling_s": (0.8380000000000001, 0.839),
    "estimate_error_n_m": (0.6819350401486082, 0.3371119900616023),
    "ripple_rad_s": (0.014395059395710655, 0.011334821323452189),
    "iae_rad": (1.317309, 0.788055000000001),
    "w_peak_rad_s": (86.10000000000001, 84.77),
    "i_peak_a": (1.9484106343376388, 2.0732170653358994),
    "u_peak_v": (195.28315467546093, 192.04326595848133),
    "u_noise_v": (0.027622930192097682, 0.023443757409166013),
}
"""Figures of two cases of twenty seconds, more than one block, as the first version of campaigns had them."""


def test_figures_stay_what_they_were(tmp_path: Path) -> None:
    pole = '"controller.speed_pole_rad_s"'
    text = f'set = ["loop.duration_s=20.0"]\n[list]\n{J} = [0.009, 0.012]\n{pole} = [20.0, 40.0]\n'
    path = plan_file(tmp_path, text, short=False)
    stand = job_of(path, read_plan(path))[1]
    rows = [stand.run(1), stand.run(0)][::-1]  # one after the other in the same arrays
    for key, values in BEFORE.items():  # to the bit here; libm's last bit is not ours elsewhere
        assert [row[key] for row in rows] == pytest.approx(list(values), rel=1e-12), key
    assert all(row["passed"] and row["end"]["t_s"] == 20.0 for row in rows)


def test_columns_are_the_fields_of_the_records(tmp_path: Path) -> None:
    path = plan_file(tmp_path, '[grid]\n"plant:firmware.w_trip_rad_s" = [300.0, 50.0]\n', short=False)
    stand, room = job_of(path, read_plan(path))[1], Columns(1000)
    for case in range(2):
        settings = stand.plan.settings(case)
        ticks = np.concatenate([t.copy() for t in stand.simulation(settings)[1].blocks()])
        parts = [
            {name: columns[name].copy() for name in (*FLOATS, *INTEGERS)}
            for columns in stand.simulation(settings)[1].columns(room)
        ]
        assert len(parts) == 1 + (len(ticks) - 1) // 1000
        for name in parts[0]:
            np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), ticks[name])
        first = ticks[np.argmax(ticks["reason"] != 0)]
        assert first["reason"] != 0 and first["k"] < ticks["k"][-1]
        assert room.stop[0].tobytes() == first.tobytes()


def test_the_longest_is_that_of_all() -> None:
    x, y = np.random.default_rng(5).normal(size=(2, 1000))
    assert longest(x, y) == np.hypot(x, y).max()
    x[7], y[7], x[8] = 3.0, 4.0, np.nan
    assert longest(x, y) == 5.0
    assert longest(x * 1e-250, y * 1e-250) == np.nanmax(np.hypot(x * 1e-250, y * 1e-250)) > 0
    y[9] = np.inf
    assert longest(x, y) == np.inf
    assert longest(x[8:9], y[8:9]) == 0.0


def test_settings_leave_the_data_as_it_was(tmp_path: Path) -> None:
    data = {"a": {"b": {"c": 1}, "d": 2}, "rows": [{"e": 3}, {"e": 4}]}
    before = deepcopy(data)
    settings = {"a.b.c": 5, "a.new.f": 6, "rows.1.e": 7, "rows.0": {"e": 8}, "rows.0.g": 9}
    made = with_settings(data, settings, tmp_path, "plant")
    assert data == before and settings["rows.0"] == {"e": 8}
    assert made == {
        "a": {"b": {"c": 5}, "d": 2, "new": {"f": 6}},
        "rows": [{"e": 8, "g": 9}, {"e": 7}],
    }
    for key in ("rows.2.e", "a.d.x", "rows.x.e"):
        with pytest.raises(ConfigError, match=key.split(".")[0]):
            with_settings(data, {key: 1}, tmp_path, "plant")
    assert data == before


def test_margins_are_those_of_the_design_whatever_the_plant_is(tmp_path: Path) -> None:
    text = f'[grid]\n"controller.speed_pole_rad_s" = [20.0, 60.0]\n{J} = [0.011, 0.013]\n'
    path = plan_file(tmp_path, text + '"controller.current_pole_rad_s" = [250.0]\n')
    rows = hil.campaign(path, tmp_path / "out").rows()
    by_law: dict[Any, set[Any]] = {}
    for row in rows:
        by_law.setdefault(row["controller.speed_pole_rad_s"], set()).add(tuple(row[key] for key in DESIGN))
    slow, fast = by_law[20.0], by_law[60.0]
    assert len(slow) == len(fast) == 1 and len(rows) == 4
    (one,), (other,) = slow, fast
    poles = ("controller.speed_pole_rad_s=20.0", "controller.current_pole_rad_s=250.0")
    setup = load_setup(CONFIGS / "demo.toml", Overrides(settings=poles))
    bench = bench_of(CONFIGS / "demo.toml", setup)
    wanted = margins(setup.machine.law, bench, rigid(bench.motor, bench.T_s))
    assert one[1:] == pytest.approx(tuple(wanted.values()), rel=1e-12)
    assert 1.0 < one[0] < other[0] and all(a > b > 0 for a, b in zip(one[1:], other[1:], strict=True))


UNSTABLE = """controller={kind="pi", speed_gain_as_rad=0.39, speed_integral_a_rad=15.0,
current_gain_v_a=200.0, current_integral_v_as=674.0}""".replace("\n", " ")


@pytest.mark.parametrize(("config", "settings"), [("paper", ()), ("current", ()), ("demo", (UNSTABLE,))])
def test_a_law_that_asks_for_no_voltage_or_is_unstable_has_no_margins(
    config: str, settings: tuple[str, ...]
) -> None:
    setup = load_setup(CONFIGS / f"{config}.toml", Overrides(settings=settings))
    assert design_margins(setup) == dict.fromkeys(DESIGN)


def test_a_variant_with_another_kind_of_law_replaces_the_whole_table(tmp_path: Path) -> None:
    pi = """kind = "pi"
speed_gain_as_rad = 0.39
speed_integral_a_rad = 15.0
current_gain_v_a = 6.0
current_integral_v_as = 674.0
"""
    text = f"[variants.shipped]\n[variants.pi.controller]\n{pi}"
    text += "[variants.soft.controller]\nspeed_pole_rad_s = 20.0\n"
    path = plan_file(tmp_path, text)
    assert plan_of(tmp_path, text).settings(2) == {"controller.speed_pole_rad_s": 20.0}
    rows = hil.campaign(path, tmp_path / "out").rows()
    assert [row["variant"] for row in rows] == ["shipped", "pi", "soft"]
    assert [row["ended"] for row in rows] == ["stop_requested"] * 3
    assert len({row["iae_rad"] for row in rows}) == 3


def test_why_a_case_is_refused_names_no_folder_of_a_worker(tmp_path: Path) -> None:
    """A row is the same wherever it was run: alone in place, or by a worker from its copies."""
    path = plan_file(tmp_path, '[grid]\n"emulator.plant" = ["plants/demo.toml", "plants/none.toml"]\n')
    (_, refused) = hil.campaign(path, tmp_path / "out").rows()
    assert refused["why"] == "plants/none.toml: can't be read: No such file or directory"
    assert one_case(path, 1)["why"] == refused["why"]


def test_a_case_that_fails_is_a_row_with_its_reason(tmp_path: Path) -> None:
    text = f'[grid]\n{J} = [0.011, -1.0]\n"plant:motor.R_s_ohm" = [2.9, 1e300]\n'
    result = hil.campaign(plan_file(tmp_path, text), tmp_path / "out")
    first, unstable, second, _ = result.rows()
    assert result.cases == 4 and result.failed >= 3
    assert first["ended"] == "stop_requested"
    assert unstable["ended"] != "stop_requested" and unstable["why"]  # no number in it
    assert second["ended"] == "refused" and "J_kg_m2" in second["why"] and not second["passed"]


@pytest.mark.parametrize("workers", [0, 1, 2, 7])
def test_batches_cover_every_span_once_and_get_smaller_at_the_end(workers: int) -> None:
    spans = [(0, 501), (600, 601), (700, 1300)]
    pieces = list(batches(iter(spans), 100, 501 + 1 + 600, workers))
    cases = [case for start, stop in pieces for case in range(start, stop)]
    assert cases == [case for start, stop in spans for case in range(start, stop)]
    sizes = [stop - start for start, stop in pieces]
    assert max(sizes) == (100 if workers < 7 else 78) and min(sizes) >= 1
    assert sizes[-1] <= (100 if workers == 0 else 12) and len(pieces) <= 13 + 20 * workers


def test_a_folder_keeps_its_rows_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = plan_file(tmp_path, f"samples = 8\n[random]\n{J} = [0.01, 0.012]\n"), tmp_path / "out"
    hil.campaign(path, out)
    before = rows_of(out)
    assert "holds a campaign, 8 of 8 cases done; go on with --resume" in refusal(
        capsys, str(path), "-o", str(out)
    )
    first, *others = sorted((out / "rows").iterdir())
    for part in others:
        part.unlink()
    kept = [row for row in before if row["case"] not in (2, 3, 7)]
    store.write_part(first, kept, store.open_folder(out).schema)
    assert hil.campaign(path, out, resume=True).cases == 8
    assert repr(rows_of(out)) == repr(before)  # no number is not equal to itself


def test_many_parts_become_few_and_a_crash_meanwhile_leaves_each_row_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = plan_file(tmp_path, f"samples = 9\n[random]\n{J} = [0.01, 0.012]\n"), tmp_path / "out"
    rows = hil.campaign(path, out).rows()
    held = store.open_folder(out)
    held.parts()[0].unlink()
    for row in rows:
        held.add([row])
        held.flush()
    before = {part.name: part.read_bytes() for part in held.parts()}
    monkeypatch.setattr(store, "MERGED_ROWS", 4)
    held.merge()
    sizes = [len(store.read_columns(part, ["case"])["case"]) for part in held.parts()]
    assert len(before) == 9 and sorted(sizes) == [1, 4, 4] and held.done().all()
    for name, content in list(before.items())[:3]:  # as if it had ended before they were removed
        (out / "rows" / name).write_bytes(content)
    again = store.open_folder(out).columns(*held.schema)
    assert again["case"].tolist() == list(range(9))
    assert again["iae_rad"].tolist() == [row["iae_rad"] for row in rows]
    monkeypatch.setattr(store, "_write_table", full_disk)
    monkeypatch.setattr(store, "MERGED_ROWS", 100)
    parts = store.open_folder(out).parts()
    store.open_folder(out).merge()
    assert store.open_folder(out).parts() == parts and len(parts) == 6


def full_disk(*_: Any) -> None:
    raise OSError(errno.ENOSPC, "no space")


def test_another_plan_another_file_another_version_are_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], configs: Path
) -> None:
    text = f"samples = 2\n[random]\n{J} = [0.01, 0.012]\n"
    path, out = plan_file(tmp_path, text), tmp_path / "out"
    path.write_text(path.read_text().replace(str(CONFIGS), str(configs)))
    hil.campaign(path, out)
    again = (str(path), "-o", str(out), "--resume")
    path.write_text(path.read_text().replace("samples = 2", "samples = 3"))
    assert "another plan: samples differs" in refusal(capsys, *again)
    path.write_text(path.read_text().replace("samples = 3", "samples = 2"))
    motor = configs / "motors" / "bench.toml"
    good = motor.read_text()
    motor.write_text(good + "# changed\n")
    assert "was begun with another motors/bench.toml" in refusal(capsys, *again)
    motor.write_text(good)
    about = json.loads((out / "campaign.json").read_text())
    about["made_by"]["hil-drive"] = "0.0.1"
    (out / "campaign.json").write_text(json.dumps(about))
    assert "was begun with hil-drive 0.0.1 and not" in refusal(capsys, *again)
    assert len(rows_of(out)) == 2


def test_a_folder_of_something_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = plan_file(tmp_path, f"[grid]\n{J} = [0.01]\n")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    assert "is not empty and holds no campaign" in refusal(capsys, str(path), "-o", str(tmp_path / "mine"))
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_full_disk_is_a_line_and_nothing_half_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = plan_file(tmp_path, f"[grid]\n{J} = [0.01]\n"), tmp_path / "out"

    def no_room(table: Any, target: Path, **_: Any) -> None:
        Path(target).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(store.arrow().parquet, "write_table", no_room)
        assert "no room left on the disk; the rows before are kept" in refusal(
            capsys, str(path), "-o", str(out)
        )
    assert list((out / "rows").iterdir()) == []
    assert hil.campaign(path, out, resume=True).cases == 1


def test_a_dry_run_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = plan_file(tmp_path, f"samples = 10000\n[random]\n{J} = [0.01, 0.012]\n", short=False)
    assert main(["campaign", str(path), "-o", str(tmp_path / "out"), "--dry-run", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cases"] == 10000 and found["seconds"] > 1 and found["bytes"] > 1e5
    assert not (tmp_path / "out").exists()


def test_without_dask_one_line_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = plan_file(tmp_path, f"[grid]\n{J} = [0.01]\n")
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    err = refusal(capsys, str(path), "-o", str(tmp_path / "out"), "-j", "1")
    assert err == "hil: campaigns need dask.distributed: pip install 'hil-drive[campaign]'\n"


def test_values_as_toml_are_exact() -> None:
    assert toml({"a": [1, 0.1, True, 'x"y']}) == '{"a" = [1, 0.1, true, "x\\"y"]}'
