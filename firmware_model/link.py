"""The DC link: capacitor, rectifier, brake resistor, and the power that the motor takes or gives back.

    C dv/dt = i_r - i_b - P / v,  i_r = max(V_0 - v, 0) / R_r,  i_b = v / R_b while the chopper is on
    P = 1.5 (u_q i_q + u_d i_d)
The chopper goes on at v_on and off at v_off. Between two such edges v has a Taylor series, as the motor has;
each edge is found on it and the next series begins there.
"""

from __future__ import annotations

import math
from typing import Any

from firmware_model.jit import jit
from firmware_model.plant import INVERSE, LINK, POWER
from firmware_model.series import ORDER, evaluate, first_crossing, inner, shifted, within

LINK_ERROR_V = 1e-7
"""Last term of the series that a step may have [V]."""
EDGES = 1000
"""Steps and edges that one substep may have; beyond, it takes what is left in one."""
LEAST_V = 1.0
"""An empty link: below, P / v would have no sense."""


@jit
def link_voltage(p: Any, s: Any) -> float:
    """Voltage of the DC link [V]."""
    return float(s["v_dc"]) if p["capacitance"] > 0.0 else float(p["v_dc"])


@jit
def conducts(p: Any, s: Any, power: float) -> bool:
    """Whether the rectifier feeds the link; at V_0 it depends on where the voltage is going."""
    v = s["v_dc"]
    if v != p["v_dc"]:
        return bool(v < p["v_dc"])
    return bool(power / v + (v / p["brake_resistance"] if s["braking"] else 0.0) > 0.0)


@jit
def drain(p: Any, s: Any, fed: bool) -> tuple[float, float, float]:
    """Of C dv/dt = i_0 - G v - P / v: i_0 / C, G / C and 1 / C."""
    inverse_C = 1.0 / p["capacitance"]
    feed = 1.0 / p["rectifier"] if fed else 0.0
    conductance = feed + (1.0 / p["brake_resistance"] if s["braking"] else 0.0)
    return feed * p["v_dc"] * inverse_C, conductance * inverse_C, inverse_C


@jit
def link_coefficients(of: Any, power: Any, v: Any, i: Any, k: int) -> tuple[float, float]:
    """Coefficients k + 1 of v and k of i = 1 / v, from those up to k of P and v, and before k of i.

    Of v i = 1 follows i_k = old - v_k i_0^2, old = -i_0 sum_{0<j<k} v_j i_{k-j}; so dv/dt is linear in v_k.
    """
    current, fall, inverse_C = of
    if k == 0:
        return current - fall * v[0] - inverse_C * power[0] * i[0], i[0]
    square, old = i[0] * i[0], -i[0] * inner(v, i, k)
    rest = power[0] * old + inner(power, i, k) + power[k] * i[0]
    slope = -(fall - inverse_C * power[0] * square) * v[k] - inverse_C * rest
    return slope * (1.0 / (k + 1)), old - v[k] * square


@jit
def link_series(p: Any, s: Any, c: Any, fed: bool) -> None:
    """Coefficients of v in row LINK, from those of the motor's power in row POWER."""
    v, inverse, of = c[LINK], c[INVERSE], drain(p, s, fed)
    v[0], inverse[0] = s["v_dc"], 1.0 / s["v_dc"]
    for k in range(ORDER):
        v[k + 1], inverse[k] = link_coefficients(of, c[POWER], v, inverse, k)


@jit
def link_longer(of: Any, power: Any, v: Any, inverse: Any) -> Any:
    """The series v and 1 / v, here tuples, with one coefficient more."""
    more, last = link_coefficients(of, power, v, inverse, len(v) - 1)
    return (*v, more), (*inverse, last)


@jit
def held_link_series(p: Any, s: Any, power: Any, fed: bool) -> Any:
    """:func:`link_series` as a tuple, of the motor's power as one."""
    of = drain(p, s, fed)
    v_0 = s["v_dc"]
    more, last = link_coefficients(of, power, (v_0,), (1.0 / v_0,), 0)
    v, inverse = (v_0, more), (last,)
    v, inverse = link_longer(of, power, v, inverse)
    v, inverse = link_longer(of, power, v, inverse)
    v, inverse = link_longer(of, power, v, inverse)
    v, inverse = link_longer(of, power, v, inverse)
    v, inverse = link_longer(of, power, v, inverse)
    v, inverse = link_longer(of, power, v, inverse)
    v, _ = link_longer(of, power, v, inverse)
    return v


@jit
def link_step(p: Any, s: Any, v: Any, left: float) -> float:
    """Advance the link along its series to the next edge, by at most ``left`` [s]; return how far."""
    edge = p["brake_off"] if s["braking"] else p["brake_on"]
    at_edge = first_crossing(v, edge, left) if edge < math.inf else math.inf
    at_rectifier = first_crossing(v, p["v_dc"], left)
    step = min(left, at_edge, at_rectifier)
    s["v_dc"] = max(evaluate(v, step), LEAST_V)
    if at_edge == step:
        s["v_dc"], s["braking"] = edge, 1 - s["braking"]
    elif at_rectifier == step:
        s["v_dc"] = p["v_dc"]
    return float(step)


@jit
def advance_held_link(p: Any, s: Any, c: Any, power: Any, h: float) -> None:
    """:func:`advance_link` with the power as a tuple: nearly always one step is all, the rest goes there."""
    if s["v_dc"] >= p["brake_on"]:
        s["braking"] = 1
    v = held_link_series(p, s, power, conducts(p, s, power[0]))
    step = link_step(p, s, v, within(v, h, LINK_ERROR_V))
    if h - step > 0.0:
        for k in range(ORDER + 1):
            c[POWER, k] = power[k]
        shifted(c[POWER], step)
        link_steps(p, s, c, h - step, 1)


@jit
def link_steps(p: Any, s: Any, c: Any, left: float, first: int) -> None:
    """Advance the link by ``left`` [s], of which so many steps are done."""
    for n in range(first, EDGES):
        link_series(p, s, c, conducts(p, s, c[POWER, 0]))
        step = link_step(p, s, c[LINK], left if n == EDGES - 1 else within(c[LINK], left, LINK_ERROR_V))
        left -= step
        if left <= 0.0:
            return
        shifted(c[POWER], step)


@jit
def advance_link(p: Any, s: Any, c: Any, h: float) -> None:
    """Advance the link by h [s]; row POWER holds the motor's power about the beginning of h."""
    if s["v_dc"] >= p["brake_on"]:
        s["braking"] = 1
    link_steps(p, s, c, h, 0)
