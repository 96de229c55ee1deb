"""`hil simulate --sweep`: a campaign of a grid, small enough for a table and without a folder."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from hil.campaign.case import CaseJob, Stand, job_of
from hil.campaign.engine import batches, run
from hil.campaign.plan import PLANT, PlanTable
from hil.campaign.run import batch_size, ticks_of, where
from hil.campaign.values import toml
from hil.errors import ConfigError
from hil.runtime.setup import Overrides

MOST_CASES: Final = 10_000


def axis(flag: str, text: str) -> tuple[str, list[Any]]:
    """``KEY=[v1, v2, ...]`` (a TOML array) as key and values. Raises ConfigError."""
    key, equals, values = text.partition("=")
    try:
        found = tomllib.loads(f"values = {values}")["values"] if equals and key.strip() else None
    except tomllib.TOMLDecodeError:
        found = None
    if not isinstance(found, list) or not found:
        raise ConfigError(flag, [f"{text!r} is not of the form table.key=[value, value, ...]"])
    return key.strip(), found


def job_of_sweep(
    path: Path,
    overrides: Overrides,
    plant_settings: list[str],
    sweep: Sequence[str],
    plant_sweep: Sequence[str],
) -> tuple[CaseJob, Stand]:
    """The campaign that a sweep is: a grid in which every combination is a case. Raises ConfigError."""
    grid = [axis("--sweep", text) for text in sweep]
    grid += [(PLANT + key, values) for key, values in (axis("--plant-sweep", text) for text in plant_sweep)]
    count = math.prod(len(values) for _, values in grid)
    if count > MOST_CASES:
        raise ConfigError("--sweep", [f"{count} combinations; at most {MOST_CASES}: take hil campaign"])
    table = PlanTable.model_validate(
        {
            "config": path.name,
            "set": overrides.as_settings(),
            "plant_set": plant_settings,
            "grid": dict(grid),
        }
    )
    return job_of(path, table)


def sweep(job: CaseJob, stand: Stand, seen: Callable[[int], None] | None = None) -> list[dict[str, Any]]:
    """Simulate every case, in their order; ``seen`` is told how many are done. Raises HilError."""
    rows: list[dict[str, Any]] = []

    def take(more: list[dict[str, Any]]) -> None:
        rows.extend(more)
        if seen:
            seen(len(rows))

    count = stand.plan.count
    used = where(stand, None, None)
    size = batch_size(ticks_of(stand), count, used.count)
    run(job, batches(iter([(0, count)]), size), used, take)
    return [_row(stand, row) for row in sorted(rows, key=lambda row: int(row["case"]))]


def _row(stand: Stand, row: dict[str, Any]) -> dict[str, Any]:
    """A case as a sweep shows it."""
    recovery = row.get("recovery_s")
    settings = stand.plan.settings(row["case"])
    return {
        "case": [f"{key.removeprefix(PLANT)}={toml(value)}" for key, value in settings.items()],
        "ended": row["ended"],
        "why": row["why"],
        "end": row.get("end"),
        "tracking_rms_rad_s": row.get("tracking_rms_rad_s"),
        "dip_rad_s": row.get("dip_rad_s"),
        "recovery_ms": None if recovery is None else 1e3 * recovery,
        "i_max_a": row.get("i_peak_a"),
    }
