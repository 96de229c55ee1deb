"""Lateness of one run with nobody watching and with five viewers of `hil watch --web`, by turns.

    python -m benchmarks.viewers [--turns N] [--seconds S]

Both come from the same run on the same machine, so that only their ratio says something.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from hil.runtime.registry import WatchError, choose
from hil.runtime.setup import Overrides
from hil.sim.demo import emulator_process
from hil.watch.look import Look

VIEWERS = 5
CONFIG = Path(__file__).resolve().parent.parent / "configs" / "demo.toml"
CHANNEL = "viewers"
SETTINGS = (
    f'bus.channel="{CHANNEL}"',
    "loop.max_gap_ticks=64",
    "feedback.hold_ticks=150",
    "feedback.quick_stop_ticks=200",
)


async def view(url: str) -> int:
    """Read what a viewer gets until cancelled."""
    async with connect(url, proxy=None) as socket:
        async for _ in socket:
            pass
    return 0


async def turn(look: Look, url: str, viewers: int, seconds: float) -> list[int]:
    """Lateness [ns] of the ticks of one turn."""
    tasks = [asyncio.create_task(view(url)) for _ in range(viewers)]
    await asyncio.sleep(1.0)
    look.new_ticks()
    found: list[int] = []
    for _ in range(round(seconds)):
        await asyncio.sleep(1.0)
        found += look.new_ticks()["lateness_ns"].tolist()
    for task in tasks:
        task.cancel()
    return found


async def measure(look: Look, url: str, turns: int, seconds: float) -> dict[str, dict[str, float]]:
    """Percentiles [us] with 0 and with all viewers, and their ratio."""
    late: dict[int, list[int]] = {0: [], VIEWERS: []}
    for n in range(2 * turns):
        viewers = (0, VIEWERS)[n % 2]
        late[viewers] += await turn(look, url, viewers, seconds)
    shares = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
    out = {}
    for name, share in shares.items():
        without, with_all = (float(np.percentile(late[n], share)) * 1e-3 for n in (0, VIEWERS))
        out[name] = {
            "0 viewers [us]": without,
            f"{VIEWERS} viewers [us]": with_all,
            "ratio": with_all / without,
        }
    return out


async def look_at_run() -> Look:
    """The run, once it is there."""
    for _ in range(600):
        try:
            return Look(choose(CHANNEL))
        except WatchError:
            await asyncio.sleep(0.1)
    raise WatchError("the run does not begin")


async def compare(turns: int, seconds: float) -> dict[str, dict[str, float]]:
    """Start run and server beside an emulator, measure, stop."""
    command = [sys.executable, "-m", "hil.cli", "watch", "--web", CHANNEL, "--port", "0"]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    settings = [*SETTINGS, f"loop.duration_s={2 * turns * (seconds + 2) + 60}"]
    words = [word for setting in settings for word in ("--set", setting)]
    run = subprocess.Popen(
        [sys.executable, "-m", "hil.cli", "run", str(CONFIG), *words], stdout=subprocess.DEVNULL
    )
    try:
        assert server.stderr is not None  # noqa: S101 - PIPE was asked for
        found = re.search(r"http://[\d.:]+/[\w-]+/", server.stderr.readline())
        assert found is not None  # noqa: S101 - a taken port can't be: it asked for a free one
        look = await look_at_run()
        return await measure(look, found[0].replace("http", "ws") + "live", turns, seconds)
    finally:
        server.terminate()
        run.terminate()
        run.wait(30)
        server.communicate(timeout=30)


def main() -> None:
    """Print the comparison as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0)
    args = parser.parse_args()
    with emulator_process(CONFIG, Overrides(settings=SETTINGS)):
        result = asyncio.run(compare(args.turns, args.seconds))
    print(json.dumps(result, indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
