"""Anti-cogging in simulation: learned from the observer's estimate, it takes a slow speed's ripple away."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hil.config.tables import RunConfig, load_toml
from hil.control.errors import ControlDesignError
from hil.identify.cogging import Cogging, response
from hil.identify.coggingrun import LAPS, of_runs, picture, run_config, table_of, toml_of, with_table
from hil.replay import replay
from hil.replay.whatif import what_if
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, load_setup, setup_of
from hil.signals import OUTPUTS, Reason, TickArray
from hil.sim.simulate import simulate, simulate_ticks
from tests.conftest import CONFIGS

PATH = CONFIGS / "cogging.toml"
COGGING = {36: 0.35, 72: 0.1, 1: 0.15}
"""configs/plants/cogging.toml [N m]."""
K_T = 0.76 / 0.8
"""The motor's torque constant over the one that is believed in: by that its torques are too large."""
pytestmark = [pytest.mark.compiled, pytest.mark.slow]


@cache
def simulated(*settings: str) -> TickArray:
    return simulate_ticks(load_setup(PATH, Overrides(settings=settings)))


def rounds(path: Path, plant: tuple[str, ...], settings: tuple[str, ...]) -> tuple[RunConfig, Cogging]:
    """What the learning runs on a plant tell, the second with what the first has told."""
    config = load_toml(path, RunConfig, settings)
    for laps in LAPS:
        setup = setup_of(path, run_config(config, "learn", laps))
        ticks = simulate_ticks(setup, list(plant))
        assert Reason(int(ticks["reason"][-1])) == Reason.STOP_REQUESTED
        found = of_runs([(ticks, setup.machine.law)], response(config), config)
        config = with_table(config, table_of(found, config, []))
    return config, found


@cache
def taught(*settings: str) -> tuple[RunConfig, Cogging]:
    """What is learned on the shipped plant."""
    return rounds(PATH, (), settings)


def inline(config: RunConfig) -> str:
    """The file as a setting."""
    rows = [
        line
        for line in toml_of(config.controller.anticogging).splitlines()
        if " = " in line and line[0] != "#"
    ]
    return f"controller.anticogging={{ {', '.join(rows)} }}"


def ripple(ticks: TickArray) -> float:
    """Speed error at constant speed [rad/s rms]."""
    own = operating(ticks)
    own = own[(own["t_ns"] > 2e9) & (own["t_ns"] < 8e9)]
    return float(np.sqrt(np.mean((own["w"] - own["w_ref"]) ** 2)))


@pytest.mark.long
def test_the_plants_harmonics_are_found_within_their_intervals() -> None:
    _, found = taught()
    assert found.known.orders == tuple(sorted(COGGING))
    for n, size, half in zip(found.known.orders, found.amplitudes, found.half, strict=True):
        assert size * K_T == pytest.approx(COGGING[n], rel=0.05), n
        assert half < 0.05 * size
    assert found.laps >= 6 and found.residual < 0.1 * found.before
    assert found.friction * K_T == pytest.approx(0.21, abs=0.03)


@pytest.mark.long
def test_the_ripple_of_a_slow_speed_drops_tenfold() -> None:
    before, after = simulated(), simulated(inline(taught()[0]))
    assert Reason(int(after["reason"][-1])) == Reason.STOP_REQUESTED
    assert ripple(after) < 0.1 * ripple(before), (ripple(before), ripple(after))
    assert not (after["guard_flags"][after["t_ns"] > 1e9]).any()
    own = operating(after)  # the load estimate is still of the whole load
    own = own[(own["t_ns"] > 2e9) & (own["t_ns"] < 8e9)]
    assert float(np.std(own["T_L_hat"] * K_T - own["T_L_true"])) < 0.05
    assert np.abs(own["T_L_true"] - np.mean(own["T_L_true"])).max() > 0.4


@pytest.mark.corners
@pytest.mark.parametrize(
    "law",
    [
        'controller={kind="pi", speed_gain_as_rad=0.39, speed_integral_a_rad=15.0, '
        "current_gain_v_a=6.5, current_integral_v_as=674.0}",
        'controller={kind="mtpa", speed_pole_rad_s=117.0, current_pole_rad_s=254.0}',
        'controller={kind="lq", speed_weight=2000.0}',
        'controller={kind="deadbeat", speed_pole_rad_s=117.0}',
    ],
)
def test_every_law_of_the_speed_takes_it(law: str) -> None:
    before, after = simulated(law), simulated(law, inline(taught()[0]))
    assert ripple(after) < 0.4 * ripple(before), (ripple(before), ripple(after))


