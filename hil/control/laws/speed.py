"""The law for a drive that takes a current or a torque: the speed error's pole, disturbance compensated.

The drive's own current loop is part of the model (:mod:`hil.control.speed`); its pole stays where it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.fac import sample
from hil.control.linalg import exp
from hil.control.registry import JERK, InnerLoop, Key, Law, Plan, Values
from hil.control.speed import MOST_DELAY

CODE = 4


def inner_loop(tau: float, pole: float, T_s: float) -> tuple[float, float]:
    """(l, alpha) of dw/dt = pole w + i, di/dt = -i / tau: w+ = .. + alpha Ed_w i, i+ = l i, exactly."""
    if tau == 0.0:
        return 0.0, 0.0
    model = sample(np.array([[pole, 1.0], [0.0, -1.0 / tau]]), np.eye(2), T_s, 1)
    return float(model.Ad[1, 1]), float(model.Ad[0, 1] / model.Ed[0, 0])


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """lam = e^{-pole T_s}, and the sampled inner loop. Raises ControlDesignError."""
    inner, motor, T_s = plan.inner, plan.motor, plan.T_s
    assert inner is not None  # noqa: S101 - a drive that takes voltages has other laws
    _check(inner)
    lag, share = inner_loop(inner.lag, -motor.B_f / motor.J, T_s)
    a, b = float(plan.model.Ad[0, 0]), float(plan.model.Bd[0, 0])
    if not lag < 0.999 * a:
        raise ControlDesignError(
            f"drive.current_lag_ms = {inner.lag * 1e3:g}: slower than the shaft itself; is it in ms?"
        )
    kappa = share * b / (a - lag)
    return {
        "lam_w": exp(-values["speed_pole_rad_s"] * T_s),
        "k_u": inner.k_u,
        "u_i": inner.u_i,
        "told": int(inner.told),
        "delay": inner.delay,
        "lag": lag,
        "share": share,
        "kappa": kappa,
        "g_u": (1.0 - share) * b + kappa * (1.0 - lag),
        "jerk": int(values.get("jerk_feedforward", False)),
    }


def _check(inner: InnerLoop) -> None:
    """Refuse an inner loop that no command reaches in time."""
    if not 0 <= inner.delay <= MOST_DELAY:
        raise ControlDesignError(
            f"drive.delay_ticks = {inner.delay}: 0 to {MOST_DELAY} are kept; lower loop.rate_hz"
        )


MEMBER = Law(
    "speed",
    "pole of the speed for a drive that takes a current or a torque, disturbance compensated",
    CODE,
    design,
    {"speed_pole_rad_s": Key("pole of the speed error", 30.0), "jerk_feedforward": JERK},
    ("current", "torque"),
)
