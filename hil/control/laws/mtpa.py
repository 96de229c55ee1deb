"""The cascade for a salient motor: torque with the least current, the field weakened past base speed.

The speed law asks for a torque, :func:`hil.control.mtpa.operating_point` makes (i_d*, i_q*) of it at the
speed of the tick. A table i_d*(|i_q*|) takes the place of the closed form, where a motor that saturates
was measured; i_max and the voltage hold for it, too. The steady voltage of that point, as the observers
correct the model's, may take
``voltage_share`` of the circle; the circle is u_max, or v_dc / sqrt 3 of the measured DC link where that is
less.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.laws import cascade
from hil.control.mtpa import POINTS
from hil.control.registry import JERK, Key, Law, Plan, Values

CODE = 5


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The cascade's, and what the voltage ellipse needs. Raises ControlDesignError."""
    own = {"R_s": plan.motor.R_s, "u_share": values["voltage_share"]}
    return cascade.design(values, plan) | own | table_params(values["i_d_table"], plan)


def table_params(given: Values | None, plan: Plan) -> dict[str, Any]:
    """The table of i_d* over |i_q*|; empty where none is given. Raises ControlDesignError."""
    if given is None:
        return {}
    m, i_q, i_d = plan.motor, np.array(given["i_q_a"]), np.array(given["i_d_a"])
    s, slope = m.L_q - m.L_d, np.diff(i_d) / np.diff(i_q)
    rises = [m.psi_f - s * (i_d[part] + slope * i_q[part]) > 0 for part in (slice(-1), slice(1, None))]
    if not np.all(rises):
        row = 1 + int(np.argmin(np.all(rises, axis=0)))
        raise ControlDesignError(
            f"controller.i_d_table: up to i_q_a = {i_q[row]:g} the torque does not rise with i_q; correct "
            "i_d_a there, or the motor's inductances"
        )
    out: dict[str, Any] = {"points": len(i_q), "i_q_at": np.zeros(POINTS), "i_d_at": np.zeros(POINTS)}
    out["i_q_at"][: len(i_q)], out["i_d_at"][: len(i_q)] = i_q, i_d
    return out


MEMBER = Law(
    "mtpa",
    "the cascade with the least current for the torque, and the field weakened past base speed",
    CODE,
    design,
    cascade.KEYS
    | {
        "jerk_feedforward": JERK,
        "voltage_share": Key(
            "share of the voltage circle that the steady state may take; the rest is for dynamics",
            0.92,
            most=1.0,
        ),
        "i_d_table": Key(
            "i_d* over |i_q*| by points, a TOML file or inline; left out: least current by the inductances",
            None,
            type="i_d_table",
        ),
    },
)
