"""Peer: time of a tick of the compiled simulation in this interpreter's hil-drive. Prints one JSON line.

    PYTHON benchmarks/simulated_tick.py [CONFIG]

CONFIG: the demo of that hil-drive. The fastest of many runs of six seconds, in time of the processor. It is
standalone and asks for no more than versions before campaigns have, so that two versions can be compared.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

SECONDS, REPEATS = 6.0, 60


def module(*names: str) -> Any:
    """The first of hil's modules ``names`` that this version has: they moved to rooms."""
    for name in names:
        with contextlib.suppress(ModuleNotFoundError):
            return importlib.import_module(f"hil.{name}")
    raise ModuleNotFoundError(f"none of hil.{', hil.'.join(names)}")


def main() -> None:
    """Simulate and say how long a tick took."""
    os.environ.pop("NUMBA_CACHE_DIR", None)  # each version keeps its kernels in its own tree
    import hil

    setups, sim = module("runtime.setup", "app"), module("sim.simulate", "simulate")
    demo = Path(hil.__file__).resolve().parents[1] / "configs" / "demo.toml"
    config = Path(sys.argv[1]) if len(sys.argv) > 1 else demo
    setup = setups.load_setup(config, setups.Overrides(settings=(f"loop.duration_s={SECONDS}",)))
    best, ticks = float("inf"), 0
    for _ in range(REPEATS + 1):
        blocks = sim.make_simulation(setup, []).blocks()
        begin = time.process_time()
        ticks = sum(len(block) for block in blocks)
        best = min(best, time.process_time() - begin)
    sys.stdout.write(json.dumps({"config": str(config), "us_a_tick": 1e6 * best / ticks}) + "\n")


if __name__ == "__main__":
    main()
