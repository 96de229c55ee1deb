"""What runs achieved, for scripts: figures, pictures, reports."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.api.setups import File
from hil.log.reader import Log
from hil.report.build import Report
from hil.report.build import build as build_report
from hil.report.collect import Run, collect_nodes, named
from hil.report.criteria import figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLOCK = 4096


def metrics(log: Log | File) -> dict[str, float | None]:
    """Figures of a run by name, as in ``hil report --json``: dip, recovery, overshoot, tracking, lateness ...

    The unit ends the name. None: the run does not show it, as a recovery without a load step.
    """
    return figures(_seen(log, alone=True)[0])


def plot(*logs: Log | File, path: File | None = None) -> Figure:
    """The curves of one run, or of several side by side, as a matplotlib figure; saved as well with ``path``.

    Raises ``hil.HilError`` for what is no log.
    """
    from hil.report.picture import figure

    drawn = figure([run for log in logs for run in _seen(log, alone=len(logs) == 1)])
    if path is not None:
        drawn.savefig(path)
    return drawn


def report(*logs: File, path: File) -> Report:
    """Write the report of one or several log files, an HTML page or a PNG by the name's end.

    The result says ``passed`` and, as ``as_dict()``, all that the page shows. Raises ``hil.HilError``.
    """
    from hil.identify.section import identification

    return build_report([Path(log) for log in logs], Path(path), sections=identification)


def _seen(log: Log | File, *, alone: bool) -> list[Run]:
    """What a report knows of a log, without its replay; of a file with several nodes, of each."""
    if not isinstance(log, Log):
        return named(collect_nodes(Path(log), verify=False), alone=alone)
    run = Run(log, log.path.stem)
    for begin in range(0, len(log.ticks), BLOCK):
        run.feed(log.ticks[begin : begin + BLOCK])
    with np.errstate(invalid="ignore", over="ignore"):
        run.responses.finish()
    return [run]
