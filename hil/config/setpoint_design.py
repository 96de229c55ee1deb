"""Ramp of a stop and range of live set-points: from a configuration to :mod:`hil.tick.setpoint`'s record."""

from __future__ import annotations

from typing import Final

import numpy as np

from hil.config.tables import RunConfig
from hil.control.errors import ControlDesignError
from hil.tick.setpoint import SETPOINT_PARAMS, Record

SETTLE_S: Final = 0.5
"""How long a drive may take to come to rest once the reference is 0."""
STILL: Final = 0.01
"""Speed that counts as at rest, as a share of w_max."""
RANGE: Final = 0.9
"""Share of a limit that a live set-point reaches unless the config says otherwise."""


def acceleration_max(config: RunConfig) -> float:
    """What the torque at i_max gives [rad/s2]: 1.5 n_p psi_f i_max / J; fac adds the load machine."""
    motor, limits = config.motor, config.limits
    torque = 1.5 * motor.n_p * motor.psi_f_wb * limits.i_max_a
    torque += limits.T_L_max_n_m if config.controller.kind == "fac" else 0.0
    return torque / motor.J_kg_m2


def stop_rate(config: RunConfig) -> float:
    """Rate of the ramp before a stop [rad/s2], 0 for none. Raises ControlDesignError for one out of reach."""
    stop, limits, most = config.stop, config.limits, acceleration_max(config)
    if stop.ramp_rad_s2 is None:
        return min(limits.w_max_rad_s / 1.0, 0.5 * most)
    if stop.ramp_rad_s2 > most:
        raise ControlDesignError(
            f"stop.ramp_rad_s2: the torque at i_max_a gives {most:.4g} rad/s2, not {stop.ramp_rad_s2:g}"
        )
    if stop.ramp_rad_s2 and limits.w_max_rad_s > stop.ramp_rad_s2 * stop.ramp_max_s * (1 + 1e-9):
        raise ControlDesignError(
            f"stop.ramp_rad_s2: {stop.ramp_rad_s2:g} rad/s2 takes longer than stop.ramp_max_s = "
            f"{stop.ramp_max_s:g} s from w_max_rad_s; raise one of them"
        )
    return stop.ramp_rad_s2


def _bounded(name: str, given: float | None, limit: float) -> float:
    """A live set-point's bound [SI]: as given, which must lie within the limit, or RANGE of the limit."""
    if given is None:
        return RANGE * limit
    if abs(given) > abs(limit):
        raise ControlDesignError(f"setpoint.{name}: {given:g} is beyond the limit of {limit:g}")
    return given


def setpoint_params(config: RunConfig) -> Record:
    """The parameters of a run. Raises ControlDesignError for a range or a rate that can't be."""
    p, table, limits, rate = np.zeros(1, SETPOINT_PARAMS), config.setpoint, config.limits, stop_rate(config)
    at_once = config.loop.shadow or rate == 0.0
    values: dict[str, float] = {
        "T_s": 1.0 / config.loop.rate_hz,
        "stop_rate": rate,
        "stop_ticks": 0 if at_once else max(1, round(config.stop.ramp_max_s * config.loop.rate_hz)),
        "settle_ticks": round(SETTLE_S * config.loop.rate_hz),
        "w_still": STILL * limits.w_max_rad_s,
        "w_min": _bounded("w_min_rad_s", table.w_min_rad_s, -limits.w_max_rad_s),
        "w_max": _bounded("w_max_rad_s", table.w_max_rad_s, limits.w_max_rad_s),
        "w_rate": table.rate_rad_s2 or rate or limits.w_max_rad_s,
        "i_q_max": _bounded("i_q_max_a", table.i_q_max_a, limits.i_max_a),
        "i_q_rate": table.i_q_rate_a_s or limits.i_max_a,
    }
    if values["w_min"] > values["w_max"]:
        raise ControlDesignError(f"setpoint.w_min_rad_s: {values['w_min']:g} is above w_max_rad_s")
    if values["w_rate"] > acceleration_max(config):
        raise ControlDesignError(
            f"setpoint.rate_rad_s2: the torque at i_max_a gives {acceleration_max(config):.4g} rad/s2, "
            f"not {values['w_rate']:g}"
        )
    for name, value in values.items():
        p[name] = value
    return p
