"""Linear extended-state observer (ESO) of second order with free damping, on the exact innovations.

    rho_k = p rho_{k-1} + v_k - d_hat_{k-1},  d_hat_k = d_hat_{k-1} + q rho_k
    p = l1 l2,  q = (1 - l1)(1 - l2),  l = e^{-w0 T_s (zeta +- i sqrt(1 - zeta^2))}
Its error poles are l exactly, whatever the other channels do. It is the ESO with x_hat = x - Ad^-1 Ed p rho,
written by what drives it. Lag 2 zeta / w0; never exact.
"""

from __future__ import annotations

import math

import numpy as np

from hil.control.linalg import cos_sin, exp
from hil.control.observer import Window, linear_filter
from hil.control.registry import Channel, Key, Observer, Values


def design(values: Values, channel: Channel) -> Window:
    """Gains from the poles."""
    zeta, tick = values["damping"], values["bandwidth_rad_s"] * channel.T_s
    root = tick * math.sqrt(abs(zeta * zeta - 1))
    if zeta < 1:
        cos, sin = cos_sin(root)
        decay = exp(-zeta * tick)
        p, q = exp(-2 * zeta * tick), (1 - decay * cos) ** 2 + (decay * sin) ** 2
    else:
        p, q = exp(-2 * zeta * tick), (1 - exp(-zeta * tick - root)) * (1 - exp(-zeta * tick + root))
    return linear_filter(np.array([[p]]), np.array([[q]]))


MEMBER = Observer(
    "eso",
    "linear extended-state observer, second order",
    {
        "bandwidth_rad_s": Key("natural frequency w0 of the error"),
        "damping": Key("damping zeta; 1 is the double pole", 0.78, above=None, least=0.3, most=2.0),
    },
    design,
)
