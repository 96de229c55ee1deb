"""All peers beside this project, in one run: ``python -m benchmarks [--json] [--python PYTHON]``.

A peer that is not installed is one line. motulator and gym-electric-motor are in the optional group
``benchmarks``; ``--python`` names an interpreter that has them, if this one has not.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from hil.bench.machine import machine_facts
from hil.bench.measure import QUICK, Length, simulate_speed
from hil.bench.processes import Stand, bare_run, hil_run, metered_run, stand
from hil.config.shipped import find_config
from hil.report.view import key_values, show
from hil.runtime.setup import Overrides

HERE = Path(__file__).resolve().parent
LIMIT_S = 120


def peer(*command: str) -> dict[str, Any]:
    """One peer's JSON, or what is ``missing``."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=HERE.parent
    )
    if done.returncode != 0:
        return {"missing": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def on_the_bus(one: Stand, seconds: float) -> dict[str, dict[str, Any]]:
    """The loops that exchange frames with the same emulated drive, one after the other."""
    config = one.setup.config
    run = hil_run(one, config.loop.rate_hz, seconds)
    bus = (config.bus.interface, config.bus.channel, str(one.setup.database.path))
    ticks = str(round(seconds * config.loop.rate_hz))
    usual = (sys.executable, "-m", "benchmarks.python_can_loop", *bus)
    return {
        "hil run": {**run.said, "record_us": metered_run(one, config.loop.rate_hz, seconds)["record"]},
        "bare loop": bare_run(one, config.loop.rate_hz, seconds).said,
        "python-can loop": peer(*usual, "--rate", str(config.loop.rate_hz), "--ticks", ticks),
    }


def measure(config: Path, overrides: Overrides, python: str, length: Length) -> dict[str, Any]:
    """Everything, by name."""
    with stand(config, overrides) as one:
        found = on_the_bus(one, length.run_s)
    return {
        **found,
        "hil simulate": {"x_realtime": simulate_speed(config, overrides, length)},
        "motulator": peer(python, str(HERE / "motulator_drive.py")),
        "gym-electric-motor": peer(python, str(HERE / "gym_motor.py")),
        "mcap inline": peer(sys.executable, "-m", "benchmarks.mcap_inline"),
    }


def rows(found: dict[str, Any]) -> dict[str, str]:
    """Ratios first: each peer's figure over ours."""
    ours = found["hil run"]
    out = {
        "processor time a tick": f"hil run {ours['processor_us']:.1f} us with checks, control, guard and log",
        "  bare loop": _ratio(
            found["bare loop"], "processor_us", ours["processor_us"], "us", "computes nothing"
        ),
        "  python-can loop": _ratio(
            found["python-can loop"], "processor_us", ours["processor_us"], "us", "no checks, no log"
        ),
        "simulated seconds a second": f"hil simulate {found['hil simulate']['x_realtime']:.0f}, log included",
    }
    speed = found["hil simulate"]["x_realtime"]
    for name in ("motulator", "gym-electric-motor"):
        out[f"  {name}"] = _ratio(found[name], "x_realtime", speed, "", "at 1 kHz")
    out["a record's cost to the loop"] = f"hil run {ours['record_us']:.1f} us, written by another process"
    inline = found["mcap inline"]
    stall = "" if "missing" in inline else f"stalls to {inline['stall_us']:.0f} us"
    return out | {"  mcap inline": _ratio(inline, "record_us", ours["record_us"], "us", stall)}


def _ratio(theirs: dict[str, Any], key: str, ours: float, unit: str, note: str) -> str:
    if "missing" in theirs:
        return f"skipped: {theirs['missing']}"
    return f"{theirs[key] / ours:.3g} x ours: {theirs[key]:.3g} {unit}, {note}".replace(" ,", ",")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("config", nargs="?", type=Path)
    parser.add_argument("--python", default=sys.executable, help="interpreter for motulator and gym")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    length = Length(5.0, 1.0, QUICK.simulated_s, ())
    found = measure(args.config or find_config("demo.toml"), Overrides(), args.python, length)
    if args.json:
        sys.stdout.write(json.dumps(found | {"machine": machine_facts()}, indent=2) + "\n")
        return
    table = rows(found) | {"machine": ", ".join(f"{k} {v}" for k, v in machine_facts().items())}
    show(key_values("hil beside its peers", table))


if __name__ == "__main__":
    main()
