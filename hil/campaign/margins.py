"""Stability margins of a case's law, on the linear loop with the motor that it believes in.

They are those of ``hil design`` and tell one design from another; what the case's own plant does to them
shows in its dip and recovery. Many cases share a design, so each is computed once a process.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from hil.config.design import motor_model
from hil.control.law import CASCADE, LAW_PARAMS, PI, MotorModel
from hil.runtime.setup import Setup
from hil.tuning.loop import rigid
from hil.tuning.measure import Bench, loops, margins

DESIGN: Final = {
    "design_ms": "peak of the sensitivity, with the motor that the law believes in",
    "design_gain_margin": "gain margin, with the motor that the law believes in",
    "design_phase_margin_deg": "phase margin, with the motor that the law believes in, deg",
    "design_delay_margin_ms": "delay margin, with the motor that the law believes in, ms",
}

VOLTAGE: Final = (CASCADE, PI)
"""Codes of the laws that ask a drive for a voltage: what the linear loop is made of."""


def design_margins(setup: Setup) -> dict[str, float | None]:
    """Columns of :data:`DESIGN`; None for a law that asks for anything but a voltage, or is unstable."""
    return _margins(
        setup.machine.law.tobytes(), motor_model(setup.config.motor), 1.0 / setup.config.loop.rate_hz
    )


@lru_cache(maxsize=64)
def _margins(params: bytes, motor: MotorModel, T_s: float) -> dict[str, float | None]:
    law = np.frombuffer(params, LAW_PARAMS)
    bench, plant = Bench(motor, T_s, 1.0, 0.0, 0.0), rigid(motor, T_s)
    if law["kind"][0] not in VOLTAGE or not (loop := loops(law, bench, [plant])[0]).stable:
        return dict.fromkeys(DESIGN)
    values = (loop.ms, *margins(law, bench, plant).values())
    return {key: value if math.isfinite(value) else None for key, value in zip(DESIGN, values, strict=True)}
