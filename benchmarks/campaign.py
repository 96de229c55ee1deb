"""What a case of a campaign costs, beside a case as it was simulated before, and how workers add up.

    python -m benchmarks.campaign [--json] [--cases N] [--full] [--huge] [--base PYTHON] [--motulator PYTHON]

Processor time and ratios of one run, so that other load on the machine matters little:

* a case of the demo (6 s at 1 kHz) from plan to row, its simulation alone, and a case with the set-up
  done anew, as `hil simulate --sweep` did until campaigns came: files read, DBC parsed, law designed;
* the same with the controller varied, which is designed for each case;
* one worker and two over N cases: wall time, processor time of all, and peak memory of a worker;
* `--full`: 10,000 cases on two workers, three minutes of two cores; `--huge`: 100,000, half an hour;
* `--base`: a tick of the compiled simulation, and a case of a campaign or of the sweep before them, here and
  in another version, whose interpreter is given, by turns over that version's demo: `git worktree add
  ../base REVISION`, a virtual environment in it and `pip install -e .`;
* how much a worker's memory grows by a case, from the smallest and the largest of these campaigns;
* motulator's own loop over the same motor at the same control rate. It integrates the motor with scipy's
  adaptive RK45 between control steps and keeps each step; we advance a Taylor series of order 8 twice a tick,
  through the wire's resolution, guard and supervisor, and keep figures. Neither does all that the other does.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.__main__ import HERE, peer
from hil.bench.machine import machine_facts
from hil.campaign.case import job_of
from hil.campaign.plan import read_plan
from hil.config.shipped import find_config
from hil.report.segments import Responses
from hil.report.statistics import Totals
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides, load_setup
from hil.sim.simulate import simulate_ticks

REPEATS, TURNS, CASE_S = 40, 3, 6.0
LOOK_S = 0.5
"""From one look at all processes to the next; each takes milliseconds."""
PLANT = """[random]
"plant:motor.J_kg_m2" = { percent = 20 }
"plant:motor.R_s_ohm" = { percent = 20 }
"""
LAW = '"controller.speed_pole_rad_s" = { percent = 20 }\n'


def plan_file(folder: Path, cases: int, text: str = PLANT) -> Path:
    """A plan of the demo."""
    path = folder / f"plan{cases}.toml"
    config = json.dumps(str(find_config("demo.toml").resolve()))
    path.write_text(f"config = {config}\nsamples = {cases}\n{text}", encoding="utf-8")
    return path


def fastest_ms(*works: Callable[[int], Any]) -> list[float]:
    """Processor time [ms] of the fastest of many, by turns so that all see the same machine."""
    best = [float("inf")] * len(works)
    for turn in range(REPEATS + 1):
        for place, work in enumerate(works):
            begin = time.process_time()
            work(turn)
            best[place] = min(best[place], time.process_time() - begin) if turn else best[place]
    return [1e3 * seconds for seconds in best]


def as_before(case: int) -> None:
    """A case with its set-up done anew and judged as a whole run in memory."""
    setup = load_setup(find_config("demo.toml"), Overrides(settings=("bus.fd=false",)))
    ticks = simulate_ticks(setup, [f"motor.J_kg_m2={0.01 + 1e-5 * case}"])
    load_setup(find_config("demo.toml"), Overrides())  # the plant's DBC and tables, for the judgement
    totals, responses, t = Totals(), Responses(), ticks["t_ns"] * 1e-9
    with np.errstate(all="ignore"):
        totals.feed(t, ticks)
        responses.feed(t, ticks)
        responses.finish()


def one_case(folder: Path) -> dict[str, float]:
    """A case from plan to row, its parts, and one as before [ms of a core]."""
    plan = plan_file(folder, 100_000)
    _, stand = job_of(plan, read_plan(plan))
    _, law = job_of(plan, read_plan(plan_file(folder, 99_999, PLANT + LAW)))

    def loop(case: int) -> None:
        for _ in made[case].blocks():
            pass

    made = [stand.simulation(stand.plan.settings(case), 1)[1] for case in range(REPEATS + 1)]
    case, simulated, designed, before = fastest_ms(stand.run, loop, law.run, as_before)
    ticks = round(1000 * CASE_S)
    return {
        "case_ms": case,
        "simulation_ms": simulated,
        "simulation_us_a_tick": 1e3 * simulated / ticks,
        "case_with_design_ms": designed,
        "as_before_ms": before,
        "as_before_over_case": before / case,
    }


def watched(client: subprocess.Popen[str]) -> dict[str, float]:
    """Peak memory of the largest worker [MB], and processor seconds of a command and of all below it."""
    peak_mb, seconds = 0.0, dict[int, float]()
    above = psutil.Process(client.pid)
    while client.poll() is None:
        with contextlib.suppress(psutil.Error):
            for process in (above, *above.children(recursive=True)):
                if process.pid != client.pid:
                    peak_mb = max(peak_mb, process.memory_info().rss / 1e6)
                used = process.cpu_times()
                seconds[process.pid] = used.user + used.system
        with contextlib.suppress(subprocess.TimeoutExpired):
            client.wait(LOOK_S)
    own = seconds.pop(client.pid)
    return {"peak_mb": peak_mb, "client_s": own, "workers_s": sum(seconds.values())}


def whole(folder: Path, cases: int, workers: int) -> dict[str, float]:
    """The command, from its start to its end: imports, workers' start and report are in it."""
    out = folder / f"{cases}-{workers}"
    command = [sys.executable, "-m", "hil.cli", "campaign", str(plan_file(folder, cases))]
    command += ["-o", str(out), "-j", str(workers), "--json"]
    begin = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as client:
        found = watched(client)
        told = json.loads(client.communicate()[0])
    wall = time.perf_counter() - begin
    size = sum(path.stat().st_size for path in (out / "rows").iterdir())
    return found | {"wall_s": wall, "passed": told["passed"], "bytes_a_case": size / cases}


