"""A drive with a current loop of its own and the law `speed`: closed forms, and the whole simulated run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from hil.check.checks import reach_rows, speed_filter_rows
from hil.check.filtered import filter_rows
from hil.config.design import speed_filter
from hil.config.drive import MovingAverageFilter
from hil.control.law import (
    LAW_PARAMS,
    ChannelSpec,
    LawSpec,
    MotorModel,
    ask,
    design_law,
    new_law_state,
    observe,
)
from hil.control.registry import InnerLoop, SpeedFilter
from hil.control.speed import flowed, latched
from hil.errors import HilError
from hil.replay import replay
from hil.replay.whatif import what_if
from hil.report.build import build
from hil.report.curves import plots_of
from hil.report.metrics import operating
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import GuardFlag, Reason, TickArray
from hil.sim.simulate import simulate, simulate_ticks
from hil.tick.guard import NO_ANGLE
from tests.conftest import CONFIGS

PATH = CONFIGS / "current.toml"
MOTOR = MotorModel(2.875, 0.033, 0.033, 0.8, 3, 0.011, 2e-4)
FTDOB = ChannelSpec("ftdob", 25.0, 58.0, 0.012)
T_S = 1e-3
MATCHED = (
    "motor={R_s_ohm=2.875,L_d_h=0.033,L_q_h=0.033,psi_f_wb=0.8,n_p=3,J_kg_m2=0.011,B_f_n_m_s=2e-4}",
    'load=[{kind="step",torque_n_m=5.4,at_s=2.5}]', "friction={}", "sensors={}",
    "inverter={v_dc_v=540.0,resolution_v=0.0}",
)  # fmt: skip
BY_FTDOB = (
    "controller.speed_pole_rad_s=30.0",
    'observer.speed={kind="ftdob",gamma_1_rad_s=25.0,gamma_2_rad_s=58.0,delay_ms=12.0}',
)
"""In place of the shipped design: D = 12 ms."""
UNTOLD = 'drive.signals.i_q=""'
SLOW = 'firmware={takes="current",current_loop_rad_s=333.33}'
AS_TORQUE = (
    'drive.signals.torque_ref="COMMAND.CurrentQ"', 'drive.signals.i_q_ref=""', 'drive.signals.i_d_ref=""',
    'drive.signals.units={torque_ref="N m"}',
    'drive.signals.constants={"COMMAND.Mode"=1,"COMMAND.CurrentD"=0}',
)  # fmt: skip


def setup_of(*settings: str) -> Setup:
    return load_setup(
        PATH, Overrides(settings=("loop.duration_s=3.2", "reference.down_at_s=9.0", *BY_FTDOB, *settings))
    )


def law(inner: InnerLoop, pole: float = 30.0) -> Any:
    spec = LawSpec("speed", MOTOR, FTDOB, FTDOB, pole, i_max=1e9, inner=inner)
    return design_law(spec, T_S)[0]


class Shaft:
    """The continuous plant (w, i) by the matrix exponential, a command that acts ``delay`` ticks late."""

    def __init__(self, inner: InnerLoop, d: float) -> None:
        A = np.array([[-MOTOR.B_f / MOTOR.J, inner.k_u / MOTOR.J, 0.0, 1.0], [0.0] * 4, [0.0] * 4, [0.0] * 4])
        if inner.lag:
            A[1, 1], A[1, 2] = -1.0 / inner.lag, 1.0 / inner.lag
        self._step, self._lag = expm(A * T_S), inner.lag
        self.w, self.i, self.d = 10.0, 0.0, d
        self._on_their_way = [0.0] * (1 + inner.delay)

    def tick(self, u: float) -> None:
        """A period under the command that acts now; ``u`` comes behind those on their way."""
        acts = self._on_their_way.pop(0)
        self._on_their_way.append(u)
        i = self.i if self._lag else acts
        self.w, self.i = (self._step @ [self.w, i, acts, self.d])[:2]


def drive(p: Any, shaft: Shaft, ticks: int, w_ref: float, commands: Any = None) -> tuple[Any, np.ndarray]:
    """The law's own kernels against the plant; ``commands`` in place of what the law asks for."""
    s, u, speeds = new_law_state()[0], 0.0, []
    for k in range(ticks):
        s["ua"][0] = flowed(p, s, 0.0, False, 1)
        observe(p, s, shaft.w, 0.0, 0.0, True, 1)
        latched(p, s, u, True)
        ask(p, s, w_ref, 0.0, 0.0, 1e9)
        u = float(s["u"][1]) if commands is None else commands[k]
        shaft.tick(u)
        speeds.append(shaft.w)
    return s, np.array(speeds)


