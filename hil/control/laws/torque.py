"""The law for a load machine on a dyno bench: a commanded torque by a table, no speed loop.

A torque T, reached at ``slew_n_m_s``, is made i_q = T / k_t by the motor that is believed in, and runs on the
kernels of the law ``speed``. A drive that takes voltages gets the currents of least size for it within the
voltage, and its current loop, from the law ``mtpa``. The observer goes on, so that the log has the estimate
of this node, too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.law import ROWS
from hil.control.laws import mtpa
from hil.control.laws.speed import CODE
from hil.control.laws.speed import MEMBER as OWN_LOOP
from hil.control.registry import Key, Law, Plan, Values

VOLTAGE = ("current_pole_rad_s", "current_d_pole_rad_s", "voltage_share", "i_d_table")
"""Keys of the current loop of a drive that takes voltages; of no effect for others."""
_NEVER = {0: -1.0, 1: math.inf, -1: -math.inf}
"""Speed at which a row ends that ends by its time alone, by the sign of its torque."""


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The table in amperes and ticks. Raises ControlDesignError."""
    torque, times = values["torque_n_m"], values["for_s"]
    if len(torque) != len(times):
        raise ControlDesignError(
            f"controller: torque_n_m has {len(torque)} entries and for_s {len(times)}; one time a torque"
        )
    rows = {name: np.zeros(ROWS) for name in ("row_q", "row_w", "row_slew", "row_ticks")}
    count, k_t = len(torque), plan.motor.k_t
    rows["row_q"][:count] = np.array(torque) / k_t
    rows["row_w"][:count] = [_NEVER[int(np.sign(T))] for T in torque]
    rows["row_slew"][:count] = values["slew_n_m_s"] * plan.T_s / k_t
    rows["row_ticks"][:count] = np.rint(np.array(times) / plan.T_s)
    rows["row_ticks"][1:count] -= 1  # the kernel counts from the tick after the one that a row begins in
    given = {**values, "speed_pole_rad_s": 1.0}  # of no effect: no speed is followed
    own = (
        mtpa.design(given, plan) | {"kind": mtpa.CODE} if plan.inner is None else OWN_LOOP.design(given, plan)
    )
    return own | rows | {"rows": count, "goal": (1e9, 1.0, 1.0), "w_wrong": 1e9}


MEMBER = Law(
    "torque",
    "commanded torque by a table, for a load machine; no speed is followed",
    CODE,
    design,
    {
        "torque_n_m": Key("torque of the row; 0 after the last", type="numbers", above=None, count=ROWS),
        "for_s": Key("how long the row lasts", type="numbers", above=None, least=0.0, count=ROWS),
        "slew_n_m_s": Key("how fast the torque goes there", 1000.0, unit="N m/s"),
    }
    | {name: mtpa.MEMBER.keys[name] for name in VOLTAGE},
    ("voltage", "current", "torque"),
)
