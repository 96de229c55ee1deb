"""The law position: exact eigenvalues, references that are integrals, moves, angles over turns, refusals."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from drivers.errors import DatabaseError
from hil.config.tables import RunConfig, load_toml
from hil.control.errors import ControlDesignError
from hil.control.law import ChannelSpec, LawSpec, MotorModel, ask, design_law, new_law_state, observe
from hil.control.position import TURN, locate
from hil.control.references import move, reference, reference_at, turned_at
from hil.control.registry import InnerLoop, SpeedFilter
from hil.control.speed import flowed, latched
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.signals import DriveState, Request, new_ticks
from hil.tick.kernel import new_safety_state
from hil.tick.setpoint import new_setpoint_state, no_setpoint, prepare
from tests.conftest import CONFIGS

pytestmark = pytest.mark.slow

PATH = CONFIGS / "position.toml"
MOTOR = MotorModel(2.875, 0.033, 0.033, 0.8, 3, 0.011, 2e-4)
FTDOB = ChannelSpec("ftdob", 25.0, 58.0, 0.012)
T_S = 1e-3
POLES = (40.0, 120.0)
STEADY = reference("step", w=50.0)[0]


def law(inner: InnerLoop, poles: tuple[float, float] = POLES) -> Any:
    more = {"position_pole_rad_s": poles[0], "speed_pole_rad_s": poles[1], "jerk_feedforward": False}
    return design_law(LawSpec("position", MOTOR, FTDOB, FTDOB, more=more, i_max=1e9, inner=inner), T_S)[0]


class Shaft:
    """The continuous plant (theta, w, i) by the matrix exponential; a command acts ``delay`` ticks late."""

    def __init__(self, inner: InnerLoop, d: float) -> None:
        A = np.zeros((5, 5))  # theta, w, i, u, d
        A[0, 1], A[1, 1], A[1, 2], A[1, 4] = 1.0, -MOTOR.B_f / MOTOR.J, inner.k_u / MOTOR.J, 1.0
        if inner.lag:
            A[2, 2], A[2, 3] = -1.0 / inner.lag, 1.0 / inner.lag
        self._step, self._lag, self.d = expm(A * T_S), inner.lag, d
        self.theta, self.w, self.i = 0.3, 10.0, 0.0
        self._on_their_way = [0.0] * (1 + inner.delay)

    def tick(self, u: float) -> None:
        acts = self._on_their_way.pop(0)
        self._on_their_way.append(u)
        i = self.i if self._lag else acts
        self.theta, self.w, self.i = (self._step @ [self.theta, self.w, i, acts, self.d])[:3]


def errors(p: Any, shaft: Shaft, ticks: int, profile: Any = STEADY) -> Any:
    """theta - theta* of the law's own kernels against the plant."""
    s, u, out = new_law_state()[0], 0.0, []
    for k in range(ticks):
        s["ua"][0] = flowed(p, s, 0.0, False, 1)
        observe(p, s, shaft.w, 0.0, 0.0, True, 1)
        latched(p, s, u, True)
        s["turned"], s["theta_ref"] = shaft.theta, turned_at(profile, k * T_S)
        ask(p, s, *reference_at(profile, k * T_S), 0.0, 1e9)
        u = float(s["u"][1])
        out.append(shaft.theta - s["theta_ref"])
        shaft.tick(u)
    return np.array(out)


@pytest.mark.parametrize("poles", [POLES, (60.0, 60.0), (5.0, 400.0)])
@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0), (1e-3, 0), (3e-3, 2), (0.0, 4)])
def test_the_angle_error_has_the_poles_given_and_no_load_stays_in_it(
    lag: float, delay: int, poles: tuple[float, float]
) -> None:
    inner = InnerLoop(3.6, 1.0, lag, delay, told=False)
    e = errors(law(inner, poles), Shaft(inner, -400.0), 4000)
    assert abs(e[-1]) < 1e-8
    roots = [math.exp(-p * T_S) for p in poles] + ([math.exp(-T_S / lag)] if lag else [0.0])
    late = e[60:160]
    left = sum(c * late[3 - j : len(late) - j] for j, c in enumerate(np.poly(roots)))
    assert np.abs(left).max() < 1e-9, "these eigenvalues, and no fourth"


def test_the_jerk_that_is_fed_forward_follows_an_s_curve_closer() -> None:
    inner = InnerLoop(3.6, 1.0, 1e-3, 0, told=False)
    record = move(20.0, 40.0, 200.0, 2000.0, 0.1)
    worst = []
    for jerk in (0, 1):
        p, shaft = law(inner), Shaft(inner, 0.0)
        p["jerk"], shaft.theta, shaft.w = jerk, 0.0, 0.0
        worst.append(np.abs(errors(p, shaft, 1200, record[0])).max())
    assert worst[1] < 0.5 * worst[0] < 1e-3


