"""From log files to a report file; its ending says which kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hil.errors import HilError
from hil.log.reader import Source
from hil.report.collect import Run, collect_nodes, named
from hil.report.criteria import figures, judge, notes, open_loop
from hil.report.page import page
from hil.report.section import Section, Sections, no_more

MOST_LOGS: Final = 8
KINDS: Final = (".html", ".htm", ".png")


@dataclass(frozen=True, slots=True)
class Report:
    """A written report."""

    path: Path
    runs: tuple[Run, ...]
    sections: tuple[Section, ...] = ()

    @property
    def passed(self) -> bool:
        """True when every check of every run passed."""
        return all(check.outcome == "pass" for run in self.runs for check in judge(run))

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "report": str(self.path),
            "passed": self.passed,
            "runs": [
                {
                    "log": str(run.log.path),
                    **({"node": run.node} if run.node else {}),
                    "ticks": run.totals.ticks,
                    "checks": [check.as_dict() for check in judge(run)],
                    "figures": figures(run),
                    "notes": notes(run),
                    "end": run.end,
                    "replay": run.verdict.as_dict(),
                    "damage": run.log.damage,
                }
                for run in self.runs
            ],
            **{section.key: section.data for section in self.sections},
        }


def build(
    logs: Sequence[Source], out: Path, *, verify: bool = True, sections: Sections = no_more
) -> Report:  # fmt: skip
    """Read the logs and write the report, with the page's ``sections`` of later rooms.

    Raises HilError before reading what could not be written.
    """
    if out.suffix.lower() not in KINDS:
        raise HilError(f"{out}: a report is an HTML page or a PNG picture; name it .html or .png")
    if len(logs) > MOST_LOGS:
        raise HilError(f"{len(logs)} logs: a report compares at most {MOST_LOGS}; name fewer")
    if not out.parent.is_dir():
        raise HilError(f"{out.parent}: no such folder; make it, or choose another file with -o")
    runs = [
        run for source in logs for run in named(collect_nodes(source, verify=verify), alone=len(logs) == 1)
    ]
    if len(runs) > MOST_LOGS:
        raise HilError(f"{len(runs)} nodes: a report compares at most {MOST_LOGS}; name fewer logs")
    names = [run.name for run in runs]
    for index, run in enumerate(runs):
        run.name = f"{run.name} ({index + 1})" if names.count(names[index]) > 1 else run.name
        run.name += " (open loop)" if open_loop(run) else ""
    more = tuple(sections(runs))
    try:
        if out.suffix.lower() == ".png":
            from hil.report.picture import picture

            out.write_bytes(picture(runs))
        else:
            out.write_text(page(runs, more), encoding="utf-8", errors="replace")
    except OSError as error:
        raise HilError(f"{out}: can't be written: {error.strerror or error}") from error
    return Report(out, tuple(runs), more)
