"""`hil design`, `compare`, `tune` of drives with their own current loop: figures, refusals, simulation."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_model import drive as emulated
from firmware_model.config import PlantConfig, Wire, build_params, new_state
from firmware_model.plant import State
from hil.cli import main
from hil.config.filtered import loop_through
from hil.control.law import design_law
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import bench_of, seen_in, spec_in
from hil.tuning.current import Regulator, shaft_of
from hil.tuning.families import OWN_LOOP, settings_of, toml
from hil.tuning.foretell import foretold
from hil.tuning.measure import Bench, judge, loops, margins, quiet
from hil.tuning.optimise import law_of
from hil.tuning.verify import mean_noise, plants_of, verdict, verify
from hil.tuning.windows import own_loop_figures
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

NAMES = ("current", "moteus", "odrive", "cia402")
QUICK = ("loop.duration_s=3.0",)
SELDOM = "feedback.period_ms=10.0"


def drive(name: str, *settings: str, **more: Any) -> tuple[Setup, Bench]:
    path = CONFIGS / f"{name}.toml"
    setup = load_setup(path, Overrides(settings=settings))
    return setup, bench_of(path, setup, **more)


def tables(pole: float = 90.0, delay_ms: float = 20.0) -> dict[str, Any]:
    return {
        "controller": {"kind": "speed", "speed_pole_rad_s": pole},
        "speed": {"kind": "cubic", "delay_ms": delay_ms},
    }


def refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    assert main([*args]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_margins_are_those_of_hil_check(name: str) -> None:
    setup, bench = drive(name)
    law, plant = setup.machine.law, bench.plant(bench.motor)
    checked = loop_through(setup.config, setup.machine, bench.filter)
    assert loops(law, bench, [plant])[0].ms == pytest.approx(checked.ms, rel=2e-3)
    own = margins(law, bench, plant)
    assert own["phase_deg"] == pytest.approx(checked.margins.phase_deg, rel=0.01)
    assert own["gain"] == pytest.approx(checked.margins.gain, rel=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_design_is_better_than_the_slow_first_one_at_its_noise(name: str) -> None:
    """docs/drives: with J and psi_f off by 30 %."""
    slow = (
        "controller.speed_pole_rad_s=30.0",
        ('observer.speed={kind="ftdob",gamma_1_rad_s=25.0,gamma_2_rad_s=58.0,delay_ms=12.0}'),
    )
    shipped, first = (judge(setup.machine.law, bench) for setup, bench in (drive(name), drive(name, *slow)))
    assert shipped.u_noise < 1.01 * first.u_noise and shipped.nominal.ms < 1.61 and shipped.worst.ms < 2.2
    assert shipped.nominal.iae < 0.5 * first.nominal.iae and shipped.worst.iae < 0.65 * first.worst.iae
    assert shipped.nominal.dip < first.nominal.dip and shipped.worst.dip < first.worst.dip


@pytest.mark.parametrize(
    ("name", "corner"),
    [(name, corner) for name in NAMES for corner in ("as believed", "corner 1")] + [("moteus", "corner 4")],
)
def test_the_linear_loop_foretells_the_simulation(name: str, corner: str) -> None:
    """Dip within 5 %, noise of the command within 15 %, as --verify asks for."""
    setup, bench = drive(name, *settings_of(tables()), *QUICK)
    rows = dict(zip(list(plants_of(bench))[1:], bench.plants(), strict=True))
    assert len(rows) == 5, "J and psi_f alone: R_s and L are the drive's own affair"
    assert bench.load == 5.4, "the step of the plant's brake"
    said = judge(setup.machine.law, bench, [rows[corner]])
    seen = seen_in(simulate_ticks(setup, plants_of(bench)[corner]), bench.T_s)
    assert seen.dip == pytest.approx(said.nominal.dip, rel=0.05)
    assert seen.u_noise == pytest.approx(said.u_noise, rel=0.15)


def test_the_linear_loop_of_an_angle_foretells_the_simulation() -> None:
    """Both loops, the steps of the angle among the noise; its margins are those of hil check."""
    setup, bench = drive("position", *QUICK)
    law, plant = setup.machine.law, bench.plant(bench.motor)
    said = judge(law, bench, [plant])
    seen = seen_in(simulate_ticks(setup, plants_of(bench)["as believed"]), bench.T_s)
    assert seen.dip == pytest.approx(said.nominal.dip, rel=0.05)
    assert seen.u_noise == pytest.approx(said.u_noise, rel=0.15)
    assert said.u_noise > 1.3 * judge(law, replace(bench, theta_noise=None), [plant]).u_noise
    assert loops(law, bench, [plant])[0].ms == pytest.approx(
        loop_through(setup.config, setup.machine, bench.filter).ms, rel=2e-3
    )


@pytest.mark.parametrize("period_us", [50, 100, 1000])
def test_the_sampled_current_loop_is_the_emulated_drive_s(period_us: int) -> None:
    """Tick by tick, also while it accelerates: i_d and its coupling are of third order here."""
    bench = drive("current")[1]
    motor = replace(bench.motor, B_f=0.0)
    keys = {"R_s_ohm": motor.R_s, "L_d_h": motor.L_d, "L_q_h": motor.L_q, "psi_f_wb": motor.psi_f}
    keys |= {"n_p": motor.n_p, "J_kg_m2": motor.J, "B_f_n_m_s": 0.0}
    firmware = {"takes": "current", "current_period_us": period_us, "current_loop_rad_s": 800.0}
    inverter = {"v_dc_v": 540.0, "resolution_v": 0.0}
    p = build_params(
        PlantConfig.model_validate(
            {"dbc": "none.dbc", "motor": keys, "firmware": firmware, "inverter": inverter}
        ),
        Wire(0.01, 327.67, 0.001, 32.767, 0.01, 20.47),
    )
    s = new_state(p, 15)[0]
    s["started"], s["state"] = 1, State.OPERATION_ENABLED.value
    assert bench.inner is not None
    plant = shaft_of(motor, bench.inner, None, bench.T_s, None, Regulator(period_us * 1e-6, 800.0))
    x = np.zeros(len(plant.A))
    for k, u in enumerate((1e-3, 1e-3, -2e-3, 5e-4, 0.0, 0.0)):
        emulated.on_command(s, k + 1, 0x0F, u, 0.0)
        emulated.latch(p[0], s)
        emulated.advance(p[0], s, 1_000_000)
        x = plant.A @ x + plant.b * u
        assert s["x"][:2] == pytest.approx(x[:2], rel=1e-7, abs=1e-11)


@pytest.mark.long
def test_a_corner_near_its_limit_on_a_shaft_is_foretold() -> None:
    """A voltage that is held against the back-EMF feeds the acceleration back: here that is damping."""
    own = tables(286.73, 22.0)
    setup, bench = drive("current", *settings_of(own), *QUICK, shafts=((60.0, 0.01, 0.5),))
    rows = dict(zip(list(plants_of(bench))[1:], foretold(setup.machine.law, bench), strict=True))
    assert max(rows, key=lambda name: rows[name][1]) == "corner 2"
    by_lag = foretold(setup.machine.law, replace(bench, regulator=None))
    for name in ("as believed", "corner 2"):
        plant = plants_of(bench)[name]
        seen = seen_in(simulate_ticks(setup, plant), bench.T_s)
        assert seen.dip == pytest.approx(rows[name][0], rel=0.05)
        noise = mean_noise(setup, plant, seen, bench.T_s)
        assert noise == pytest.approx(rows[name][1], rel=0.1)
    assert abs(by_lag[list(rows).index("corner 2")][1] / noise - 1) > 0.15


def test_ticks_of_no_whole_number_of_current_samples_are_judged_by_the_lag() -> None:
    assert drive("current")[1].regulator == Regulator(5e-5, 1000.0)
    assert drive("current", "loop.rate_hz=800")[1].regulator == Regulator(5e-5, 1000.0)
    assert drive("current", "loop.rate_hz=1600")[1].regulator is None


def test_a_filter_that_the_observer_does_not_know_is_in_the_plant_all_the_same() -> None:
    filter_text = 'drive.speed_filter={kind="pll", pole_1_rad_s=1013.0, pole_2_rad_s=1013.0, modelled=false}'
    setup, bench = drive("moteus", filter_text, *settings_of(tables(40.0, 30.0)), *QUICK)
    assert bench.inner is not None and bench.inner.filter is None and bench.filter is not None
    said = judge(setup.machine.law, bench, [bench.plant(bench.motor)])
    seen = seen_in(simulate_ticks(setup, plants_of(bench)["as believed"]), bench.T_s)
    assert seen.dip == pytest.approx(said.nominal.dip, rel=0.05)
    assert said.nominal.ms == pytest.approx(
        loop_through(setup.config, setup.machine, bench.filter).ms, rel=2e-3
    )


@pytest.mark.parametrize("law", OWN_LOOP)
@pytest.mark.parametrize(("name", "every"), [("current", 1), ("odrive", 10)])
def test_every_family_makes_configs_that_design(name: str, every: int, law: str) -> None:
    one, rng = OWN_LOOP[law], np.random.default_rng(3)
    setup, bench = drive(name, *((SELDOM, *settings_of(tables(10.0, 200.0))) if every > 1 else ()))
    assert bench.every == every
    for _ in range(3):
        low = [max(low, 6.0) if index in one.whole else low for index, (low, _) in enumerate(one.free)]
        high = [min(high, 20.0) if index in one.whole else high for index, (_, high) in enumerate(one.free)]
        own = one.tables(np.exp(rng.uniform(np.log(low), np.log(high))).tolist(), bench)
        assert set(own) == {"controller", "speed"} and "np." not in toml(own)
        if "delay_ms" in own["speed"]:
            assert own["speed"]["delay_ms"] % every == 0, "whole samples"
        by_config = settings_config(name, own, every)
        assert by_config.tobytes() == law_of(own, spec_in(setup), 1e-3).tobytes()


def settings_config(name: str, own: dict[str, Any], every: int) -> Any:
    """The record that a configuration with these tables has, stable or not."""
    from hil.config.design import law_spec
    from hil.config.tables import RunConfig, load_toml

    settings = [*settings_of(own), *((SELDOM,) if every > 1 else ())]
    return design_law(law_spec(load_toml(CONFIGS / f"{name}.toml", RunConfig, settings)), 1e-3)


def test_figures_of_a_window_behind_a_current_loop() -> None:
    own = tables() | {"speed": {"kind": "least-noise", "delay_ms": 12.0}}
    lsb = np.array([0.01, 0.001, 0.001])
    setup, bench = drive("current", *settings_of(own), given={"i_noise": 0.0})
    found = own_loop_figures(setup.machine.law, bench, lsb)["speed"]
    assert (found["N"], found["D_ms"]) == (12, 12.0)
    assert found["sigma_d"] == pytest.approx(bench.w_noise / 1e-3 * math.sqrt(1 / (13 * 14)), rel=0.01)
    assert found["lag_ms"] == pytest.approx(6.0, rel=1e-3)
    assert found["peak_H"] == pytest.approx(1.0, rel=1e-6)
    setup, bench = drive("moteus", *settings_of(own))
    through = own_loop_figures(setup.machine.law, bench, lsb)["speed"]
    assert through["N"] == 12 and through["sigma_d"] > 2 * found["sigma_d"], "to undo a filter costs noise"


def test_a_stiff_shaft_is_a_rigid_one_and_a_soft_one_is_not() -> None:
    setup, bench = drive("moteus", *settings_of(tables()))
    law, rigid = setup.machine.law, bench.plant(bench.motor)
    one, other = (loops(law, bench, [p])[0] for p in (rigid, bench.plant(bench.motor, (5000.0, 0.3, 0.5))))
    assert other.dip == pytest.approx(one.dip, rel=0.01) and other.ms == pytest.approx(one.ms, rel=0.02)
    fast = law_of(tables(350.0, 8.0), spec_in(setup), bench.T_s)
    slow = law_of(tables(10.0, 60.0), spec_in(setup), bench.T_s)
    soft = [(bench.motor, (60.0, 0.01, 0.5))]
    assert not quiet(fast, bench, soft, 3.0)[0] and quiet(slow, bench, soft, 3.0)[0]


def test_design_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, config = tmp_path / "tuned.toml", str(CONFIGS / "moteus.toml")
    wish = ["--law", "cubic", "--effort", "0.3", "--command-noise", "0.05", "-o", str(out), "--json"]
    assert main(["design", config, *wish]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["command_noise"] <= 0.0503 and found["ms"] <= 1.61 and found["ms_worst"] <= 2.21
    assert found["bench"]["unit"] == "N m" and "u_noise_mv" not in found
    assert found["dip"] < 5.5 and list(found["windows"]) == ["speed"]
    assert (tmp_path / "tuned.png").read_bytes().startswith(b"\x89PNG")
    noises = [point["command_noise"] for point in found["front"]]
    assert noises == sorted(noises) and len(noises) >= 2
    setup, bench = drive("moteus", *settings_of(found["tables"]))
    assert judge(setup.machine.law, bench).nominal.dip == pytest.approx(found["dip"])
    assert out.read_text() == found["toml"] and "observer.current" not in found["toml"]


def test_compare_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--laws", "dob,cubic", "--effort", "0.05", "--seeds", "1", "--spread", "0.1"]
    config = [str(CONFIGS / "current.toml"), "--set", "loop.duration_s=3.0", "-o", str(tmp_path)]
    wide = ["--command-noise", "0.02", "--ms", "1.8", "--ms-worst", "2.6"]
    assert main(["compare", *config, *flags, *wide, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["limits"] == {"command_noise": 0.02, "ms": 1.8, "ms_worst": 2.6}
    for row in found["rows"]:
        assert row["command_noise"] < 0.024 and row["dip"] < found["as_configured"]["dip"]
    assert "noise of the command [A]" in (tmp_path / "compare.html").read_text()


def test_tune_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tuned.toml"
    flags = ["--effort", "0.05", "--cases", "1", "-o", str(out), "--json"]
    assert main(["tune", str(CONFIGS / "current.toml"), *flags]) in (0, 1)
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["command_noise"] > 0 and found["yield"]["cases"] == 1
    tuned = load_setup(out, Overrides())
    assert tuned.config.observer.current is None and tuned.config.controller.kind == "speed"


@pytest.mark.parametrize(
    ("config", "flags", "said"),
    [
        ("moteus", ["--u-noise-mv", "30"], "takes a torque; give --command-noise in N m"),
        ("current", ["--u-noise-mv", "30"], "takes a current; give --command-noise in A"),
        ("demo", ["--command-noise", "1"], "takes voltages; give --u-noise-mv"),
        ("current", ["--law", "pi"], "pi is not for a drive with a current loop of its own; there are dob,"),
        ("current", ["--law", "none"], "no law 'none'; there are dob,"),
        ("current", ["--law", "cubic", "--command-noise", "1e-6"], " A, Ms "),
        (
            "cia402",
            ["--set", 'controller={kind="torque", torque_n_m=[1.0], for_s=[1.0], slew_n_m_s=100.0}'],
            "controller.kind torque follows no speed",
        ),
    ],
)
def test_designs_that_can_not_be_are_refused(
    config: str, flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.toml"
    text = refused(
        capsys, "design", str(CONFIGS / f"{config}.toml"), "--effort", "0.05", "-o", str(out), *flags
    )
    assert said in text and not out.exists()


@pytest.mark.long
@pytest.mark.process
def test_a_design_is_verified_in_simulation_and_on_the_bus(tmp_path: Path) -> None:
    """The plant of the file and the motor that is believed in; corners differ from them by a setting."""
    settings = ("loop.duration_s=3.0", f'log.folder="{tmp_path}"')
    setup, _ = drive("moteus")
    law, seen = law_of(tables(), spec_in(setup), 1e-3), list[int]()
    config, none = CONFIGS / "moteus.toml", dict.fromkeys(("J", "psi_f"), 0.0)
    found = verify(config, Overrides(settings=settings), tables(), {}, none, law, seen.append)
    assert found["ok"] and seen == [1, 2], found
    file, believed = found["rows"]
    assert believed["predicted_command_noise"] > 0 and abs(believed["bus_dip_off"]) < 0.05
    differs = {**believed, "bus_same": False}
    assert verdict([file, differs], exact=False)["ok"] and not verdict([file, differs])["ok"]
    for key, value in (("dip_off", -0.06), ("bus_dip_off", 0.06), ("bus_noise_off", -0.16)):
        assert not verdict([file, {**differs, key: value}], exact=False)["ok"]
