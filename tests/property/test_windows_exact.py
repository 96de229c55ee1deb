"""Every window of the registry in the law's own kernels: exact N ticks after the last change, not before."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from hil.control.law import (
    ChannelSpec,
    LawSpec,
    MotorModel,
    apply,
    design_law,
    law_window,
    new_law_state,
    observe,
    sampled_model,
)
from hil.control.noise import least_noise, noise_matrix, weights_of_noise
from hil.control.observer import bounds, impulse_response, response_length
from hil.control.observers.least_noise import closed_form
from hil.control.registry import Channel, observers
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

T_S = 1e-3
MOTOR = MotorModel(2.875, 0.033, 0.033, 0.8, 3, 0.011, 2e-4)
MODEL = sampled_model(MOTOR, T_S)
NOISE = {"w_noise_rad_s": 0.0104, "i_noise_a": 0.0021}
WINDOWS: dict[str, dict[str, Any]] = {
    "ftdob": {"gamma_1_rad_s": 25.0, "gamma_2_rad_s": 58.0},
    "least-noise": {**NOISE},
    "cubic": {},
    "ramp-exact": {"lead_ticks": 0.0},
    "harmonic-exact": {"frequency_hz": 20.0, "lead_ticks": 1.5, **NOISE},
    "exponentials": {"gammas_rad_s": [20.0, 40.0, 60.0]},
}
NEVER_EXACT = {"dob", "eso", "kalman"}
OF_ITS_OWN = {"adaptive"}
"""Exact earlier than N ticks after a change: tests/property/test_adaptive_window.py."""
LEAST = {"ramp-exact": 2, "harmonic-exact": 3, "exponentials": 3}


def channel(kind: str, N: int) -> ChannelSpec:
    return ChannelSpec(kind, more=WINDOWS[kind] | {"delay_ms": N * T_S * 1e3})


def law(speed: ChannelSpec, current: ChannelSpec) -> LawSpec:
    return LawSpec("cascade", MOTOR, speed, current, i_max=15.0, coupling=False)


def estimates(spec: LawSpec, d: Any, ticks: int, seed: int) -> np.ndarray:
    """d_hat of each tick for a disturbance whose mean over tick k is d(k)."""
    rng, p, s = np.random.default_rng(seed), design_law(spec, T_S)[0], new_law_state()[0]
    x, out = rng.normal(size=3), []
    observe(p, s, *x, True, 1)
    for k in range(ticks):
        u = rng.normal(size=3) * 10
        apply(s, *u)
        x = MODEL.Ad @ x + MODEL.Bd @ u + MODEL.Ed @ d(k)
        observe(p, s, *x, True, 1)
        out.append(s["d_hat"].copy())
    return np.array(out)


def test_all_windows_are_here() -> None:
    assert set(WINDOWS) | NEVER_EXACT | OF_ITS_OWN == set(observers())


@pytest.mark.parametrize("N", [3, 7, 20, 100, 256])
@pytest.mark.parametrize("kind", WINDOWS)
def test_exact_after_n_ticks_and_not_before(kind: str, N: int) -> None:
    rng = np.random.default_rng(N)
    before, after = rng.normal(size=(2, 3)) * 100
    found = estimates(
        law(channel(kind, N), channel(kind, N)), lambda k: after if k >= 300 else before, 700, N
    )
    error = np.abs(found - after).max(axis=1)
    scale = 1e-10 * np.abs(after).max() * max(1.0, 100.0 / N)
    assert error[300 + N - 1 :].max() < scale, "exact from N ticks on"
    assert error[300 + N - 2] > scale, "and not a tick earlier"


def assert_exact_through_losses(p: Any, rng: np.random.Generator, size: float) -> None:
    """A fifth of the measurements is lost, and d ~ ``size`` changes its sign: known exactly in the end."""
    s = new_law_state()[0]
    x, d = rng.normal(size=3), rng.normal(size=3) * size
    observe(p, s, *x, True, 1)
    for k in range(400):
        u = rng.normal(size=3) * 10
        apply(s, *u)
        x = MODEL.Ad @ x + MODEL.Bd @ u + MODEL.Ed @ (d if k > 200 else -d)
        observe(p, s, *x, bool(rng.random() > 0.2) or k in (200, 399), 1)
    np.testing.assert_allclose(s["d_hat"], d, rtol=0, atol=1e-8 * np.abs(d).max())


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("kind", WINDOWS)
def test_exact_through_lost_measurements(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    N = int(rng.integers(LEAST.get(kind, 1), 61))
    p = design_law(law(channel(kind, N), channel(kind, N)), T_S)[0]
    assert_exact_through_losses(p, rng, 100.0)


@pytest.mark.parametrize("kind", sorted(NEVER_EXACT))
def test_the_check_can_fail(kind: str) -> None:
    keys = {
        "dob": {"gamma_1_rad_s": 100.0, "gamma_2_rad_s": None, "delay_ms": None},
        "eso": {"bandwidth_rad_s": 150.0, "damping": 0.8},
        "kalman": {"d_walk_per_s": 2e3, "x_noise": 0.01, "filtered_state": False},
    }[kind]
    one = ChannelSpec(kind, more=keys)
    found = estimates(law(one, one), lambda k: np.ones(3) * (k >= 20), 320, 1)
    assert abs(found[39, 0] - 1.0) > 1e-4 and abs(found[-1, 0] - 1.0) < 1e-2


@pytest.mark.parametrize("lead", [0.0, 1.5, 4.0])
@pytest.mark.parametrize("N", [2, 10, 40])
def test_a_ramp_is_exact_at_the_lead(N: int, lead: float) -> None:
    one = ChannelSpec("ramp-exact", more={"delay_ms": float(N), "lead_ticks": lead})
    slope, at = np.array([3.0, -2.0, 1.0]), 80
    found = estimates(law(one, one), lambda k: slope * (k + 0.5 - at) * (k >= at), 200, 3)
    for k in (at + N - 1, at + N + 30):  # after tick k the time is k + 1
        np.testing.assert_allclose(found[k], slope * (k + 1 + lead - at), atol=1e-8 * 200)


@pytest.mark.parametrize(("hz", "N"), [(20.0, 25), (5.0, 60), (50.0, 20)])
def test_a_sine_of_the_known_frequency_is_exact(hz: float, N: int) -> None:
    lead, w = 1.5, 2 * math.pi * hz * T_S
    one = ChannelSpec("harmonic-exact", more={"delay_ms": float(N), "frequency_hz": hz, "lead_ticks": lead})

    def mean(k: int) -> Any:  # of 5 + sin(w t + 0.7) over tick k
        return np.full(3, 5.0 + (math.cos(w * k + 0.7) - math.cos(w * (k + 1) + 0.7)) / w)

    found = estimates(law(one, one), mean, 200, 5)
    for k in (120, 190):
        assert found[k, 0] == pytest.approx(5.0 + math.sin(w * (k + 1 + lead) + 0.7), abs=1e-7)


@pytest.mark.parametrize("N", [1, 2, 12, 50, 200])
def test_the_parabola_is_the_limit(N: int) -> None:
    found = least_noise(np.ones((1, N)), np.ones(1), 2.0, 1.0)
    np.testing.assert_allclose(found, closed_form(N, 0.0), rtol=1e-9)
    sigma = math.sqrt(found @ noise_matrix(N, 2.0, 1.0) @ found)
    assert sigma == pytest.approx(math.sqrt(12 / (N * (N + 1) * (N + 2))), rel=1e-9)


@pytest.mark.parametrize("index", [0, 1])
def test_the_closed_form_with_cosh(index: int) -> None:
    diagonal, neighbour = weights_of_noise(Channel(index, T_S, MODEL), NOISE)
    kappa = math.acosh(diagonal / (2 * neighbour))
    assert kappa == pytest.approx({0: 0.064, 1: 0.39}[index], rel=0.06)
    np.testing.assert_allclose(
        closed_form(20, kappa), least_noise(np.ones((1, 20)), np.ones(1), diagonal, neighbour), rtol=1e-7
    )


def sigma_of(
    kind: str, N: int, more: dict[str, Any] | None = None, i_noise: float = NOISE["i_noise_a"]
) -> float:
    """sigma(d_hat_w) [rad/s2] for the demo's noise, by the response of the window that runs."""
    one = ChannelSpec(kind, more=(WINDOWS[kind] if more is None else more) | {"delay_ms": float(N)})
    window = law_window(law(one, one), T_S)
    scale = np.array([NOISE["w_noise_rad_s"], i_noise, i_noise])
    weights, inverse = impulse_response(window, N + 1)[:, 0], MODEL.gap_inverse[0]
    shifted = np.r_[0.0, weights[:-1]]
    rows = weights[:, None] * inverse[0] - shifted[:, None] * (inverse @ MODEL.Ad)[0]
    return float(np.sqrt(((rows * scale) ** 2).sum()))


