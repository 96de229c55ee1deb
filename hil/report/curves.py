"""Which curves a report draws, in which plot, and how each is read from tick records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.config import RunConfig
from hil.signals import DriveState, RxFlag, TickArray

F8 = npt.NDArray[np.float64]
F4 = npt.NDArray[np.float32]
STATE_NAMES: Final = tuple(state.name.lower().replace("_", " ") for state in DriveState)


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve: its key, what the legend calls it, how it is read, and whether a comparison shows it."""

    key: str
    label: str
    of: Callable[[TickArray], Any]
    compared: bool = True


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves that share an axis. ``held``: the value holds until the next tick; ``names``: of 0, 1, 2..."""

    key: str
    title: str
    unit: str
    curves: tuple[Curve, ...]
    held: bool = False
    names: tuple[str, ...] = ()


def _field(name: str, scale: float = 1.0) -> Callable[[TickArray], Any]:
    return lambda ticks: ticks[name] * scale


def _error(ticks: TickArray) -> Any:
    """w - w* in operation; outside of it there is no reference to follow."""
    on = ticks["state"] == int(DriveState.OPERATION_ENABLED)
    return np.where(on, ticks["w"] - ticks["w_ref"], np.nan)


def _lost(ticks: TickArray) -> Any:
    """1 where a tick had no fresh feedback."""
    return (ticks["rx_flags"] & int(RxFlag.FRESH)) == 0


def _until_stop(name: str, label: str, compared: bool = True, scale: float = 1.0) -> Curve:
    """What means nothing once the run stops, and would then set the scale: estimates, times in a tick."""

    def of(ticks: TickArray) -> Any:
        return np.where(ticks["reason"] == 0, ticks[name] * scale, np.nan)

    return Curve(name, label, of, compared)


def _curve(name: str, label: str, compared: bool = True, scale: float = 1.0) -> Curve:
    return Curve(name, label, _field(name, scale), compared)


PLOTS: Final = (
    Plot("speed", "Speed and reference", "rad/s", (_curve("w_ref", "w*"), _curve("w", "w"))),
    Plot("error", "Speed error in operation", "rad/s", (Curve("error", "w − w*", _error),)),
    Plot(
        "current", "Currents", "A",
        (_curve("i_q_ref", "i_q*", False), _curve("i_q", "i_q"), _curve("i_d", "i_d", False)),
    ),
    Plot(
        "voltage_q", "q voltage: asked by the law, sent, applied", "V",
        (_curve("u_q_law", "asked", False), _curve("u_q", "sent", False), _curve("ua_q", "applied")), True,
    ),
    Plot(
        "voltage_d", "d voltage: asked by the law, sent, applied", "V",
        (_curve("u_d_law", "asked", False), _curve("u_d", "sent", False), _curve("ua_d", "applied")), True,
    ),
    Plot(
        "load", "Load torque: true and estimated", "N m",
        (_curve("T_L_true", "true"), _until_stop("T_L_hat", "estimate")),
    ),
    Plot("d_w", "Disturbance estimate, speed channel", "rad/s²", (_until_stop("d_hat_w", "d_hat_w"),)),
    Plot(
        "d_i", "Disturbance estimates, current channels", "A/s",
        (_until_stop("d_hat_q", "d_hat_q"), _until_stop("d_hat_d", "d_hat_d", False)),
    ),
    Plot("filled", "Observer memory filled", "ticks", (_curve("filled", "filled"),), True),
    Plot(
        "state", "States", "",
        (_curve("state", "supervisor"), _curve("drive_state", "drive", False)), True, STATE_NAMES,
    ),
    Plot(
        "lateness", "After the deadline of the tick", "µs",
        (
            _until_stop("sent_ns", "sent", False, 1e-3), _until_stop("computed_ns", "computed", False, 1e-3),
            _until_stop("received_ns", "received", False, 1e-3),
            _until_stop("lateness_ns", "woken", True, 1e-3),
        ),
    ),
    Plot(
        "bus", "Periods skipped; ticks without fresh feedback", "",
        (_curve("skipped", "skipped"), Curve("lost", "no feedback", _lost)), True,
    ),
    Plot("v_dc", "DC-link voltage", "V", (_curve("v_dc", "v_dc"),)),
    Plot(
        "temperature", "Temperatures", "°C",
        (_curve("temperature_motor", "motor"), _curve("temperature_inverter", "inverter", False)),
    ),
)  # fmt: skip
OF_VOLTAGES: Final = ("voltage_d", "d_i")
"""Plots of what a drive that takes a current or a torque does not have."""


def plots_of(config: RunConfig | None) -> tuple[Plot, ...]:
    """The plots of a run: of a drive with a current loop the command is no voltage."""
    if config is None or config.drive.takes == "voltage":
        return PLOTS
    title = f"{config.drive.takes}: asked by the law, sent, in effect".capitalize()
    unit = config.command.unit
    return tuple(
        replace(plot, title=title, unit=unit) if plot.key == "voltage_q" else plot
        for plot in PLOTS
        if plot.key not in OF_VOLTAGES
    )


CURVES: Final = tuple(curve for plot in PLOTS for curve in plot.curves)
KEYS: Final = tuple(curve.key for curve in CURVES)


def values_of(ticks: TickArray) -> F4:
    """All curves of some ticks, float32 of shape (curves, ticks); what overflows becomes infinite."""
    out = np.empty((len(CURVES), len(ticks)), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for row, curve in enumerate(CURVES):
            out[row] = curve.of(ticks)
    return out


def limit_lines(config: RunConfig | None, windows: tuple[int, ...]) -> dict[str, list[tuple[float, str]]]:
    """Per plot the horizontal lines of what must not be exceeded: (value, name)."""
    if config is None:
        return {}
    limits = config.limits

    def both(value: float, name: str) -> list[tuple[float, str]]:
        return [(value, name), (-value, "")]

    return {
        "speed": both(limits.w_max_rad_s, "trip"),
        "current": both(limits.i_max_a, "i_max") + both(limits.i_trip_a, "trip"),
        "voltage_q": both(config.command.most, "u_max"),
        "voltage_d": both(config.command.most, "u_max"),
        "filled": [(float(N), f"N = {N}") for N in sorted(set(windows))],
        "v_dc": [(limits.v_dc_min_v, "min"), (limits.v_dc_max_v, "max")],
        "temperature": [(limits.temperature_max_c, "max")],
    }


def limits_text(lines: list[tuple[float, str]]) -> str:
    """The limits of a plot in words, for its heading: an axis need not reach to them."""
    named = (name if "=" in name else f"{name} {value:g}" for value, name in lines if name)
    return ", ".join(named)
