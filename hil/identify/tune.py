"""`hil tune`: from the identified motor, its noise and a wish to a configuration and its yield.

The design is :mod:`hil.tuning`'s, the spread of its corners the intervals' half-widths; the yield comes from
a campaign of simulated cases whose motors are drawn from the intervals.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from hil.campaign.case import Stand
from hil.campaign.plan import PlanTable
from hil.campaign.values import toml
from hil.config.motor import MotorTable
from hil.config.tables import RunConfig, validate
from hil.config.toml import override, read_toml
from hil.errors import HilError
from hil.runtime.setup import Overrides
from hil.tuning.bench import coupled, identified_shafts, speed_drive
from hil.tuning.design import Wish, design

LEAST_SPREAD: Final = 0.01
"""Share by which each parameter is taken to be off at least."""
UNKNOWN_SPREAD: Final = 0.3
"""The same for a parameter without an interval."""
GROUPS: Final = {"J": ("J_kg_m2",), "psi_f": ("psi_f_wb",), "R_s": ("R_s_ohm",), "L": ("L_d_h", "L_q_h")}
WITHIN: Final = 1.15
"""Dip and recovery of a case may exceed the prediction so far."""


def interval(motor: MotorTable, key: str) -> tuple[float, float]:
    """The 95 % interval of a key, widened to LEAST_SPREAD; UNKNOWN_SPREAD without one."""
    value, known = getattr(motor, key), motor.identified
    if known is None or key not in known.low or key not in known.high:
        return value * (1 - UNKNOWN_SPREAD), value * (1 + UNKNOWN_SPREAD)
    least = LEAST_SPREAD * value
    return min(known.low[key], value - least), max(known.high[key], value + least)


def spread_of(motor: MotorTable) -> dict[str, float]:
    """Shares of the design's corners."""
    shares = {}
    for name, keys in GROUPS.items():
        ends = [(getattr(motor, key), *interval(motor, key)) for key in keys]
        shares[name] = min(0.9, max(max(high - value, value - low) / value for value, low, high in ends))
    return shares


