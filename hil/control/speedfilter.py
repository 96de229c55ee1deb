"""A speed y that is reported through a filter of known poles: w and d from y, in exact sampled form.

With z = (w, state of the filter), n numbers in all, the constant current u of a tick
(:mod:`hil.control.speed`) and the change b of the current in it,
    z+ = F z + G u + S b + E d,   y = C z
what of any n + 1 samples no start of z can explain is the innovation, and of n samples there is one z:
    v_k = sum_j r_j y_{k-j} - (known inputs),   v_k = sum_j e_j d_{k-1-j} with sum_j e_j = 1
    w_k = sum_j p_j y_{k-j} + (known inputs) + t d_hat_k
Both are exact for a d that is constant over their samples; nothing is filtered a second time. v_k needs
n - 1 ticks more than without a filter, by which the observer's window is shorter: the whole is exact after D
as before. To undo a filter costs noise, |r| and |p|: each pole multiplies it by (1 + l^2)^1/2 / (1 - l) and
more, l = e^{-pole T_s}; a mean does not.

A load behind an elastic shaft is known in the same way: z = (w, twist, w_load, filter's state), with d at the
load, -T_L / J as ever. What the shaft does is then no part of d_hat. Of a drive that takes voltages the
measured current is what flowed (:func:`sampled_winding`).

Of a drive that reports in every m-th tick alone the samples are those, y_{k-jm}, with F^m in F's place; what
flowed is known of each tick all the same. All that n counts then takes m times as long.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.fac import MAX_GAP
from hil.control.jit import jit
from hil.control.linalg import Array, condition, dot, exp, halvings_of, integral_exponential, inverse
from hil.control.registry import InnerLoop, Shaft, SpeedFilter

MOST_AVERAGE: Final = 32
"""Ticks of the longest moving average."""
ROOM: Final = MOST_AVERAGE + 2
"""Samples that v rests on, at most: n + 1."""
PAST: Final = 128
"""Ring of past samples: those of a gap, and those that the first of it needs."""
MOST_CONDITION: Final = 1e12
"""Of the samples that z is found from."""


def order_of(inner: InnerLoop | None, shaft: Shaft | None = None) -> int:
    """States of filter and shaft that the observer takes into its model; ``shaft`` of a drive by voltage."""
    if inner is None:
        return 2 if shaft else 0
    given = inner.filter or SpeedFilter()
    return (given.ticks or len(given.poles)) + (2 if inner.shaft else 0)


def ticks_of(inner: InnerLoop | None, shaft: Shaft | None = None) -> int:
    """Ticks that an innovation needs for those states, besides the one or the gap that it is of."""
    if inner is None:
        return order_of(None, shaft)
    averaged = inner.filter is not None and inner.filter.ticks
    return order_of(inner) * (1 if averaged else inner.every)


def sampled_filter(
    given: SpeedFilter,
    friction: float,
    gain: float,
    lag: float | None,
    T_s: float,
    shaft: Shaft | None = None,
) -> Any:
    """F (n, n), G, S, E (n,), C (n,) of z = (w, shaft, filter), w' = friction [1/s] w + gain i + d.

    The current of a tick runs straight from its first sample to its last (``lag`` None), else as a
    first-order lag; by u and b the effect on w is that of u alone, but for the shaft's.
    """
    A, of_i, of_d = _continuous(given, friction, gain, shaft)
    n = len(A)
    whole = np.zeros((n + 3, n + 3))  # (z, i, its target or slope, d)
    whole[:n, :n], whole[:n, n], whole[:n, n + 2] = A, of_i, of_d
    if lag is None:
        whole[n, n + 1] = 1.0 / T_s
    elif lag:
        whole[n, n], whole[n, n + 1] = -1.0 / lag, 1.0 / lag
    step, _ = integral_exponential(whole, T_s, halvings_of(whole, T_s))
    held, E = _held(A, of_i, T_s), step[:n, n + 2]
    if lag is None:  # u = i + b / 2
        S = step[:n, n + 1] - 0.5 * step[:n, n]
    elif lag:  # i + (target - i)(1 - l) = i + b
        S = step[:n, n + 1] / (1.0 - step[n, n])
        S = S - held * _share_of_target(S, held, friction, lag, T_s, shaft)
    else:
        S = np.zeros(n)
    if shaft is None:
        S[0] = 0.0
    C = np.zeros(n)
    C[(3 if shaft else 1) if given.poles or given.ticks else 0] = 1.0
    parts = step[:n, :n], held, S, E, C
    return _averaged(parts, given.ticks, T_s) if given.ticks else parts


def sampled_winding(shaft: Shaft, A: Array, T_s: float) -> Any:
    """F (3, 3), G, S, E, C (3,) of z = (w, twist, w_load), whose currents at both ends of a tick are known.

    A (2, 2) of (w, i_q) of one inertia. What drives the current through a tick is its voltage and all that
    nobody knows of it, a constant g; from i at its end follows that:
        z+ = F_zz z + F_zi i + G_z g + E_z d,   g = (i+ - F_iz z - F_ii i - E_i d) / G_i
    """
    mass, of_i, of_d = _continuous(SpeedFilter(), float(A[0, 0]), float(A[0, 1]), shaft)
    whole = np.zeros((6, 6))  # (z, i, g, d)
    whole[:3, :3], whole[:3, 3], whole[:3, 5] = mass, of_i, of_d
    whole[3, 0], whole[3, 3], whole[3, 4] = A[1, 0], A[1, 1], 1.0
    step, _ = integral_exponential(whole, T_s, halvings_of(whole, T_s))
    at_end = step[:3, 4] / step[3, 4]
    F, first, E = (step[:3, own] - np.multiply.outer(at_end, step[3, own]) for own in (slice(3), 3, 5))
    return F, first + at_end, 0.5 * (at_end - first), E, np.eye(3)[0]


def _share_of_target(
    S: Array, held: Array, friction: float, lag: float, T_s: float, shaft: Shaft | None
) -> float:
    """What u counts of b: as it is without a shaft, which :func:`hil.control.speed.flowed` does not know."""
    if shaft is None:
        return float(S[0] / held[0])
    alone = np.array([[friction, 1.0, 0.0], [0.0, -1.0 / lag, 1.0 / lag], [0.0, 0.0, 0.0]])
    step, _ = integral_exponential(alone, T_s, halvings_of(alone, T_s))
    one = np.array([[friction]])
    return float(step[0, 2] / (1.0 - step[1, 1]) / _held(one, np.ones(1), T_s)[0])


def _continuous(
    given: SpeedFilter, friction: float, gain: float, shaft: Shaft | None
) -> tuple[Array, Array, Array]:
    """A of (w, shaft, filter), and what current and d do: f' = p (w - f);  f'' = p q (w - f) - (p + q) f'.

    A mean has the angle turned; a shaft (twist, w_load).
    """
    mass, m = _masses(friction, shaft), 3 if shaft else 1
    n = m + (1 if given.ticks else len(given.poles))
    A, of_i, of_d = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    A[:m, :m] = mass
    of_i[0] = gain / (shaft.share if shaft else 1.0)
    of_d[m - 1] = 1.0 / (1.0 - shaft.share) if shaft else 1.0
    if given.ticks:
        A[m, 0] = 1.0
    elif len(given.poles) == 1:
        A[m, 0], A[m, m] = given.poles[0], -given.poles[0]
    elif given.poles:
        p, q = given.poles
        A[m, m + 1], A[m + 1, 0], A[m + 1, m], A[m + 1, m + 1] = 1.0, p * q, -p * q, -(p + q)
    return A, of_i, of_d


def _masses(friction: float, shaft: Shaft | None) -> Array:
    """A of w, or of (w, twist, w_load)."""
    if shaft is None:
        return np.array([[friction]])
    a = shaft.share
    k = shaft.resonance * shaft.resonance * a * (1.0 - a)
    c = 2.0 * shaft.damping * k / shaft.resonance
    motor, load = [(friction - c) / a, -k / a, c / a], [c / (1.0 - a), k / (1.0 - a), -c / (1.0 - a)]
    return np.array([motor, [1.0, 0.0, -1.0], load])


def _held(A: Array, of_i: Array, T_s: float) -> Array:
    """Effect of a constant current of 1 on z."""
    _, integral = integral_exponential(A, T_s, halvings_of(A, T_s))
    held: Array = integral[:, 0] * of_i[0]
    return held


def _averaged(parts: Any, ticks: int, T_s: float) -> Any:
    """z = (w, angle of the last tick, of the one before, ...), y their sum over the window's length."""
    step, *inputs, _ = parts
    n = 1 + ticks
    F, C = np.zeros((n, n)), np.full(n, 1.0 / (ticks * T_s))
    F[0, 0], F[1, 0], C[0] = step[0, 0], step[1, 0], 0.0
    for row in range(2, n):
        F[row, row - 1] = 1.0
    return F, *(np.r_[one, np.zeros(n - 2)] for one in inputs), C


