"""The same engine over logs: verdict and figures of thousands of them, or another controller over each.

A log that cannot be read is a row with the reason.
"""

from __future__ import annotations

import glob
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hil.campaign import engine, store
from hil.campaign.engine import Rate, Row, Workers
from hil.campaign.run import Seen
from hil.campaign.store import Folder, Schema
from hil.config.tables import RunConfig, load_toml
from hil.errors import HilError
from hil.log.parts import grouped
from hil.replay.whatif import COMPARED, what_if
from hil.report.collect import collect_nodes
from hil.report.criteria import FIGURES, figures, judge

LOGS_A_BATCH: Final = 8
ALONE: Final = 16
"""So few logs are read sooner in this process than workers are started."""
TEXTS: Final = ("log", "verdict", "ended", "why")
HEAD: Final[Schema] = {"case": "i8", **dict.fromkeys(TEXTS, "text"), "passed": "bool"}


def logs_of(places: Sequence[str]) -> list[Path]:
    """Every log of files, folders (at any depth) and patterns, each once. Raises HilError for none."""
    found: dict[Path, None] = {}
    for place in places:
        path = Path(place)
        if path.is_dir():
            more = sorted(path.rglob("*.mcap"))
        else:
            more = [path] if path.is_file() else sorted(map(Path, glob.glob(place, recursive=True)))  # noqa: PTH207 - an absolute pattern, too
        found |= dict.fromkeys(p.resolve() for p in more if p.is_file())
        if not more:
            raise HilError(f"{place}: no log there; name a folder, a file or a pattern of .mcap files")
    return list(found)


@dataclass(frozen=True)
class FleetJob:
    """Runs of one or more files each; ``config``: the controller to try, None: replay and report."""

    runs: tuple[tuple[str, ...], ...]
    config: str | None = None

    @property
    def unit(self) -> str:
        """What is counted."""
        return "logs"

    @property
    def schema(self) -> Schema:
        """The columns of a row."""
        if self.config is None:
            return HEAD | dict.fromkeys((figure.key for figure in FIGURES), "f8")
        return (
            HEAD | {f"{name}_{what}": "f8" for name in COMPARED for what in ("rms", "max")} | {"ticks": "i8"}
        )

    def run(self, start: int, stop: int) -> list[Row]:
        """The rows of the logs from ``start`` up to ``stop``."""
        return [self._row(case) for case in range(start, stop)]

    def _row(self, case: int) -> Row:
        paths = tuple(map(Path, self.runs[case]))
        row: Row = {"case": case, "log": str(paths[0])}
        try:
            return row | (_judged(paths) if self.config is None else _tried(paths, Path(self.config)))
        except Exception as error:  # noqa: BLE001 - one log that can't be read is a row, not the fleet's end
            why = str(error).strip().splitlines() or [type(error).__name__]
            return row | {"verdict": "cannot", "ended": "unreadable", "passed": False, "why": why[0]}


def _judged(paths: tuple[Path, ...]) -> Row:
    """Replay and figures of a run; of one with several nodes the worst verdict, and the first's figures."""
    runs = collect_nodes(paths)
    missed = [(run.node, check) for run in runs for check in judge(run) if check.outcome != "pass"]
    why = "; ".join(f"{node} {check.name}: {check.found}".lstrip() for node, check in missed)
    worst = max(runs, key=lambda run: run.verdict.exit_code).verdict
    head: Row = {"verdict": worst.verdict, "ended": runs[0].ended, "passed": not missed, "why": why}
    return head | figures(runs[0])


def _tried(paths: tuple[Path, ...], config: Path) -> Row:
    """Another controller over the log, open loop."""
    found = what_if(paths, config, load_toml(config, RunConfig, []))
    out: Row = {"verdict": "tried", "ended": "what-if", "passed": True, "why": "", "ticks": found.ticks}
    for name, spread in found.spreads.items():
        out |= {f"{name}_rms": spread.rms, f"{name}_max": spread.top}
    return out


def fleet(
    places: Sequence[str],
    *,
    config: Path | None = None,
    folder: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    seen: Seen | None = None,
) -> tuple[list[Row], Folder | None]:
    """Rows of all logs in their order, kept in ``folder`` when one is named. Raises HilError."""
    runs = grouped(logs_of(places))
    if config is not None:
        load_toml(config, RunConfig, [])  # mistakes at once, not once a log
    job = FleetJob(
        tuple(tuple(map(str, run)) for run in runs), None if config is None else str(config.resolve())
    )
    few = len(runs) <= ALONE and scheduler is None
    used = Workers((0 if few else engine.cores()) if workers is None else workers, scheduler)
    held = None if folder is None else store.make(folder, _about(job), (), resume=resume)
    rows: list[Row] = []
    rate = Rate(len(runs), 0 if held is None else int(held.done().sum()))

    def take(more: list[Row]) -> None:
        rows.extend(more)
        if held is not None:
            held.add(more)
        rate.add(len(more))
        if seen:
            seen(rate)

    spans = iter([(0, len(runs))]) if held is None else held.open_spans()
    size = max(1, min(LOGS_A_BATCH, len(runs) // max(1, 4 * used.count)))
    try:
        engine.run(job, engine.batches(spans, size), used, take)
    finally:
        if held is not None:
            held.flush()
    return sorted(rows, key=lambda row: int(row["case"])), held


def _about(job: FleetJob) -> dict[str, Any]:
    """What a folder of a fleet says of itself; the logs by name and size, for --resume."""
    names = [(run, [Path(path).stat().st_size for path in run]) for run in job.runs]
    config = "" if job.config is None else Path(job.config).read_text(encoding="utf-8")
    digest = hashlib.sha256(json.dumps([names, config]).encode()).hexdigest()
    plan = json.dumps({"logs": digest, "variants": {}})
    return {"kind": "fleet", "plan": plan, "count": len(job.runs), "schema": job.schema, "files": {}}


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """How many logs there are of each verdict, and how many pass."""
    verdicts = [row["verdict"] for row in rows]
    out = {name: verdicts.count(name) for name in ("same", "differs", "cannot", "tried") if name in verdicts}
    passed = sum(bool(row["passed"]) for row in rows)
    return {"logs": len(rows), **out, "passed": passed, "failed": len(rows) - passed}