def tune(
    path: Path, overrides: Overrides, wish: Wish, load: float | None, cases: int, seen: Callable[[int], None]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The result, and the configuration's data. Raises HilError when no design keeps the wish."""
    setup = speed_drive(path, overrides)
    motor = setup.config.motor
    known = motor.identified
    spread = spread_of(motor)
    found, best = design(path, overrides, wish, {"load": load}, spread)
    data = tuned_data(path, overrides, motor, best.tables)
    result = {
        "config": str(path),
        "identified": known is not None,
        "spread": spread,
        "tables": best.tables,
        "predicted": {
            key: found[key]
            for key in ("iae", "u_noise_mv", "command_noise", "ms", "ms_worst", "worst_recovery_ms")
            if key in found
        },
        "margins": found["margins"],
        "shaft": found["bench"]["shafts"][:1] if found["bench"]["elastic"] else [],
        "limited_by": found["limited_by"],
        "limits": limits_in_words(found["limited_by"], setup.config),
        "bench": found["bench"],
        "findings": found["findings"],
    }
    dip, recovery = float(best.verdict.nominal.dip), float(best.verdict.nominal.recovery_ms)
    result["predicted"] |= {"dip_rad_s": dip, "recovery_ms": recovery}
    result["predicted"] |= {"worst_dip_rad_s": float(best.verdict.worst.dip)}
    result["yield"] = yield_of(
        path, data, motor, float(found["bench"]["load"]), dip, cases, seen, identified_shafts(setup)
    )
    return result, data


def limits_in_words(names: list[str], config: RunConfig) -> str:
    """What keeps the design from being better."""
    said = {
        "u_noise": "noise in u_q" if config.drive.takes == "voltage" else "noise in the command",
        "ms": "margin (Ms)",
        "ms_worst": "margin in the worst corner of the intervals",
        "dip": "the dip that is wished for",
        "recovery_ms": "the recovery that is wished for",
    }
    return ", ".join(said.get(name, name) for name in names) or (
        f"the delay of one tick at {config.loop.rate_hz} Hz and the bounds of the search"
    )


def tuned_data(path: Path, overrides: Overrides, motor: MotorTable, tables: dict[str, Any]) -> dict[str, Any]:
    """The configuration's own keys with the motor and the design in their place."""
    data = read_toml(path)
    for text in overrides.as_settings():
        override(data, text, path.parent)
    data["motor"] = motor.model_dump(exclude_none=True)
    data["controller"] = tables["controller"]
    data["observer"] = {name: table for name, table in tables.items() if name != "controller"}
    validate(data, RunConfig, str(path), path.parent)
    return data


def written(data: dict[str, Any], path: Path, to: Path) -> str:
    """The configuration as TOML for the file ``to``; the files that it names stay where they are."""
    here, there = path.parent.resolve(), to.parent.resolve()
    lines = ["# Written by hil tune from the identified motor.", ""]
    for name, table in data.items():
        if not isinstance(table, dict):
            lines.append(f"{name} = {toml(table)}")
    for name, table in data.items():
        if isinstance(table, dict):
            rows = {key: _moved(value, here, there) for key, value in table.items()}
            lines += ["", f"[{name}]", *(f"{key} = {toml(value)}" for key, value in rows.items())]
    return "\n".join(lines) + "\n"


def _moved(value: Any, here: Path, there: Path) -> Any:
    """A path of a file that is there, relative to the new folder."""
    if isinstance(value, str) and value.endswith((".dbc", ".toml")) and (here / value).is_file():
        return os.path.relpath(here / value, there)
    return value


def yield_of(
    path: Path, data: dict[str, Any], motor: MotorTable, load: float, dip: float, cases: int,
    seen: Callable[[int], None], shafts: Sequence[tuple[float, float, float]] = (),
) -> dict[str, Any] | None:  # fmt: skip
    """How many motors of the intervals keep the predicted dip; None without an emulated plant, or cases.

    The load is a step of the design's size, as long as the run; friction is the plant's own. ``shafts``: the
    coupling that was identified and the ends of its intervals.
    """
    if cases == 0 or data.get("emulator") is None:
        return None
    keys = [key for group in GROUPS.values() for key in group]
    random = {f"plant:motor.{key}": {"uniform": list(interval(motor, key))} for key in keys}
    coupling = coupled(shafts[0]) if shafts else []
    for key, column in (
        ("resonance_hz", [f for f, _, _ in shafts]),
        ("inertia_ratio", [1 / s - 1 for _, _, s in shafts]),
    ):
        if column:
            random[f"plant:coupling.{key}"] = {"uniform": [min(column), max(column)]}
    at = {"kind": "step", "torque_n_m": load, "at_s": 2.5, "until_s": 4.0}
    settings = [f"{name}={toml(table)}" for name, table in data.items() if isinstance(table, dict)]
    table = PlanTable.model_validate(
        {
            "config": str(path),
            "samples": cases,
            "set": [*settings, "loop.duration_s=5.0"],
            "plant_set": [f"load=[{toml(at)}]", *coupling],
            "random": random,
            "criteria": {"dip_max_rad_s": WITHIN * dip},
        }
    )
    stand = Stand(path, table, str(path))
    rows = []
    for case in range(stand.plan.count):
        rows.append(stand.run(case))
        seen(len(rows))
    passed = sum(bool(row["passed"]) for row in rows)
    dips = [row["dip_rad_s"] for row in rows if row.get("dip_rad_s") is not None]
    why = sorted({str(row["why"]) for row in rows if not row["passed"]})
    worst = max(dips, default=None)
    return {
        "cases": len(rows),
        "passed": passed,
        "share": passed / len(rows),
        "worst_dip_rad_s": worst,
        "why": why,
    }


def at_motor(overrides: Overrides, motor: Path | None) -> Overrides:
    """The overrides with the identified motor's file. Raises HilError when there is none."""
    if motor is None:
        return overrides
    if not motor.is_file():
        raise HilError(f"{motor}: no such file; hil identify writes one")
    return replace(overrides, settings=(f"motor={json.dumps(str(motor.resolve()))}", *overrides.settings))
