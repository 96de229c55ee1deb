"""A window that is long while nothing happens and short from the tick at which the load changes.

Steady noise is that of ``delay_ms``, dip and margins are those of ``short_ms``; ``first_ms`` is the length
right after a change that came while the window was full. Exact for a constant d at every length: after a
change that shows in its first tick, first_ms later. The formulas are in :mod:`hil.control.adaptive`.

Thresholds come from the noise: an estimate by n ticks is off by more than h sigma_n with probability
2 e^{-h^2/2} at most, sigma_n^2 = g' Q g (:mod:`hil.control.noise`), for Gaussian noise and for rounding that
is independent of it (both sub-Gaussian by their variance). By the union bound over lengths and ticks
    h = sqrt(2 ln(2 * 3600 / T_s * lengths / alarms_per_hour))
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.linalg import Array, dot
from hil.control.noise import NOISE, ticks_of, weights_of_noise
from hil.control.observer import Window, adaptive
from hil.control.observers.least_noise import closed_form
from hil.control.registry import Channel, Key, Observer, Values


def lengths(N: int) -> int:
    """How many windows 1, 2, 4 .. N / 2 are compared with the present one."""
    return max((N // 2).bit_length(), 1)


def threshold(N: int, T_s: float, alarms_per_hour: float) -> float:
    """h of the union bound, to three digits: logarithms differ in their last bit between machines."""
    tries = 3600.0 / T_s * lengths(N)
    return round(math.sqrt(2.0 * max(math.log(2.0 * tries / alarms_per_hour), 0.0)), 3)


def sigmas(N: int, diagonal: float, neighbour: float) -> Array:
    """sigma_n of the parabolas of 1 to N ticks."""
    out = np.empty(N)
    for n in range(1, N + 1):
        g = closed_form(n, 0.0)
        out[n - 1] = math.sqrt(diagonal * dot(g, g) - 2.0 * neighbour * dot(g[:-1], g[1:]))
    return out


def _ticks(values: Values, name: str, T_s: float, most: int) -> int:
    """A shorter window's length. Raises ControlDesignError when it is longer than the next."""
    n = ticks_of({"delay_ms": values[name]}, T_s)
    if n > most:
        raise ControlDesignError(
            f"{name} = {values[name]:g} is {n} ticks, longer than the window that it shortens ({most}); "
            "first_ms <= short_ms <= delay_ms"
        )
    return n


def design(values: Values, channel: Channel) -> Window:
    """Lengths and thresholds. Raises ControlDesignError."""
    T_s, more = channel.T_s, dict[str, Any](values)
    N = ticks_of(values, T_s)
    short = _ticks(values, "short_ms", T_s, N)
    more["first_ms"] = values["short_ms"] if values["first_ms"] is None else values["first_ms"]
    first = _ticks(more, "first_ms", T_s, short)
    bounds = threshold(N, T_s, values["alarms_per_hour"]) * sigmas(N, *weights_of_noise(channel, values))
    return adaptive(N, short, first, bounds, float(channel.model.Ed[channel.index, channel.index]))


def _needed(name: str) -> Key:
    return Key(NOISE[name].doc.partition(";")[0] + "; thresholds and filters rest on it")


MEMBER = Observer(
    "adaptive",
    "long while nothing happens, short from the tick at which d changes",
    {
        "delay_ms": Key("length D of the window while nothing happens"),
        "short_ms": Key("its length after a change; margins are those of this one"),
        "first_ms": Key("its length for the first change after a time of rest; default: short_ms", None),
        "w_noise_rad_s": _needed("w_noise_rad_s"),
        "i_noise_a": _needed("i_noise_a"),
        "alarms_per_hour": Key("bound on a channel's false alarms in noise", 0.01, most=3600.0, unit="1/h"),
    },
    design,
)
