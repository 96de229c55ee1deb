"""The machine's own limit: cyclictest of Debian's rt-tests, at the loop's period and priority."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hil.bench.histogram import TOP_US, Histogram

MISSING: Final = "cyclictest is not installed: apt install rt-tests"
OTHER_FOLDERS: Final = ("/usr/sbin", "/usr/bin")
SLACK_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class Anchor:
    """cyclictest's lateness, or why there is none."""

    lateness: Histogram | None
    note: str


def cyclictest(period_ns: int, seconds: float, priority: int, core: int | None = None) -> Anchor:
    """Run it, under FIFO with that priority if granted, else as any process; a failure becomes a note."""
    program = shutil.which("cyclictest", path=os.pathsep.join((os.environ.get("PATH", ""), *OTHER_FOLDERS)))
    if program is None:
        return Anchor(None, MISSING)
    problem = ""
    for policy, rank in (("fifo", priority), ("other", 0)):
        if policy == "fifo" and not priority:
            continue
        lateness, problem = _run(program, period_ns, seconds, policy, rank, core)
        if lateness is not None:
            return Anchor(lateness, f"{policy}, priority {rank}")
    return Anchor(None, f"cyclictest failed: {problem}")


def _run(
    program: str, period_ns: int, seconds: float, policy: str, priority: int, core: int | None
) -> tuple[Histogram | None, str]:
    """One run with its memory locked and the system's power management as it is."""
    loops = max(1, round(seconds * 1e9 / period_ns))
    command = [program, "-q", "-m", "--default-system", f"--policy={policy}", f"-p{priority}"]
    command += ["-t1", f"-i{max(1, period_ns // 1000)}", f"-l{loops}", f"-h{TOP_US}"]
    command += [] if core is None else [f"-a{core}"]
    try:
        done = subprocess.run(
            command, cwd=Path("/"), capture_output=True, text=True, timeout=seconds + SLACK_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    if done.returncode != 0:
        return None, (done.stderr.strip().splitlines() or ["no message"])[-1]
    return parse(done.stdout), ""


def parse(text: str) -> Histogram:
    """The histogram that ``cyclictest -h`` prints: lines of microseconds and counts, then comments."""
    counts = np.zeros(TOP_US, np.int64)
    worst = 0.0
    for line in text.splitlines():
        words = line.split()
        if len(words) == 2 and all(word.isdigit() for word in words):
            counts[min(int(words[0]), TOP_US - 1)] += int(words[1])
        elif line.startswith("# Max Latencies:"):
            worst = float(words[-1])
        elif line.startswith("# Histogram Overflows:"):
            counts[-1] += int(words[-1])
    return Histogram(counts, worst)
