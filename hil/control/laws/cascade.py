"""The cascade: speed to i_q*, currents to u_q, u_d, each step with a pole of its own (Theorem 2)."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.composite import composite_gain
from hil.control.linalg import exp
from hil.control.registry import JERK, Key, Law, Plan, Values

CODE = 0
KEYS = {
    "speed_pole_rad_s": Key("pole of the speed error", 30.0),
    "current_pole_rad_s": Key("pole of the current errors", 250.0),
    "current_d_pole_rad_s": Key("pole of the d current's error; default: as the other", None),
}


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """lam = e^{-pole T_s} of each step, and the gain of Theorem 2 with Z = I. Raises ControlDesignError."""
    d_pole = values["current_d_pole_rad_s"]
    d_pole = values["current_pole_rad_s"] if d_pole is None else d_pole
    poles = (values["speed_pole_rad_s"], values["current_pole_rad_s"], d_pole)
    gain = composite_gain(plan.model, -np.diag(poles), np.eye(3))
    lam = dict(zip(("lam_w", "lam_q", "lam_d"), (exp(-pole * plan.T_s) for pole in poles), strict=True))
    jerk = int(values.get("jerk_feedforward", False))
    return {**lam, "closed": gain.closed, "Bd_inv": gain.Bd_inv, "jerk": jerk}


MEMBER = Law(
    "cascade",
    "poles of speed and currents, disturbance compensated",
    CODE,
    design,
    KEYS | {"jerk_feedforward": JERK},
)
