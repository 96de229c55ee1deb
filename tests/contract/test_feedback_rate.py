"""A drive that measures less often than the loop ticks: configuration, emulator, loop, guard, replay."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.busload import message_rates
from drivers.listen import Heard
from firmware_model.config import PlantConfig
from hil.check.checks import feedback_row
from hil.check.seldom import seldom_rows
from hil.config.tables import load_toml
from hil.control.errors import ControlDesignError
from hil.errors import ConfigError, HilError
from hil.identify.plan import Skipped, config_of, make
from hil.log.reader import open_log
from hil.replay import replay
from hil.runtime.rules import SINCE, count, is_due, new_pace
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Reason, RxFlag
from hil.sim.demo import emulator_process, own_channel, set_up
from hil.sim.simulate import simulate_ticks
from tests.conftest import CONFIGS

FRESH = int(RxFlag.FRESH)
ODRIVE, CURRENT, CIA402 = (CONFIGS / f"{name}.toml" for name in ("odrive", "current", "cia402"))
EXACT = (  # the plant is what the controller believes in, without dry friction
    "motor={R_s_ohm = 2.875, L_d_h = 0.033, L_q_h = 0.033, psi_f_wb = 0.8, n_p = 3, J_kg_m2 = 0.011, "
    "B_f_n_m_s = 2e-4}",
    "friction.coulomb_n_m=0.0",
    "friction.static_n_m=0.0",
    "sensors.w_noise_rad_s=0.0",
    "sensors.i_noise_a=0.0",
)


def asked(*settings: str, folder: Path | None = None, ms: float = 5.0, D: float = 20.0) -> Overrides:
    """With the slow first tuning: the shipped one is for a measurement in each tick."""
    law = f'observer.speed={{kind="ftdob",gamma_1_rad_s=25.0,gamma_2_rad_s=58.0,delay_ms={D}}}'
    own = (f"feedback.period_ms={ms}", "controller.speed_pole_rad_s=30.0", law, "loop.duration_s=3.2")
    log = () if folder is None else ('loop.clock="lockstep"', f'log.folder="{folder}"')
    return Overrides(settings=(*own, *log, *settings))


def in_lockstep(path: Path, overrides: Overrides, plant: tuple[str, ...]) -> tuple[Any, Path]:
    """Ticks and log of a run against the emulator's process."""
    overrides = replace(overrides, channel=own_channel("seldom"))
    setup = load_setup(path, overrides)
    with emulator_process(path, overrides, plant):
        if setup.config.canopen is not None:
            set_up(path, setup.config)
        result = run(setup)
    return open_log(Path(result.log)).ticks, Path(result.log)


def see_it_holds(ticks: Any, every: int, known: int) -> None:
    """Measured in each so manieth tick, the load held, its estimate within 2 % once it is known."""
    on = ticks[ticks["state"] == int(DriveState.OPERATION_ENABLED)]
    fresh = np.flatnonzero(on["rx_flags"] & FRESH)
    assert (np.diff(fresh) == every).all() and len(fresh) > 100
    assert ticks["reason"][-1] == Reason.STOP_REQUESTED and not ticks["u_q"][ticks["reason"] != 0].any()
    step = int(np.argmax(on["T_L_true"] > 5.0))
    late = on[step + known + 1 : step + known + 200]
    assert np.abs(late["T_L_hat"] / 5.4 - 1.0).max() < 0.02
    assert np.abs(on["w"] - on["w_ref"])[step + 300 : step + 500].max() < 0.3
    asked_for = on["u_q"][step + known : step + known + 40]
    assert (np.diff(asked_for) != 0.0).mean() > 0.5, "the law goes on between two measurements"


@pytest.mark.long
def test_an_odrive_at_200_hz_holds_the_load_and_replays_to_the_bit(tmp_path: Path) -> None:
    overrides = asked(folder=tmp_path)
    ticks, log = in_lockstep(ODRIVE, overrides, ("feedback_every=5", *EXACT))
    see_it_holds(ticks, 5, 24)
    assert replay(log).verdict == "same"


