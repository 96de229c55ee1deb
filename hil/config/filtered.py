"""What the drive's filter of its speed does to the loop: margins, noise, and what is refused for it.

The tuning is judged on the linear loop (:mod:`hil.tuning.current`) with the motor that is believed in.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from hil.config.design import Machine, elastic_shaft, inner_loop, motor_model, speed_filter
from hil.config.tables import RunConfig
from hil.control.registry import SpeedFilter
from hil.errors import ConfigError

if TYPE_CHECKING:
    from hil.tuning.current import Loop

SHAKEN_S = 3.0
"""Time for which a loop on its shaft is watched."""


def loop_through(config: RunConfig, machine: Machine, given: SpeedFilter | None) -> Loop:
    """The loop of a drive with a current loop of its own whose speed really comes through ``given``."""
    from hil.tuning.current import loop_of, shaft_of  # loads scipy

    inner, T_s = inner_loop(config, bool(machine.law["told"][0])), 1.0 / config.loop.rate_hz
    assert inner is not None  # noqa: S101 - asked of no other drive
    law = machine.law.copy()
    law["pair"] = 0  # of one law over two nodes: their net command is the law speed's
    return loop_of(law, shaft_of(motor_model(config.motor), inner, given, T_s), T_s)


def refuse_unstable(where: str, config: RunConfig, machine: Machine, w_lsb: float) -> None:
    """Raise ConfigError for a filter with which the tuning is not stable, or that leaves nothing but noise.

    ``w_lsb`` [rad/s] is the resolution of the speed in the frames.
    """
    table = config.drive.speed_filter
    given = speed_filter(table, config.loop.rate_hz)
    every, shaft = config.feedback_every, config.motor.shaft
    if (
        (given is None and every == 1 and shaft is None) or not config.follows_speed or machine.law["rows"][0]
    ):  # an experiment closes no loop
        return
    loop, command = loop_through(config, machine, given), config.command
    if not loop.stable and every > 1:
        seldom = f"the loop is not stable through {words(table)}, measured in each {every}th tick"
        remedy = "take a lower controller.speed_pole_rad_s, or let the drive send more often"
        raise ConfigError(where, [f"feedback.period_ms: {seldom}; {remedy}"])
    if not loop.stable and shaft is not None:
        soft = f"the loop is not stable on a shaft of {shaft.resonance_hz:g} Hz"
        raise ConfigError(where, [f"motor.shaft: {soft}; take a lower controller.speed_pole_rad_s"])
    if not loop.stable:
        raise ConfigError(where, [f"drive.speed_filter: {_unstable(table)}"])
    if given is None and shaft is None:
        return
    noise = loop.u_noise * w_lsb / math.sqrt(12.0)
    if noise > command.most and shaft is not None:
        found = (
            f"to see through a shaft of {shaft.resonance_hz:g} Hz makes {noise:.2g} {command.unit} of noise"
        )
        remedy = f"limits allow {command.most:g}; take a longer observer.speed.delay_ms"
        raise ConfigError(where, [f"motor.shaft: {found} of the frames' resolution alone, {remedy}"])
    if noise > command.most:
        raise ConfigError(
            where,
            [
                f"drive.speed_filter: to undo {words(table)} makes {noise:.2g} {command.unit} of noise of "
                f"the frames' resolution alone, limits allow {command.most:g}; set a faster filter in the "
                "drive"
            ],
        )


def refuse_shaking(where: str, config: RunConfig, machine: Machine) -> None:
    """Raise ConfigError for a shaft on which the tuning of a drive that takes voltages is not stable."""
    shaft = elastic_shaft(config.motor)
    if shaft is None or machine.law["rows"][0]:  # an experiment closes no loop
        return
    from hil.tuning.measure import Bench, quiet  # loads scipy

    motor, w = motor_model(config.motor), abs(float(machine.reference["w"][0]))
    bench = Bench(motor, 1.0 / config.loop.rate_hz, 1.0, 0.0, 0.0, w_0=w)
    if not all(quiet(machine.law, bench, [(motor, shaft.elastic)], SHAKEN_S)):
        hz = config.motor.shaft.resonance_hz if config.motor.shaft else 0.0
        text = f"the loop is not stable on a shaft of {hz:g} Hz"
        raise ConfigError(where, [f"motor.shaft: {text}; take a lower controller.speed_pole_rad_s"])


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


def known(told: Any) -> str:
    """A filter in words, and whether the observer knows it."""
    return f"{words(told)}, which the observer {'knows' if told.modelled else 'does not know'}"
