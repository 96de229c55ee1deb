"""A shaft that the observer knows: its estimate of the torque on the load is exact, and does not ring."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.config.design import elastic_shaft, law_spec
from hil.control.errors import ControlDesignError
from hil.control.law import design_law, exact_after, new_law_state
from hil.control.registry import Shaft, SpeedFilter
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import bench_of, plant_settings
from hil.tuning.current import respond_current, shaft_of
from hil.tuning.loop import LOAD, two_masses
from hil.tuning.measure import judge, margins, quiet
from tests.conftest import CONFIGS

CURRENT = CONFIGS / "current.toml"
SPEC = law_spec(load_setup(CURRENT, Overrides()).config)
INNER = replace(SPEC.inner, told=False) if SPEC.inner else None
KNOWN = "motor.shaft={resonance_hz=60.0, damping_ratio=0.01, inertia_ratio=1.0}"
SLOW = "controller.speed_pole_rad_s=60.0"
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
    assert len(there.b) == 4 and len(rigid.plant(bench.motor).b) == 2
    assert margins(law, bench, there) != margins(law, bench, rigid.plant(bench.motor))
    assert judge(law, bench).worst.stable


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


@pytest.mark.parametrize(
    ("config", "settings", "said"),
    [
        ("demo", (KNOWN,), "motor.shaft: the drive takes voltages"),
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
