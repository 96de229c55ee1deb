"""`hil identify --from`: what runs that are logged already tell of the motor, and whether it drifts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.config.motor import MotorTable
from hil.config.tables import RunConfig, validate
from hil.errors import ConfigError, HilError
from hil.identify.estimate import Estimate
from hil.identify.innerloop import estimate_for
from hil.identify.motorfile import KEYS, SHAFT_KEYS, motor_of
from hil.identify.plan import excites_shaft
from hil.log.parts import grouped
from hil.log.reader import open_log
from hil.signals import TickArray


@dataclass(frozen=True, slots=True)
class Logged:
    """A run from its log: its own configuration, its ticks and what they tell."""

    path: Path
    started: str
    config: RunConfig
    ticks: TickArray
    found: Estimate

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "log": str(self.path),
            "started": self.started,
            "parameters": {name: p.as_dict() for name, p in self.found.parameters.items()},
            "findings": self.found.findings,
            "faults": self.found.faults,
        }


def read(paths: tuple[Path, ...]) -> Logged:
    """Estimate from one run. Raises HilError for a log without what it takes."""
    log = open_log(paths if len(paths) > 1 else paths[0], frames=False)
    text = log.attachments.get("config.json")
    if text is None:
        raise HilError(f"{paths[0]}: holds no configuration; hil identify needs a run's own log")
    try:
        config = validate(json.loads(text), RunConfig, f"{paths[0]}: config.json", None)
    except ValueError as error:
        raise HilError(f"{paths[0]}: its configuration can't be read ({error})") from error
    needs = {"ua_q", "ua_d", "w", "i_q", "i_d"} if config.drive.takes == "voltage" else {"u_q", "w"}
    if log.absent & needs:
        raise HilError(f"{paths[0]}: its ticks lack what was measured or applied")
    found = estimate_for(config, config.motor, [log.ticks])
    return Logged(paths[0], log.metadata.get("run", {}).get("started", ""), config, log.ticks, found)


def drift(runs: Sequence[Logged]) -> dict[str, dict[str, Any]]:
    """How each parameter moves from run to run: its change from first to last, and whether intervals part.

    ``drifts``: some two runs' 95 % intervals, widened by half for being many, do not meet.
    """
    out: dict[str, dict[str, Any]] = {}
    for name in (*KEYS, *SHAFT_KEYS, "coulomb", "k_t_over_J", "lag"):
        found = [run.found.parameters[name] for run in runs if name in run.found.parameters]
        told = [p for p in found if p.told]
        if len(told) < 2:
            continue
        value, half = np.array([p.value for p in told]), np.array([1.5 * p.half for p in told])
        apart = float(np.max(value - half) - np.min(value + half))
        change = float(value[-1] - value[0])
        share = 100.0 * change / abs(float(value[0])) if value[0] else None
        out[name] = {"runs": len(told), "change": change, "change_percent": share, "drifts": apart > 0.0}
    return out


def from_logs(paths: Sequence[Path]) -> tuple[dict[str, Any], Estimate, MotorTable, RunConfig]:
    """All runs together, each by itself, and the drift. Raises HilError."""
    runs = sorted((read(parts) for parts in grouped(paths)), key=lambda run: run.started)
    kinds = {(run.config.loop.rate_hz, run.config.motor.n_p, run.config.drive.takes) for run in runs}
    if len(kinds) > 1:
        differ = (
            "the runs differ in loop.rate_hz, n_p or what the drive takes; they are of no one motor and loop"
        )
        raise ConfigError("--from", [differ])
    last = runs[-1].config
    whole = runs[0].found
    if len(runs) > 1:
        kinds_of = [
            [run.ticks for run in runs if excites_shaft(run.config) is rings] for rings in (False, True)
        ]
        whole = estimate_for(last, last.motor, *kinds_of)
    result = {
        **whole.as_dict(),
        "logs": [str(run.path) for run in runs],
        "runs": [run.as_dict() for run in runs],
        "drift": drift(runs),
        "ok": not whole.faults and whole.tells,
    }
    return result, whole, motor_of(whole, last.motor), last