FAC = (
    'controller={kind="fac", speed_pole_rad_s=60.0, current_pole_rad_s=254.0, current_d_pole_rad_s=254.0}',
    "limits.T_L_max_n_m=20.0",
)


def test_a_commanded_load_takes_it_without_a_currents_lag() -> None:
    """The law fac gives the table's torque by the load machine, in the tick in which it acts."""
    known = inline(taught()[0])
    before, after = simulated(*FAC), simulated(*FAC, known)
    assert Reason(int(after["reason"][-1])) == Reason.STOP_REQUESTED
    law = load_setup(PATH, Overrides(settings=(*FAC, known))).machine.law
    assert (law["cog_lead"][0], law["cog_lag"][0]) == (1.5e-3, 0.0)
    assert ripple(after) < 0.4 * ripple(before), (ripple(before), ripple(after))


def test_a_table_of_torques_has_none() -> None:
    torque = 'controller={kind="torque", torque_n_m=[1.0], for_s=[1.0]}'
    said = "controller.anticogging: the law torque follows no speed, and gives what it is commanded; leave"
    with pytest.raises(ControlDesignError, match=said):
        load_setup(PATH, Overrides(settings=(torque, 'reference={kind="step", w_rad_s=0.0}', HARMONIC)))


HARMONIC = "controller.anticogging={n_p=3, k_t_n_m_a=3.6, orders=[36], cos_n_m=[0.2], sin_n_m=[0.3]}"


def test_what_if_with_a_table_and_without(tmp_path: Path) -> None:
    """A run with it tells what it had been without, and the reverse; the same table tells nothing."""
    short, logs = ("loop.duration_s=2.0", "reference.down_at_s=1.8"), {}
    for name, own in (("off", short), ("on", (*short, HARMONIC))):
        settings = (*own, f'log.folder="{tmp_path}"', f'log.name="{name}"')
        simulate(load_setup(PATH, Overrides(settings=settings)), [])
        logs[name] = tmp_path / f"{name}.mcap", load_toml(PATH, RunConfig, own)
    for name, other in (("off", "on"), ("on", "off")):
        log, own = logs[name]
        same = what_if(log, PATH, own)
        assert {key for key, spread in same.spreads.items() if spread.top} == set()
        found = what_if(log, PATH, logs[other][1], tmp_path / f"{name}-{other}.mcap").spreads
        assert found["d_hat_w"].top > 10.0 and found["i_q_ref"].top > 0.05, name
        assert replay(tmp_path / f"{name}-{other}.mcap").verdict == "same"


def test_zeros_are_nothing_to_the_bit_and_an_angle_alone_changes_nothing() -> None:
    none = ", ".join(f"{key} = [0.0]" for key in ("cos_n_m", "sin_n_m"))
    given = f"controller.anticogging={{ n_p = 3, k_t_n_m_a = 3.6, orders = [36], {none} }}"
    plain, zeros = simulated(), simulated(given)
    deaf = simulate_ticks(load_setup(PATH, Overrides(settings=('drive.dbc="drives/hil_pmsm_fd.dbc"',))))
    assert np.isfinite(plain["theta"]).all() and np.isnan(deaf["theta"]).all()
    for name in OUTPUTS:
        assert np.array_equal(plain[name], zeros[name], equal_nan=True), name
        assert np.array_equal(plain[name], deaf[name], equal_nan=True), name


@pytest.mark.long
def test_a_drive_with_its_own_loop_and_a_filtered_speed_is_taught_too(tmp_path: Path) -> None:
    shutil.copytree(CONFIGS, tmp_path, dirs_exist_ok=True)
    path, plant = (
        tmp_path / "odrive.toml",
        ('load=[{kind="cogging", torque_n_m=0.35, order=36, phase_rad=0.7}]',),
    )
    slow = (
        'drive.signals.angle="Get_Encoder_Estimates.Pos_Estimate"', 'loop.clock="lockstep"',
        "loop.duration_s=9.0", "reference.w_rad_s=3.0", "reference.down_at_s=8.5",
    )  # fmt: skip
    config, found = rounds(path, plant, slow)
    at = found.known.orders.index(36)
    assert found.amplitudes[at] * K_T == pytest.approx(0.35, rel=0.03)
    before, after = (
        simulate_ticks(load_setup(path, Overrides(settings=(*slow, *own))), list(plant))
        for own in ((), (inline(config),))
    )
    assert ripple(after) < 0.3 * ripple(before), (ripple(before), ripple(after))


def test_the_picture_is_a_png() -> None:
    assert picture(taught()[1])[:8] == b"\x89PNG\r\n\x1a\n"
