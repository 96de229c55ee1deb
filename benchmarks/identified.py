"""`hil identify` over the bus for twelve motors that nobody told it: what it finds against the truth.

    python -m benchmarks.identified [--json] [--lockstep] [NAME ...]

The motors of benchmarks/motors.py, 50 W to 100 kW, one with cogging and one on a soft coupling, each on the
emulated drive as a process of its own, in real time by turns (--lockstep: as fast as it goes). The
configuration is 30 % off. Every frame of the logs, decoded by cantools, is held against the limits.
Exit code 1 when a motor misses a goal.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import cantools
from rich.table import Table

from benchmarks.motors import MORE, MOTORS, NAMES, written_bench
from hil.log.reader import open_log
from hil.report.view import show

GOALS: Final = {"R_s": 0.02, "L_d": 0.02, "L_q": 0.02, "psi_f": 0.02, "J": 0.03, "friction": 0.1}
"""Largest shares by which what is found may be off; friction at half of w_max."""
PATIENT: Final = ("feedback.hold_ticks=150", "feedback.quick_stop_ticks=200", "loop.max_gap_ticks=64")
"""The host has more to do than this: it is not what is judged."""
MOST_S: Final = 60.0
MOST_PEAK: Final = 1.0
LIMIT_S: Final = 280


def one_motor(name: str, folder: Path, *, lockstep: bool) -> dict[str, Any]:
    """Identify one of the motors in an empty folder; what was found, its errors, how near the limits."""
    true = dict(zip(NAMES, MOTORS[name], strict=True))
    path = written_bench(folder / "configs", true, *MORE.get(name, ()), "firmware.watchdog_ms=400.0")
    begun = time.monotonic()
    result = identify(path, *(["--lockstep"] if lockstep else []))
    return {
        "motor": name,
        "wall_s": time.monotonic() - begun,
        "off": off(result["parameters"], true),
        "delay_ticks": result["parameters"].get("delay", {"value": math.nan})["value"],
        "peaks": peaks(path, [Path(log) for log in result["logs"]], true),
        **{key: result[key] for key in ("motor_s", "steps", "findings", "faults")},
    }


def identify(path: Path, *more: str) -> dict[str, Any]:
    """What the command says. Raises SystemExit with its message when it says nothing."""
    command = [sys.executable, "-m", "hil.cli", "identify", str(path), "--emulated", "--json"]
    command += ["-o", str(path.with_name("motor.toml")), *more]
    command += [word for setting in PATIENT for word in ("--set", setting)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if not done.stdout:
        raise SystemExit(done.stderr)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def off(found: dict[str, Any], true: dict[str, float]) -> dict[str, float]:
    """Shares by which the parameters are off; NaN for one that is not told."""

    def value(name: str, *, untold: bool = False) -> float:
        p = found.get(name.lower(), {"told": False, "value": None})
        return float(p["value"]) if p["value"] is not None and (p["told"] or untold) else math.nan

    out = {name: value(name) / true[name] - 1.0 for name in GOALS if name in true}
    half = 0.5 * true["w_max"]
    viscous = value("B_f", untold=True) * half  # too small beside dry friction to be told of some motors
    friction = value("coulomb") + viscous
    return out | {"friction": friction / (true["coulomb"] + true["B_f"] * half) - 1.0}


def peaks(path: Path, logs: Sequence[Path], true: dict[str, float]) -> dict[str, float]:
    """The largest current, speed (true and told) and voltage in any frame, as shares of their limits."""
    database = cantools.database.load_file(path.parent / "drives" / "hil_pmsm.dbc")
    out = {"i_max": 0.0, "w_max": 0.0, "u_max": 0.0}
    for log in logs:
        for key, value in sizes(database, open_log(log).frames):
            out[key] = max(out[key], value / true[key])
    return out


def sizes(database: Any, frames: Sequence[Any]) -> Iterator[tuple[str, float]]:
    """Whatever the limits are of, in each frame."""
    for frame in frames:
        message = database.get_message_by_frame_id(frame.can_id)
        if message.name not in ("FEEDBACK", "TRUTH", "COMMAND"):
            continue
        told = message.decode(frame.data, decode_choices=False)
        if message.name == "FEEDBACK":
            yield "i_max", math.hypot(told["CurrentQ"], told["CurrentD"])
            yield "w_max", abs(told["Speed"])
        elif message.name == "TRUTH":
            yield "w_max", abs(told["SpeedTrue"])
        else:
            yield "u_max", math.hypot(told["VoltageQ"], told["VoltageD"])


def misses(row: dict[str, Any]) -> list[str]:
    """Which goals a motor misses."""
    out = [*row["faults"]]
    out += [f"{name} {share:+.2%}" for name, share in row["off"].items() if not abs(share) <= GOALS[name]]
    out += [f"{name} {share:.0%} of it" for name, share in row["peaks"].items() if share > MOST_PEAK]
    if row["delay_ticks"] != 1:
        out.append(f"delay {row['delay_ticks']} ticks")
    if row["motor_s"] >= MOST_S:
        out.append(f"{row['motor_s']:.0f} s of the motor")
    return out


def shown(rows: list[dict[str, Any]]) -> Table:
    """A row a motor."""
    table = Table(title="hil identify, percent off the truth", title_justify="left")
    for column in ("motor", *GOALS, "delay", "motor s", "i, w, u of their limits %", "misses"):
        table.add_column(column)
    for row in rows:
        cells = [f"{100 * row['off'][name]:+.2f}" for name in GOALS]
        near = ", ".join(f"{100 * share:.0f}" for share in row["peaks"].values())
        ends = [f"{row['delay_ticks']:.0f}", f"{row['motor_s']:.1f}", near, "; ".join(misses(row)) or "-"]
        table.add_row(row["motor"], *cells, *ends)
    return table


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identified", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="motors (all)")
    parser.add_argument("--lockstep", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if unknown := [name for name in args.names if name not in MOTORS]:
        parser.error(f"no motor {', '.join(unknown)}; there are {', '.join(MOTORS)}")
    rows = []
    for name in args.names or MOTORS:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(one_motor(name, Path(folder), lockstep=args.lockstep))
        sys.stderr.write(f"{name}: {'; '.join(misses(rows[-1])) or 'all goals'}\n")
    if args.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
    else:
        show(shown(rows))
    return 0 if not any(misses(row) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