@pytest.mark.parametrize("lag", [0.0, 1e-4, 1e-3, 3e-3, 2e-2])
@pytest.mark.parametrize("delay", [0, 1, 5])
def test_the_estimate_is_exact_by_the_model_of_the_inner_loop(lag: float, delay: int) -> None:
    inner = InnerLoop(3.6, 1.0, lag, delay, told=False)
    random = np.random.default_rng(round(1e5 * lag) + delay)
    s, _ = drive(law(inner), Shaft(inner, -431.7), 40, 0.0, random.uniform(-5.0, 5.0, 40))
    assert s["d_hat"][0] == pytest.approx(-431.7, rel=1e-9)
    assert s["d_hat"][1] == s["d_hat"][2] == 0.0


@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0), (1e-3, 0), (3e-3, 2), (0.0, 4)])
def test_the_speed_error_moves_by_its_pole_and_the_inner_loop_keeps_its_own(lag: float, delay: int) -> None:
    inner = InnerLoop(3.6, 1.0, lag, delay, told=False)
    p, shaft = law(inner, 100.0), Shaft(inner, -400.0)
    _, w = drive(p, shaft, 400, 50.0)
    error = w - 50.0
    assert abs(error[-1]) < 1e-9
    late = error[60:110]
    slow, fast = np.exp(-100.0 * T_S), np.exp(-T_S / lag) if lag else 0.0
    left = late[2:] - (slow + fast) * late[1:-1] + slow * fast * late[:-2]  # both poles, and no third
    assert np.abs(left).max() < 1e-9


def settled(ticks: TickArray) -> int:
    """Ticks after the load step from which the estimate stays within 2 %."""
    t = ticks["t_ns"]
    error = np.abs(ticks["T_L_hat"][(t >= 2_500_000_000) & (t < 3_100_000_000)] - 5.4)
    return int(np.nonzero(error > 0.02 * 5.4)[0][-1]) + 1


@pytest.mark.parametrize(
    ("settings", "plant", "ticks"),
    [
        ((), (), 12),  # told by two samples of i_q
        (("drive.current_lag_ms=3.0",), (SLOW,), 12),
        (("drive.current_lag_ms=0.0",), (SLOW,), 12),  # what flowed is told: the lag need not be known
        ((UNTOLD,), (), 12),  # by the model of the inner loop
        ((UNTOLD, "drive.current_lag_ms=3.0"), (SLOW,), 12),
        ((UNTOLD, "drive.current_lag_ms=0.0"), (), 21),  # by the command alone
    ],
)
@pytest.mark.compiled
def test_a_load_step_is_known_after_d(settings: tuple[str, ...], plant: tuple[str, ...], ticks: int) -> None:
    run = simulate_ticks(setup_of(*settings), [*MATCHED, *plant])
    assert run["reason"][-1] == Reason.STOP_REQUESTED
    assert settled(run) == ticks
    assert abs(run["w"][3100] - 80.0) < 0.5


PLL = '{kind="pll",pole_1_rad_s=1000.0,pole_2_rad_s=1000.0}'
VESC = '{kind="pll",pole_1_rad_s=15.0,pole_2_rad_s=1985.0}'
MEAN = '{kind="moving-average",window_ms=4.0}'
LAG = '{kind="first-order",pole_rad_s=300.0}'


def through(real: str, told: str = "", *more: str) -> tuple[Setup, list[str]]:
    """The setup that tells ``told``, and the plant whose speed comes through ``real``."""
    tells = (f"drive.speed_filter={told}",) if told else ()
    return setup_of(*tells, *more), [*MATCHED, f'firmware={{takes="current",speed_filter={real}}}']


@pytest.mark.parametrize(
    ("real", "told", "more", "ticks"),
    [
        (PLL, PLL, (), 13),  # 1.1 D
        (PLL, PLL, (UNTOLD,), 13),
        (LAG, LAG, (), 13),
        (MEAN, MEAN, (), 13),
        (PLL, "", (), 40),  # what it costs not to tell it
    ],
)
@pytest.mark.compiled
def test_a_load_step_is_known_after_d_through_a_filter_that_is_told(
    real: str, told: str, more: tuple[str, ...], ticks: int
) -> None:
    setup, plant = through(real, told, *more)
    run = simulate_ticks(setup, plant)
    assert run["reason"][-1] == Reason.STOP_REQUESTED
    assert settled(run) <= ticks and (told or settled(run) > 30)
    assert abs(run["w"][3100] - 80.0) < 0.5


