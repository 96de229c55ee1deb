"""The drive's speed filter: the observer's exact sampled form, and the emulated drive's closed forms."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from firmware_model.config import PlantConfig, Wire, build_params, new_state
from firmware_model.drive import advance
from firmware_model.plant import Filter, State
from firmware_model.speedfilter import track
from hil.control.errors import ControlDesignError
from hil.control.law import (
    LAW_NEUTRAL,
    LAW_PARAMS,
    ChannelSpec,
    LawSpec,
    MotorModel,
    ask,
    between,
    design_law,
    exact_after,
    new_law_state,
    observe,
)
from hil.control.registry import InnerLoop, SpeedFilter
from hil.control.speed import flowed, latched
from hil.replay.ranges import check_ranges
from hil.tuning.current import loop_of, shaft_of

MOTOR = MotorModel(2.875, 0.033, 0.033, 0.8, 3, 0.011, 2e-4)
FTDOB = ChannelSpec("ftdob", 25.0, 58.0, 0.012)
T_S, D_TICKS = 1e-3, 12
ODRIVE, VESC = SpeedFilter((1000.0, 1000.0)), SpeedFilter((15.0, 1985.0))
FILTERS = [
    SpeedFilter((300.0,)),
    ODRIVE,
    VESC,
    SpeedFilter(ticks=1),
    SpeedFilter(ticks=4),
    SpeedFilter(ticks=9),
]


def order(given: SpeedFilter) -> int:
    return given.ticks or len(given.poles)


def law(inner: InnerLoop, observer: ChannelSpec = FTDOB, pole: float = 30.0) -> Any:
    return design_law(LawSpec("speed", MOTOR, observer, observer, pole, i_max=1e9, inner=inner), T_S)


class Shaft:
    """The continuous plant (w, filter, i) by the matrix exponential; ``y`` is what the drive reports."""

    def __init__(self, inner: InnerLoop, d: float, w: float = 10.0) -> None:
        given = inner.filter or SpeedFilter()
        poles, n = given.poles, 2 if given.ticks else len(given.poles)
        A = np.zeros((n + 4, n + 4))  # w, filter, i, u, d
        A[0, 0], A[0, n + 1], A[0, n + 3] = -MOTOR.B_f / MOTOR.J, inner.k_u / MOTOR.J, 1.0
        if given.ticks:
            A[1, 0] = 1.0
        elif n == 1:
            A[1, 0], A[1, 1] = poles[0], -poles[0]
        elif n == 2:
            A[1, 2], A[2, 0] = 1.0, poles[0] * poles[1]
            A[2, 1], A[2, 2] = -poles[0] * poles[1], -poles[0] - poles[1]
        if inner.lag:
            A[n + 1, n + 1], A[n + 1, n + 2] = -1.0 / inner.lag, 1.0 / inner.lag
        self.step, self.n, self.inner, self.ticks = expm(A * T_S), n, inner, given.ticks
        self.z = np.zeros(n + 4)
        self.z[0], self.z[-1] = w, d
        self.z[1:2] = 0.0 if given.ticks else w
        self.angles = [-w * T_S * back for back in range(given.ticks, -1, -1)]
        self.way = [0.0] * (1 + inner.delay)

    @property
    def y(self) -> float:
        if self.ticks:
            return float(self.angles[-1] - self.angles[-1 - self.ticks]) / (self.ticks * T_S)
        return float(self.z[1])

    def tick(self, u: float) -> None:
        self.z[self.n + 2] = self.way.pop(0)
        self.way.append(u)
        if not self.inner.lag:
            self.z[self.n + 1] = self.z[self.n + 2]
        self.z = self.step @ self.z
        self.angles.append(float(self.z[1]))


@dataclasses.dataclass
class Seen:
    """By tick: estimate, speed behind the filter, true speed, reported speed."""

    d_hat: np.ndarray[Any, Any]
    w_hat: np.ndarray[Any, Any]
    w: np.ndarray[Any, Any]
    y: np.ndarray[Any, Any]


def drive(
    p: Any,
    shaft: Shaft,
    ticks: int,
    commands: Any = None,
    change: tuple[int, float] = (-1, 0.0),
    lost: Any = (),
) -> Seen:
    """The law's own kernels against the plant; ``change``: from which tick on d is another one."""
    s, u, rows = new_law_state()[0], 0.0, []
    for k in range(ticks):
        if k == change[0]:
            shaft.z[-1] = change[1]
        heard = k not in lost and k % max(p["every"], 1) == 0
        s["ua"][0] = flowed(p, s, 0.0, False, 1)
        observe(p, s, shaft.y if heard else 0.0, 0.0, 0.0, heard, 1)
        if p["every"] > 1 and not heard:
            between(p, s)
        latched(p, s, u, True)
        ask(p, s, 10.0, 0.0, 0.0, 1e9)
        u = float(s["u"][1]) if commands is None else commands[k]
        rows.append((s["d_hat"][0], s["x"][0], shaft.z[0], shaft.y))
        shaft.tick(u)
    return Seen(*np.array(rows).T)