def _rows(F: Array, C: Array, count: int) -> Array:
    """C, C F, C F^2, ...; (count, n)."""
    rows = [C]
    for _ in range(count - 1):
        rows.append(np.array([dot(rows[-1], column) for column in F.T]))
    return np.array(rows)


def _innovation(given: SpeedFilter, F: Array, T_s: float, every: int, masses: int) -> Array:
    """Weights r_j of y_{k-jm} that no z explains: characteristic polynomial of F^m, of a mean (q - a) q^M.

    That of the ``masses`` states of motor and shaft from the traces of powers, by Newton's identities.
    """
    own = F[:masses, :masses]
    over = own if every == 1 else np.array([_rows(own, row, every + 1)[-1] for row in np.eye(masses)])
    weights = _characteristic(over)
    for pole in given.poles:
        weights = np.convolve(weights, np.array([1.0, -exp(-pole * every * T_s)]))
    return weights


def _characteristic(M: Array) -> Array:
    """Coefficients of det(q - M), highest first."""
    weights, power, traces = [1.0], np.eye(len(M)), []
    for k in range(1, len(M) + 1):
        power = np.array([[dot(row, column) for column in M.T] for row in power])
        traces.append(math.fsum(np.diag(power)))
        weights.append(-math.fsum(w * t for w, t in zip(reversed(weights), traces, strict=True)) / k)
    return np.array(weights)


