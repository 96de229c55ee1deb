"""The law of the load machine that another node's ``fac`` commands: its torque and nothing of its own.

It runs on the kernels of the law ``speed``, and its observer goes on, so that the log has this node's
estimate, too.
"""

from __future__ import annotations

from typing import Any

from hil.control.laws.speed import CODE
from hil.control.laws.speed import MEMBER as OWN_LOOP
from hil.control.registry import Law, Plan, Values
from hil.control.speed import FOLLOWS


def design(_values: Values, plan: Plan) -> dict[str, Any]:
    """The inner loop; no speed is followed, so its pole is of no effect. Raises ControlDesignError."""
    return OWN_LOOP.design({"speed_pole_rad_s": 1.0}, plan) | {"pair": FOLLOWS}


MEMBER = Law(
    "follow",
    "the torque that another node's fac asks for, for a load machine; no speed is followed",
    CODE,
    design,
    {},
    ("current", "torque"),
)