def test_a_wrong_estimate_leaves_the_angle_that_the_stiffness_says() -> None:
    inner = InnerLoop(3.6, 1.0, 1e-3, 0, told=False)
    p = law(inner)
    p["theta"] *= 0.9  # a d_hat that is a tenth too small
    e = errors(p, Shaft(inner, -400.0), 2000)
    late = 1.0 + (POLES[0] + POLES[1]) * (T_S + 1e-3)  # a tick and the lag, which d_hat foretells, too
    assert e[-1] == pytest.approx(-40.0 * late / (POLES[0] * POLES[1]), rel=0.1)


REFERENCES = [
    reference("step", w=20.0, at=0.3),
    reference("ramp", w=-30.0, at=0.1, down_at=1.1, rate=100.0),
    reference("ramp", w=30.0, at=0.1, down_at=0.2, rate=100.0),
    reference("s-curve", w=30.0, at=0.1, down_at=1.0, rate=100.0, jerk=1000.0),
    reference("s-curve", w=-3.0, at=0.1, down_at=1.0, rate=100.0, jerk=1000.0),
    reference("sine", w=4.0, offset=2.0, frequency=3.0),
    reference("table", table=([0.2, 0.5, 0.5, 1.0], [1.0, 4.0, -2.0, 3.0])),
]


@pytest.mark.parametrize("record", REFERENCES)
def test_the_angle_is_the_integral_of_the_speed(record: Any) -> None:
    t = np.linspace(0.0, 2.0, 20_001)
    w = np.array([reference_at(record[0], at)[0] for at in t])
    trapezoids = np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * np.diff(t))])
    angle = np.array([turned_at(record[0], at) for at in t])
    assert np.abs(angle - trapezoids).max() < 2.1e-3 * (record["kind"][0] in (0, 4)) + 1e-6


@pytest.mark.parametrize("jerk", [math.inf, 1000.0])
@pytest.mark.parametrize("way", [377.0, -377.0, 20.0, 1.0, -1e-3, 0.0])
def test_a_move_ends_at_its_target_within_its_limits(way: float, jerk: float) -> None:
    record = move(way, 80.0, 100.0, jerk, 0.2)
    t = 1e-3 * np.arange(9000)
    w, dw = np.array([reference_at(record[0], at) for at in t]).T
    assert turned_at(record[0], 9.0) == pytest.approx(way, abs=1e-12)
    assert np.abs(w).max() <= 80.0 and np.abs(dw).max() <= 100.0 * (1 + 1e-12) and w[-1] == dw[-1] == 0.0
    assert np.abs(np.diff(dw)).max() <= 1e-3 * jerk * (1 + 1e-9)
    assert (w * way >= 0.0).all(), "it never goes back"
    if abs(way) == 377.0:
        assert np.abs(w).max() == pytest.approx(80.0)


@pytest.mark.parametrize(
    ("counts", "bits"),
    [
        (4096, 12),  # within a turn
        (65536, 16),
        (1000, 12),  # begins anew after 4.096 turns
        (4096, 32),
        (10_000, 20),
    ],
)
def test_an_angle_over_turns_drifts_by_nothing(counts: int, bits: int) -> None:
    """An hour, 30,000 turns forward and some back, a sample in 120 ms: the count that it is, to rounding."""
    lsb, span = TURN / counts, (1 << bits) * TURN / counts
    p, s = law(InnerLoop(3.6, 1.0)), new_law_state()[0]
    p["theta_span"] = 0.0 if abs(span / TURN - round(span / TURN)) < 0.01 else span
    t = 0.12 * np.arange(30_000)
    w, theta = 55.0 + 60.0 * np.sin(0.05 * t), 55.0 * t - 1200.0 * np.cos(0.05 * t)
    shown = np.rint(theta / lsb) % (1 << bits) * lsb
    jumps, turned = np.empty((2, len(t)))
    for k in range(len(t)):
        s["x"][0], s["unseen"] = w[k], 120
        jumps[k], turned[k] = locate(p, s, shown[k]), s["turned"]
    assert np.abs(jumps).max() < 1.1 * lsb + 1e-4
    off = turned - np.rint(theta / lsb) * lsb
    assert np.abs(off - off[0]).max() < 1e-9 * lsb + 1e-9


def test_what_the_speed_does_not_tell_is_a_jump() -> None:
    p, s = law(InnerLoop(3.6, 1.0)), new_law_state()[0]
    s["x"][0], s["unseen"] = 10.0, 1
    assert locate(p, s, 6.28) == 0.0
    s["unseen"] = 1
    assert locate(p, s, 0.01 + 6.28 - TURN) == pytest.approx(0.0, abs=1e-12)
    s["unseen"] = 1
    assert locate(p, s, 0.02 + 6.28 - TURN + 1.0) == pytest.approx(1.0)
    assert s["turned"] == pytest.approx(7.3)


