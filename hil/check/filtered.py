"""The row of `hil check` on the drive's filter of its speed: margins and noise, with what is really there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from hil.check.preflight import Row
from hil.config.design import speed_filter
from hil.config.filtered import known, loop_through, words
from hil.config.tables import RunConfig
from hil.control.errors import ControlDesignError

if TYPE_CHECKING:
    from hil.runtime.setup import Setup
    from hil.tuning.current import Loop

LEAST_PHASE_DEG, LEAST_GAIN, MOST_MS = 30.0, 1.7, 2.5
"""Margins below, and a peak of S above which a loop is called near its limit."""
MOST_NOISE: Final = 0.02
"""Noise of the command, of what the law may ask for, above which it is said."""
ROW: Final = "speed filter"
OWN: Final = "write the kind and the poles of the drive's own filter into drive.speed_filter"


def filter_rows(setup: Setup, real: Any = None, w_noise: float = 0.0) -> list[Row]:
    """The row of ``hil check``; ``real``: the table of the filter that an emulated drive really has.

    ``w_noise`` [rad/s] is what its sensor adds to the resolution of the frames.
    """
    config, told = setup.config, setup.config.drive.speed_filter
    if config.drive.takes == "voltage" or not config.follows_speed:
        return []
    real = real or told
    try:
        given, believed = (speed_filter(table, config.loop.rate_hz) for table in (real, told))
    except ControlDesignError as error:  # of the real one: no run begins with such a one told
        return [Row(ROW, "warn", f"the emulated drive has {words(real)}: {error}", "take a shorter one")]
    loop = loop_through(config, setup.machine, given)
    what, shaft = _which(real, told, given == believed), config.motor.shaft
    what += f", a shaft of {shaft.resonance_hz:g} Hz, which the observer knows" if shaft else ""
    if not loop.stable:
        return [Row(ROW, "fail", f"{what}: the loop is not stable", OWN)]
    noise = math.hypot(w_noise, setup.wire.x_lsb[0] / math.sqrt(12.0))
    found = f"{what}: {_figures(config, loop, noise)}"
    if given != believed:
        return [Row(ROW, "warn", found, OWN)]
    if near_its_limit(loop):
        return [Row(ROW, "warn", found, "take a longer delay_ms and a lower speed_pole_rad_s")]
    if loop.u_noise * noise > MOST_NOISE * config.command.most:
        remedy = "take a longer observer.speed.delay_ms, or set a faster filter in the drive"
        return [Row(ROW, "warn", found, remedy)]
    return [Row(ROW, "pass", found)]


def _which(real: Any, told: Any, same: bool) -> str:
    """The filter, and what is known of it."""
    if not same:
        return f"the emulated drive has {words(real)}, drive.speed_filter tells {words(told)}"
    return words(told) if told.kind == "none" else known(told)


def _figures(config: RunConfig, loop: Loop, noise: float) -> str:
    """Margins, and what noise [rad/s] of the reported speed becomes."""
    m, torque = loop.margins, config.motor.J_kg_m2 * loop.d_noise * noise
    return (
        f"Ms {loop.ms:.2f}, gain margin {m.gain:.2g}, phase {m.phase_deg:.0f} deg, "
        f"delay {m.delay_ms:.2g} ms; {noise:.2g} rad/s of noise make {torque:.2g} N m in the estimate "
        f"and {loop.u_noise * noise:.2g} {config.command.unit} in the command"
    )


def near_its_limit(loop: Loop) -> bool:
    """True when a margin is small."""
    m = loop.margins
    return loop.ms > MOST_MS or m.gain < LEAST_GAIN or m.phase_deg < LEAST_PHASE_DEG
