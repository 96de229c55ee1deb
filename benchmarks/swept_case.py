"""Peer: processor time of a varied case of six seconds in this interpreter's hil-drive. Prints one JSON line.

    PYTHON benchmarks/swept_case.py [CONFIG]

CONFIG: the demo of that hil-drive. A version that has campaigns runs a case of one, from plan to row; one
before them what `hil simulate --sweep` did for each case. The fastest of many.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SECONDS, REPEATS = 6.0, 30


def of_campaign(config: Path, folder: Path) -> Callable[[int], Any]:
    """A case of a campaign over the motor's inertia."""
    from hil.campaign.case import job_of
    from hil.campaign.plan import read_plan

    plan = folder / "plan.toml"
    text = (
        f'config = {json.dumps(str(config))}\nsamples = {REPEATS + 1}\nset = ["loop.duration_s={SECONDS}"]\n'
    )
    plan.write_text(text + '[random]\n"plant:motor.J_kg_m2" = { percent = 20 }\n', encoding="utf-8")
    run: Callable[[int], Any] = job_of(plan, read_plan(plan))[1].run
    return run


def of_sweep(config: Path) -> Callable[[int], Any]:
    """A case of the sweep that was there before campaigns."""
    sweep, app = importlib.import_module("hil.sweep"), importlib.import_module("hil.app")
    overrides = app.Overrides(settings=(f"loop.duration_s={SECONDS}",))

    def run(case: int) -> Any:
        own = sweep.Case((), (f"motor.J_kg_m2={0.010 + 1e-5 * case}",))
        return sweep.run_case(config, overrides, [], own)

    return run


def main() -> None:
    """Run cases and say how long one took."""
    os.environ.pop("NUMBA_CACHE_DIR", None)  # each version keeps its kernels in its own tree
    import hil

    root = Path(hil.__file__).resolve().parent
    config = Path(sys.argv[1]) if len(sys.argv) > 1 else root.parent / "configs" / "demo.toml"
    with tempfile.TemporaryDirectory(prefix="hil-bench-") as name:
        campaigns = (root / "campaign").is_dir()
        run, best = of_campaign(config, Path(name)) if campaigns else of_sweep(config), float("inf")
        run(0)
        for case in range(1, REPEATS + 1):
            begin = time.process_time()
            run(case)
            best = min(best, time.process_time() - begin)
    sys.stdout.write(json.dumps({"config": str(config), "ms_a_case": 1e3 * best}) + "\n")


if __name__ == "__main__":
    main()
