"""The law for an angle: two poles of its error, behind a drive that takes a current or a torque.

All of the law ``speed`` holds: what the drive is known to have applied, its current loop, delay and speed
filter, the load that is known and the one that is found. What d_hat misses, delta [rad/s2], leaves an
angle of about delta (1 + (p_1 + p_2) tau) / (p_1 p_2), tau the time from measurement to effect.
"""

from __future__ import annotations

from typing import Any

from hil.control.errors import ControlDesignError
from hil.control.laws.speed import CODE
from hil.control.laws.speed import MEMBER as OWN_LOOP
from hil.control.linalg import exp
from hil.control.position import angle_gains
from hil.control.registry import JERK, Key, Law, Plan, Values

POLES = ("position_pole_rad_s", "speed_pole_rad_s")


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The law speed, and what the angle adds to it. Raises ControlDesignError."""
    inner, motor, T_s = plan.inner, plan.motor, plan.T_s
    assert inner is not None  # noqa: S101 - a drive that takes voltages has other laws
    for key in POLES:
        if values[key] * T_s > 1.0:
            raise ControlDesignError(
                f"controller.{key} = {values[key]:g}: faster than the sampling, which takes poles up to "
                f"{1.0 / T_s:g} rad/s; take less, or a higher loop.rate_hz"
            )
    own = OWN_LOOP.design(values, plan)
    lams = exp(-values[POLES[0]] * T_s), exp(-values[POLES[1]] * T_s)
    a = float(plan.model.Ad[0, 0])
    return own | angle_gains(-motor.B_f / motor.J, inner.k_u / motor.J, inner.lag, own, a, lams, T_s)


MEMBER = Law(
    "position",
    "two poles of the angle for a drive that takes a current or a torque, disturbance compensated",
    CODE,
    design,
    {
        "position_pole_rad_s": Key("pole of the angle error", 30.0),
        "speed_pole_rad_s": Key("second pole of the angle error, as of the speed's", 100.0),
        "jerk_feedforward": JERK,
    },
    ("current", "torque"),
)
