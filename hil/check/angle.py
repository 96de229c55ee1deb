"""The row of `hil check` on the law position: what the angle's resolution costs, what holds the load."""

from __future__ import annotations

import math

from hil.check.filtered import MOST_NOISE
from hil.check.preflight import Row
from hil.runtime.setup import Setup


def angle_rows(setup: Setup) -> list[Row]:
    """Noise of the command by the angle's resolution alone; stiffness J p_1 p_2 against what d_hat misses."""
    config, law, angle = setup.config, setup.machine.law, setup.binding.signal("angle")
    if not config.follows_angle or angle is None:
        return []
    noise = float(law["k_th"][0] / law["g_u"][0]) * angle.step / math.sqrt(12.0)
    poles = config.controller.position_pole_rad_s * config.controller.speed_pole_rad_s
    stiff = config.motor.J_kg_m2 * poles
    found = (
        f"steps of {angle.step:.2g} rad make {noise:.2g} {config.command.unit} of noise in the command; "
        f"{stiff:.3g} N m/rad hold what the estimate misses: {0.1 / stiff:.2g} rad for 0.1 N m"
    )
    if noise > MOST_NOISE * config.command.most:
        return [Row("angle", "warn", found, "take lower poles of the law, or a finer encoder")]
    return [Row("angle", "pass", found)]
