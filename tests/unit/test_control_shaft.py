"""A shaft that the observer knows: its estimate of the torque on the load is exact, and does not ring."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.check.shaft import shaft_rows
from hil.config.design import elastic_shaft, law_spec
from hil.control.errors import ControlDesignError
from hil.control.law import apply, command, design_law, exact_after, new_law_state, observe
from hil.control.registry import Shaft, SpeedFilter
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import bench_of, plant_settings
from hil.tuning.current import respond_current, shaft_of
from hil.tuning.loop import LOAD, two_masses
from hil.tuning.loop import shaft as two_mass_plant
from hil.tuning.measure import judge, loops, margins, quiet
from tests.conftest import CONFIGS

CURRENT = CONFIGS / "current.toml"
SPEC = law_spec(load_setup(CURRENT, Overrides()).config)
VOLTAGE = law_spec(load_setup(CONFIGS / "demo.toml", Overrides()).config)
INNER = replace(SPEC.inner, told=False) if SPEC.inner else None
KNOWN = "motor.shaft={resonance_hz=60.0, damping_ratio=0.01, inertia_ratio=1.0}"
SLOW = "controller.speed_pole_rad_s=60.0"
KALMAN = "observer.{0}={{kind='kalman', d_walk_per_s=20000.0, x_noise=0.01, filtered_state=true}}"
LOAD_STEP = 'load=[{kind="step", torque_n_m=3.0, at_s=2.5}]'


def design(shaft: Shaft | None, pole: float = 60.0, **inner: Any) -> Any:
    assert INNER is not None
    own = replace(INNER, shaft=shaft, **inner)
    return design_law(replace(SPEC, inner=own, more={"speed_pole_rad_s": pole}), 1e-3), own


def response(law: Any, inner: Any, hz: float, share: float, given: SpeedFilter | None = None) -> Any:
    """Estimate over the torque of a step on the load, and the speed of the motor; (2, 1000)."""
    plant = shaft_of(SPEC.motor, inner, given, 1e-3, two_masses(SPEC.motor, hz, 0.01, share))
    out, own = np.empty((4, 1000)), law.copy()
    own["i_max"] = np.inf
    respond_current(own[0], new_law_state()[0], plant.A, plant.b, plant.e, plant.C, LOAD, True, out)
    return -SPEC.motor.J * out[3], out[2]


@pytest.mark.parametrize("lag", [0.0, 1e-3, 4e-3])
@pytest.mark.parametrize(("hz", "share"), [(15.0, 0.5), (60.0, 0.5), (60.0, 0.2), (120.0, 0.8)])
def test_the_estimate_is_exact_after_its_window_in_closed_loop(hz: float, share: float, lag: float) -> None:
    law, inner = design(Shaft(2 * math.pi * hz, 0.01, share), pole=20.0, lag=lag)
    N = exact_after(law)[0]
    assert N == 25, "the window gives two ticks to the shaft's states"
    d, w = response(law, inner, hz, share)
    near = 1e-7 if lag else 5e-5  # the plant has a lag of 1e-4 ticks for none
    assert np.abs(d[N:200] - 1.0).max() < near < 3e-4 < np.abs(d[N - 3] - 1.0) and np.abs(w).max() > 0.1
    unknown, _ = response(*design(None, pole=20.0, lag=lag), hz, share)
    assert np.abs(unknown[N:200] - 1.0).max() > 0.005, "it takes the twist for a load, which rings"


def test_a_filter_of_the_speed_is_known_beside_the_shaft() -> None:
    pll = SpeedFilter((800.0, 900.0))
    law, inner = design(Shaft(2 * math.pi * 60.0, 0.01, 0.5), pole=20.0, filter=pll)
    d, _ = response(law, inner, 60.0, 0.5, pll)
    assert exact_after(law)[0] == 25 and np.abs(d[25:200] - 1.0).max() < 1e-9 < np.abs(d[24] - 1.0)


def test_a_known_shaft_allows_a_pole_that_an_unknown_one_does_not() -> None:
    settings = (SLOW,)
    found = {}
    for known in (True, False):
        more = ("motor.shaft={resonance_hz=120.0}",) if known else ()
        setup = load_setup(CURRENT, Overrides(settings=(*settings, *more)))
        place = [(bench_of(CURRENT, setup).motor, (120.0, 0.01, 0.5))]
        found[known] = quiet(setup.machine.law, bench_of(CURRENT, setup), place, 3.0)[0]
    assert found == {True: True, False: False}


def test_margins_and_verdict_of_a_design_are_those_on_the_known_shaft() -> None:
    setup = load_setup(CURRENT, Overrides(settings=(KNOWN, SLOW)))
    shaft = elastic_shaft(setup.config.motor)
    bench, law = bench_of(CURRENT, setup), setup.machine.law
    assert shaft is not None and bench.shafts == (shaft.elastic,) and bench.turns()[0] == shaft.elastic
    there, rigid = bench.plant(bench.motor), replace(bench, inner=replace(bench.inner, shaft=None))
    assert len(there.b) == 5 and len(rigid.plant(bench.motor).b) == 3, "and its integral"
    assert margins(law, bench, there) != margins(law, bench, rigid.plant(bench.motor))
    assert judge(law, bench).worst.stable


@pytest.mark.compiled
def test_no_ringing_in_the_estimate_of_a_simulated_run() -> None:
    """3 N m on the load behind 60 Hz, resolution of the frames and noise of the sensors with it."""
    setups = [load_setup(CURRENT, Overrides(settings=(SLOW, *more))) for more in ((KNOWN,), ())]
    plant = [*plant_settings(bench_of(CURRENT, setups[0]))[0], LOAD_STEP]
    assert any(one.startswith("coupling") for one in plant)
    rings = []
    for setup in setups:
        ticks = simulate_ticks(setup, plant)
        row = int(np.flatnonzero(np.abs(np.diff(ticks["T_L_true"])) > 1.0)[0])
        after, before = (ticks["d_hat_w"][row + a : row + b] for a, b in ((26, 126), (-330, -30)))
        rings.append(float(np.std(after) / np.std(before)))
    assert rings[0] < 1.2 and rings[1] > 10.0, "over its own noise, from the window's end on"


def by_voltage(hz: float, share: float, known: bool, gap_at: int = -1) -> tuple[int, Any]:
    """Estimate of a step of 1 N m on the load behind a shaft, and ticks after which it is exact; (1500,)."""
    shaft = Shaft(2 * math.pi * hz, 0.01, share) if known else None
    poles = {"speed_pole_rad_s": 20.0, "current_pole_rad_s": 100.0}
    law = design_law(replace(VOLTAGE, shaft=shaft, more=VOLTAGE.more | poles), 1e-3)
    law["i_max"] = np.inf
    plant, s, x, u, d = (
        two_mass_plant(VOLTAGE.motor, 1e-3, hz, 0.01, share),
        new_law_state()[0],
        np.zeros(4),
        0.0,
        [],
    )
    for k in range(-40, 1500):
        acts, missed = u, gap_at <= k < gap_at + 3 and gap_at > 0
        observe(law[0], s, x[0], x[1], 0.0, not missed, 1)
        apply(s, 0.0, acts, 0.0)
        command(law[0], s, 0.0, 0.0, 0.0, 1e300)
        u = s["u"][1]
        d.append(-VOLTAGE.motor.J * s["d_hat"][0])
        x = plant.A @ x + plant.b * acts + plant.e * float(k >= 0)
    return exact_after(law)[0], np.array(d[40:])


@pytest.mark.parametrize(("hz", "share"), [(15.0, 0.5), (60.0, 0.5), (60.0, 0.2), (120.0, 0.8)])
def test_a_drive_that_takes_voltages_knows_the_load_behind_its_shaft_exactly(hz: float, share: float) -> None:
    N, d = by_voltage(hz, share, known=True)
    assert N == 22, "the window gives two ticks to the shaft's states"
    assert np.abs(d[N:] - 1.0).max() < 1e-9 < 1e-3 < abs(d[N - 2] - 1.0)
    _, unknown = by_voltage(hz, share, known=False)
    assert np.abs(unknown[N:200] - 1.0).max() > 0.05, "it takes the twist for a load, which rings"


def test_lost_samples_leave_the_estimate_behind_a_shaft_within_a_window() -> None:
    N, d = by_voltage(60.0, 0.5, known=True, gap_at=700)
    assert np.abs(d[N:700] - 1.0).max() < 1e-9 and np.abs(d[703:] - 1.0).max() < 0.1
    assert np.abs(d[760:] - 1.0).max() < 1e-3, "what the current did in the gap is told by its ends alone"


def test_without_a_shaft_no_parameter_of_it_is_there() -> None:
    law = load_setup(CONFIGS / "demo.toml", Overrides()).machine.law[0]
    assert law["order"] == 0 and not law["v_y"].any() and not law["gap_y"].any()


def test_the_margins_of_a_voltage_loop_are_those_on_the_shaft_it_knows() -> None:
    """On 120 Hz the demo's loop is at its limit; one that knows the shaft is not."""
    at, found = (120.0, 0.01, 0.5), {}
    for known in (True, False):
        more = ("motor.shaft={resonance_hz=120.0}",) if known else ()
        setup = load_setup(CONFIGS / "demo.toml", Overrides(settings=more))
        bench = bench_of(CONFIGS / "demo.toml", setup)
        assert bench.elastic == (bench.known is not None) == known
        assert not known or bench.known == pytest.approx(at)
        there = replace(bench, known=at)
        found[known] = loops(setup.machine.law, there, [there.plant(there.motor)])[0].ms
    assert found[True] < 1.4 and found[False] > 5.0


