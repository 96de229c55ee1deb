"""``hil.campaign(plan, folder)``: a plan over the workers into a folder, and what came out."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hil.campaign import engine, store
from hil.campaign.case import CaseJob, Stand, job_of
from hil.campaign.engine import Rate, Workers
from hil.campaign.figures import KEYS
from hil.campaign.margins import design_margins
from hil.campaign.onbus import CASE_S
from hil.campaign.page import page
from hil.campaign.plan import PLANT, PlanTable, read_plan
from hil.campaign.store import Folder, Schema, kind_of
from hil.errors import HilError
from hil.log.outputs import output_file

BATCH_TICKS: Final = 700_000
"""Ticks of a batch: about half a second of a core; what a lost worker takes along."""
WORKERS_OF_SHORT: Final = 64
ALONE_TICKS: Final = 400_000
"""A campaign of fewer ticks is done sooner in this process than workers are started."""
PAGE: Final = "report.html"
TICK_S: Final = 0.85e-6
FIRSTS: Final = 64
"""Cases that are looked at to see how many go over the bus."""
START_S: Final = 4.0
"""Imports, start of the workers and report."""
ROW_BYTES: Final = 130
Seen = Callable[[Rate], None]


@dataclass(frozen=True, slots=True)
class Result:
    """What a campaign came to; ``folder`` has its rows."""

    folder: Folder
    cases: int
    passed: int
    seconds: float
    cases_per_s: float

    @property
    def failed(self) -> int:
        """Cases that did not pass: refused, ended otherwise than asked, or outside of [criteria]."""
        return self.cases - self.passed

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "cases": self.cases,
            "failed": self.failed,
            "passed": self.passed,
            "seconds": self.seconds,
            "cases_per_s": self.cases_per_s,
            "folder": str(self.folder.path),
            "report": str(self.folder.path / PAGE),
        }

    def rows(self) -> list[dict[str, Any]]:
        """Every row, in the order of the cases; for as many as fit into memory."""
        found = self.folder.columns(*self.folder.schema)
        return [
            dict(zip(found, values, strict=True))
            for values in zip(*(v.tolist() for v in found.values()), strict=True)
        ]


def schema_of(stand: Stand) -> Schema:
    """Kinds of a campaign's columns."""
    listed = stand.plan.listed()
    known: Schema = {"case": "i8", "sample": "i8", "seed": "i8", "passed": "bool"}
    figures: Schema = dict.fromkeys(KEYS, "f8")
    known |= figures | {key: kind_of(values) for key, values in listed.items()}
    return {name: known.get(name, "text") for name in stand.columns()}


def about_of(job: CaseJob, stand: Stand) -> dict[str, Any]:
    """What a folder says of itself."""
    return {
        "kind": "campaign",
        "name": stand.plan.name,
        "plan": job.table,
        "config": job.config,
        "count": stand.plan.count,
        "schema": schema_of(stand),
        "limits": stand.limits,
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in job.files},
    }


def ticks_of(stand: Stand) -> int:
    """Ticks of a case of the base."""
    return max(
        1, round(float(stand.own("loop.duration_s") or 1.0) * float(stand.own("loop.rate_hz") or 1000))
    )


def work_of(stand: Stand) -> int:
    """What a case costs, in ticks of a simulation: of the first ones, some may go over the bus."""
    firsts = min(stand.plan.count, FIRSTS)
    on_bus = sum(map(stand.on_bus, range(firsts))) if f"{PLANT}fault" in stand.plan.keys else 0
    return ticks_of(stand) + round(on_bus / max(1, firsts) * CASE_S / TICK_S)


