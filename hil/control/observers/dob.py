"""Conventional disturbance observer (31): one filter of first order, never exact.

d_hat_k = lam d_hat_{k-1} + (1 - lam) v_k;   lag behind a ramp 1 / gamma
"""

from __future__ import annotations

import numpy as np

from hil.control.observer import Window, conventional_dob
from hil.control.registry import Channel, Key, Observer, Values


def design(values: Values, channel: Channel) -> Window:
    """One pole. Raises ControlDesignError."""
    return conventional_dob(np.array([values["gamma_1_rad_s"]]), channel.T_s)


UNUSED = Key("not used by this kind", None)
MEMBER = Observer(
    "dob",
    "conventional disturbance observer, first order",
    {"gamma_1_rad_s": Key("pole"), "gamma_2_rad_s": UNUSED, "delay_ms": UNUSED},
    design,
)
