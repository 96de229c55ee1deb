"""`hil design --verify`: the design in `hil simulate` and on the lockstep bus, over 18 plants."""

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
from hil.tuning.bench import bench_of, corner_settings, seen_in
from hil.tuning.families import Tables, settings_of
from hil.tuning.loop import Record
from hil.tuning.measure import loops, noise

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
    """Run the design everywhere; ``ok`` when every dip and noise is as predicted and the bus agrees."""
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
        row |= {"u_noise_mv": own.u_noise * 1e3, "bus_same": same_run(ticks, bus)}
        if name in said:
            loop, u = said[name]
            row |= {"predicted_dip": loop.dip, "dip_off": own.dip / loop.dip - 1}
            row |= {"predicted_u_noise_mv": u * 1e3, "u_noise_off": own.u_noise / u - 1}
        rows.append(row)
        seen(len(rows))
    return verdict(rows)


def verdict(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The worst of all plants with a prediction, and whether it is near enough."""
    dips, noises = (max(abs(row[key]) for row in rows if key in row) for key in ("dip_off", "u_noise_off"))
    same = all(row["bus_same"] for row in rows)
    return {
        "rows": rows,
        "worst_dip_off": dips,
        "worst_noise_off": noises,
        "bus_same": same,
        "ok": dips <= DIP_WITHIN and noises <= NOISE_WITHIN and same,
    }


def same_run(ticks: Any, bus: Any) -> bool:
    """Whether speed and voltage of both are the same to the bit for as long as both ran."""
    count = min(len(ticks), len(bus))
    return count > 0 and all((ticks[name][:count] == bus[name][:count]).all() for name in ("w", "u_q", "u_d"))