@pytest.mark.compiled
def test_through_a_slow_pll_the_loop_diverges_unless_it_is_told(tmp_path: Path) -> None:
    more = ("limits.following_error_rad_s=1e6", "limits.w_max_rad_s=200.0")
    after = slice(2000, 3100)
    untold = simulate_ticks(*through(VESC, "", *more))
    assert np.abs(untold["w_ref"][after] - untold["w"][after]).max() > 20.0
    setup, plant = through(VESC, VESC, f'log.folder="{tmp_path}"')
    told = simulate_ticks(setup, plant)
    assert told["reason"][-1] == Reason.STOP_REQUESTED
    assert np.abs(80.0 - told["w"][after]).max() < 2.0 and abs(told["T_L_hat"][2900:3100].mean() - 5.4) < 0.1
    log = Path(simulate(setup, plant)["log"])
    assert replay(log).verdict == "same"
    again = what_if(log, PATH, setup.config)  # the same controller beside itself
    assert again.spreads["T_L_hat"].count > 3000 and again.spreads["T_L_hat"].rms < 1e-9
    page = build([log], tmp_path / "page.html", verify=False)
    assert page.runs[0].N[0] == 12  # D, though the window is shorter by the filter's states
    assert "a PLL with poles of 15 and 1985 rad/s, which the observer knows" in page.path.read_text("utf-8")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ((f"drive.speed_filter={VESC[:-1]},modelled=false}}",), "which the observer does not know; let it"),
        (
            ('drive.speed_filter={kind="first-order",pole_rad_s=0.01}',),
            "A of noise of the frames' resolution",
        ),
        (('drive.speed_filter={kind="moving-average",window_ms=3.5}',), "no whole number of periods at 1000"),
        (('drive.speed_filter={kind="moving-average",window_ms=12.0}',), "take 12 ms of it, and nothing is"),
        (
            ('drive.speed_filter={kind="moving-average",window_ms=33.0,modelled=false}',),
            "33 periods, and 32 are",
        ),
        (('drive.speed_filter={kind="pll",pole_1_rad_s=9.0}',), "drive.speed_filter.pole_2_rad_s: missing"),
        (('drive.speed_filter={kind="notch"}',), "drive.speed_filter: input tag 'notch'"),
        (('drive.speed_filter="pll"',), "drive.speed_filter: must be a table"),
    ],
)
def test_a_filter_that_can_not_be_had_is_one_line(settings: tuple[str, ...], said: str) -> None:
    with pytest.raises((HilError, ValueError)) as caught:
        setup_of(*settings)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_drive_that_takes_voltages_is_told_no_filter() -> None:
    with pytest.raises(HilError, match=r"drive\.speed_filter: the drive takes voltages"):
        load_setup(CONFIGS / "demo.toml", Overrides(settings=(f"drive.speed_filter={PLL}",)))


@pytest.mark.compiled
def test_check_says_what_the_filter_does_to_the_loop(tmp_path: Path) -> None:
    plain, told = setup_of(), setup_of(f"drive.speed_filter={PLL}")
    unknown = setup_of(f"drive.speed_filter={PLL[:-1]},modelled=false}}")
    slow = setup_of(f"drive.speed_filter={VESC}")
    pll, vesc, none = (s.config.drive.speed_filter for s in (told, slow, plain))

    def row(setup: Setup, *real: Any) -> Any:
        (found,) = filter_rows(setup, *real)
        return found

    assert row(plain).verdict == row(told).verdict == row(unknown).verdict == "pass"
    assert row(plain).found.startswith("no filter: Ms 1.46")
    assert "poles of 1000 and 1000 rad/s, which the observer knows: Ms 1.60" in row(told).found
    assert "which the observer does not know: Ms 2.03" in row(unknown).found
    assert row(plain, vesc).verdict == "fail" and "not stable" in row(plain, vesc).found
    assert row(plain, pll).verdict == row(told, none).verdict == "warn"
    assert (
        row(slow, None, 0.01).verdict == "warn"
        and "longer observer.speed.delay_ms" in row(slow, None, 0.01).remedy
    )
    near = setup_of('drive.speed_filter={kind="pll",pole_1_rad_s=300.0,pole_2_rad_s=300.0,modelled=false}')
    assert row(near).verdict == "warn" and "lower speed_pole_rad_s" in row(near).remedy
    assert filter_rows(load_setup(CONFIGS / "demo.toml", Overrides())) == []
    (emulated,) = speed_filter_rows(setup_of())
    assert emulated.verdict == "pass" and "0.01 rad/s of noise make 0.015 N m" in emulated.found
    (odrive,) = speed_filter_rows(load_setup(CONFIGS / "odrive.toml", Overrides()))
    assert odrive.verdict == "pass" and "which the observer knows" in odrive.found
    (broken,) = speed_filter_rows(setup_of('emulator.plant="none.toml"'))
    assert broken.verdict == "warn" and "none.toml" in broken.found


