"""Reference profiles as pure functions of time: step, ramp, S-curve, sine, table; their integrals; moves.

The value is an input of the tick and logged, so nothing here has to be the same to the bit elsewhere.
"""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from hil.control.errors import ControlDesignError
from hil.control.jit import jit

STEP, RAMP, S_CURVE, SINE, TABLE = range(5)
TABLE_MAX: Final = 256

REFERENCE: Final = np.dtype(
    [
        ("kind", "i8"),
        ("w", "f8"),
        ("at", "f8"),
        ("down_at", "f8"),
        ("rate", "f8"),
        ("jerk", "f8"),
        ("offset", "f8"),
        ("frequency", "f8"),
        ("i_q", "f8"),
        ("count", "i8"),
        ("t_table", "f8", TABLE_MAX),
        ("w_table", "f8", TABLE_MAX),
    ],
    align=True,
)

REFERENCE_NEUTRAL: Final[dict[str, float]] = {}
"""Parameters newer than log format 1, each with the value that means "as before"; see the law's table."""

Kind = Literal["step", "ramp", "s-curve", "sine", "table"]
_KINDS: Final[dict[str, int]] = {"step": STEP, "ramp": RAMP, "s-curve": S_CURVE, "sine": SINE, "table": TABLE}


def _check(kind: Kind, rate: float, jerk: float, times: list[float], values: list[float]) -> None:
    """Refuse slopes that are not positive (an S-curve's must be finite too) and tables out of order."""
    if not rate > 0 or not jerk > 0:
        raise ControlDesignError(f"rate and jerk must be positive, not {rate} and {jerk}")
    if kind == "s-curve" and math.isinf(rate + jerk):
        raise ControlDesignError("an S-curve needs a finite rate and a finite jerk; or take a ramp")
    if kind != "table":
        return
    if len(times) != len(values) or not 0 < len(times) <= TABLE_MAX:
        raise ControlDesignError(
            f"a table needs as many w as t, 1 to {TABLE_MAX}, not {len(values)}, {len(times)}"
        )
    if not np.isfinite(times + values).all() or (np.diff(times) < 0).any():
        raise ControlDesignError("a table must be finite and its times must not go back")


def reference(
    kind: Kind,
    *,
    w: float = 0.0,
    at: float = 0.0,
    down_at: float = math.inf,
    rate: float = math.inf,
    jerk: float = math.inf,
    offset: float = 0.0,
    frequency: float = 0.0,
    i_q: float = 0.0,
    table: tuple[list[float], list[float]] = ([], []),
) -> npt.NDArray[np.void]:
    """A one-element array of REFERENCE; w [rad/s], times [s], rate [rad/s2], jerk [rad/s3], i_q [A].

    Raises ControlDesignError when the profile's own numbers are missing or can't be followed.
    """
    times, values = table
    _check(kind, rate, jerk, times, values)
    out = np.zeros(1, REFERENCE)
    named = {"w": w, "at": at, "down_at": down_at, "rate": rate, "jerk": jerk, "offset": offset}
    for name, value in (named | {"frequency": frequency, "i_q": i_q, "count": len(times)}).items():
        out[name] = value
    out["kind"] = _KINDS[kind]
    out["t_table"][0, : len(times)], out["w_table"][0, : len(times)] = times, values
    return out


@jit
def ramp_at(t: float, w: float, rate: float) -> tuple[float, float]:
    """Ramp from 0 at t = 0 to w with slope rate; value and slope."""
    sign = 1.0 if w >= 0.0 else -1.0
    if t <= 0.0:
        return 0.0, 0.0
    if rate * t >= abs(w):
        return w, 0.0
    return sign * rate * t, sign * rate


@jit
def s_curve_at(t: float, w: float, rate: float, jerk: float) -> tuple[float, float]:
    """Jerk-limited move from 0 at t = 0 to w: acceleration a trapezium of slope jerk, at most rate.

    With T_j = min(rate / jerk, sqrt(|w| / jerk)) and a = jerk T_j it lasts |w| / a + T_j.
    """
    size = abs(w)
    if t <= 0.0 or size == 0.0:
        return 0.0, 0.0
    sign = 1.0 if w >= 0.0 else -1.0
    T_j = min(rate / jerk, math.sqrt(size / jerk))
    a = jerk * T_j
    end = size / a + T_j
    if t >= end:
        return w, 0.0
    if t < T_j:
        return sign * 0.5 * jerk * t * t, sign * jerk * t
    if t < end - T_j:
        return sign * a * (t - 0.5 * T_j), sign * a
    left = end - t
    return sign * (size - 0.5 * jerk * left * left), sign * jerk * left


@jit
def table_at(p: Any, t: float) -> tuple[float, float]:
    """Piecewise linear through the table's points, constant outside."""
    count = p["count"]
    times, values = p["t_table"], p["w_table"]
    if t < times[0]:
        return values[0], 0.0
    for j in range(count - 1):
        if t < times[j + 1]:
            slope = (values[j + 1] - values[j]) / (times[j + 1] - times[j])
            return values[j] + slope * (t - times[j]), slope
    return values[count - 1], 0.0


