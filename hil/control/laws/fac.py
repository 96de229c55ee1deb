"""The paper's own law for a bench whose load machine is commanded too: u = [T_L, u_q, u_d].

Of drives that close their own current loop it is u = [T_L, i_q*], over two nodes: i_q* is the reference's,
and the load machine's torque moves the speed. With the net command u = i_q* - T_L / k_u the pair is one drive
to the kernels of the law ``speed``, whose current loop is that of both.
"""

from __future__ import annotations

from typing import Any

from hil.control.errors import ControlDesignError
from hil.control.laws import cascade
from hil.control.laws.speed import CODE
from hil.control.laws.speed import MEMBER as OWN_LOOP
from hil.control.registry import Law, Plan, Values
from hil.control.speed import LEADS


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The cascade's, or the speed law's over the net command. Raises ControlDesignError."""
    inner = plan.inner
    if inner is None:
        return cascade.design(values, plan)
    if not inner.told:
        raise ControlDesignError(
            "controller.kind fac: the drive reports neither i_q nor torque; map one in drive.signals"
        )
    return OWN_LOOP.design(values, plan) | {"kind": CODE, "pair": LEADS}


MEMBER = Law(
    "fac",
    "the paper's fully actuated law, load torque commanded",
    1,
    design,
    cascade.KEYS,
    ("voltage", "current", "torque"),
)