def untold(given: SpeedFilter, lag: float = 1e-3, delay: int = 0) -> InnerLoop:
    return InnerLoop(3.6, 1.0, lag, delay, told=False, filter=given)


@pytest.mark.parametrize("given", FILTERS)
@pytest.mark.parametrize(("lag", "delay"), [(0.0, 0), (1e-3, 1), (3e-3, 0)])
def test_speed_and_disturbance_are_exact_after_d_and_not_before(
    given: SpeedFilter, lag: float, delay: int
) -> None:
    inner = untold(given, lag, delay)
    p = law(inner)
    assert exact_after(p) == (D_TICKS, D_TICKS) and p["order"][0] == order(given)
    commands = np.random.default_rng(round(1e5 * lag) + delay).uniform(-5.0, 5.0, 60)
    seen = drive(p[0], Shaft(inner, -431.7), 60, commands, change=(30, 200.0))
    warm = order(given) + 1  # n samples before the first that a v rests on
    assert seen.d_hat[warm:31] == pytest.approx(-431.7, rel=1e-8)
    assert seen.w_hat[warm:31] == pytest.approx(seen.w[warm:31], abs=1e-8)
    assert abs(seen.d_hat[30 + D_TICKS - 1] - 200.0) > 0.1
    assert seen.d_hat[30 + D_TICKS :] == pytest.approx(200.0, rel=1e-8)
    assert seen.w_hat[30 + D_TICKS :] == pytest.approx(seen.w[30 + D_TICKS :], abs=1e-8)
    assert np.abs(seen.y - seen.w).max() > 0.01  # the filter is there


@pytest.mark.parametrize("given", FILTERS)
def test_until_there_are_samples_enough_the_reported_speed_is_taken(given: SpeedFilter) -> None:
    inner = untold(given)
    seen = drive(law(inner)[0], Shaft(inner, -431.7), 20, np.zeros(20))
    few = order(given)
    assert (seen.w_hat[:few] == seen.y[:few]).all() and not seen.d_hat[: few + 1].any()
    assert seen.d_hat[few + 1] == pytest.approx(-431.7, rel=1e-8)


@pytest.mark.parametrize("given", FILTERS)
@pytest.mark.parametrize("lost", [(20,), (20, 21, 22), (20, 22, 23, 24, 25, 27)])
def test_a_gap_in_the_samples_is_made_up_for_exactly(given: SpeedFilter, lost: tuple[int, ...]) -> None:
    inner = untold(given)
    commands = np.random.default_rng(7).uniform(-5.0, 5.0, 40)
    seen = drive(law(inner)[0], Shaft(inner, -431.7), 40, commands, lost=lost)
    heard = [k for k in range(19, 40) if k not in lost]
    assert seen.d_hat[heard] == pytest.approx(-431.7, rel=1e-7)
    assert seen.w_hat[heard] == pytest.approx(seen.w[heard], abs=1e-7)


def test_a_disturbance_that_changes_as_a_gap_begins_is_made_up_for() -> None:
    inner = untold(ODRIVE)
    commands = np.random.default_rng(7).uniform(-5.0, 5.0, 60)
    seen = drive(law(inner)[0], Shaft(inner, -431.7), 60, commands, change=(30, 200.0), lost=(31, 32, 33))
    assert seen.w_hat[34:36] == pytest.approx(seen.w[34:36], abs=0.6)
    assert seen.d_hat[30 + D_TICKS :] == pytest.approx(200.0, rel=1e-7)


SELDOM = [
    (None, 2, 12),
    (None, 5, 20),
    (None, 10, 12),
    (SpeedFilter((300.0,)), 4, 20),
    (ODRIVE, 2, 12),
    (ODRIVE, 10, 40),
    (VESC, 7, 30),
    (SpeedFilter(ticks=4), 2, 12),
    (SpeedFilter(ticks=4), 10, 24),
    (SpeedFilter(ticks=9), 4, 20),
]


