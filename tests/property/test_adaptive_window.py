"""The adaptive window in the law's own kernels: exact at every length, bumpless, deaf to noise."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from hil.control.adaptive import changed, set_length
from hil.control.errors import ControlDesignError
from hil.control.law import (
    ChannelSpec,
    LawSpec,
    apply,
    command,
    design_law,
    law_window,
    new_law_state,
    observe,
    sampled_model,
)
from hil.control.noise import noise_matrix, weights_of_noise
from hil.control.observer import impulse_response
from hil.control.observers.adaptive import lengths, sigmas, threshold
from hil.control.registry import Channel, InnerLoop, SpeedFilter
from hil.tuning.loop import count_alarms, rigid
from hil.tuning.measure import Bench
from tests.property.test_windows_exact import (
    MODEL,
    MOTOR,
    NOISE,
    T_S,
    assert_exact_through_losses,
    estimates,
)

N, SHORT, FIRST = 40, 12, 3
SIGMA = np.array([NOISE["w_noise_rad_s"], NOISE["i_noise_a"], NOISE["i_noise_a"]])


def spec(**more: Any) -> LawSpec:
    keys = {"delay_ms": float(N), "short_ms": float(SHORT), "first_ms": float(FIRST), "alarms_per_hour": 0.01}
    one = ChannelSpec("adaptive", more=keys | NOISE | more)
    return LawSpec(
        "cascade", MOTOR, one, one, speed_pole=90.0, current_pole=480.0, current_d_pole=480.0, i_max=15.0,
        coupling=False,
    )  # fmt: skip


def law(**more: Any) -> Any:
    return design_law(spec(**more), T_S)[0]


def test_a_large_change_is_exact_after_the_first_length_and_stays_so_while_the_window_grows() -> None:
    before, after = np.array([[40.0, -300.0, 200.0], [-450.0, 900.0, -700.0]])
    found = estimates(spec(), lambda k: after if k >= 300 else before, 500, 7)
    error = np.abs(found - after).max(axis=1)
    assert error[300 + FIRST - 1 :].max() < 1e-7, "exact FIRST ticks after it"
    assert error[300 + FIRST - 2] > 1.0, "and not a tick earlier"


def test_a_change_in_the_midst_of_a_tick_is_exact_a_tick_later() -> None:
    found = estimates(spec(), lambda k: np.full(3, 900.0 * min(max(k - 299.6, 0.0), 1.0)), 500, 8)
    assert np.abs(found[301 + FIRST - 1 :] - 900.0).max() < 1e-7


@pytest.mark.parametrize("wait", [1, 5, 20, 39, 80])
def test_a_second_change_is_exact_after_the_short_length(wait: int) -> None:
    """It came before the window was full again: then no window is shorter than SHORT but by growth."""
    levels = lambda k: np.full(3, 500.0 * (k >= 300) + 800.0 * (k >= 300 + wait))  # noqa: E731
    found = estimates(spec(), levels, 600, 9)
    assert np.abs(found[300 + wait + SHORT - 1 :] - 1300.0).max() < 1e-7


def test_small_changes_are_exact_after_the_long_length() -> None:
    found = estimates(spec(), lambda k: np.full(3, 0.01 * (k >= 300)), 500, 10)
    error = np.abs(found - 0.01).max(axis=1)
    assert error[300 + N - 1 :].max() < 1e-9 and error[300 + N - 2] > 1e-7


@pytest.mark.parametrize("seed", range(5))
def test_exact_through_lost_measurements(seed: int) -> None:
    assert_exact_through_losses(law(), np.random.default_rng(seed), 300.0)


def run(p: Any, ticks: int, d: Any, seed: int = 1, noise: float = 0.0, hold: Any = None) -> list[Any]:
    """States behind each tick of a shaft that accelerates; ``hold(k)``: its measured speed stands still."""
    rng, s, out = np.random.default_rng(seed), new_law_state()[0], []
    x = np.zeros(3)
    measured = x.copy()
    observe(p, s, *measured, True, 1)
    for k in range(ticks):
        u = np.array([0.0, 0.5 * k, 0.0])
        apply(s, *u)
        x = MODEL.Ad @ x + MODEL.Bd @ u + MODEL.Ed @ d(k)
        held = measured[0]
        measured = x + noise * SIGMA * rng.normal(size=3)
        if hold is not None and hold(k):
            measured[0] = held
        observe(p, s, *measured, True, 1)
        out.append(s.copy())
    return out


def test_the_length_after_a_change_holds_then_grows_by_one() -> None:
    states = run(law(), 420, lambda k: np.array([600.0 * (k >= 300), 0.0, 0.0]))
    length = np.array([s["length"][0] for s in states])
    assert length[299] == N and length[300] == FIRST
    hold = int(np.flatnonzero(length > FIRST)[np.flatnonzero(length > FIRST) > 300][0]) - 300
    assert FIRST <= hold <= 2 * FIRST + 1, "until the new level alone fills it"
    np.testing.assert_array_equal(
        length[300 + hold : 300 + hold + N - FIRST], np.arange(FIRST + 1, N + 1), "then a tick a tick"
    )
    assert (length[300 + hold + N - FIRST :] == N).all()
    assert all((s["length"][1:] == N).all() for s in states[299:]), "each channel by itself"


def test_it_begins_with_the_short_window() -> None:
    states = run(law(), N + 2, lambda k: np.zeros(3))
    assert states[0]["length"][0] == SHORT and states[SHORT]["length"][0] == SHORT + 1
    assert states[N]["length"][0] == N


def test_a_change_of_length_is_bumpless() -> None:
    """At a constant d the command is the same whatever the length: no step when it changes."""
    p, d, u = law(), np.array([200.0, -100.0, 50.0]), np.array([0.0, 30.0, 0.0])
    state = run(p, 300, lambda k: d)[-1]
    asked = []
    for length in range(1, N + 1):
        s = state.copy()
        s["length"][:] = length
        s["hold"][:] = 2
        apply(s, *u)
        observe(p, s, *(MODEL.Ad @ s["x"] + MODEL.Bd @ u + MODEL.Ed @ d), True, 1)
        command(p, s, 10.0, 0.0, 0.0, 300.0)
        assert (s["length"] == length).all()
        asked.append(s["u"].copy())
    np.testing.assert_allclose(np.array(asked), np.tile(asked[0], (N, 1)), rtol=0, atol=1e-7)


def test_the_thresholds_are_the_noise_of_each_length() -> None:
    p, window = law(), law_window(spec(), T_S)
    h = threshold(N, T_S, 0.01)
    for c in range(3):
        diagonal, neighbour = weights_of_noise(Channel(c, T_S, MODEL), NOISE)
        for n in (1, 2, 7, N):
            j = np.arange(n)
            g = 6.0 * (j + 1) * (n - j) / (n * (n + 1) * (n + 2))
            sigma = math.sqrt(g @ noise_matrix(n, diagonal, neighbour) @ g)
            assert p["g"][n - 1, c] == pytest.approx(h * sigma, rel=1e-12)
    weights = impulse_response(window, N + 1)[:, 0]
    j = np.arange(N)
    np.testing.assert_allclose(weights[:N], 6.0 * (j + 1) * (N - j) / (N * (N + 1) * (N + 2)))
    assert weights[N] == 0.0
    assert sigmas(3, 2.0, 1.0)[0] == pytest.approx(math.sqrt(2.0))


def test_the_bound_on_false_alarms() -> None:
    """Tries an hour times 2 e^{-h^2/2} is what was asked for, to the digits of h."""
    assert [lengths(n) for n in (1, 2, 3, 4, 7, 8, 60)] == [1, 1, 1, 2, 2, 3, 5]
    for alarms in (1e-4, 0.01, 1.0, 3600.0):
        h = threshold(60, T_S, alarms)
        assert 3.6e6 * 5 * 2 * math.exp(-h * h / 2) == pytest.approx(alarms, rel=0.01)
    assert threshold(60, T_S / 4, 0.01) > threshold(60, T_S, 0.01)


@pytest.mark.compiled
def test_no_false_alarm_in_five_minutes_of_noise_and_rounding() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(300_000, 3)) * [0.01, 0.002, 0.002]
    x = np.round(x / [0.01, 0.001, 0.001]) * [0.01, 0.001, 0.001]
    count = lambda p: count_alarms(p, new_law_state()[0], x)  # noqa: E731
    assert count(law()) == 0
    loud = {name: value / 2.0 for name, value in NOISE.items()}
    assert count(law(**loud)) > 0, "with half the noise told it can fail"
    many = count(law(alarms_per_hour=3600.0))
    assert many <= 3 * 300, "no more than the bound for three channels"


def test_a_frozen_encoder_is_not_taken_for_a_load() -> None:
    """The shaft accelerates while the measured speed stands still; then it jumps to where the shaft is."""
    quiet, p = (lambda k: np.array([-50.0, 0.0, 0.0])), law()
    free, frozen = (run(p, 400, quiet, 2, 1.0, hold) for hold in (None, lambda k: 300 <= k < 330))
    assert all(s["length"][0] == N for s in free[100:])
    assert all(s["length"][0] == N for s in frozen[100:331]), "neither frozen nor when it comes back"
    assert any(s["doubt"][0] for s in frozen[300:330]) and frozen[330]["doubt"][0] == 0
    assert not any(s["doubt"][0] for s in free[100:])


def test_a_load_after_a_long_rest_is_seen_at_once() -> None:
    """A measurement that stood still with reason casts no doubt on what ends it."""
    s, p = new_law_state()[0], law()
    for _ in range(200):
        observe(p, s, 0.0, 0.0, 0.0, True, 1)
    assert s["still"][0] == N and s["doubt"][0] == 0 and s["length"][0] == N
    observe(p, s, -0.5, 0.0, 0.0, True, 1)
    assert s["length"][0] == FIRST and s["still"][0] == 0


def test_windows_shorter_than_a_doubtful_stand_are_passed_over() -> None:
    p, s = law(), new_law_state()[0]
    s["length"][:], s["head"] = N, 100
    s["past"][100, 0, 0] = 5000.0  # a jump in the newest tick
    assert changed(p, s, 0, 0) == 1 and changed(p, s, 0, 1) == 2 and changed(p, s, 0, 4) == 8
    assert changed(p, s, 0, 16) == 0
    s["x"][:], s["still"][:], s["doubt"][:] = 1.0, 30, 1
    set_length(p, s, 0)
    assert s["length"][0] == N
    s["doubt"][:] = 0
    set_length(p, s, 0)
    assert s["length"][0] == FIRST and s["hold"][0] == FIRST


@pytest.mark.parametrize(("share", "found"), [(0.99, 0), (1.01, 1)])
def test_the_bound_is_that_of_both_estimates(share: float, found: int) -> None:
    p, s = law(), new_law_state()[0]
    s["length"][:], s["head"] = N, 100
    s["past"][100, 0, 0] = share * (p["g"][0, 0] + p["g"][N - 1, 0])
    assert changed(p, s, 0, 0) == found
    s["past"][100, 0, 0] *= -1.0
    assert changed(p, s, 0, 0) == found


def test_windows_up_to_half_the_present_one_are_compared() -> None:
    p, s = law(), new_law_state()[0]
    s["head"], s["past"][100, 0, 0] = 100, 5000.0
    for length, least, found in ((1, 0, 0), (2, 0, 1), (3, 1, 0), (4, 1, 2), (31, 8, 0), (32, 8, 16)):
        s["length"][:] = length
        assert changed(p, s, 0, least) == found


def test_the_first_length_is_for_a_full_window_alone() -> None:
    p, s = law(), new_law_state()[0]
    s["head"], s["x"][:] = 100, 1.0
    s["past"][100, 0, 0] = 5000.0
    for length, after in ((N, FIRST), (N - 1, SHORT), (SHORT, SHORT), (SHORT - 1, SHORT)):
        s["length"][:], s["hold"][:] = length, 0
        set_length(p, s, 0)
        assert s["length"][0] == after


@pytest.mark.long
def test_first_alarms_at_every_chance_upset_no_corner() -> None:
    """Dwell: the loop over one cycle of rest, first length and growth contracts, in all corners of +-30 %.

    Thresholds are zero in the tick at which the window is full and infinite in all others.
    """
    bench = Bench(MOTOR, T_S, 5.4, SIGMA[0], SIGMA[1])
    never, always = law(short_ms=14.0), law(short_ms=14.0)
    never["g"][:], always["g"][:] = np.inf, -1.0
    for plant in bench.plants():
        s, x, u, size = new_law_state()[0], np.array([1.0, 0.1]), 0.0, []
        for _ in range(12 * (N + FIRST)):
            p = always if (s["length"][:2] == N).all() else never
            observe(p, s, x[0], x[1], 0.0, True, 1)
            apply(s, 0.0, u, 0.0)
            command(p, s, 0.0, 0.0, 0.0, 1e300)
            x, u = plant.A @ x + plant.b * u, s["u"][1]
            size.append(abs(x[0]))
        assert max(size[-2 * N :]) < 1e-2 * max(size[: 2 * N]), "dies away"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"short_ms": 41.0}, "short_ms = 41 is 41 ticks, longer than the window that it shortens"),
        ({"first_ms": 13.0}, "first_ms = 13 is 13 ticks, longer"),
        ({"short_ms": 0.2}, "takes 1 to 256"),
        ({"delay_ms": 300.0}, "takes 1 to 256"),
    ],
)
def test_lengths_that_can_not_be_are_refused(more: dict[str, float], said: str) -> None:
    with pytest.raises(ControlDesignError, match=said):
        law(**more)


def test_a_speed_behind_a_filter_is_refused() -> None:
    """To undo a filter costs noise that the thresholds know nothing of."""
    inner = InnerLoop(3.6, 1.0, filter=SpeedFilter((400.0,)))
    given = dataclasses.replace(spec(), kind="speed", inner=inner, more={"speed_pole_rad_s": 30.0})
    assert design_law(dataclasses.replace(given, inner=InnerLoop(3.6, 1.0)), T_S)["short"][0, 0] == SHORT
    with pytest.raises(ControlDesignError, match=r"adaptive: its thresholds .* without drive\.speed_filter"):
        design_law(given, T_S)


def test_without_a_first_length_it_is_the_short_one() -> None:
    p = law(first_ms=None)
    assert (p["first"] == SHORT).all() and (p["short"] == SHORT).all() and (p["N"] == N).all()


def test_the_law_takes_the_end_of_the_line() -> None:
    """x_hat of a full window is the end of the least-squares line through the last F + 1 states."""
    p, s = law(), new_law_state()[0]
    rng = np.random.default_rng(4)
    x = rng.normal(size=(200, 3)) * SIGMA
    for row in x:
        observe(p, s, *row, True, 1)
        apply(s, 0.0, 0.0, 0.0)
        command(p, s, 0.0, 0.0, 0.0, 300.0)
    F = N - SHORT
    line = np.polyfit(np.arange(-F, 1), x[-F - 1 :, 0], 1)
    assert s["x_hat"][0] == pytest.approx(line[1], abs=0.05 * SIGMA[0])
    short = s.copy()
    short["length"][:], short["hold"][:] = SHORT, 2
    observe(p, short, *x[-1], True, 1)
    command(p, short, 0.0, 0.0, 0.0, 300.0)
    np.testing.assert_array_equal(short["x_hat"], short["x"])


def test_the_plant_of_the_corners_is_the_motors() -> None:
    assert np.allclose(rigid(MOTOR, T_S).A, sampled_model(MOTOR, T_S).Ad[:2, :2])
