"""Reference profiles: end points, limits, and the derivative against a difference quotient."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hil.control.errors import ControlDesignError
from hil.control.references import TABLE_MAX, reference, reference_at

PROFILES: dict[str, np.ndarray] = {
    "step": reference("step", w=80.0, at=0.5),
    "ramp": reference("ramp", w=-80.0, at=0.25, rate=100.0),
    "ramp down": reference("ramp", w=80.0, at=0.25, rate=100.0, down_at=2.0),
    "s-curve": reference("s-curve", w=80.0, at=0.25, rate=100.0, jerk=1000.0),
    "s-curve negative": reference("s-curve", w=-80.0, at=0.25, rate=100.0, jerk=1000.0),
    "s-curve short": reference("s-curve", w=2.0, at=0.25, rate=100.0, jerk=1000.0, down_at=2.0),
    "sine": reference("sine", w=10.0, offset=50.0, frequency=1.5),
    "table": reference("table", table=([0.1, 0.5, 0.5, 2.0], [0.0, 40.0, 60.0, -10.0])),
}


def sampled(p: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values = np.array([reference_at(p[0], t) for t in times])
    return values[:, 0], values[:, 1]


@pytest.mark.parametrize("name", PROFILES)
def test_derivative_is_the_slope(name: str) -> None:
    """Away from jumps and corners, which no derivative describes, the central difference agrees."""
    times, eps = np.arange(0.0503, 4.0, 0.01), 1e-5
    before, at_before = sampled(PROFILES[name], times - eps)
    after, at_after = sampled(PROFILES[name], times + eps)
    smooth = np.abs(at_after - at_before) < 0.05
    slope = (after - before) / (2 * eps)
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(slope[smooth], ((at_before + at_after) / 2)[smooth], atol=2e-2)


@pytest.mark.parametrize(
    ("name", "t", "w"),
    [
        ("step", 0.4999, 0.0),
        ("step", 0.5, 80.0),
        ("ramp", 0.25, 0.0),
        ("ramp", 0.65, -40.0),
        ("ramp", 1.05, -80.0),
        ("ramp down", 2.4, 40.0),
        ("ramp down", 9.0, 0.0),
        ("s-curve", 0.25, 0.0),
        ("s-curve", 0.35, 5.0),
        ("s-curve", 0.70, 40.0),
        ("s-curve", 1.15, 80.0),
        ("s-curve negative", 0.70, -40.0),
        ("s-curve short", 9.0, 0.0),
        ("sine", 0.0, 50.0),
        ("sine", 1 / 6, 60.0),
        ("table", 0.0, 0.0),
        ("table", 0.3, 20.0),
        ("table", 0.5, 60.0),
        ("table", 9.0, -10.0),
    ],
)
def test_values_by_hand(name: str, t: float, w: float) -> None:
    assert reference_at(PROFILES[name][0], t)[0] == pytest.approx(w, abs=1e-9)


@pytest.mark.parametrize("name", ["s-curve", "s-curve negative", "s-curve short"])
def test_s_curve_keeps_rate_and_jerk(name: str) -> None:
    times = np.arange(0.0, 2.0, 1e-4)
    value, slope = sampled(PROFILES[name], times)
    assert np.abs(slope).max() <= 100.0 * (1 + 1e-12)
    assert np.abs(np.diff(slope)).max() / 1e-4 <= 1000.0 * (1 + 1e-6)
    np.testing.assert_allclose(np.cumsum(slope) * 1e-4, value, atol=0.02)


def test_s_curve_to_zero_stays() -> None:
    assert reference_at(reference("s-curve", w=0.0, rate=1.0, jerk=1.0)[0], 5.0) == (0.0, 0.0)


def test_ramp_without_a_rate_jumps() -> None:
    assert reference_at(reference("ramp", w=5.0)[0], 1e-9) == (5.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "numbers", "condition"),
    [
        ("ramp", {"rate": 0.0}, "positive"),
        ("ramp", {"rate": math.nan}, "positive"),
        ("s-curve", {"rate": 10.0}, "finite"),
        ("s-curve", {"jerk": 10.0}, "finite"),
        ("s-curve", {"rate": 10.0, "jerk": -1.0}, "positive"),
        ("table", {}, "1 to 256"),
        ("table", {"table": ([0.0], [])}, "1 to 256"),
        ("table", {"table": ([0.0] * (TABLE_MAX + 1),) * 2}, "1 to 256"),
        ("table", {"table": ([1.0, 0.5], [0.0, 1.0])}, "go back"),
        ("table", {"table": ([0.0, 0.5], [0.0, math.nan])}, "finite"),
    ],
)
def test_profiles_that_can_not_be_followed(kind: Any, numbers: dict[str, Any], condition: str) -> None:
    with pytest.raises(ControlDesignError, match=condition):
        reference(kind, w=1.0, **numbers)