@pytest.mark.parametrize(("given", "every", "D"), SELDOM)
@pytest.mark.parametrize("past", [0, 1, -1])
def test_speed_and_disturbance_of_measurements_in_each_mth_tick(
    given: SpeedFilter | None, every: int, D: int, past: int
) -> None:
    """Exact in ticks: just after a measurement the gap that is not whole adds what is left of it."""
    inner = dataclasses.replace(untold(ODRIVE), filter=given, every=every)
    p = law(inner, dataclasses.replace(FTDOB, delay=D * T_S))
    shaft = Shaft(dataclasses.replace(inner, filter=given or SpeedFilter((1e9,))), -431.7)
    start, length = 20 * every + past, 60 * every
    commands = np.random.default_rng(every).uniform(-5.0, 5.0, length)
    seen = drive(p[0], shaft, length, commands, change=(start, 200.0))
    before = slice(10 * every, start)
    assert seen.d_hat[before] == pytest.approx(-431.7, rel=1e-6)
    assert seen.w_hat[before] == pytest.approx(seen.w[before], abs=1e-5), "between measurements too"
    known = start + exact_after(p)[0]
    assert seen.d_hat[known:] == pytest.approx(200.0, rel=1e-6)
    assert seen.w_hat[known:] == pytest.approx(seen.w[known:], abs=1e-5)
    if past == 0:  # a change at a measurement is known after D, to the next measurement
        on_time = start + D + -D % every
        assert seen.d_hat[on_time:] == pytest.approx(200.0, rel=1e-6)
        assert abs(seen.d_hat[on_time - 1] - 200.0) > 1e-3


@pytest.mark.parametrize("given", [None, ODRIVE, SpeedFilter(ticks=4)])
def test_a_measurement_that_was_due_and_lost_is_made_up_for(given: SpeedFilter | None) -> None:
    inner = dataclasses.replace(untold(ODRIVE), filter=given, every=5)
    p = law(inner, dataclasses.replace(FTDOB, delay=0.02))
    shaft = Shaft(dataclasses.replace(inner, filter=given or SpeedFilter((1e9,))), -431.7)
    commands = np.random.default_rng(7).uniform(-5.0, 5.0, 100)
    seen = drive(p[0], shaft, 100, commands, lost=(40, 50, 55))
    assert seen.d_hat[30:] == pytest.approx(-431.7, rel=1e-6)
    assert seen.w_hat[30:] == pytest.approx(seen.w[30:], abs=1e-5)


def test_a_measurement_between_its_times_begins_anew_where_a_filter_is_known() -> None:
    inner = dataclasses.replace(untold(ODRIVE), every=2)
    p, s = law(inner, dataclasses.replace(FTDOB, delay=0.02))[0], new_law_state()[0]
    for fresh in (True, False, True, False, True, True):
        flowed(p, s, 0.0, False, 1)
        observe(p, s, 1.0, 0.0, 0.0, fresh, 1)
    assert s["heard"] == 1


def test_the_loop_is_judged_at_the_rate_of_its_measurements() -> None:
    loops = []
    for every in (1, 2, 5):
        inner = dataclasses.replace(untold(ODRIVE), filter=None, every=every)
        p = law(inner, dataclasses.replace(FTDOB, delay=0.02))
        loops.append(loop_of(p, shaft_of(MOTOR, inner, None, T_S), T_S))
    assert all(loop.stable for loop in loops)
    assert loops[0].ms < loops[1].ms < loops[2].ms
    assert loops[0].margins.phase_deg > loops[1].margins.phase_deg > loops[2].margins.phase_deg


@pytest.mark.parametrize(
    ("given", "every", "window", "said"),
    [
        (None, 13, FTDOB, "measurements come every 13 ms .feedback.period_ms., no one in the window"),
        (
            ODRIVE,
            5,
            FTDOB,
            "the states of drive.speed_filter and motor.shaft take 10 ms of it, and at least one must",
        ),
        (ODRIVE, 12, dataclasses.replace(FTDOB, delay=0.1), "takes 36 ticks of measurements in each 12th"),
        (
            None,
            2,
            ChannelSpec("adaptive", more={"delay_ms": 40.0}),
            "its thresholds are those of a speed in each tick",
        ),
    ],
)
def test_measurements_too_seldom_for_the_observer_are_refused(
    given: SpeedFilter | None, every: int, window: ChannelSpec, said: str
) -> None:
    with pytest.raises(ControlDesignError, match=said):
        law(dataclasses.replace(untold(ODRIVE), filter=given, every=every), window)


