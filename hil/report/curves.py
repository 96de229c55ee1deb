"""Which curves a report draws, in which plot, and how each is read from tick records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.config.tables import RunConfig
from hil.signals import FIELDS, DriveState, Field, RxFlag, TickArray

F8 = npt.NDArray[np.float64]
F4 = npt.NDArray[np.float32]
STATE_NAMES: Final = tuple(state.name.lower().replace("_", " ") for state in DriveState)


def since(values: npt.NDArray[Any], before: Any) -> npt.NDArray[Any]:
    """What each value adds to the one before it, the first to ``before``: as numpy's diff, but sooner."""
    out = np.empty_like(values)
    out[0] = values[0] - before
    np.subtract(values[1:], values[:-1], out=out[1:])
    return out


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
    curves: tuple[Curve, ...] = ()
    held: bool = False
    names: tuple[str, ...] = ()


def _error(ticks: TickArray) -> Any:
    """w - w* in operation; outside of it there is no reference to follow."""
    on = ticks["state"] == int(DriveState.OPERATION_ENABLED)
    return np.where(on, ticks["w"] - ticks["w_ref"], np.nan)


def _lost(ticks: TickArray) -> Any:
    """1 where a tick had no fresh feedback."""
    return (ticks["rx_flags"] & int(RxFlag.FRESH)) == 0


def _curve(field: Field) -> Curve:
    """A field as its row in :data:`hil.signals.FIELDS` says."""
    name, scale, shown = field.name, field.scale, field.shown

    def of(ticks: TickArray) -> Any:
        values = ticks[name] * scale
        return np.where(ticks["reason"] == 0, values, np.nan) if shown.until_stop else values

    return Curve(name, shown.label, of, shown.compared)


DERIVED: Final = {"error": (Curve("error", "w − w*", _error),), "bus": (Curve("lost", "no feedback", _lost),)}
"""Curves that are no field, by plot; they stand behind its fields."""
HEADS: Final = (
    Plot("speed", "Speed and reference", "rad/s"),
    Plot("error", "Speed error in operation", "rad/s"),
    Plot("angle", "Angle and reference, from where it was armed", "rad"),
    Plot("angle_error", "Following error of the angle", "rad"),
    Plot("current", "Currents", "A"),
    Plot("voltage_q", "q voltage: asked by the law, sent, applied", "V", held=True),
    Plot("voltage_d", "d voltage: asked by the law, sent, applied", "V", held=True),
    Plot("load", "Load torque: true and estimated", "N m"),
    Plot("d_w", "Disturbance estimate, speed channel", "rad/s²"),
    Plot("d_i", "Disturbance estimates, current channels", "A/s"),
    Plot("filled", "Observer memory filled", "ticks", held=True),
    Plot("state", "States", "", held=True, names=STATE_NAMES),
    Plot("lateness", "After the deadline of the tick", "µs"),
    Plot("bus", "Periods skipped; ticks without fresh feedback", "", held=True),
    Plot("v_dc", "DC-link voltage", "V"),
    Plot("temperature", "Temperatures", "°C"),
)


def plots_by_field(fields: Sequence[Field]) -> tuple[Plot, ...]:
    """The plots of these fields: those of :data:`HEADS` in their order, then those that fields alone name."""
    heads = {head.key: head for head in HEADS}
    for field in fields:
        if field.shown.plot:
            own = Plot(
                field.shown.plot,
                field.doc[:1].upper() + field.doc[1:],
                field.drawn_unit,
                held=field.kind in ("u4", "u8"),
            )
            heads.setdefault(own.key, own)
    made = [replace(head, curves=_curves(head.key, fields)) for head in heads.values()]
    return tuple(plot for plot in made if plot.curves)


def _curves(key: str, fields: Sequence[Field]) -> tuple[Curve, ...]:
    """The curves of a plot, its fields by their place."""
    own = sorted((f for f in fields if f.shown.plot == key), key=lambda f: f.shown.place)
    return (*map(_curve, own), *DERIVED.get(key, ()))


PLOTS: Final = plots_by_field(FIELDS)
OF_VOLTAGES: Final = ("voltage_d", "d_i")
"""Plots of what a drive that takes a current or a torque does not have."""


def plots_of(*configs: RunConfig | None) -> tuple[Plot, ...]:
    """The plots of runs: of drives with a current loop the command is no voltage."""
    takes = {config.drive.takes: config.command.unit for config in configs if config is not None}
    if not takes or "voltage" in takes:
        return PLOTS
    name = next(iter(takes)) if len(takes) == 1 else "command"
    title, unit = f"{name}: asked by the law, sent, in effect".capitalize(), " or ".join(takes.values())
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
        **({"angle_error": both(limits.following_error_rad, "trip")} if limits.following_error_rad else {}),
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
