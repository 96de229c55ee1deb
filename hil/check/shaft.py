"""The row of `hil check` on the elastic shaft that the observer knows: its margins, and what is there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hil.check.preflight import Row
from hil.config.design import elastic_shaft
from hil.control.registry import Shaft
from hil.errors import ConfigError
from hil.runtime.bus import is_emulated_bus
from hil.sim.emulate import load_plant

if TYPE_CHECKING:
    from hil.runtime.setup import Setup

ROW: Final = "shaft"
NEAR: Final = 0.1
"""Share by which resonance and inertia ratio may be off: an observer's model is hardly better known."""
MOST_MS: Final = 2.5


def shaft_rows(setup: Setup) -> list[Row]:
    """Whether the emulated plant has the shaft of ``motor.shaft``; of voltage drives the margins on it."""
    told = elastic_shaft(setup.config.motor)
    emulated = setup.config.emulator is not None and is_emulated_bus(setup.config)
    try:
        real = real_shaft(setup) if emulated else None
    except ConfigError as error:
        return [] if told is None else [Row(ROW, "warn", str(error), "correct emulator.plant")]
    if told is None and real is None:
        return []
    if told is None:
        remedy = "write it into motor.shaft, or design for it: hil design"
        return [Row(ROW, "warn", f"the emulated plant has {_words(real)}, the observer knows none", remedy)]
    if not emulated:
        return [_margins(setup, f"the observer knows {_words(told)}")]
    if real is None or not same(told, real):
        found = f"motor.shaft tells {_words(told)}, the emulated plant has {_words(real)}"
        return [Row(ROW, "warn", found, "write the plant's [coupling] into motor.shaft, or leave that out")]
    return [_margins(setup, f"{_words(told)}, as motor.shaft tells")]


def real_shaft(setup: Setup) -> Shaft | None:
    """The coupling in the plant's file. Raises ConfigError."""
    plant, _ = load_plant(setup.path, setup.config)
    if plant.coupling is None:
        return None
    at = plant.masses
    return Shaft(at.resonance_rad_s, 0.5 * at.d * at.resonance_rad_s / at.c, at.J_m / (at.J_m + at.J_l))


def same(told: Shaft, real: Shaft) -> bool:
    """Whether resonance and inertia ratio are within NEAR; the damping is small in either."""
    ratios = [(1.0 - one.share) / one.share for one in (told, real)]
    return abs(told.resonance / real.resonance - 1.0) <= NEAR and abs(ratios[0] / ratios[1] - 1.0) <= NEAR


def _words(shaft: Shaft | None) -> str:
    if shaft is None:
        return "a rigid shaft"
    hz, damping, share = shaft.elastic
    return f"a shaft of {hz:.3g} Hz, damping {damping:.2g}, inertia ratio {(1.0 - share) / share:.3g}"


def _margins(setup: Setup, what: str) -> Row:
    """The verdict by Ms on the shaft; a drive with its own current loop has that in another row."""
    if setup.config.drive.takes != "voltage" or setup.machine.law["rows"][0]:
        return Row(ROW, "pass", what)
    from hil.tuning.bench import bench_of  # loads scipy
    from hil.tuning.measure import loops

    bench = bench_of(setup.path, setup)
    ms = loops(setup.machine.law, bench, [bench.plant(bench.motor)])[0].ms
    if ms <= MOST_MS:
        return Row(ROW, "pass", f"{what}; Ms {ms:.2f} on it")
    return Row(
        ROW, "warn", f"{what}; Ms {ms:.2f} on it", "take a lower controller.speed_pole_rad_s: hil design"
    )