def batch_size(ticks: int, count: int, workers: int) -> int:
    """Cases of a batch: half a second of work, and for few cases enough batches for all.

    With many workers longer, so that one scheduler keeps up with them.
    """
    fair = math.ceil(count / (engine.IN_FLIGHT * max(1, workers)))
    long = BATCH_TICKS * max(1, workers // WORKERS_OF_SHORT) // ticks
    return max(1, min(long, fair))


def where(stand: Stand, workers: int | None, scheduler: str | None) -> Workers:
    """Where it runs, unless it was said: small campaigns in this process."""
    if scheduler is not None:
        return Workers(workers or engine.cores(), scheduler)
    small = work_of(stand) * stand.plan.count <= ALONE_TICKS
    return Workers((0 if small else engine.cores()) if workers is None else workers)


def dry_run(plan: Path, workers: int | None = None) -> dict[str, Any]:
    """How many cases, how long [s] and how large [bytes], without running one. Raises HilError."""
    _, stand = job_of(plan, read_plan(plan))
    used = where(stand, workers, None).count
    ticks = ticks_of(stand)
    seconds = stand.plan.count * (work_of(stand) * TICK_S + 1e-3) / max(1, used) + (START_S if used else 0.0)
    return {
        "cases": stand.plan.count,
        "ticks_a_case": ticks,
        "workers": used,
        "seconds": seconds,
        "bytes": stand.plan.count * (ROW_BYTES + 8 * len(stand.plan.keys)),
        "keys": stand.plan.keys,
    }


def one_case(plan: Path, case: int) -> dict[str, Any]:
    """The row of one case alone. Raises HilError."""
    _, stand = job_of(plan, read_plan(plan))
    if not 0 <= case < stand.plan.count:
        raise HilError(f"--case {case}: the plan has the cases 0 to {stand.plan.count - 1}")
    return stand.run(case)


def campaign(
    plan: str | Path | PlanTable,
    folder: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    seen: Seen | None = None,
) -> Result:
    """Run every case of a plan that ``folder`` has no row of.

    ``workers``: local processes (default: one a core; 0: this process); ``scheduler``: the address of an
    existing one of Dask; ``resume``: go on with what the folder holds; ``seen`` is told of progress. Raises
    HilError for a plan that cannot be, for another plan's folder, for a worker of another version.
    """
    path = Path() / "plan.toml" if isinstance(plan, PlanTable) else Path(plan)
    job, stand = job_of(path, plan if isinstance(plan, PlanTable) else read_plan(path))
    if workers is not None and workers < 0:
        raise HilError(f"{workers} workers: take 1 or more, or 0 for this process")
    store.arrow()
    held = store.make(Path(folder), about_of(job, stand), job.files, resume=resume)
    output_file(held.path / PAGE, ".html")
    used = where(stand, workers, scheduler)
    if used.count or used.scheduler:
        warm(stand)
    return finish(job, held, used, batch_size(work_of(stand), stand.plan.count, used.count), seen)


def warm(stand: Stand) -> None:
    """Compile every kernel before the workers start: they take them from the cache."""
    with contextlib.suppress(Exception):  # what the base can't, each case says for itself
        setup, simulation = stand.simulation({})
        simulation.warm_up()
        design_margins(setup)


def finish(job: Any, held: Folder, used: Workers, size: int, seen: Seen | None) -> Result:
    """Run what is open; the rows that are done stay, whatever ends it."""
    done = int(held.done().sum())
    rate = Rate(held.count, done)

    def take(rows: list[engine.Row]) -> None:
        held.add(rows)
        rate.add(len(rows))
        if seen:
            seen(rate)

    with _kept(held):
        engine.run(job, engine.batches(held.open_spans(), size, held.count - done, used.count), used, take)
    held.merge()
    passed = held.columns("passed")["passed"]
    write_page(held)
    return Result(held, len(passed), int(passed.astype(bool).sum()), rate.seconds, rate.per_s)


def write_page(held: Folder) -> Path:
    """The report of a folder's rows, beside them. Raises HilError."""
    target = held.path / PAGE
    try:
        target.write_text(page(held), encoding="utf-8")
    except OSError as error:
        raise HilError(store.full(held.path / store.ROWS / PAGE, error)) from error
    return target


@contextlib.contextmanager
def _kept(held: Folder) -> Iterator[None]:
    """Write what waits, also when the block ends by an error or Ctrl-C."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(HilError):
            held.flush()
        raise
    held.flush()
