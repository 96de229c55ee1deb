"""How long `hil` takes to start: `hil --help`, and `hil run` from start to armed, kernels compiled before.

    python -m benchmarks.startup [--json] [--turns N]

Both stand beside `python -c pass` and `python -c "import numpy"` of the same run, by turns, as the fastest of
a few; ratios say more than seconds of a machine. Armed: the drive was heard, the first command goes out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

from hil.bench.machine import machine_facts
from hil.bench.processes import Stand, hil_run, stand
from hil.config.shipped import find_config
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides

COMMANDS: dict[str, tuple[str, ...]] = {
    "python -c pass": ("-c", "pass"),
    "import numpy": ("-c", "import numpy"),
    "hil --help": ("-m", "hil.cli", "--help"),
}
ARMED = "hil run, start to armed"
RUN_S = 0.3


@dataclass(slots=True)
class Took:
    """Seconds: as long as one waits for it, and of the processor (NaN where it can't be told apart)."""

    wall_s: float
    processor_s: float


def once(*words: str) -> Took:
    """One start of an interpreter."""
    begin, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True, timeout=60)
    after = os.times()
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    return Took(time.perf_counter() - begin, processor)


def armed(one: Stand) -> Took:
    """One `hil run` until it says that it is arming."""
    return Took(hil_run(one, one.setup.config.loop.rate_hz, RUN_S).armed_s, float("nan"))


def measure(turns: int) -> dict[str, Took]:
    """The fastest of each, taken by turns so that all see the same machine."""
    best: dict[str, Took] = {}
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # what is installed has its byte code beside it
    with stand(find_config("demo.toml"), Overrides()) as one:
        jobs: dict[str, Callable[[], Took]] = {
            name: lambda words=words: once(*words)  # type: ignore[misc]
            for name, words in COMMANDS.items()
        }
        jobs[ARMED] = lambda: armed(one)
        armed(one)  # compiles the kernels, if nothing has yet
        for _ in range(turns):
            for name, job in jobs.items():
                took = job()
                if name not in best or took.wall_s < best[name].wall_s:
                    best[name] = took
    return best


def ratios(best: dict[str, Took]) -> dict[str, str]:
    """What to show: ratios first."""
    bare, numpy = best["python -c pass"].wall_s, best["import numpy"].wall_s
    return {
        name: f"{took.wall_s / bare:.2f} x python -c pass, {took.wall_s / numpy:.2f} x import numpy: "
        f"{took.wall_s:.3f} s" + (f", processor {took.processor_s:.3f} s" if took.processor_s > 0 else "")
        for name, took in best.items()
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.startup", description=__doc__)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    best = measure(args.turns)
    if args.json:
        found = {name: asdict(took) for name, took in best.items()}
        sys.stdout.write(json.dumps(found | {"machine": machine_facts()}, indent=2) + "\n")
        return
    show(key_values("start-up, fastest of a few", ratios(best)))


if __name__ == "__main__":
    main()