@pytest.mark.compiled
def test_a_mean_that_the_observer_does_not_know_need_not_be_of_whole_periods() -> None:
    def mean(window_ms: float) -> Any:
        return MovingAverageFilter(kind="moving-average", window_ms=window_ms, modelled=False)

    setup = setup_of('drive.speed_filter={kind="moving-average",window_ms=3.6,modelled=false}')
    assert not setup.machine.law["order"].any()
    assert [speed_filter(mean(ms), 1000) for ms in (3.6, 0.4)] == [SpeedFilter(ticks=4), None]
    near, long = (filter_rows(setup_of(), mean(window_ms))[0] for window_ms in (3.6, 40.0))
    assert (
        near.verdict == "warn" and "has a moving average of 3.6 ms, drive.speed_filter tells no" in near.found
    )
    assert long.verdict == "warn" and "40 periods, and 32 are kept at most" in long.found


def torque_setup(folder: Path, *settings: str) -> Setup:
    """The same drive by torque: a file of its own, since no setting takes a key out of one."""
    for name in ("drives", "plants", "motors"):
        (folder / name).symlink_to(CONFIGS / name)
    path = folder / "torque.toml"
    path.write_text(PATH.read_text("utf-8").replace("di_max_a = 5.0", "dtorque_max_n_m = 20.0"), "utf-8")
    return load_setup(
        path, Overrides(settings=("loop.duration_s=3.2", "reference.down_at_s=9.0", *BY_FTDOB, *settings))
    )


@pytest.mark.compiled
def test_by_torque_it_is_the_same(tmp_path: Path) -> None:
    setup = torque_setup(tmp_path, *AS_TORQUE)
    assert setup.config.command.unit == "N m" and setup.machine.law["k_u"][0] == 1.0
    run = simulate_ticks(setup, [*MATCHED, 'firmware={takes="torque"}'])
    assert settled(run) == 12 and operating(run)["u_q"].max() <= 3.6 * 15.0


@pytest.mark.compiled
def test_a_drive_that_reckons_with_another_torque_constant_is_told_apart(tmp_path: Path) -> None:
    constant = "drive.torque_constant_n_m_a=1.8"
    setup = torque_setup(tmp_path, *AS_TORQUE, constant, "limits.torque_max_n_m=3.0")
    run = simulate_ticks(setup, [*MATCHED, 'firmware={takes="torque",torque_constant_n_m_a=1.8}'])
    assert settled(run) == 12
    assert operating(run)["u_q"].max() == 3.0  # of the drive's: 1.67 A, and 6 N m on the shaft


@pytest.mark.compiled
def test_the_guard_holds_the_command_to_its_limits_in_amperes() -> None:
    setup = setup_of("limits.i_max_a=2.0", "limits.di_max_a=0.05", "limits.soft_start_s=2.5")
    ticks = simulate_ticks(setup)
    own = operating(ticks)
    assert own["u_q"].max() == 2.0 and not own["u_d"].any()
    assert np.abs(np.diff(own["u_q"])).max() < 0.05 + 0.0011
    assert (np.abs(own["u_q"]) <= 2.0 * np.arange(len(own)) / 2500 + 0.001)[:2500].all()  # the soft start
    seen = np.bitwise_or.reduce(ticks["guard_flags"])
    for flag in (GuardFlag.VOLTAGE_STEP, GuardFlag.SATURATED):
        assert seen & flag
    after = ticks[ticks["reason"] != 0]
    assert len(after) and not after["u_q"].any()


