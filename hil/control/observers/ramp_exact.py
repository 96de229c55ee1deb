"""A window that is exact for d = const + slope t, at the time ``lead`` ticks after the sample.

    g_j = P_j [1/S0 - (tau + N/2)(j - m)/S2],  P_j = (j + 1)(N - j),  m = (N - 1)/2
    S0 = sum P,  S2 = sum P (j - m)^2,  tau the lead
No lag, four times the noise of the parabola, weights of both signs: |H| up to 1.6 (1.8 with a lead), so that
the loop bears +-15 % of mismatch and no more. For identified motors only.
"""

from __future__ import annotations

import numpy as np

from hil.control.noise import DELAY, ticks_of
from hil.control.observer import Window, fir
from hil.control.registry import Channel, Key, Observer, Values

LEAD = Key("ticks after the sample for which the estimate holds", 0.0, above=None, least=0.0, most=64.0)


def design(values: Values, channel: Channel) -> Window:
    """The closed form for exactness of degree 1. Raises ControlDesignError."""
    N = ticks_of(values, channel.T_s, 2)
    j, m = np.arange(N), (N - 1) / 2
    P = (j + 1.0) * (N - j)
    return fir(P * (1 / P.sum() - (values["lead_ticks"] + N / 2) * (j - m) / (P * (j - m) ** 2).sum()))


MEMBER = Observer(
    "ramp-exact",
    "exact for ramps; bears 15 % of mismatch",
    {"delay_ms": DELAY, "lead_ticks": LEAD},
    design,
)
