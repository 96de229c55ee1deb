"""`hil design --verify`: in `hil simulate` and on the lockstep bus, 18 plants, or 6 behind a current loop.

A drive with a current loop of its own may take other ticks to start than the simulated one, and then has
other noise: its run on the bus need not be the same to the bit, but as near as a prediction has to be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hil.log.reader import open_log
from hil.runtime.session import run
from hil.runtime.setup import Overrides, load_setup
from hil.sim.demo import emulator_process, own_channel
from hil.sim.simulate import simulate_ticks
from hil.tuning.bench import Seen, bench_of, corner_settings, seen_in
from hil.tuning.families import Tables, settings_of
from hil.tuning.loop import Record
from hil.tuning.measure import loops, noise, noise_in

DIP_WITHIN: Final = 0.05
NOISE_WITHIN: Final = 0.15


def plants_of(bench: Any) -> dict[str, list[str]]:
    """The plant of the config's file, the believed motor, and every corner of the spread."""
    corners = corner_settings(bench)
    m = bench.motor
    exact = (
        f"motor={{R_s_ohm = {m.R_s!r}, L_d_h = {m.L_d!r}, L_q_h = {m.L_q!r}, psi_f_wb = {m.psi_f!r}, "
        f"n_p = {m.n_p}, J_kg_m2 = {m.J!r}, B_f_n_m_s = {m.B_f!r}}}"
    )
    named = {"as in the plant's file": [], "as believed": [exact]}
    return named | {f"corner {j + 1}": one for j, one in enumerate(corners)}


def on_the_bus(path: Path, overrides: Overrides, plant: list[str]) -> Any:
    """The ticks of a lockstep run with the emulator as a process."""
    lockstep = (*overrides.settings, 'loop.clock="lockstep"')
    overrides = replace(overrides, channel=own_channel("verify"), settings=lockstep)
    with emulator_process(path, overrides, tuple(plant)):
        result = run(load_setup(path, overrides))
    return open_log(Path(result.log)).ticks


def verify(
    path: Path, overrides: Overrides, tables: Tables, given: dict[str, Any], spread: dict[str, float],
    law: Record, seen: Callable[[int], None],
) -> dict[str, Any]:  # fmt: skip
    """Run the design everywhere; ``ok`` when every dip and noise is as predicted and the bus agrees.

    The bus agrees when it gave the same bits; behind a current loop, when dip and noise are as near.
    """
    overrides = replace(overrides, settings=(*overrides.settings, *settings_of(tables)))
    setup = load_setup(path, overrides)
    bench = bench_of(path, setup, given, spread=spread)
    plants = bench.plants()
    predicted = zip(loops(law, bench, plants), (noise(law, bench, one)[0] for one in plants), strict=True)
    said = dict(zip(list(plants_of(bench))[1:], predicted, strict=True))
    rows: list[dict[str, Any]] = []
    for name, plant in plants_of(bench).items():
        ticks = simulate_ticks(setup, plant)
        own, bus = seen_in(ticks, bench.T_s), on_the_bus(path, overrides, plant)
        row = {"plant": name, "dip": own.dip, "recovery_ms": own.recovery_ms, "iae": own.iae}
        row |= {**noise_in(bench.unit, own.u_noise), "bus_same": same_run(ticks, bus)}
        row |= beside(own, seen_in(bus, bench.T_s))
        if name in said:
            loop, u = said[name]
            row |= {"predicted_dip": loop.dip, "dip_off": own.dip / loop.dip - 1}
            row |= {f"predicted_{key}": value for key, value in noise_in(bench.unit, u).items()}
            row |= {"u_noise_off": own.u_noise / u - 1}
        rows.append(row)
        seen(len(rows))
    return verdict(rows, exact=bench.inner is None)


def beside(own: Seen, bus: Seen) -> dict[str, float]:
    """How far the run on the bus is off the simulated one."""
    return {"bus_dip_off": bus.dip / own.dip - 1, "bus_noise_off": bus.u_noise / own.u_noise - 1}


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
