"""A case with a fault script: what it disturbs is a bus, which a simulation has not.

It runs over the embedded bus in lockstep, controller and drive each in a process of its own: the same at any
speed of the machine, in seconds instead of milliseconds. Its figures are those of its log.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hil.campaign.figures import Judged
from hil.campaign.margins import design_margins
from hil.control.law import exact_after
from hil.errors import HilError
from hil.log.reader import Log, open_log
from hil.runtime.setup import Overrides, Setup
from hil.signals import Reason
from hil.sim.columns import ROWS, Columns, gather
from hil.sim.demo import closed_loop

CASE_S: Final = 4.0
"""What such a case takes of a core [s]: two processes begin, 6000 ticks go over the bus."""
LONGEST_S: Final = 600.0
"""Then a case has hung; it is a row that says so."""


def judged_on_the_bus(
    setup: Setup, settings: Sequence[str], plant: Sequence[str], room: Columns
) -> dict[str, Any]:
    """Run and judge one case by its settings, KEY=VALUE. Raises HilError."""
    with tempfile.TemporaryDirectory(prefix="hil-case-") as folder:
        own = [*settings, 'loop.clock="lockstep"', f"log.folder={json.dumps(folder)}"]
        log = _run({"config": str(setup.path), "set": own, "plant": list(plant)})
    found = Judged(setup.config, exact_after(setup.machine.law)[0])
    for start in range(0, len(log.ticks), ROWS):
        part = log.ticks[start : start + ROWS]
        gather(part, room.floats, room.integers, 0)
        room.count = len(part)
        found.feed(room)
    row, end = found.finish() | design_margins(setup), log.result.get("end")
    asked = found.reason == Reason.STOP_REQUESTED
    return row | {"end": end, "why": row["why"] if asked or not end else end["text"]}


def _run(job: dict[str, Any]) -> Log:
    """Its log. In a process of its own, since a run takes the signals of the thread that has them."""
    command = [sys.executable, "-m", "hil.campaign.onbus"]
    done = subprocess.run(
        command, input=json.dumps(job), capture_output=True, text=True, check=False, timeout=LONGEST_S
    )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"its process ended with {done.returncode}"]
        said = next(
            (line for line in lines if line.startswith("hil: ")), lines[-1]
        )  # the drive's own process
        raise HilError(said.removeprefix("hil: "))
    return open_log(done.stdout.strip(), frames=False)


def main() -> None:
    """The process of one case: its job on standard input, its log's name on standard output."""
    job = json.load(sys.stdin)
    try:
        _, result, _ = closed_loop(
            Path(job["config"]), Overrides(settings=tuple(job["set"])), tuple(job["plant"])
        )
    except HilError as error:
        raise SystemExit(str(error)) from None
    sys.stdout.write(result.log)


if __name__ == "__main__":
    main()
