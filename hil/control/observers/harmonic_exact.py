"""A window that is exact for d = const + a sin(w t + phi) of a known frequency, with least noise.

g = Q^-1 C' (C Q^-1 C')^-1 b with the rows 1, Re m, Im m of C, m_j = (e^{-i w j} - e^{-i w (j + 1)}) / (i w)
(w in rad a tick), and b = (1, Re e^{i w tau}, Im e^{i w tau}), tau the lead. |H| up to 2.1, four and more
times the noise of the parabola; bears +-10 % of mismatch. 2 % off the frequency leaves 7 % of the sine with
one cycle in D.
"""

from __future__ import annotations

import math

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.linalg import cos_sin
from hil.control.noise import DELAY, NOISE, least_noise, ticks_of, weights_of_noise
from hil.control.observer import Window, fir
from hil.control.observers.ramp_exact import LEAD
from hil.control.registry import Channel, Key, Observer, Values


def design(values: Values, channel: Channel) -> Window:
    """Solve the three conditions. Raises ControlDesignError."""
    N = ticks_of(values, channel.T_s, 3)
    w = 2 * math.pi * values["frequency_hz"] * channel.T_s
    if w >= math.pi:
        raise ControlDesignError(f"frequency_hz = {values['frequency_hz']:g} is above half the loop's rate")
    cos, sin = np.array([cos_sin(w * j) for j in range(N + 1)]).T
    C = np.array([np.ones(N), np.diff(sin) / w, np.diff(cos) / w])
    b = np.array([1.0, *cos_sin(w * values["lead_ticks"])])
    return fir(least_noise(C, b, *weights_of_noise(channel, values)))


MEMBER = Observer(
    "harmonic-exact",
    "exact for a sine of known frequency; bears 10 % of mismatch",
    {"delay_ms": DELAY, "frequency_hz": Key("frequency of the sine"), "lead_ticks": LEAD, **NOISE},
    design,
)