@pytest.mark.compiled
def test_what_is_not_reported_is_no_number_and_is_judged_by_the_command(tmp_path: Path) -> None:
    absent = (UNTOLD, 'drive.signals.i_d=""', "limits.i2t_max_a2s=0.5", "limits.i_continuous_a=0.1")
    ticks = simulate_ticks(setup_of(*absent))
    assert np.isnan(ticks["i_q"]).all() and np.isnan(ticks["i_d"]).all()
    assert ticks["reason"][-1] == Reason.I2T
    folder = f'log.folder="{tmp_path}"'
    assert replay(Path(simulate(setup_of(*absent, folder), [])["log"])).verdict == "same"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ('controller.kind="cascade"',),
            "controller.kind: cascade asks for a voltage, the drive takes a current",
        ),
        (("limits.u_max_v=100.0",), "limits.u_max_v: the drive takes a current, no voltage; remove it"),
        (("limits.i_max_a=40.0", "limits.i_trip_a=50.0"), "a command carries no more than 32.767"),
        (('drive.signals.units.i_q_ref="permille"',), "that needs drive.rated_current_arms"),
        (('drive.signals.units.i_q_ref="Ax"',), "i_q_ref: COMMAND.CurrentQ is given the unit 'Ax'"),
        (('drive.signals.u_q="COMMAND.CurrentD"',), "i_q_ref and u_q: the drive takes one of them"),
        (('drive.signals.torque="FEEDBACK.CurrentD"',), "i_q and torque: one of them tells what flows"),
        (("drive.current_lag_ms=9000.0",), "slower than the shaft itself"),
        (("drive.delay_ticks=9",), "drive.delay_ticks"),
    ],
)
def test_a_mistake_is_one_line(settings: tuple[str, ...], said: str) -> None:
    extra = ("motor.B_f_n_m_s=0.2",) if "lag_ms" in settings[0] else ()
    with pytest.raises((HilError, ValueError, OSError)) as caught:
        setup_of(*settings, *extra)
    assert said in str(caught.value)


def test_limits_that_the_drive_needs_are_asked_for(tmp_path: Path) -> None:
    lines = PATH.read_text(encoding="utf-8").replace("di_max_a = 5.0", "# none")
    path = tmp_path / "current.toml"
    path.write_text(lines, encoding="utf-8")
    with pytest.raises(HilError, match=r"limits\.di_max_a: missing; add it"):
        load_setup(path, Overrides())


def test_a_voltage_law_needs_its_limits_and_its_observer_as_before(tmp_path: Path) -> None:
    text = (CONFIGS / "demo.toml").read_text(encoding="utf-8")
    path = tmp_path / "demo.toml"
    path.write_text(
        text.replace("\nu_max_v", "\n# u_max_v").replace("[observer.current]", "[other]"), "utf-8"
    )
    with pytest.raises(HilError) as caught:
        load_setup(path, Overrides())
    assert "limits.u_max_v: missing; add it" in str(caught.value)
    assert "observer.current: missing; add it" in str(caught.value)
    with pytest.raises(HilError, match="speed asks for a current or torque, the drive takes a voltage"):
        load_setup(CONFIGS / "demo.toml", Overrides(settings=('controller={kind="speed"}',)))


def test_more_than_the_drives_own_limit_is_told_before_the_run() -> None:
    (row,) = reach_rows(setup_of("drive.current_limit_a=10.0"))
    assert row.verdict == "warn"  # an emulated bus: on one that may be real it fails
    assert "the drive's own limit is drive.current_limit_a = 10 A" in row.found
    assert [r.verdict for r in reach_rows(setup_of())] == ["pass"]


def test_per_mille_of_the_rated_current_is_peak() -> None:
    setup = setup_of(
        'drive.signals.units={i_q_ref="per mille",i_d_ref="per mille"}',
        "drive.rated_current_arms=10.0", "limits.i_max_a=0.4", "drive.current_limit_a=20.0",
    )  # fmt: skip
    assert setup.wire.u_lsb == pytest.approx(0.001 * 1e-3 * 10.0 * np.sqrt(2.0))


def test_the_report_names_what_the_drive_takes() -> None:
    plots = {plot.key: plot for plot in plots_of(setup_of().config)}
    assert plots["voltage_q"].unit == "A" and "voltage_d" not in plots
    volts = {plot.key: plot for plot in plots_of(load_setup(CONFIGS / "demo.toml", Overrides()).config)}
    assert volts["voltage_q"].unit == "V" and "voltage_d" in volts


def test_todays_parameters_are_neutral() -> None:
    p = load_setup(CONFIGS / "demo.toml", Overrides()).machine
    for name in ("k_u", "u_i", "told", "delay", "lag", "share", "kappa", "g_u"):
        assert name in LAW_PARAMS.fields and not p.law[name].any()
    assert not p.safety["k_u"].any() and p.safety["absent"].tolist() == [NO_ANGLE]