def _reconstruction(given: SpeedFilter, F: Array, C: Array, every: int) -> Array:
    """Weights p_j of y_{k-jm}, j < n, that give w_k for every z. Raises ControlDesignError."""
    n = len(F)
    count = 1 + (given.ticks or (n - 1) * every)
    seen, first = _rows(F, C, count), np.eye(n)[0]
    speed = _rows(F, first, count)[-1]
    if given.ticks:  # what was before the window is forgotten: one sample tells
        return np.array([speed[0] / seen[-1][0]])
    seen = seen[::every]
    if not condition(seen) < MOST_CONDITION:
        told = "no number of samples tells" if every == 1 else f"measurements in each {every}th tick tell not"
        raise ControlDesignError(
            f"drive.speed_filter: {told} the speed behind it; let the observer not know it: modelled = false"
        )
    back = inverse(seen)
    return np.array([dot(speed, column) for column in back.T])[::-1]


def _known(r: Array, rows: Array, before: Array, inputs: tuple[Array, ...], every: int) -> list[Array]:
    """Weights of an input X of j ticks ago, beside r of the samples: wanted_j X - sum_i r_i C F^{j-im} X.

    ``rows``: C F^j; ``before``: what is wanted of z, times F^j; j counts from the newest, 0.
    """
    out = []
    for X in inputs:
        effect = [dot(row, X) for row in rows]
        own = [dot(row, X) for row in before]
        out.append(
            np.array(
                [
                    own[j]
                    - math.fsum(r[i] * effect[j - i * every] for i in range(min(j // every + 1, len(r))))
                    for j in range(len(before))
                ]
            )
        )
    return out


def filter_params(inner: InnerLoop | None, friction: float, gain: float, T_s: float) -> dict[str, Any]:
    """The filter's part of LAW_PARAMS; empty without a filter. Raises ControlDesignError."""
    if inner is None or order_of(inner) == 0:
        return {}
    given, shaft = inner.filter or SpeedFilter(), inner.shaft
    _check(given, T_s)
    _check_shaft(given, shaft, T_s)
    _check_room(inner)
    every, more = inner.every, ticks_of(inner)
    lag = None if inner.told and every == 1 else inner.lag  # between two samples the model tells what flows
    parts = sampled_filter(given, friction, gain, lag, T_s, shaft)
    return _weights(parts, given, T_s, every, more, 3 if shaft else 1)


def shaft_params(shaft: Shaft, A: Array, T_s: float) -> dict[str, Any]:
    """The shaft's part of LAW_PARAMS, of a drive that takes voltages. Raises ControlDesignError."""
    _check_shaft(SpeedFilter(), shaft, T_s)
    return _weights(sampled_winding(shaft, A, T_s), SpeedFilter(), T_s, 1, 2, 3)


def _weights(
    parts: Any, given: SpeedFilter, T_s: float, every: int, more: int, masses: int
) -> dict[str, Any]:
    """Of a sampled form: weights of the samples and of what flowed, of innovation and speed."""
    F, G, S, E, C = parts
    n = len(F)
    rows, none = _rows(F, C, MAX_GAP), np.zeros((more + every, n))
    r, p = _innovation(given, F, T_s, every, masses), _reconstruction(given, F, C, every)
    v_u, v_s, v_d = _known(r, rows, none, (G, S, E), every)
    w_u, w_s, w_d = _known(p, rows, _rows(F, np.eye(n)[0], n * every)[:more], (G, S, E), every)
    scale = -math.fsum(v_d)
    steps = np.array([dot(row, E) for row in rows])
    return {
        "order": n - 1,
        "span": more + every if every > 1 else 0,
        "v_y": _padded(r / scale),
        "v_u": _padded(v_u / scale),
        "v_s": _padded(v_s / scale),
        "w_y": _padded(p),
        "w_u": _padded(w_u),
        "w_s": _padded(w_s),
        "w_d": math.fsum(w_d),
        "gap_y": np.array([math.fsum(steps[: m + 1]) for m in range(MAX_GAP)]),
    }


def _padded(values: Array) -> Array:
    out = np.zeros(ROOM)
    out[: len(values)] = values
    return out


def _check(given: SpeedFilter, T_s: float) -> None:
    """Refuse a filter that the record has no room for, or that the sampling does not see."""
    if given.ticks > MOST_AVERAGE:
        raise ControlDesignError(
            f"drive.speed_filter.window_ms: {given.ticks} periods, and {MOST_AVERAGE} are kept at most; "
            "lower loop.rate_hz"
        )
    slow = [pole for pole in given.poles if pole * T_s < 1e-6]
    if slow:
        raise ControlDesignError(
            f"drive.speed_filter: a pole of {slow[0]:g} rad/s says nothing of the speed in a period; "
            "set a faster one in the drive"
        )


def _check_shaft(given: SpeedFilter, shaft: Shaft | None, T_s: float) -> None:
    """Refuse a shaft beside a mean, and one whose vibration the sampling does not see or tell from others."""
    if shaft is None:
        return
    if given.ticks:
        raise ControlDesignError(
            "motor.shaft: no observer has both a shaft and a moving average in its model; leave the shaft "
            "out, or let the observer not know the average: drive.speed_filter.modelled = false"
        )
    hz, least, most = shaft.elastic[0], 1e-3 / (2.0 * math.pi * T_s), 0.25 / T_s
    if not least < hz <= most:
        raise ControlDesignError(
            f"motor.shaft.resonance_hz = {hz:g}: at {1.0 / T_s:g} Hz the observer tells vibration of "
            f"{least:.3g} to {most:g} Hz; change loop.rate_hz, or leave the shaft out"
        )


def _check_room(inner: InnerLoop) -> None:
    """Refuse measurements so seldom that the record has no room for what they rest on."""
    need = ticks_of(inner) + inner.every
    if inner.every > 1 and need > ROOM:
        raise ControlDesignError(
            f"feedback.period_ms: to know the states of drive.speed_filter takes {need} ticks of "
            f"measurements in each {inner.every}th tick, and {ROOM} are kept; lower loop.rate_hz, or let the "
            "observer not know the filter: modelled = false"
        )


@jit
def enter(s: Any, u: float, bend: float) -> None:
    """Begin the next place of the ring: a period with the constant current u, in which it changed by bend."""
    s["place"] = (s["place"] + 1) % PAST
    s["flow"][s["place"]], s["bend"][s["place"]] = u, bend


@jit
def inputs_of(s: Any, place: int, count: int, by_u: Any, by_bend: Any) -> float:
    """Sum over the ``count`` periods that end at ``place``, of what flowed in them."""
    total = 0.0
    for j in range(count):
        at = (place - j) % PAST
        total += by_u[j] * s["flow"][at] + by_bend[j] * s["bend"][at]
    return total


@jit
def span_of(p: Any) -> int:
    """Ticks that an innovation rests on."""
    return int(p["span"] if p["every"] > 1 else p["order"] + 1)


@jit
def innovation(p: Any, s: Any, place: int) -> float:
    """v at the end of the period at ``place``."""
    every, span = max(p["every"], 1), span_of(p)
    total = inputs_of(s, place, span, p["v_u"], p["v_s"])
    for j in range(span // every + 1):
        total += p["v_y"][j] * s["y"][(place - j * every) % PAST]
    return total


@jit
def bridge(p: Any, s: Any, gap: int, y: float) -> None:
    """The samples that a gap of ``gap`` periods lacks: those of a d that changed when it began, and led to y.

    With d_hat as it was each would be what makes v = d_hat.
    """
    every = max(p["every"], 1)
    for j in range(gap - every, -1, -every):
        at = (s["place"] - j) % PAST
        s["y"][at] = 0.0
        s["y"][at] = (s["d_hat"][0] - innovation(p, s, at)) / p["v_y"][0]
    off = (y - s["y"][s["place"]]) / p["gap_y"][gap - 1]
    for j in range(gap - every, 0, -every):
        s["y"][(s["place"] - j) % PAST] += off * p["gap_y"][gap - 1 - j]


@jit
def hear(p: Any, s: Any) -> int:
    """Take the reported speed s['x'][0] after s['gap'] periods; return for how many of them there is a v.

    None until there are samples enough, after a start, and after a gap of no whole number of samples; the
    observer waits.
    """
    y, gap, n, every = s["x"][0], s["gap"], span_of(p), max(p["every"], 1)
    if gap % every or (gap > every and s["heard"] <= n):
        s["heard"] = 0
    elif gap > every:
        bridge(p, s, gap, y)
    s["y"][s["place"]] = y
    s["heard"] = min(s["heard"] + gap if s["heard"] else 1, PAST)
    return int(gap) if s["heard"] > n else 0


@jit
def behind(p: Any, s: Any) -> None:
    """Write the speed behind the filter to s['x'][0]; what is reported as long as samples are too few."""
    every = max(p["every"], 1)
    more = span_of(p) - every
    if s["heard"] > more:
        w = inputs_of(s, s["place"], more, p["w_u"], p["w_s"]) + p["w_d"] * s["d_hat"][0]
        for j in range(more // every + 1):
            w += p["w_y"][j] * s["y"][(s["place"] - j * every) % PAST]
        s["x"][0] = w
