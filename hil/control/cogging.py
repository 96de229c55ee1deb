"""The load torque that is known beforehand: harmonics of named orders over the shaft's angle, and by speed.

    T_c(theta, w) = sum_m a_m cos(n_m theta) + b_m sin(n_m theta) + k w |w|   [N m], against positive speed

It is a known term of the model, as reluctance torque is: the observer finds what is left, and the law
compensates it at the angles at which its command will act. A harmonic that changes too fast for the period is
left to the observer: from n |w| T_s = SLOW on it fades, and is nothing at twice that. e^{i n theta} is a
power of e^{i theta}, and that a polynomial: no libm, so the same bits on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.jit import jit
from hil.control.speedfilter import PAST

ORDERS: Final = 24
"""Harmonics that the record has room for."""
MOST_ORDER: Final = 1000
MOST_ANGLE: Final = 1e9
"""Angle [rad] from which on, as without one, nothing is known: its steps are no small ones."""
SLOW: Final = 0.4
"""n |w| T_s [rad] up to which a harmonic counts whole: the mean of a tick's ends is its mean within 1.4 %."""
_QUARTER: Final = 0.5 * math.pi
_QUARTER_LOW: Final = 6.123233995736766e-17
"""pi / 2 as a sum of two numbers."""


@dataclass(frozen=True, slots=True)
class Harmonics:
    """Orders n (ascending) and their cosine and sine coefficients a, b [N m]."""

    orders: tuple[int, ...]
    a: tuple[float, ...]
    b: tuple[float, ...]

    @property
    def peak(self) -> float:
        """Largest |T_c| over a turn [N m], to one in a thousand."""
        if not self.orders:
            return 0.0
        theta = np.linspace(0.0, 2.0 * math.pi, 64 * self.orders[-1], endpoint=False)
        return float(np.abs(self.torque(theta)).max())

    def torque(self, theta: Any) -> Any:
        """T_c at angles (N,) [rad] at rest, for figures; the tick has :func:`torque_at`."""
        return basis(theta, self.orders) @ np.ravel([self.a, self.b], "F")


def basis(theta: Any, orders: Sequence[int]) -> Any:
    """cos(n theta), sin(n theta) for each order in turn; (N, 2 orders)."""
    angles = np.outer(theta, np.asarray(orders, float))
    return np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(angles), -1)


def cog_params(
    known: Harmonics | None, lead: float, lag: float, T_s: float, k_w2: float = 0.0
) -> dict[str, Any]:
    """The part of LAW_PARAMS: :func:`ahead` has ``lead`` [s] and ``lag``; k_w2 [N m s2/rad2] of k w |w|.

    Empty where nothing is known. Raises ControlDesignError.
    """
    if not 0.0 <= k_w2 < math.inf:
        raise ControlDesignError(f"known_load: quadratic is {k_w2}; 0 and more")
    known = Harmonics((), (), ()) if known is None and k_w2 else known
    if known is None:
        return {}
    orders = np.asarray(known.orders)
    if not len(orders) == len(known.a) == len(known.b) or len(orders) > ORDERS:
        raise ControlDesignError(f"anticogging: orders, a and b are as many, and at most {ORDERS}")
    if (np.diff([0, *orders]) <= 0).any() or (orders > MOST_ORDER).any():
        raise ControlDesignError(f"anticogging: orders ascend, from 1 to {MOST_ORDER}")
    if not (np.isfinite(known.a).all() and np.isfinite(known.b).all()):
        raise ControlDesignError("anticogging: a coefficient is no number")
    return {
        "cogs": len(orders),
        "cog_order": _padded(orders),
        "cog_a": _padded(known.a),
        "cog_b": _padded(known.b),
        "cog_lead": lead,
        "cog_lag": lag,
        "cog_slow": SLOW / T_s,
        "k_w2": k_w2,
    }


def _padded(values: Any) -> Any:
    out = np.zeros(ORDERS, np.asarray(values).dtype if len(values) else float)
    out[: len(values)] = values
    return out


