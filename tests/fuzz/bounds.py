"""Kernels with their bounds checked: nothing of a stranger's log leads one out of its arrays.

    python -m tests.fuzz.bounds [--inputs 200] [--unchecked]

Numbers of a log's parameters and state are put out of place and its ticks replayed by kernels that are
compiled with bounds checks, in a cache of their own. ``--unchecked`` leaves the reader's ranges out: then an
index must be found that is out of bounds, or this proves nothing. Prints what came of the inputs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
from collections import Counter
from dataclasses import replace
from typing import Any

ENVIRONMENT = {"NUMBA_BOUNDSCHECK": "1"}
TICKS = 40
EDGES = (-1, 0, 1, 2, 3, 7, 255, 256, 257, 2**31, 2**62, -(2**63), 2**63 - 1, -1e300, 1e300, "inf", "nan:")
INDEX = ("counter_modulus", "messages", "kind", "N", "form", "count", "counter", "head", "filled", "max_gap")
"""Fields of whole numbers that are drawn half of the time: the others seldom index."""
FILES = ("controller.json", "state.json")


def own_environment() -> dict[str, str]:
    """The environment of a process whose kernels check their bounds."""
    from drivers.kernelcache import cache_folder

    return {**os.environ, **ENVIRONMENT, "NUMBA_CACHE_DIR": str(cache_folder() / "bounds")}


def places(given: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths to all numbers in nested tables and lists."""
    if isinstance(given, dict | list):
        items = given.items() if isinstance(given, dict) else enumerate(given)
        return [path for key, value in items for path in places(value, (*at, key))]
    return [at]


def mutated(log: Any, rng: random.Random) -> Any:
    """The log with one to three numbers of its parameters and state put out of place."""
    files = {name: json.loads(log.attachments[name]) for name in FILES if name in log.attachments}
    fields: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
    for path in places(files):
        fields.setdefault(path[:3], []).append(path)
    indexing = [field for field in fields if field[-1] in INDEX]
    for _ in range(rng.randint(1, 4)):
        *way, last = rng.choice(fields[rng.choice(indexing if rng.random() < 0.7 else list(fields))])
        table: Any = files
        for key in way:
            table = table[key]
        old, new = table[last], rng.choice(EDGES)
        if isinstance(old, int) and not isinstance(new, int):
            new = old + rng.randint(-1000, 1000)
        table[last] = new
    texts = {name: json.dumps(given) for name, given in files.items()}
    ticks = log.ticks[:TICKS].copy()
    for name in rng.sample(("gap", "echo", "rx_flags", "drive_state", "request"), rng.randint(0, 2)):
        kind: Any = ticks[name].dtype
        ticks[name][rng.randrange(len(ticks))] = rng.choice((0, 255, 2**31 - 1)) % (
            2 ** (8 * kind.itemsize - 1)
        )
    return replace(log, ticks=ticks, frames=[], attachments=log.attachments | texts)


def seeds() -> list[Any]:
    """Kept logs with parameters and state by name: of each law, and a part that begins in the middle."""
    from hil.log.reader import open_log
    from hil.replay.machine import machine_of, restored, state_text
    from tests.golden.kept import LOGS

    out = []
    for name in ("lockstep-fac", "simulate", "split.001"):
        log = open_log(LOGS / "1a4c819" / f"{name}.mcap")
        machine = machine_of(log)
        kept, k = machine.fresh(), -1
        if "state.json" in log.attachments:
            kept, k = restored(machine, log.attachments["state.json"])
        log.attachments |= {"controller.json": machine.to_json(), "state.json": state_text(kept, k)}
        out.append(log)
    return out


def verdicts(inputs: int) -> Counter[str]:
    """How many inputs came to each verdict, and to an index out of bounds."""
    from hil.replay import replay_log

    found: Counter[str] = Counter()
    logs = seeds()
    for number in range(inputs):
        rng = random.Random(f"bounds/{number}")
        try:
            found[replay_log(mutated(rng.choice(logs), rng)).verdict] += 1
        except IndexError as error:
            print(f"input bounds/{number}: {error}", flush=True)
            found["out of bounds"] += 1
    return found


def ends(kind: str, record: Any) -> None:
    """What ``--unchecked`` leaves of the reader's check: a number that is looped to. Raises ValueError."""
    from hil.replay.ranges import RANGES

    if kind == "safety_state" and not 0 <= record["elapsed"][0] <= RANGES[kind]["elapsed"][1]:
        raise ValueError("it would loop for ever")


def main() -> int:
    """Exit code 1 for an index out of bounds; with ``--unchecked`` where there was none."""
    parser = argparse.ArgumentParser(description="replay with bounds checks")
    parser.add_argument("--inputs", type=int, default=200)
    parser.add_argument("--unchecked", action="store_true", help="leave out the reader's check of ranges")
    args = parser.parse_args()
    if not set(ENVIRONMENT.items()) <= set(os.environ.items()):
        command = [sys.executable, "-m", "tests.fuzz.bounds", *sys.argv[1:]]
        os.execve(sys.executable, command, own_environment())
    if args.unchecked:
        import hil.replay.machine

        hil.replay.machine.check_ranges = ends  # type: ignore[attr-defined]
    found = verdicts(args.inputs)
    print(dict(found), flush=True)
    return int((found["out of bounds"] > 0) != args.unchecked)


if __name__ == "__main__":
    sys.exit(main())
