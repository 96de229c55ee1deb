"""A soft coupling: seen where there is one and nowhere else, told with intervals that hold the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_model.config import PlantConfig, Wire, build_params, new_sample, new_state
from firmware_model.kernels import Kernels
from firmware_model.plant import LOAD_SPEED, State
from hil.config.motor import MotorTable
from hil.config.tables import RunConfig, load_toml
from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.identify.coupling import Seen, seen
from hil.identify.data import Samples
from hil.identify.estimate import Estimate, Parameter, _aliased
from hil.identify.fit import Fit, Shaft, fit
from hil.identify.model import COULOMB, L_Q, R_S, J
from hil.identify.motorfile import toml_of
from hil.identify.tune import at_motor
from hil.runtime.setup import Overrides, load_setup
from hil.tuning.bench import bench_of, identified_shafts
from hil.tuning.measure import judge, loops, ringing
from tests.conftest import CONFIGS

T = 1e-3
TRUE = MotorModel(R_s=3.45, L_d=0.0297, L_q=0.0297, psi_f=0.76, n_p=3, J=0.01265, B_f=4e-3)
COULOMB_TRUE, SEGMENTS, EACH = 0.2, 16, 150
DEMO = CONFIGS / "demo.toml"


def reversed_torque(
    seed: int, hz: float = 0.0, damping: float = 0.01, ratio: float = 1.0, noise: float = 0.02
) -> Samples:
    """The emulator's drive both ways under steps of voltage, on a coupling or rigid; w and i with noise."""
    random, half = np.random.default_rng(seed), SEGMENTS * EACH // 2
    y, u = np.zeros((2 * half, 3)), np.zeros((2 * half, 2))
    for way, first in ((1.0, 0), (-1.0, half)):
        drive, s = emulated(hz, damping, ratio)
        s["x"][0, 0] = s["series"][0, LOAD_SPEED, 0] = way * 40.0
        y[first] = way * 40.0, 0.0, 0.0
        for n in range(1, half):
            if n % 30 == 1:
                fast = way * s["x"][0, 0]
                size = -abs(random.normal()) if fast > 50.0 else abs(random.normal()) if fast < 30.0 else 0.0
                push = way * 6.0 * (size or random.normal()), random.normal()
            u[first + n] = push[0] + TRUE.n_p * TRUE.psi_f * s["x"][0, 0], push[1]
            s["u_q"], s["u_d"] = u[first + n]
            drive.advance(1_000_000)
            y[first + n] = s["x"][0]
    y += random.normal(size=y.shape) * [noise, 0.005, 0.005]
    begins, at = np.arange(len(y)) % EACH == 0, np.arange(len(y)) * T
    return Samples(T, at, y, u, begins, np.ones(len(y), bool), np.zeros(len(y)))


def emulated(hz: float, damping: float, ratio: float) -> tuple[Kernels, Any]:
    """The drive and its state, its gates on."""
    m = TRUE
    keys = {"R_s_ohm": m.R_s, "L_d_h": m.L_d, "L_q_h": m.L_q, "psi_f_wb": m.psi_f, "n_p": m.n_p}
    data: dict[str, Any] = {
        "dbc": "none.dbc", "motor": keys | {"J_kg_m2": m.J, "B_f_n_m_s": m.B_f},
        "friction": {"coulomb_n_m": COULOMB_TRUE},
        "firmware": {"i_trip_a": 1e6, "w_trip_rad_s": 1e6, "temperature_trip_c": 1e6, "watchdog_ms": 0},
    }  # fmt: skip
    if hz:
        data["coupling"] = {"inertia_ratio": ratio, "resonance_hz": hz, "damping_ratio": damping}
    p = build_params(PlantConfig.model_validate(data), Wire(1e-3, 1e4, 1e-3, 1e4, 1e-3, 1e4))
    s = new_state(p, 15)
    s["started"], s["state"] = 1, int(State.OPERATION_ENABLED)
    return Kernels(p, s, new_sample()), s


@pytest.mark.parametrize("seed", range(6))
def test_a_rigid_shaft_gives_none(seed: int) -> None:
    """And says up to where a load as heavy as the motor would have shown."""
    assert seen(reversed_torque(seed), TRUE) == Seen((), pytest.approx(450.0))


@pytest.mark.parametrize(("hz", "ratio"), [(20.0, 3.0), (80.0, 1.0), (200.0, 0.3)])
def test_a_coupling_is_seen_where_it_is(hz: float, ratio: float) -> None:
    w_r, _, found = seen(reversed_torque(1, hz, 0.02, ratio), TRUE).masses
    assert w_r / (2.0 * math.pi) == pytest.approx(hz, abs=6.0) and found == pytest.approx(ratio, rel=0.3)


def test_cogging_that_rings_by_itself_is_no_coupling() -> None:
    """A torque of 36 periods a turn moves the speed at a frequency that goes with it."""
    samples = reversed_torque(2)
    y = samples.y.copy()
    y[:, 0] += 0.1 * np.sin(36.0 * np.cumsum(y[:, 0]) * T)
    assert seen(replace(samples, y=y), TRUE).masses == ()


def test_too_little_motion_tells_nothing() -> None:
    samples = reversed_torque(0)
    assert seen(samples.segments(np.arange(SEGMENTS) < 2), TRUE) == Seen((), 0.0)