@jit
def unit(theta: float) -> tuple[float, float]:
    """(cos theta, sin theta) to the rounding of theta, by Taylor's series about the nearest quarter turn."""
    quarters = np.rint(theta / _QUARTER)
    r = (theta - quarters * _QUARTER) - quarters * _QUARTER_LOW
    s = r * r
    cosine, sine = 1.0, 1.0
    for k in range(9, 0, -1):
        cosine = 1.0 - s * cosine / ((2 * k - 1) * (2 * k))
        sine = 1.0 - s * sine / ((2 * k) * (2 * k + 1))
    sine *= r
    quarter = int(quarters) % 4
    if quarter == 0:
        return cosine, sine
    if quarter == 1:
        return -sine, cosine
    if quarter == 2:
        return -cosine, -sine
    return sine, -cosine


@jit
def raised(c: float, s: float, n: int) -> tuple[float, float]:
    """(c + i s)^n by squaring."""
    u, v = 1.0, 0.0
    while n > 0:
        if n & 1:
            u, v = u * c - v * s, u * s + v * c
        c, s = c * c - s * s, 2.0 * c * s
        n >>= 1
    return u, v


@jit
def torque_at(p: Any, theta: float, w: float) -> float:
    """T_c(theta) [N m] at the speed w [rad/s]; 0 at an angle that is none."""
    if not abs(theta) < MOST_ANGLE:
        return 0.0
    c, s = unit(theta)
    u, v, n, total = 1.0, 0.0, 0, 0.0
    for m in range(p["cogs"]):
        x, y = raised(c, s, p["cog_order"][m] - n)
        u, v, n = u * x - v * y, u * y + v * x, p["cog_order"][m]
        share = min(max(2.0 - n * abs(w) / p["cog_slow"], 0.0), 1.0)
        total += share * (p["cog_a"][m] * u + p["cog_b"][m] * v)
    return float(total)


@jit
def loaded(p: Any) -> bool:
    """Whether a load is known beforehand."""
    return bool(p["cogs"] > 0 or p["k_w2"] != 0.0)


@jit
def known_load(p: Any, s: Any, after: float) -> float:
    """T_c [N m], ``after`` [s] from the measurement by the measured speed."""
    w, total = s["x"][0], 0.0
    if p["cogs"] > 0:
        total = torque_at(p, s["theta"] + after * w, w)
    if p["k_w2"] != 0.0:
        total += p["k_w2"] * w * abs(w)
    return float(total)


@jit
def ripple(p: Any, s: Any, after: float) -> float:
    """-T_c / J [rad/s2], as :func:`known_load`."""
    return float(-known_load(p, s, after) / p["J"])


@jit
def ahead(p: Any, s: Any) -> float:
    """The ripple [rad/s2] that is to be asked for now, so that the current that comes of it is the right one.

    A command acts a tick late, and i_{k+2} = lam i_{k+1} + (1 - lam) i*_k:
    i*_k = (i_{k+2} - lam i_{k+1}) / (1 - lam), lead being 2 T_s. Without a lag lead is the tick's middle.
    """
    lam, lead = p["cog_lag"], p["cog_lead"]
    if lam == 0.0:
        return ripple(p, s, lead)
    return float((ripple(p, s, lead) - lam * ripple(p, s, lead - p["T_s"])) / (1.0 - lam))


@jit
def flows(p: Any, s: Any, periods: int) -> None:
    """Put the known load of the past ``periods`` into the ring of what flowed, as the command of its effect.

    For a drive whose speed comes through a filter: there the innovation is of that ring.
    """
    before, now, unit_of_u = s["c"][0], ripple(p, s, 0.0), p["J"] / p["k_u"]
    for age in range(periods):
        at = (s["place"] - age) % PAST
        s["flow"][at] += 0.5 * unit_of_u * (before + now)
        s["bend"][at] += unit_of_u * (now - before) / periods