@pytest.mark.parametrize(
    ("config", "settings", "said"),
    [
        ("demo", ("motor.shaft={resonance_hz=300.0}",), "tells vibration of 0.159 to 250 Hz"),
        ("demo", (KNOWN, "observer.speed.delay_ms=2.0"), "the states of drive.speed_filter and motor.shaft"),
        (
            "demo",
            ("motor.shaft={resonance_hz=120.0}", "controller.speed_pole_rad_s=300"),
            "the loop is not stable on a shaft of 120 Hz",
        ),
        ("rigid", (KNOWN, KALMAN.format("speed"), KALMAN.format("current")), "a model of its own"),
        ("paper", (KNOWN,), "the law fac commands the load itself"),
        ("current", ("motor.shaft={resonance_hz=300.0}",), "tells vibration of 0.159 to 250 Hz"),
        ("current", ("motor.shaft={resonance_hz=20.0, damping_ratio=1.0}",), "damping_ratio"),
        (
            "current",
            (KNOWN, "observer.speed.delay_ms=2.0"),
            "the states of drive.speed_filter and motor.shaft",
        ),
        (
            "current",
            ("motor.shaft={resonance_hz=200.0}",),
            "the loop is not stable on a shaft of 200 Hz",
        ),
        (
            "current",
            (KNOWN, 'drive.speed_filter={kind="moving-average", window_ms=4.0}'),
            "both a shaft and a moving average",
        ),
    ],
)
def test_what_can_not_be_known_is_refused(config: str, settings: tuple[str, ...], said: str) -> None:
    with pytest.raises((ConfigError, ControlDesignError), match="shaft") as error:
        load_setup(CONFIGS / f"{config}.toml", Overrides(settings=settings))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("config", "told", "real", "verdict", "said"),
    [
        ("demo", "", "", None, ""),
        (
            "demo",
            "resonance_hz=60.0",
            "resonance_hz=60.0, damping_ratio=0.01, inertia_ratio=1.0",
            "pass",
            "Ms 1.3",
        ),
        (
            "current",
            "resonance_hz=60.0",
            "resonance_hz=61.0, inertia_ratio=1.05",
            "pass",
            "as motor.shaft tells",
        ),
        ("demo", "resonance_hz=60.0", "resonance_hz=80.0, inertia_ratio=1.0", "warn", "has a shaft of 80 Hz"),
        ("demo", "resonance_hz=60.0", "resonance_hz=60.0, inertia_ratio=2.0", "warn", "inertia ratio 2"),
        ("demo", "resonance_hz=60.0", "", "warn", "the emulated plant has a rigid shaft"),
        ("demo", "", "resonance_hz=60.0, inertia_ratio=1.0", "warn", "the observer knows none"),
    ],
)
def test_check_compares_the_shaft_that_is_told_with_the_plants(
    tmp_path: Path, config: str, told: str, real: str, verdict: str | None, said: str
) -> None:
    plants = tmp_path / "plants"
    shutil.copytree(CONFIGS, tmp_path, dirs_exist_ok=True)
    if real:
        plant = plants / f"{config}.toml"
        plant.write_text(f"coupling = {{ {real} }}\n" + plant.read_text())
    slow = ("controller.speed_pole_rad_s=60.0",) if config == "current" else ()
    settings = (*slow, f"motor.shaft={{ {told} }}") if told else slow
    rows = shaft_rows(load_setup(tmp_path / f"{config}.toml", Overrides(settings=settings)))
    assert [row.verdict for row in rows] == ([] if verdict is None else [verdict])
    assert all(said in row.found for row in rows)