def test_an_odrive_at_100_hz_as_it_is_shipped_holds_the_load() -> None:
    overrides = asked(ms=10.0, D=40.0)
    ticks = simulate_ticks(load_setup(ODRIVE, overrides), ["feedback_every=10", *EXACT])
    see_it_holds(ticks, 10, 49)


def test_a_drive_that_answers_each_4th_sync_is_the_same_on_the_bus_as_in_simulation(tmp_path: Path) -> None:
    overrides = asked("loop.duration_s=0.6", folder=tmp_path, ms=4.0, D=12.0)
    plant = ("feedback_every=4",)
    simulated = simulate_ticks(load_setup(CURRENT, overrides), list(plant))
    ticks, log = in_lockstep(CURRENT, overrides, plant)
    assert len(ticks) == len(simulated) and ticks["reason"][-1] == Reason.STOP_REQUESTED
    for name in ("w", "i_q", "u_q", "T_L_hat", "rx_flags", "state"):
        assert (ticks[name] == simulated[name]).all(), name
    assert replay(log).verdict == "same"


def test_a_cia402_drive_is_told_to_answer_each_5th_sync(tmp_path: Path) -> None:
    overrides = asked("loop.duration_s=0.6", folder=tmp_path)
    ticks, log = in_lockstep(CIA402, overrides, ())
    on = ticks[ticks["state"] == int(DriveState.OPERATION_ENABLED)]
    assert len(on) > 300 and (np.diff(np.flatnonzero(on["rx_flags"] & FRESH)) == 5).all()
    assert ticks["reason"][-1] == Reason.STOP_REQUESTED and replay(log).verdict == "same"


@pytest.mark.parametrize(("hold", "ticks"), [(2, 7), (6, 11)])
def test_measurements_that_stop_coming_stop_the_run(hold: int, ticks: int) -> None:
    """From the last one on: 4 ticks that have none by plan, the hold time, and the tick that sees it."""
    setup = load_setup(ODRIVE, asked(f"feedback.hold_ticks={hold}", "reference.at_s=0.0"))
    machine, rows = setup.machine.fresh(), simulate_ticks(setup, ["feedback_every=5"])
    last = 1000
    for t in (rows[k : k + 1].copy() for k in range(last + 30)):
        if t["k"][0] > last:
            t["rx_flags"] &= np.uint32(~FRESH & 0xFFFFFFFF)
        machine.prepare(t)
        machine.step(t)
        if t["reason"][0]:
            break
    assert rows["rx_flags"][last] & FRESH
    assert (Reason(int(t["reason"][0])), int(t["k"][0]) - last) == (Reason.STALE_FEEDBACK, ticks)


def test_a_tick_waits_for_feedback_when_it_is_due() -> None:
    pace, fresh = new_pace(), [1, 0, 0, 0, 0, 1, 0, 0, 0]

    def due(fresh: int, gap: int, every: int) -> bool:
        count(pace, {"rx_flags": fresh, "gap": gap})
        return is_due(pace, every)

    assert [due(one, 1, 3) for one in fresh] == [
        False, False, True, True, True, False, False, True, True,
    ]  # fmt: skip
    assert due(1, 1, 1) and pace[SINCE] == 0
    assert not due(0, 1, 3) and due(0, 4, 6) and pace[SINCE] == 5


