"""The row of `hil check` on measurements that come less often than the loop ticks: what that costs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from hil.check.filtered import near_its_limit
from hil.check.preflight import Row
from hil.config.design import build, speed_filter
from hil.config.filtered import loop_through
from hil.control.law import exact_after

if TYPE_CHECKING:
    from hil.config.tables import RunConfig
    from hil.runtime.setup import Setup
    from hil.tuning.current import Loop

ROW = "seldom feedback"
REMEDY = "let the drive send more often, or take a longer delay_ms and a lower speed_pole_rad_s"


def seldom_rows(setup: Setup) -> list[Row]:
    """Margins, noise and lag with feedback.period_ms, and what they would be in each tick."""
    config, every = setup.config, setup.config.feedback_every
    if every == 1 or config.drive.takes == "voltage":
        return []
    each = config.model_copy(update={"feedback": config.feedback.model_copy(update={"period_ms": None})})
    given = speed_filter(config.drive.speed_filter, config.loop.rate_hz)
    seldom = loop_through(config, setup.machine, given)
    often = loop_through(each, build(each, setup.wire), given)
    found = f"{_lag(setup)}; {_figures(config, seldom, often, setup.wire.x_lsb[0] / math.sqrt(12.0))}"
    if not seldom.stable:
        return [Row(ROW, "fail", f"{found}: the loop is not stable", REMEDY)]
    return [Row(ROW, "warn", found, REMEDY) if near_its_limit(seldom) else Row(ROW, "pass", found)]


def _lag(setup: Setup) -> str:
    """D in samples, and when a load step is known."""
    config, every, T_ms = setup.config, setup.config.feedback_every, 1e3 / setup.config.loop.rate_hz
    delay_ms = getattr(config.observer.speed, "delay_ms", None)
    window = f"D = {delay_ms:g} ms is {delay_ms / (every * T_ms):.3g} of them; " if delay_ms else ""
    return (
        f"measured every {every * T_ms:g} ms, in each {every}th tick: {window}a load step is seen "
        f"{(every - 1) * T_ms / 2:g} ms later on average, and known after "
        f"{exact_after(setup.machine.law)[0] * T_ms:g} ms"
    )


def _figures(config: RunConfig, seldom: Loop, often: Loop, noise: float) -> str:
    """Both loops' margins and noise, for that of the frames' resolution [rad/s]."""
    J, m, e = config.motor.J_kg_m2, seldom.margins, often.margins
    return (
        f"Ms {seldom.ms:.2f} ({often.ms:.2f} in each tick), phase {m.phase_deg:.0f} deg ({e.phase_deg:.0f}), "
        f"delay {m.delay_ms:.2g} ms ({e.delay_ms:.2g}), noise of the estimate "
        f"{J * seldom.d_noise * noise:.2g} N m ({J * often.d_noise * noise:.2g})"
    )
