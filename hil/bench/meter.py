"""Processor time of each phase of a tick: `hil` with marks in its compiled tick.

    python -m hil.bench.meter REPORT run CONFIG ...   # as `hil run CONFIG ...`; REPORT gets a JSON object

The stamps of a log say when a phase ended, waiting included; this says what it took of the processor: the
compiled tick reads the thread's own clock at each border of :data:`hil.runtime.fused.PHASES`. What a
reading takes is measured first and taken off.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from pathlib import Path

from hil.errors import HilError
from hil.runtime import fused, fusednodes
from hil.runtime.fused import LAST, PHASES, Marks, mark_often, new_marks
from hil.runtime.loop import Loop, Outcome

READINGS = 5000


def reading_ns() -> float:
    """What one reading of the clock takes [ns]."""
    marks = new_marks()
    mark_often(marks, 1)
    begin_ns = marks[LAST]
    mark_often(marks, READINGS)
    return float(marks[LAST] - begin_ns) / READINGS


def by_phase(marks: Marks, ticks: int, reading: float) -> dict[str, float]:
    """Each phase's processor time a tick [ns]. Raises HilError when no tick was marked."""
    if not marks[1:LAST].any():
        raise HilError("no tick went through the compiled form, so there are no phases to measure")
    return {name: float(ns) / ticks - reading for name, ns in zip(PHASES, marks[:LAST], strict=True)}


def run_metered(report: Path, words: list[str]) -> int:
    """Run `hil WORDS` with marks; ``report`` gets each phase's processor time a tick [ns]."""
    from hil import cli

    reading, marks, plain = reading_ns(), new_marks(), Loop.run

    def run(self: Loop) -> Outcome:
        marks[LAST] = time.thread_time_ns()
        outcome = plain(self)
        report.write_text(json.dumps(by_phase(marks, outcome.ticks, reading)))
        return outcome

    fused.whole_tick = partial(fused.whole_tick, marks=marks)
    fusednodes.whole_nodes = partial(fusednodes.whole_nodes, marks=marks)
    Loop.run = run  # type: ignore[method-assign]
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(run_metered(Path(sys.argv[1]), sys.argv[2:]))
