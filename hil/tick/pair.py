"""What two nodes under one law tell each other in a tick: ``fac`` of the motor, ``follow`` of the other one.

Before the laws run the first one is told what the load machine gives, by its own measurement, and what it has
latched; after its law the load machine's is told what to give. Each is an input of that node's tick and is
logged, so each node replays alone. T_L is against the motor: a positive torque of the load machine is a
negative T_L.
"""

from __future__ import annotations

import math
from typing import Any

from hil.control.jit import jit
from hil.control.speed import LEADS
from hil.signals import DriveState, RxFlag


@jit
def leads(law: Any) -> bool:
    """Whether this law commands the load machine, too."""
    return bool(law[0]["pair"] == LEADS)


@jit
def tell(first: Any, load: Any, law: Any) -> None:
    """T_L as the load machine measures it, NaN without feedback, and as commanded; ``law``: its own."""
    t, other, p = first[0], load[0], law[0]
    fresh = (other["rx_flags"] & RxFlag.FRESH) != 0
    t["T_L_in"] = 0.0 - p["k_t"] * other["i_q"] if fresh else math.nan
    on = other["drive_state"] == DriveState.OPERATION_ENABLED
    t["T_L_sent"] = 0.0 - p["k_u"] * other["u_q"] if on else 0.0


@jit
def ask(first: Any, load: Any, law: Any) -> None:
    """i_q* [A] of the load machine: what makes T_L by the motor that it believes in."""
    load[0]["i_q_ref_in"] = 0.0 - first[0]["T_L"] / law[0]["k_t"]
