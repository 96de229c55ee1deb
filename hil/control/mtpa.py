"""Operating points of a salient motor: least current for a torque (MTPA), field weakening past base speed.

With tau = T / (1.5 n_p), s = L_q - L_d, w the electrical speed and f = psi_f - s i_d, so that tau = f i_q:

    |i|^2 = i_d^2 + tau^2 / f^2
    |u|^2 = R_s^2 i_d^2 + w^2 (psi_f + L_d i_d)^2 + 2 R_s w tau + (R_s^2 + w^2 L_q^2) tau^2 / f^2

in steady state. At a given torque both are convex in i_d where f > 0, for s of either sign and with R_s: so
the point of least current that the voltage allows is that of least current itself, or lies where |u| just
fits, on the way to the least |u|. The most torque of a sign lies where f times the largest i_q within circle
and ellipse, a product of concave functions, ends its rise. Iterations are fixed in number and take sums,
products, quotients and square roots alone: the same bits everywhere. MTPA, voltage circle: Morimoto et al.,
IEEE Trans. Ind. Appl. 26 (1990), 866-871.
"""

from __future__ import annotations

import math
from typing import Any, Final

from hil.control.jit import jit

NEWTON: Final = 8
"""Steps to y of :func:`least_current`: from above, without overshoot; the last bits are there after six."""
POINTS: Final = 32
"""Most points of a table of i_d*."""
HALVINGS: Final = 52
"""Of an interval of i_d no longer than 2 i_max: its end is 2^-51 i_max from the point."""


@jit
def least_current(psi_f: float, s: float, tau: float) -> tuple[float, float]:
    """(i_d, i_q) [A] of least |i| for tau: i_d = -s i_q^2 / f, f = psi_f (1 + y).

    y (1 + y)^3 = (s tau / psi_f^2)^2 is convex in y, and min(m, m^1/4) above its root.
    """
    m = (s * tau / (psi_f * psi_f)) ** 2
    y = min(m, math.sqrt(math.sqrt(m)))
    for _ in range(NEWTON):
        g = 1.0 + y
        y -= (y * g * g * g - m) / (g * g * (1.0 + 4.0 * y))
    f = psi_f * (1.0 + y)
    i_q = tau / f
    return -s * i_q * i_q / f, i_q


@jit
def by_table(p: Any, psi_f: float, s: float, tau: float) -> tuple[float, float]:
    """(i_d, i_q) [A] for tau by the table i_d(|i_q|), linear between its points, constant past the last.

    Between two points i_d = a + b |i_q|, so |tau| = (psi_f - s a - s b |i_q|) |i_q|, which rises with |i_q|.
    """
    size, a, b = abs(tau), 0.0, 0.0
    for j in range(p["points"] - 1):
        q, d = p["i_q_at"][j], p["i_d_at"][j]
        b = (p["i_d_at"][j + 1] - d) / (p["i_q_at"][j + 1] - q)
        a = d - b * q
        if size <= (psi_f - s * p["i_d_at"][j + 1]) * p["i_q_at"][j + 1]:
            break
    last = p["points"] - 1
    if size > (psi_f - s * p["i_d_at"][last]) * p["i_q_at"][last]:
        a, b = p["i_d_at"][last], 0.0
    c = psi_f - s * a
    i_q = 2.0 * size / (c + math.sqrt(max(c * c - 4.0 * s * b * size, 0.0)))
    return a + b * i_q, i_q if tau >= 0.0 else -i_q


@jit
def wanted_current(p: Any, psi_f: float, s: float, tau: float) -> tuple[float, float]:
    """(i_d, i_q) [A] for tau: by the table where there is one and it keeps to i_max, else of least |i|."""
    if p["points"] > 0:
        i_d, i_q = by_table(p, psi_f, s, tau)
        if i_d * i_d + i_q * i_q <= p["i_max"] * p["i_max"]:
            return i_d, i_q
    return least_current(psi_f, s, tau)


@jit
def voltage(p: Any, w: float, i_d: float, i_q: float) -> tuple[float, float]:
    """(u_d, u_q) [V] that hold a current in steady state, by the model."""
    psi_f = p["k_t"] / (1.5 * p["n_p"])
    return p["R_s"] * i_d - w * p["L_q"] * i_q, p["R_s"] * i_q + w * (psi_f + p["L_d"] * i_d)


@jit
def fits(p: Any, w: float, u: float, i_d: float, i_q: float) -> bool:
    """True when that takes no more than u [V]."""
    u_d, u_q = voltage(p, w, i_d, i_q)
    return bool(u_d * u_d + u_q * u_q <= u * u)