def test_the_reference_angle_never_jumps() -> None:
    """From the profile to a live set-point, back, and down the ramp of a stop: the integral of w*."""
    rp, gp, gs = reference("ramp", w=20.0, rate=100.0), no_setpoint(), new_setpoint_state()
    gp["T_s"], gp["stop_rate"], gp["stop_ticks"], gp["w_rate"], gp["w_still"] = T_S, 50.0, 5000, 80.0, 1.5
    ss, lp = new_safety_state(), np.array([law(InnerLoop(3.6, 1.0))])
    ss["state"] = DriveState.OPERATION_ENABLED
    rows = []
    for k in range(1500):
        t = new_ticks()
        t["gap"], t["w"] = 1, gs["w"]
        ss["run_ticks"] = k
        gs["live_w"], gs["w_target"] = 400 <= k < 700, 5.0
        t["request"] = Request.STOP if k > 900 else Request.ARM
        prepare(rp, gp, gs, ss, lp, t)
        rows.append((float(t["w_ref"][0]), float(t["theta_ref"][0])))
    for (w_0, a), (w_1, b) in pairwise(rows):
        assert abs(b - a) <= max(abs(w_0), abs(w_1)) * T_S + 1e-12
    assert rows[399][1] == turned_at(rp[0], 0.399) and rows[-1][0] == 0.0
    w = np.array(rows)[:, 0]
    assert rows[-1][1] == pytest.approx(float(np.sum(0.5 * (w[1:] + w[:-1])) * T_S), abs=0.02)


def test_an_angle_is_no_affair_of_other_laws() -> None:
    setup = load_setup(CONFIGS / "cia402.toml", Overrides())
    assert not setup.machine.law["k_th"][0] and not setup.machine.safety["theta_jump"][0]


MOVE = 'reference={kind="move", target_rad=1.0, w_rad_s=%s, rate_rad_s2=10.0}'


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("controller.position_pole_rad_s=-1.0", r"controller\.position_pole_rad_s: .*, not -1\.0"),
        ("controller.speed_pole_rad_s=0.0", r"controller\.speed_pole_rad_s: "),
        (MOVE % "0.0", r"reference\.move\.w_rad_s: .*, not 0\.0"),
        (MOVE.replace("target_rad=1.0, ", "") % "1.0", "give the target once, as target_rad or "),
        (MOVE.replace("target_rad=1.0", "target_rad=1.0, target_turns=2.0") % "1.0", "give the target once"),
        ('limits={w_max_rad_s=150.0, i_max_a=10.0, i_trip_a=20.0, dtorque_max_n_m=18.0}',
         r"limits\.following_error_rad: missing; the law position pulls the harder"),
    ],
)  # fmt: skip
def test_tables_that_can_not_be_are_refused(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_toml(PATH, RunConfig, [override])


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("controller.position_pole_rad_s=1100.0", r"controller\.position_pole_rad_s = 1100: faster than the "
         r"sampling, which takes poles up to 1000 rad/s; take less, or a higher loop\.rate_hz"),
        ("controller.speed_pole_rad_s=2000.0", r"controller\.speed_pole_rad_s = 2000: faster than"),
        ('drive.signals.angle=""', "controller.kind position: the drive reports no angle; name it in "
         'drive.signals.angle, or take "speed"'),
        ('drive.signals.units={load_true="mNm", angle="counts"}', r"angle: TPDO2.Position is given the unit "
         r"'counts'; give it one of rad, rev, deg, 1/4096 rev"),
        ('drive.signals.units={load_true="mNm", angle="1/100000000000 rev"}', "less than a turn"),
        ("feedback.period_ms=4.0", "controller.kind position: needs the angle in each tick"),
        ('drive.speed_filter={kind="pll", pole_1_rad_s=15.0, pole_2_rad_s=1985.0, modelled=false}',
         "drive.speed_filter: the loop is not stable through a PLL"),
    ],
)  # fmt: skip
def test_setups_that_can_not_be_are_refused(override: str, said: str) -> None:
    with pytest.raises((ConfigError, ControlDesignError, DatabaseError), match=said):
        load_setup(PATH, Overrides(settings=(override,)))


def test_counts_are_turns_by_the_resolution_that_is_given() -> None:
    units = 'drive.signals.units={load_true="mNm", angle="1/4096 rev"}'
    angle = load_setup(PATH, Overrides(settings=(units,))).binding.signal("angle")
    assert angle is not None and angle.scale == pytest.approx(0.000244140625 * TURN / 4096)


def test_the_loop_behind_a_filter_that_is_known_is_stable() -> None:
    pll = 'drive.speed_filter={kind="pll", pole_1_rad_s=1000.0, pole_2_rad_s=1000.0}'
    setup = load_setup(PATH, Overrides(settings=(pll,)))
    assert setup.machine.law["order"][0] == len(SpeedFilter((1.0, 1.0)).poles)