def test_noise_figures_of_the_study() -> None:
    """N = 12: least noise 0.796, the paper's 1.407 rad/s2; N = 50: a factor 0.29 of the paper's."""
    assert sigma_of("least-noise", 12) == pytest.approx(0.796, rel=0.01)
    assert sigma_of("ftdob", 12) == pytest.approx(1.407, rel=0.01)
    paper = {"gamma_1_rad_s": 6.0, "gamma_2_rad_s": 14.0}
    own = sigma_of("least-noise", 50, {}, 0.0) / sigma_of("ftdob", 50, paper, 0.0)
    assert own == pytest.approx(0.29, abs=0.01), "of noise in the speed alone"
    best = sigma_of("least-noise", 50)
    assert sigma_of("exponentials", 50, {"gammas_rad_s": [10.0, 20.0, 30.0], **NOISE}) < 1.06 * best
    assert all(sigma_of(kind, 50) >= best * (1 - 1e-9) for kind in WINDOWS)


@pytest.mark.parametrize(("kind", "lag"), [("least-noise", 0.5), ("cubic", 0.4), ("ramp-exact", 0.0)])
def test_lags(kind: str, lag: float) -> None:
    one = channel(kind, 100)
    weights = impulse_response(law_window(law(one, one), T_S), 101)[:, 0]
    assert (weights * (np.arange(101) + 0.5)).sum() / 100 == pytest.approx(lag, abs=0.012)