@jit
def most_current(p: Any, w: float, u: float, i_d: float, sign: float) -> tuple[float, float]:
    """Largest i_q of that sign at i_d within voltage and i_max, and a number with the sign of d|tau|/di_d.

    No voltage fits: -1, and the slope toward where one does.
    """
    psi_f, s, R_s, L_d = p["k_t"] / (1.5 * p["n_p"]), p["L_q"] - p["L_d"], p["R_s"], p["L_d"]
    f, flux = psi_f - s * i_d, psi_f + L_d * i_d
    a = R_s * R_s + w * w * p["L_q"] * p["L_q"]
    b, b_slope = sign * R_s * w * f, -sign * R_s * w * s
    c, c_slope = R_s * R_s * i_d * i_d + w * w * flux * flux - u * u, R_s * R_s * i_d + w * w * L_d * flux
    inside = b * b - a * c
    if inside < 0.0:
        return -1.0, b * b_slope - a * c_slope
    root = math.sqrt(inside)
    by_voltage = (root - b) / a
    by_current = math.sqrt(max(p["i_max"] * p["i_max"] - i_d * i_d, 0.0))
    if by_current < by_voltage:
        return by_current, -s * by_current * by_current - f * i_d
    slope = -(b_slope * by_voltage + c_slope)
    return by_voltage, slope if by_voltage <= 0.0 else f * slope - s * by_voltage * root


@jit
def span(psi_f: float, s: float, i_max: float) -> tuple[float, float]:
    """Ends of i_d [A]: within i_max, and where f > 0."""
    low, high = -i_max, i_max
    if s > 0.0:
        high = min(high, 0.999 * psi_f / s)
    if s < 0.0:
        low = max(low, 0.999 * psi_f / s)
    return low, high


@jit
def most_torque(p: Any, w: float, u: float, sign: float) -> tuple[float, float]:
    """(i_d, |i_q|) of the most torque of that sign within voltage and i_max; i_q = 0 where there is none."""
    low, high = span(p["k_t"] / (1.5 * p["n_p"]), p["L_q"] - p["L_d"], p["i_max"])
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if most_current(p, w, u, middle, sign)[1] > 0.0:
            low = middle
        else:
            high = middle
    return low, max(most_current(p, w, u, low, sign)[0], 0.0)


@jit
def voltage_rises(p: Any, tau: float, w: float, i_d: float) -> bool:
    """True where |u|^2 of tau rises with i_d."""
    R_s, L_d, s = p["R_s"], p["L_d"], p["L_q"] - p["L_d"]
    psi_f = p["k_t"] / (1.5 * p["n_p"])
    i_q = tau / (psi_f - s * i_d)
    a = R_s * R_s + w * w * p["L_q"] * p["L_q"]
    return bool(
        R_s * R_s * i_d + w * w * L_d * (psi_f + L_d * i_d) + a * s * i_q * i_q / (psi_f - s * i_d) > 0.0
    )


@jit
def weakened(p: Any, tau: float, w: float, u: float, i_d: float) -> float:
    """The i_d nearest to the given one at which tau takes no more than u; of least voltage where none does.

    |u|^2 falls from the given i_d, where it is too large, to its minimum: d|u|^2/di_d tells the side.
    """
    psi_f, s = p["k_t"] / (1.5 * p["n_p"]), p["L_q"] - p["L_d"]
    low, high = span(psi_f, s, p["i_max"])
    down = voltage_rises(p, tau, w, i_d)
    near, far = i_d, low if down else high
    for _ in range(HALVINGS):
        middle = 0.5 * (near + far)
        if fits(p, w, u, middle, tau / (psi_f - s * middle)) or voltage_rises(p, tau, w, middle) != down:
            far = middle
        else:
            near = middle
    return far


@jit
def operating_point(p: Any, tau: float, w: float, u: float) -> tuple[float, float, bool]:
    """(i_d, i_q) [A] wanted for tau [Wb A] at w [rad/s], |u| <= u, |i| <= i_max; True: tau was capped.

    Past the speed at which even i_d = -i_max leaves no torque: i_q = 0, at the i_d that takes least voltage.
    """
    psi_f, s, i_max = p["k_t"] / (1.5 * p["n_p"]), p["L_q"] - p["L_d"], p["i_max"]
    bound = 2.0 * i_max * (psi_f + abs(s) * i_max)  # more than any point has: keeps what follows finite
    tau = min(max(tau, -bound), bound)
    i_d, i_q = wanted_current(p, psi_f, s, tau)
    if i_d * i_d + i_q * i_q <= i_max * i_max and fits(p, w, u, i_d, i_q):
        return i_d, i_q, False
    sign = 1.0 if tau >= 0.0 else -1.0
    most_d, most_q = most_torque(p, w, u, sign)
    if abs(tau) >= (psi_f - s * most_d) * most_q:
        return most_d, sign * most_q, True
    i_d = weakened(p, tau, w, u, i_d)
    room = math.sqrt(max(i_max * i_max - i_d * i_d, 0.0))
    return i_d, min(max(tau / (psi_f - s * i_d), -room), room), False
