"""The paper's structure with one to three exponentials and only the condition that exactness needs.

    d_hat = sum_i Theta_i (h_i(k) - lam_i^N h_i(k - N)),   sum_i Theta_i (1 - lam_i^N) = 1
Theorem 1 also asks sum_i Theta_i lam_i^N = 0, which costs noise and buys nothing. What is left free gives
least noise: Theta ~ (E Q E')^-1 c, E_ij = (1 - lam_i) lam_i^j, c_i = 1 - lam_i^N. gamma D = (0.5, 1, 1.5) is
within 6 % of the least-noise window at O(1) a tick; lag about D / 2.
"""

from __future__ import annotations

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.linalg import condition, dot, exp, power, product, solve
from hil.control.noise import MOST_CONDITION, NOISE, times_noise, weights_of_noise
from hil.control.observer import Window, exponentials
from hil.control.registry import Channel, Key, Observer, Values


def design(values: Values, channel: Channel) -> Window:
    """Theta of least noise for the given poles. Raises ControlDesignError."""
    gamma, N = np.array(values["gammas_rad_s"], float), round(values["delay_ms"] * 1e-3 / channel.T_s)
    if len(gamma) > N:
        raise ControlDesignError(f"D = {values['delay_ms']:g} ms is {N} ticks, fewer than poles; lengthen D")
    lam = np.array([exp(-g * channel.T_s) for g in gamma])
    powers = np.multiply.accumulate(np.vstack([np.ones(len(lam)), np.tile(lam, (N - 1, 1))]))
    E, c = (1 - lam) * powers, 1 - np.array([power(x, N) for x in lam])
    inner = product(np.ascontiguousarray(E.T), times_noise(*weights_of_noise(channel, values), E))
    if not condition(inner) <= MOST_CONDITION:
        raise ControlDesignError(
            f"poles {gamma.tolist()} rad/s are too close together for D; move them apart"
        )
    theta = solve(inner, c[:, None])[:, 0]
    return exponentials(lam, theta / dot(c, theta), N)


MEMBER = Observer(
    "exponentials",
    "one to three exponentials, Theta of least noise",
    {
        "gammas_rad_s": Key("poles of the filters, all different", type="numbers"),
        "delay_ms": Key("length D of the window: exact D after the last change"),
        **NOISE,
    },
    design,
)