def test_a_gap_before_there_are_samples_enough_begins_anew() -> None:
    inner = untold(ODRIVE)
    seen = drive(law(inner)[0], Shaft(inner, -431.7), 20, np.zeros(20), lost=(2, 3))
    assert not seen.d_hat[:7].any() and seen.d_hat[7] == pytest.approx(-431.7, rel=1e-8)  # 4, 5, 6, 7


@pytest.mark.parametrize("given", [None, *FILTERS])
def test_the_speed_error_moves_by_its_pole_as_without_a_filter(given: SpeedFilter | None) -> None:
    lag = 3e-3
    inner = dataclasses.replace(untold(ODRIVE, lag, 2), filter=given)
    shaft = Shaft(dataclasses.replace(inner, filter=given or SpeedFilter((1e9,))), -400.0, 30.0)
    seen = drive(law(inner, pole=100.0)[0], shaft, 400)
    error = seen.w - 10.0
    late = error[80:120]
    slow, fast = np.exp(-100.0 * T_S), np.exp(-T_S / lag)
    left = late[2:] - (slow + fast) * late[1:-1] + slow * fast * late[:-2]  # both poles, and no third
    assert abs(error[-1]) < 1e-7 and np.abs(left).max() < 1e-7


def test_to_undo_a_filter_costs_noise_and_a_mean_costs_none() -> None:
    amplified = {
        given: float(np.sqrt((law(untold(given))["w_y"] ** 2).sum()))
        for given in (ODRIVE, VESC, *FILTERS[3:])
    }
    assert amplified[ODRIVE] == pytest.approx(3.125, abs=0.01)
    assert amplified[VESC] == pytest.approx(117.5, abs=0.5)
    assert all(amplified[given] == pytest.approx(1.0, abs=1e-3) for given in FILTERS[3:])


@pytest.mark.compiled
def test_the_loop_is_as_good_as_without_the_filter_when_it_is_known_and_bad_when_not() -> None:
    def loop(known: SpeedFilter | None, real: SpeedFilter | None) -> Any:
        inner = dataclasses.replace(untold(ODRIVE), told=True, filter=known)
        return loop_of(law(inner), shaft_of(MOTOR, inner, real, T_S), T_S)

    plain, known, unknown = loop(None, None), loop(ODRIVE, ODRIVE), loop(None, ODRIVE)
    assert plain.ms == pytest.approx(1.455, abs=0.01) and known.ms < 1.1 * plain.ms < unknown.ms
    assert known.margins.phase_deg > 50 > unknown.margins.phase_deg
    assert loop(VESC, VESC).stable and not loop(None, VESC).stable
    assert loop(None, VESC).margins.gain == 0.0
    assert known.d_noise == pytest.approx(489.3, rel=0.01) and plain.d_noise == pytest.approx(134.0, rel=0.01)
    mean = SpeedFilter(ticks=4)
    assert loop(mean, mean).ms < loop(None, mean).ms
    assert not loop(None, SpeedFilter((100.0, 100.0))).stable


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (SpeedFilter(ticks=12), "the states of drive.speed_filter and motor.shaft take 12 ms of it"),
        (SpeedFilter(ticks=33), "33 periods, and 32 are kept at most"),
        (SpeedFilter((1e-4,)), "says nothing of the speed in a period"),
        (SpeedFilter((1e-3, 1e-3)), "no number of samples tells the speed behind it"),
    ],
)
def test_what_can_not_be_undone_is_refused(given: SpeedFilter, said: str) -> None:
    window = dataclasses.replace(FTDOB, delay=0.012 if given.ticks < 33 else 0.05)
    with pytest.raises(ControlDesignError, match=said):
        law(untold(given), window)


def test_the_window_is_shorter_by_the_filters_states_and_a_dob_has_none() -> None:
    assert law(untold(SpeedFilter(ticks=11)))["N"][0].tolist() == [1, 12, 12]
    dob = ChannelSpec("dob", more={"gamma_1_rad_s": 80.0, "delay_ms": 1.0, "gamma_2_rad_s": None})
    assert law(untold(ODRIVE), dob)["N"][0, 0] == 1