def fitted(samples: Samples, hz: float) -> Fit:
    start = Shaft(0.15, masses=(2.0 * math.pi * hz * 1.02, 0.02, 0.8))
    return fit(samples, replace(TRUE, R_s=3.0, J=0.011), start)


@pytest.mark.long
@pytest.mark.slow
def test_the_intervals_hold_the_truth_on_a_coupling() -> None:
    """Of 20 runs those of resonance, damping, ratio, J, R_s, L_q and friction in nine of ten, near 95 %."""
    true = {J: TRUE.J, R_S: TRUE.R_s, L_Q: TRUE.L_q, COULOMB: COULOMB_TRUE}
    inside = []
    for seed in range(20):
        found = fitted(reversed_torque(seed, 80.0), 80.0)
        masses = (2.0 * math.pi * 80.0, 0.01, 1.0)
        off = [abs(found.value[place] - value) <= found.half[place] for place, value in true.items()]
        off += [abs(x - y) <= h for x, y, h in zip(found.masses, masses, found.half[-3:], strict=True)]
        inside.append(off)
    covered = np.mean(inside, axis=0)
    print("share of intervals that hold the truth:", covered, covered.mean())
    assert covered.mean() > 0.9 and (covered >= 0.8).all(), covered


def test_a_rigid_fit_of_a_coupling_is_too_sure_and_that_of_two_inertias_is_not() -> None:
    samples = reversed_torque(3, 80.0)
    stiff, soft = fit(samples, TRUE, Shaft(0.2)), fitted(samples, 80.0)
    assert soft.sigma[0] == pytest.approx(0.02, rel=0.1) and stiff.sigma[0] > 5.0 * soft.sigma[0]
    assert soft.white[0] > 1e-3 > stiff.white[0]
    assert abs(soft.value[J] - TRUE.J) < soft.half[J]


@pytest.mark.corners
@pytest.mark.slow
@pytest.mark.parametrize(("hz", "alias"), [(300.0, False), (700.0, True)])
def test_a_resonance_above_half_the_rate_is_not_taken_for_its_alias(hz: float, alias: bool) -> None:
    """700 Hz at 1 kHz rings at 300 Hz in the samples; with noise of 2 mrad/s 300 Hz is told apart."""
    samples = reversed_torque(4, hz, noise=0.002)
    masses = seen(samples, TRUE).masses
    assert masses[0] / (2.0 * math.pi) == pytest.approx(300.0, abs=5.0)
    found = fit(samples, TRUE, Shaft(0.2, masses=masses))
    assert _aliased(samples, TRUE, found) is alias
    assert alias or abs(found.masses[2] - 1.0) < 2.0 * found.half[-1]


def identified(folder: Path, told: bool) -> Path:
    """The file that hil identify writes of a motor on a coupling."""
    found, config = Estimate(), load_toml(DEMO, RunConfig)
    rows = {"resonance": (60.0, 1.0), "resonance_damping": (0.01, 0.02), "inertia_ratio": (1.0, 0.05)}
    for name, (value, half) in rows.items():
        found.put(name, value, half, "" if told else "no resonance is seen")
    found.parameters["J"] = Parameter(0.01265, 0.0126, 0.0127, "kg m2")
    file = folder / "motor.toml"
    file.write_text(toml_of(found, config.motor, config, ["a.mcap"]), encoding="utf-8")
    return file


def test_the_file_has_the_coupling_and_the_design_its_corners(tmp_path: Path) -> None:
    file = identified(tmp_path, True)
    known = load_toml(file, MotorTable).identified
    assert known is not None and (known.resonance_hz, known.inertia_ratio) == (60.0, 1.0)
    assert known.low["resonance_hz"] == 59.0 and known.high["inertia_ratio"] == 1.05
    setup = load_setup(DEMO, at_motor(Overrides(), file))
    nominal, *ends = identified_shafts(setup)
    assert nominal == (60.0, 0.01, 0.5) and {f for f, _, _ in ends} == {59.0, 61.0}
    assert [d for _, d, _ in ends] == pytest.approx([0.002] * 4), "an interval to 0 leaves a fifth"
    assert sorted(s for _, _, s in ends) == pytest.approx([1 / 2.05] * 2 + [1 / 1.95] * 2)
    bench = bench_of(DEMO, setup)
    assert bench.elastic and bench.shafts == (nominal, *ends)
    given = bench_of(DEMO, setup, shafts=((200.0, 0.01, 0.5),))
    assert not given.elastic and given.shafts == ((200.0, 0.01, 0.5),)
    stiff = load_setup(DEMO, at_motor(Overrides(), identified(tmp_path, False)))
    assert identified_shafts(stiff) == () and not bench_of(DEMO, stiff).elastic


def test_the_dip_is_that_of_two_inertias(tmp_path: Path) -> None:
    """Of the shaft that is there, in the nominal case and in the corners; Ms and IAE are of a rigid one."""
    setup = load_setup(DEMO, at_motor(Overrides(), identified(tmp_path, True)))
    law, bench = setup.machine.law, replace(bench_of(DEMO, setup, spread={"J": 0.01}), brake=False)
    nominal, stiff = judge(law, bench).nominal, loops(law, bench, [bench.plants()[0]])[0]
    w: Array = ringing(law, bench, bench.motor, (60.0, 0.01, 0.5))
    assert nominal.dip == float(np.abs(w).max()) != stiff.dip
    assert (nominal.ms, nominal.iae) == (stiff.ms, stiff.iae)
    assert judge(law, replace(bench, elastic=False)).nominal == stiff
