"""`hil design --verify`: in `hil simulate` and on the lockstep bus, 18 plants, or 6 behind a current loop.

A drive with a current loop of its own may take other ticks to start than the simulated one, and then has
other noise: its run on the bus need not be the same to the bit, but as near as a prediction has to be.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.runtime.setup import Overrides, Setup, load_setup
from hil.sim.demo import closed_loop, own_channel
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import Seen, bench_of, coupled, plant_settings, seen_in
from hil.tuning.families import Tables, settings_of
from hil.tuning.foretell import foretold
from hil.tuning.loop import Record
from hil.tuning.measure import Bench, noise_in

DIP_WITHIN: Final = 0.05
NOISE_WITHIN: Final = 0.15
SEEDS: Final = 4
MOST_SEEDS: Final = 128
CERTAIN: Final = 0.04
"""Standard error of the noise, share, beyond which there are more runs."""


def plants_of(bench: Bench) -> dict[str, list[str]]:
    """The plant of the file, the believed motor, and every corner of the spread; on elastic shafts."""
    exact, *corners = plant_settings(bench)
    named = {"as in the plant's file": coupled(bench.turns()[0]), "as believed": exact}
    return named | {f"corner {j + 1}": one for j, one in enumerate(corners)}


def on_the_bus(path: Path, overrides: Overrides, plant: list[str]) -> Any:
    """The ticks of a lockstep run with the emulator as a process."""
    lockstep = (*overrides.settings, 'loop.clock="lockstep"')
    overrides = replace(overrides, channel=own_channel("verify"), settings=lockstep)
    return closed_loop(path, overrides, tuple(plant))[2].ticks


def verify(
    path: Path, overrides: Overrides, tables: Tables, given: dict[str, Any], spread: dict[str, float],
    law: Record, seen: Callable[[int], None], shafts: tuple[tuple[float, float, float], ...] = (),
) -> dict[str, Any]:  # fmt: skip
    """Run the design everywhere; ``ok`` when every dip and noise is as predicted and the bus agrees.

    With elastic ``shafts`` (Hz, damping, motor's share of J) every plant has one, of several in turn.

    The bus agrees when it gave the same bits; behind a current loop, when dip and noise are as near.
    """
    overrides = replace(overrides, settings=(*overrides.settings, *settings_of(tables)))
    setup = load_setup(path, overrides)
    bench = bench_of(path, setup, given, spread=spread, shafts=shafts)
    said = dict(zip(list(plants_of(bench))[1:], foretold(law, bench), strict=True))
    rows: list[dict[str, Any]] = []
    for name, plant in plants_of(bench).items():
        ticks = simulate_ticks(setup, plant)
        own, bus = seen_in(ticks, bench.T_s), on_the_bus(path, overrides, plant)
        u_noise = mean_noise(setup, plant, own, bench.T_s)
        row = {"plant": name, "dip": own.dip, "recovery_ms": own.recovery_ms, "iae": own.iae}
        row |= {**noise_in(bench.unit, u_noise), "bus_same": same_run(ticks, bus)}
        row |= beside(own, seen_in(bus, bench.T_s))
        if name in said:
            dip, u = said[name]
            row |= {"predicted_dip": dip, "dip_off": off(own.dip, dip)}
            row |= {f"predicted_{key}": value for key, value in noise_in(bench.unit, u).items()}
            row |= {"u_noise_off": off(u_noise, u)}
        rows.append(row)
        seen(len(rows))
    return verdict(rows, exact=bench.inner is None)


def mean_noise(setup: Setup, plant: list[str], own: Seen, T_s: float) -> float:
    """Noise of the command, rms, over SEEDS runs and more while their scatter leaves it uncertain.

    Half a second of one alone has it to 5 % (one sigma); of a loop that rings for long, to 40 %.
    """
    squares = [own.u_noise**2]
    while math.isfinite(squares[-1]) and len(squares) < MOST_SEEDS and not _certain(squares):
        seed = f"seed={len(squares)}"
        squares.append(seen_in(simulate_ticks(setup, [*plant, seed]), T_s).u_noise ** 2)
    return float(np.sqrt(np.mean(squares)))


def _certain(squares: list[float]) -> bool:
    """Whether the root of their mean has a standard error within CERTAIN; of SEEDS at least."""
    count = len(squares)
    return count >= SEEDS and bool(
        0.5 * np.std(squares, ddof=1) <= CERTAIN * math.sqrt(count) * np.mean(squares)
    )


def beside(own: Seen, bus: Seen) -> dict[str, float]:
    """How far the run on the bus is off the simulated one."""
    return {"bus_dip_off": off(bus.dip, own.dip), "bus_noise_off": off(bus.u_noise, own.u_noise)}


def off(value: float, wanted: float) -> float:
    """By which share a measure is off; infinite where one or both are of a loop that did not hold."""
    return value / wanted - 1 if math.isfinite(value) and math.isfinite(wanted) else math.inf


def verdict(rows: list[dict[str, Any]], exact: bool = True) -> dict[str, Any]:
    """The worst of all plants, and whether it is near enough; ``exact``: the bus has to give the bits."""
    dips, noises = (max(abs(row[key]) for row in rows if key in row) for key in ("dip_off", "u_noise_off"))
    same = all(row["bus_same"] for row in rows)
    bus = [max(abs(row[key]) for row in rows) for key in ("bus_dip_off", "bus_noise_off")]
    agrees = same or (not exact and bus[0] <= DIP_WITHIN and bus[1] <= NOISE_WITHIN)
    return {
        "rows": rows,
        "worst_dip_off": dips,
        "worst_noise_off": noises,
        "bus_same": same,
        "worst_bus_dip_off": bus[0],
        "worst_bus_noise_off": bus[1],
        "ok": dips <= DIP_WITHIN and noises <= NOISE_WITHIN and agrees,
    }


def same_run(ticks: Any, bus: Any) -> bool:
    """Whether speed and command of both are the same to the bit for as long as both ran."""
    count = min(len(ticks), len(bus))
    return count > 0 and all((ticks[name][:count] == bus[name][:count]).all() for name in ("w", "u_q", "u_d"))
