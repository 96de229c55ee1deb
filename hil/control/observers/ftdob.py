"""FTDOB, the paper's window of two exponentials (Theorem 1), exact after N = D / T_s ticks.

    d_hat = sum_i Theta_i (h_i(k) - lam_i^N h_i(k - N))
Noise 1.41 sigma_x / D for small gamma D, 1.6 at (0.3, 0.7), 3.3 at (1, 3); lag up to D / 2.
"""

from __future__ import annotations

import numpy as np

from hil.control.observer import Window, ftdob
from hil.control.registry import Channel, Key, Observer, Values


def design(values: Values, channel: Channel) -> Window:
    """Theorem 1 in sampled form. Raises ControlDesignError."""
    first, second = np.array([values["gamma_1_rad_s"]]), np.array([values["gamma_2_rad_s"]])
    return ftdob(first, second, values["delay_ms"] * 1e-3, channel.T_s)


MEMBER = Observer(
    "ftdob",
    "the paper's window of two exponentials",
    {
        "gamma_1_rad_s": Key("pole of the first filter"),
        "gamma_2_rad_s": Key("pole of the second filter, another one"),
        "delay_ms": Key("D of Theorem 1: exact D after the last change"),
    },
    design,
)