def beside_motulator(python: str, case_ms: float) -> dict[str, Any]:
    """motulator's seconds of a core for a simulated second, and how many times ours that is."""
    found = peer(python, str(HERE / "motulator_drive.py"))
    if "core_s_a_simulated_s" in found:
        found["over_a_case_of_ours"] = found["core_s_a_simulated_s"] / (1e-3 * case_ms / CASE_S)
    return found


def beside_base(base: str, script: str, key: str) -> dict[str, Any]:
    """What ``script`` measures of this version and of interpreter ``base``'s, over the latter's demo."""
    script, best = str(HERE / script), {base: float("inf"), sys.executable: float("inf")}
    config: tuple[str, ...] = ()
    for _ in range(TURNS):
        for python in best:
            found = peer(python, script, *config)
            if "missing" in found:
                return found
            config = (found["config"],)
            best[python] = min(best[python], found[key])
    there, here = best[base], best[sys.executable]
    return {f"there_{key}": there, f"here_{key}": here, "times_as_fast": there / here}


def campaigns(folder: Path, cases: int, more: list[int]) -> dict[str, Any]:
    """One worker and two over ``cases``, two over each of ``more``, and what these tell together."""
    runs = [(cases, 1), (cases, 2), *((count, 2) for count in more)]
    found = {run: whole(folder, *run) for run in runs}
    out: dict[str, Any] = {f"{count} cases, workers {n}": value for (count, n), value in found.items()}
    out["one worker over two"] = found[cases, 1]["wall_s"] / found[cases, 2]["wall_s"]
    if more:
        grown_mb = found[more[-1], 2]["peak_mb"] - found[cases, 2]["peak_mb"]
        out["a worker's memory by a case, bytes"] = 1e6 * grown_mb / (more[-1] - cases)
    return out


def measure(cases: int, more: list[int], base: str | None, python: str) -> Iterator[tuple[str, Any]]:
    """Everything, by name, as it comes."""
    with tempfile.TemporaryDirectory(prefix="hil-bench-") as name:
        case = one_case(Path(name))
        yield "a case", case
        yield "motulator", beside_motulator(python, case["case_ms"])
        if base:
            yield "simulation beside the other version's", beside_base(base, "simulated_tick.py", "us_a_tick")
            yield "a case beside the other version's", beside_base(base, "swept_case.py", "ms_a_case")
        yield from campaigns(Path(name), cases, more).items()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.campaign", description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--full", action="store_true", help="10,000 cases, too")
    parser.add_argument("--huge", action="store_true", help="100,000 cases, too")
    parser.add_argument("--base", metavar="PYTHON", help="an interpreter that has another version")
    parser.add_argument(
        "--motulator", default=sys.executable, metavar="PYTHON", help="an interpreter that has motulator"
    )
    args = parser.parse_args()
    more = [10_000] * args.full + [100_000] * args.huge
    found: dict[str, Any] = {}
    for name, value in measure(args.cases, more, args.base, args.motulator):
        found[name] = value
        sys.stderr.write(f"{name}: {value}\n")  # what is measured is known, whatever ends it
    found["machine"] = machine_facts()
    if args.json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
        return
    rows = {
        name: ", ".join(
            f"{key} {item:.4g}" if isinstance(item, float) else f"{key} {item}" for key, item in value.items()
        )
        if isinstance(value, dict)
        else value
        for name, value in found.items()
    }
    show(key_values("campaigns", rows))


if __name__ == "__main__":
    main()
