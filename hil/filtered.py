"""What the drive's filter of its speed does to the loop: margins, noise, and what is refused for it.

The tuning is judged on the linear loop (:mod:`hil.tuning.current`) with the motor that is believed in.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from hil.config import RunConfig
from hil.control.errors import ControlDesignError
from hil.control.registry import SpeedFilter
from hil.design import Machine, inner_loop, motor_model, speed_filter
from hil.errors import ConfigError
from hil.preflight import Row

if TYPE_CHECKING:
    from hil.app import Setup
    from hil.tuning.current import Loop

LEAST_PHASE_DEG, LEAST_GAIN, MOST_MS = 30.0, 1.7, 2.5
"""Margins below, and a peak of S above which a loop is called near its limit."""
MOST_NOISE: Final = 0.02
"""Noise of the command, of what the law may ask for, above which it is said."""
ROW: Final = "speed filter"
OWN: Final = "write the kind and the poles of the drive's own filter into drive.speed_filter"


def loop_through(config: RunConfig, machine: Machine, given: SpeedFilter | None) -> Loop:
    """The loop of a drive with a current loop of its own whose speed really comes through ``given``."""
    from hil.tuning.current import loop_of, shaft_of  # loads scipy

    inner, T_s = inner_loop(config, bool(machine.law["told"][0])), 1.0 / config.loop.rate_hz
    assert inner is not None  # noqa: S101 - asked of no other drive
    return loop_of(machine.law, shaft_of(motor_model(config.motor), inner, given, T_s), T_s)


def refuse_unstable(where: str, config: RunConfig, machine: Machine, w_lsb: float) -> None:
    """Raise ConfigError for a filter with which the tuning is not stable, or that leaves nothing but noise.

    ``w_lsb`` [rad/s] is the resolution of the speed in the frames.
    """
    table = config.drive.speed_filter
    given = speed_filter(table, config.loop.rate_hz)
    if given is None or machine.law["rows"][0]:  # an experiment closes no loop
        return
    loop, command = loop_through(config, machine, given), config.command
    if not loop.stable:
        raise ConfigError(where, [f"drive.speed_filter: {_unstable(table)}"])
    noise = loop.u_noise * w_lsb / math.sqrt(12.0)
    if noise > command.most:
        raise ConfigError(
            where,
            [
                f"drive.speed_filter: to undo {words(table)} makes {noise:.2g} {command.unit} of noise of "
                f"the frames' resolution alone, limits allow {command.most:g}; set a faster filter in the "
                "drive"
            ],
        )


def _unstable(table: Any) -> str:
    """What is wrong, and what to do."""
    if table.modelled:
        return f"the loop is not stable through {words(table)}; take a lower controller.speed_pole_rad_s"
    return (
        f"the loop is not stable through {words(table)}, which the observer does not know; "
        f"let it: modelled = true, or take a longer delay_ms and a lower controller.speed_pole_rad_s"
    )


def words(table: Any) -> str:
    """A filter in words."""
    if table.kind == "first-order":
        return f"a first-order filter of {table.pole_rad_s:g} rad/s"
    if table.kind == "pll":
        return f"a PLL with poles of {table.pole_1_rad_s:g} and {table.pole_2_rad_s:g} rad/s"
    return "no filter" if table.kind == "none" else f"a moving average of {table.window_ms:g} ms"


def filter_rows(setup: Setup, real: Any = None, w_noise: float = 0.0) -> list[Row]:
    """The row of ``hil check``; ``real``: the table of the filter that an emulated drive really has.

    ``w_noise`` [rad/s] is what its sensor adds to the resolution of the frames.
    """
    config, told = setup.config, setup.config.drive.speed_filter
    if config.drive.takes == "voltage":
        return []
    real = real or told
    try:
        given, believed = (speed_filter(table, config.loop.rate_hz) for table in (real, told))
    except ControlDesignError as error:  # of the real one: no run begins with such a one told
        return [Row(ROW, "warn", f"the emulated drive has {words(real)}: {error}", "take a shorter one")]
    loop = loop_through(config, setup.machine, given)
    what = _which(real, told, given == believed)
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


def known(told: Any) -> str:
    """A filter in words, and whether the observer knows it."""
    return f"{words(told)}, which the observer {'knows' if told.modelled else 'does not know'}"


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
