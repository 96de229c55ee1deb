"""The cascade for a salient motor: torque with the least current, the field weakened past base speed.

The speed law asks for a torque, :func:`hil.control.mtpa.operating_point` makes (i_d*, i_q*) of it at the
speed of the tick. The steady voltage of that point, as the observers correct the model's, may take
``voltage_share`` of the circle; the circle is u_max, or v_dc / sqrt 3 of the measured DC link where that is
less.
"""

from __future__ import annotations

from typing import Any

from hil.control.laws import cascade
from hil.control.registry import Key, Law, Plan, Values

CODE = 5


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The cascade's, and what the voltage ellipse needs. Raises ControlDesignError."""
    own = {"R_s": plan.motor.R_s, "u_share": values["voltage_share"]}
    return cascade.design(values, plan) | own


MEMBER = Law(
    "mtpa",
    "the cascade with the least current for the torque, and the field weakened past base speed",
    CODE,
    design,
    cascade.KEYS
    | {
        "voltage_share": Key(
            "share of the voltage circle that the steady state may take; the rest is for dynamics",
            0.92,
            most=1.0,
        )
    },
)