@pytest.mark.parametrize(
    ("path", "settings", "said"),
    [
        (ODRIVE, ("feedback.period_ms=2.5",), "2.5 is no whole multiple of the loop's period, 1 ms"),
        (ODRIVE, ("feedback.period_ms=0.4",), "0.4 is no whole multiple of the loop's period, 1 ms"),
        (ODRIVE, ("feedback.period_ms=0",), "feedback.period_ms: input should be greater than 0"),
        (ODRIVE, ("feedback.period_ms=21",), "is 21 ticks, longer than loop.max_gap_ticks = 20"),
        (
            ODRIVE,
            ("feedback.period_ms=10", "feedback.enable_timeout_s=0.04"),
            "enable_timeout_s = 0.04 come fewer than four measurements",
        ),
        (
            ODRIVE,
            ("feedback.period_ms=10", "observer.speed.delay_ms=12"),
            "measurements come every 10 ms .*, the states of",
        ),
        (
            ODRIVE,
            ("feedback.period_ms=2", 'loop.pacing="timer"'),
            'with loop.pacing = "timer" the measurements slip',
        ),
        (
            CURRENT,
            ("feedback.period_ms=13", "observer.speed.delay_ms=12"),
            "every 13 ms .feedback.period_ms., no one in the window",
        ),
        (CURRENT, ("feedback.period_ms=2", 'bus.sync="kernel"'), 'bus.sync = "kernel" each SYNC is answered'),
        (CONFIGS / "demo.toml", ("feedback.period_ms=2",), "the drive takes voltages"),
        (CONFIGS / "moteus.toml", ("feedback.period_ms=2",), "the drive answers each command"),
    ],
)
def test_a_rate_that_can_not_be_is_one_line(path: Path, settings: tuple[str, ...], said: str) -> None:
    with pytest.raises((HilError, ControlDesignError), match=said) as told:
        load_setup(path, Overrides(settings=settings))
    assert "\n" not in str(told.value)


def test_the_check_says_what_seldom_measurements_cost() -> None:
    (row,) = seldom_rows(load_setup(ODRIVE, asked()))
    assert row.verdict == "pass" and re.match(
        r"measured every 5 ms, in each 5th tick: D = 20 ms is 4 of them; a load step is seen 2 ms later on "
        r"average, and known after 24 ms; Ms [\d.]+ \([\d.]+ in each tick\), phase \d+ deg \(\d+\)",
        row.found,
    )
    ms = [float(one) for one in re.findall(r"Ms ([\d.]+) \(([\d.]+) ", row.found)[0]]
    assert ms[0] > ms[1] > 1.0
    assert seldom_rows(load_setup(ODRIVE, Overrides())) == []
    (near,) = seldom_rows(load_setup(CURRENT, asked("controller.speed_pole_rad_s=300.0", ms=10.0, D=12.0)))
    assert near.verdict == "warn" and "let the drive send more often" in near.remedy


def test_the_load_and_the_rate_of_the_bus_are_those_of_seldom_measurements() -> None:
    setup = load_setup(ODRIVE, asked())
    rates = {m.name: rate for m, rate in message_rates(setup.binding, 1000.0, setup.config.feedback_every)}
    assert (rates["Get_Encoder_Estimates"], rates["Set_Input_Torque"]) == (200.0, 1000.0)
    assert "Set_Axis_State" not in rates, "it is sent when it changes"
    heard = Heard(count=101, first_ns=1, last_ns=500_000_001)
    assert feedback_row(heard, 200.0, False, "feedback.period_ms").verdict == "pass"
    wrong = feedback_row(heard, 1000.0, False)
    assert (wrong.verdict, wrong.found) == ("fail", "200 Hz, loop 1000 Hz") and "period_ms" in wrong.remedy


def test_a_loop_that_is_not_stable_at_their_rate_is_refused() -> None:
    slow = 'drive.speed_filter={kind = "first-order", pole_rad_s = 50.0, modelled = false}'
    said = "feedback.period_ms: the loop is not stable through a first-order filter of 50 rad/s, measured in"
    with pytest.raises(ConfigError, match=said) as told:
        load_setup(CURRENT, Overrides(settings=("feedback.period_ms=10", slow)))
    assert "let the drive send more often" in str(told.value)


def test_identify_needs_a_measurement_in_each_tick() -> None:
    config = load_setup(ODRIVE, asked()).config
    step = make("spinning", config, config.motor)
    assert not isinstance(step, Skipped)
    with pytest.raises(HilError, match="hil identify needs a measurement in each tick"):
        config_of(config, step, config.motor, "step")


def test_each_tick_may_be_said() -> None:
    for path in (ODRIVE, CONFIGS / "demo.toml"):
        assert load_setup(path, Overrides(settings=("feedback.period_ms=1",))).config.feedback_every == 1


def test_an_emulated_drive_that_can_not_measure_seldom_is_refused() -> None:
    with pytest.raises(ConfigError, match="feedback_every = 2: of protocols house, odrive alone"):
        load_toml(CONFIGS / "plants" / "moteus.toml", PlantConfig, ["feedback_every=2"])
