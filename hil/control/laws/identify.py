"""An experiment instead of a control law, by a table: what ``hil identify`` runs (:mod:`hil.identify`).

With ``passes`` the rows are voltages in units of a level that grows from pass to pass until the currents
reach their goals; without it they are q currents, each up to a speed or for a time. A drive with a current
loop of its own is commanded those currents, by the kernels of the law ``speed``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.law import ROWS, SPEED
from hil.control.laws.speed import MEMBER as OWN_LOOP
from hil.control.linalg import exp
from hil.control.registry import Key, Law, Plan, Values

CODE = 3
_TABLES = {"q": "row_q", "d": "row_d", "w_rad_s": "row_w", "slew_a_s": "row_slew", "for_s": "row_ticks"}


def _numbers(doc: str, least: float | None = None, unit: str = "") -> Key:
    return Key(doc, type="numbers", above=None, least=least, count=ROWS, unit=unit)


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The table in ticks, and the current controller's factor. Raises ControlDesignError."""
    if plan.inner is not None and values["passes"]:
        raise ControlDesignError(
            "controller.passes: the drive takes no voltages; its rows are currents, 0 passes"
        )
    rows = len(values["q"])
    if any(len(values[name]) != rows for name in _TABLES):
        raise ControlDesignError(f"controller: {', '.join(_TABLES)} must have one entry a row, {rows} as q")
    out: dict[str, Any] = {"rows": rows, "passes": round(values["passes"])}
    scale = {"slew_a_s": plan.T_s, "for_s": 1.0 / plan.T_s}
    for name, field in _TABLES.items():
        column = np.zeros(ROWS)
        column[:rows] = np.array(values[name]) * scale.get(name, 1.0)
        out[field] = np.rint(column) if name == "for_s" else column
    lam = exp(-values["current_pole_rad_s"] * plan.T_s)
    goal = (values["w_most_rad_s"], values["i_q_goal_a"], values["i_d_goal_a"])
    single = {"u_start": "u_start_v", "u_most": "u_most_v", "w_run": "w_run_rad_s"}
    single |= {"w_wrong": "w_wrong_rad_s", "i_brake": "i_brake_a"}
    named = {field: values[name] for field, name in single.items()}
    own = {} if plan.inner is None else OWN_LOOP.design({"speed_pole_rad_s": 1.0}, plan) | {"kind": SPEED}
    return out | named | {"lam_q": lam, "lam_d": lam, "goal": goal} | own


MEMBER = Law(
    "identify",
    "an experiment by a table of voltages, or of currents until a speed",
    CODE,
    design,
    {
        "q": _numbers("q voltage in units of the level, or q current", unit="levels or A"),
        "d": _numbers("d voltage in units of the level", unit="levels"),
        "w_rad_s": _numbers("speed at which the row ends"),
        "slew_a_s": _numbers("how fast the current goes there", 0.0),
        "for_s": _numbers("longest time of the row", 0.0),
        "passes": Key("runs through the table with voltages; 0: currents", 0.0, above=None, least=0.0),
        "u_start_v": Key("first level", 0.0, above=None, least=0.0),
        "u_most_v": Key("largest level", 0.0, above=None, least=0.0),
        "i_q_goal_a": Key("peak of i_q to reach", 1.0),
        "i_d_goal_a": Key("peak of i_d to reach", 1.0),
        "w_most_rad_s": Key("speed at which it brakes"),
        "w_run_rad_s": Key("reference at which it runs; any other is a stop"),
        "w_wrong_rad_s": Key("speed against the first torque that ends it", 1e9),
        "i_brake_a": Key("current that brings the shaft to rest", 0.0, above=None, least=0.0),
        "current_pole_rad_s": Key("pole of the current errors", 250.0),
    },
    ("voltage", "current", "torque"),
)
