"""`hil simulate --sweep`: the same run over every combination of some settings, side by side on all cores."""

from __future__ import annotations

import itertools
import os
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.app import Overrides, Setup, load_setup
from hil.demo import true_motor
from hil.design import motor_model
from hil.emulate import load_plant
from hil.errors import ConfigError
from hil.metrics import load_step, tracking_rms
from hil.reasons import explain
from hil.signals import Reason, TickArray
from hil.simulate import simulate_ticks

MOST_CASES = 10_000


@dataclass(frozen=True, slots=True)
class Case:
    """One combination: ``config`` and ``plant`` are settings as ``--set`` and ``--plant-set`` take them."""

    config: tuple[str, ...]
    plant: tuple[str, ...]


def axis(flag: str, text: str) -> list[str]:
    """``KEY=[v1, v2, ...]`` (a TOML array) as one setting a value. Raises ConfigError."""
    key, equals, values = text.partition("=")
    try:
        found = tomllib.loads(f"values = {values}")["values"] if equals and key.strip() else None
    except tomllib.TOMLDecodeError:
        found = None
    if not isinstance(found, list) or not found:
        raise ConfigError(flag, [f"{text!r} is not of the form table.key=[value, value, ...]"])
    return [f"{key.strip()}={_toml(value)}" for value in found]


def _toml(value: Any) -> str:
    return (
        f'"{value}"'
        if isinstance(value, str)
        else str(value).lower()
        if isinstance(value, bool)
        else repr(value)
    )


def cases(sweep: Sequence[str], plant_sweep: Sequence[str]) -> list[Case]:
    """Every combination of the axes. Raises ConfigError, also for more than MOST_CASES."""
    own = [axis("--sweep", text) for text in sweep]
    plant = [axis("--plant-sweep", text) for text in plant_sweep]
    count = int(np.prod([len(values) for values in own + plant]))
    if count > MOST_CASES:
        raise ConfigError("--sweep", [f"{count} combinations; at most {MOST_CASES}"])
    return [Case(one[: len(own)], one[len(own) :]) for one in itertools.product(*own, *plant)]


def _end(setup: Setup, ticks: TickArray) -> dict[str, Any] | None:
    """Why a case ended; sums of the supervisor are not kept here."""
    stopped = ticks[ticks["reason"] != 0]
    end = explain(setup.machine.safety, None, stopped[0]) if len(stopped) else None
    return end.as_dict() if end else None


def run_case(path: Path, overrides: Overrides, plant_settings: list[str], case: Case) -> dict[str, Any]:
    """Simulate one case: its settings, how it ended, and the metrics of tracking and load step."""
    setup = load_setup(path, replace(overrides, settings=(*overrides.settings, *case.config)))
    plant_all = [*plant_settings, *case.plant]
    ticks = simulate_ticks(setup, plant_all)
    plant, _ = load_plant(path, setup.config, plant_all)
    N = int(setup.machine.law["N"][0, 0])
    step = load_step(ticks, N, motor_model(setup.config.motor), true_motor(plant.motor))
    return {
        "case": [*case.config, *case.plant],
        "ended": Reason(int(ticks["reason"][-1])).name.lower(),
        "end": _end(setup, ticks),
        "tracking_rms_rad_s": tracking_rms(ticks),
        "dip_rad_s": step.dip if step else None,
        "recovery_ms": step.recovery_ms if step else None,
        "i_max_a": float(np.nanmax(np.hypot(ticks["i_q"], ticks["i_d"]))),
    }


def sweep(
    path: Path,
    overrides: Overrides,
    plant_settings: list[str],
    all_cases: list[Case],
    seen: Callable[[int], None] | None = None,
) -> list[dict[str, Any]]:
    """Simulate every case, in their order; ``seen`` is told how many are done. Raises HilError."""
    rows = [
        run_case(path, overrides, plant_settings, all_cases[0])
    ]  # here: mistakes at once, kernels compiled
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = [pool.submit(run_case, path, overrides, plant_settings, case) for case in all_cases[1:]]
        for future in futures:
            rows.append(future.result())
            if seen:
                seen(len(rows))
    return rows