def test_without_a_filter_every_parameter_is_neutral() -> None:
    p = law(dataclasses.replace(untold(ODRIVE), filter=None))
    names = LAW_PARAMS.names or ()
    for name in names[names.index("order") :]:
        assert not p[name].any() and LAW_NEUTRAL[name] == 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("order", 33), ("order", -1), ("v_y", 0.0), ("gap_y", 0.0),
        ("every", 65), ("every", -1), ("span", 35), ("span", -1),
    ],
)  # fmt: skip
def test_a_log_whose_filter_leads_out_of_the_arrays_is_refused(name: str, value: float) -> None:
    p = law(untold(ODRIVE))
    check_ranges("law", p)
    p[name] = value
    with pytest.raises(ValueError, match=name):
        check_ranges("law", p)


WIRE = Wire(1e-9, 1e4, 1e-9, 1e4, 1e-9, 1e4)
PLANT_MOTOR = {"R_s_ohm": 2.0, "L_d_h": 0.02, "L_q_h": 0.033, "psi_f_wb": 0.7, "n_p": 3, "J_kg_m2": 0.011}


def plant(**firmware: Any) -> tuple[Any, Any]:
    tables = {"dbc": "none.dbc", "motor": PLANT_MOTOR, "firmware": firmware}
    p = build_params(PlantConfig.model_validate(tables), WIRE)
    s = new_state(p, 15)
    s["started"], s["state"] = 1, State.SWITCH_ON_DISABLED.value
    return p, s


@pytest.mark.parametrize(
    ("firmware", "kind", "poles"),
    [
        ({"speed_filter": {"kind": "first-order", "pole_rad_s": 300.0}}, Filter.FIRST_ORDER, (300.0,)),
        ({"speed_pll_rad_s": 1000.0}, Filter.PLL, (1000.0, 1000.0)),
        (
            {"speed_filter": {"kind": "pll", "pole_1_rad_s": 1985.0, "pole_2_rad_s": 15.0}},
            Filter.PLL,
            (15.0, 1985.0),
        ),
    ],
)
def test_the_emulated_filter_is_that_of_its_differential_equation(
    firmware: dict[str, Any], kind: Filter, poles: tuple[float, ...]
) -> None:
    p, s = plant(**firmware)
    assert p["filter"][0] == kind and (p["pole_1"][0], p["pole_2"][0])[: len(poles)] == poles

    def speed(t: float) -> float:
        return 20.0 + 400.0 * t  # straight, as it is taken within a substep

    def rates(t: float, y: Any) -> list[float]:
        if len(poles) == 1:
            return [poles[0] * (speed(t) - y[0])]
        return [y[1], poles[0] * poles[1] * (speed(t) - y[0]) - sum(poles) * y[1]]

    for k in range(40):
        track(p[0], s[0], speed(k * 5e-4), speed((k + 1) * 5e-4), 5e-4)
    truth = solve_ivp(rates, (0.0, 0.02), [0.0] * len(poles), method="DOP853", rtol=1e-11, atol=1e-11).y[
        0, -1
    ]
    assert s["seen_w"][0] == pytest.approx(truth, rel=1e-9)


def test_the_emulated_mean_is_the_angle_turned_over_the_window() -> None:
    p, s = plant(
        speed_filter={"kind": "moving-average", "window_ms": 4.0}, takes="current", current_period_us=50
    )
    assert (p["slots"][0], p["slot_ns"][0]) == (80, 50_000)
    s["x"][0, 0] = 50.0
    for k in range(1, 9):
        advance(p[0], s[0], 1_000_000)
        assert s["seen_w"][0] == pytest.approx(50.0 * min(k, 4) / 4, rel=1e-9)


@pytest.mark.parametrize(
    ("firmware", "said"),
    [
        ({"speed_pll_rad_s": 9.0, "speed_filter": {"kind": "first-order", "pole_rad_s": 9.0}}, "keep one"),
        ({"speed_filter": {"kind": "moving-average", "window_ms": 0.07}}, "no multiple of current_period_us"),
        ({"speed_filter": {"kind": "moving-average", "window_ms": 60.0}}, "from 1 to 1024 of them"),
        ({"speed_filter": "pll"}, "must be a table"),
    ],
)
def test_an_emulated_filter_that_makes_no_sense_is_refused(firmware: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        plant(**firmware)