def test_the_eso_has_its_poles_and_bounds_count_it() -> None:
    one = ChannelSpec("eso", more={"bandwidth_rad_s": 200.0, "damping": 0.5})
    window = law_window(law(one, one), T_S)
    of = np.block([[window.M, -np.eye(3)], [window.W @ window.M, np.eye(3) - window.W]])
    poles = np.linalg.eigvals(of)
    wanted = np.exp(-0.2 * (0.5 + 1j * math.sqrt(0.75)))
    assert np.abs(poles - wanted).min() < 1e-12
    length = response_length(window)
    weights = impulse_response(window, length)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-9)
    assert (weights[:, 0] * (np.arange(length) + 0.5)).sum() * T_S == pytest.approx(1 / 200.0, rel=0.2)
    assert np.isfinite(bounds(window, MODEL.Ad, MODEL.Ed, T_S, np.ones(3)).resolution).all()


def test_the_page_on_extending_shows_a_window_that_works() -> None:
    text = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    told: dict[str, Any] = {}
    example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    exec(example, told)  # noqa: S102 - what the page says is what is tried
    member = told["MEMBER"]
    g = impulse_response(member.design({"delay_ms": 12.0}, Channel(0, T_S, MODEL)), 13)[:, 0]
    assert g.sum() == pytest.approx(1.0, rel=1e-12) and g[11] > 0 and g[12] == 0
    Q = noise_matrix(12, 2.0, 1.0)
    assert math.sqrt(
        g[:12] @ Q @ g[:12] / (closed_form(12, 0.0) @ Q @ closed_form(12, 0.0))
    ) == pytest.approx(1.11, abs=0.01)
