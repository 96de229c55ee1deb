"""Predictive deadbeat current control below a speed pole: the error is gone a tick after the delay."""

from __future__ import annotations

from typing import Any

from hil.control.laws import cascade
from hil.control.linalg import exp
from hil.control.registry import Law, Plan, Values


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """lam_q = lam_d = 0."""
    return {"lam_w": exp(-values["speed_pole_rad_s"] * plan.T_s), "lam_q": 0.0, "lam_d": 0.0}


KEYS = {"speed_pole_rad_s": cascade.KEYS["speed_pole_rad_s"]}
MEMBER = Law("deadbeat", "deadbeat currents below a speed pole, disturbance compensated", 0, design, KEYS)