@jit
def ramp_area(t: float, w: float, rate: float) -> float:
    """Integral of :func:`ramp_at` from 0 to t."""
    size = abs(w)
    if t <= 0.0:
        return 0.0
    if rate * t >= size:
        return float(w * (t - 0.5 * size / rate))
    return float(math.copysign(0.5 * rate * t * t, w))


@jit
def s_curve_area(t: float, w: float, rate: float, jerk: float) -> float:
    """Integral of :func:`s_curve_at` from 0 to t: after its end w (t - end / 2), it being symmetric."""
    size = abs(w)
    if t <= 0.0 or size == 0.0:
        return 0.0
    T_j = min(rate / jerk, math.sqrt(size / jerk))
    a = jerk * T_j
    end = size / a + T_j
    area = size * (t - 0.5 * end)
    if t < T_j:
        area = jerk * t * t * t / 6.0
    elif t < end - T_j:
        area = a * (0.5 * t * (t - T_j) + T_j * T_j / 6.0)
    elif t < end:
        left = end - t
        area += jerk * left * left * left / 6.0
    return float(math.copysign(area, w))


@jit
def table_area(p: Any, t: float) -> float:
    """Integral of :func:`table_at` from 0 to t: trapezoids."""
    count, times, values = p["count"], p["t_table"], p["w_table"]
    total = values[0] * min(t, times[0])
    for j in range(count - 1):
        length = min(t, times[j + 1]) - times[j]
        if length > 0.0:
            slope = (values[j + 1] - values[j]) / (times[j + 1] - times[j])
            total += length * (values[j] + 0.5 * slope * length)
    return float(total + values[count - 1] * max(t - times[count - 1], 0.0))


@jit
def turned_at(p: Any, t: float) -> float:
    """Integral of w* from 0 to t >= 0 [rad], in closed form: of a move it ends at its way to rounding."""
    kind = p["kind"]
    if kind == STEP:
        return float(p["w"] * max(t - p["at"], 0.0))
    if kind == RAMP:
        up = ramp_area(t - p["at"], p["w"], p["rate"])
        return float(up - ramp_area(t - p["down_at"], p["w"], p["rate"]))
    if kind == S_CURVE:
        up = s_curve_area(t - p["at"], p["w"], p["rate"], p["jerk"])
        return float(up - s_curve_area(t - p["down_at"], p["w"], p["rate"], p["jerk"]))
    if kind == SINE:
        omega = 2.0 * math.pi * p["frequency"]
        swung = p["w"] / omega * (1.0 - math.cos(omega * t)) if omega > 0.0 else 0.0
        return float(p["offset"] * t + swung)
    return table_area(p, t)


def move(way: float, w: float, rate: float, jerk: float, at: float) -> npt.NDArray[np.void]:
    """A record of a move by ``way`` [rad] from rest to rest, |w*|, slope and jerk limited; jerk may be inf.

    A way up of w* and the same way down |way| / w later turn by just that. It takes w there / a + T_j each
    (:func:`s_curve_at`), so a short way has a lower w: w (w / a + T_j) = |way|.
    """
    size = abs(way)
    short = math.sqrt(size * rate)
    if math.isfinite(jerk):
        T = rate / jerk
        short = 0.5 * rate * (math.sqrt(T * T + 4.0 * size / rate) - T)
        if short < rate * T:  # the slope does not reach its limit
            short = (0.25 * size * size * jerk) ** (1.0 / 3.0)
    w = math.copysign(min(w, short), way) if size else 0.0
    down_at = at + (way / w if w else 0.0)
    kind: Kind = "s-curve" if math.isfinite(jerk) else "ramp"
    return reference(kind, w=w, at=at, down_at=down_at, rate=rate, jerk=jerk)


@jit
def reference_at(p: Any, t: float) -> tuple[float, float]:
    """w*(t) [rad/s] and its derivative [rad/s2]."""
    kind = p["kind"]
    if kind == STEP:
        return (p["w"], 0.0) if t >= p["at"] else (0.0, 0.0)
    if kind == RAMP:
        up, d_up = ramp_at(t - p["at"], p["w"], p["rate"])
        down, d_down = ramp_at(t - p["down_at"], p["w"], p["rate"])
        return up - down, d_up - d_down
    if kind == S_CURVE:
        up, d_up = s_curve_at(t - p["at"], p["w"], p["rate"], p["jerk"])
        down, d_down = s_curve_at(t - p["down_at"], p["w"], p["rate"], p["jerk"])
        return up - down, d_up - d_down
    if kind == SINE:
        omega = 2.0 * math.pi * p["frequency"]
        return p["offset"] + p["w"] * math.sin(omega * t), p["w"] * omega * math.cos(omega * t)
    return table_at(p, t)
