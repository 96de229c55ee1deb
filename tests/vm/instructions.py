"""`python -m tests.vm.instructions`: instructions a tick in the bench machine, by phase, against the budget.

The loop's thread alone is counted, in virtual time (one instruction, one nanosecond): on vcan0, the Kvaser
pair and 64-byte frames, where the bare loop of the same boot is the floor, with each shipped drive, and with
one CiA 402 node and two.
`--update` writes the budget anew: what was measured and 3 percent. The budget is in `budget.toml` and nowhere
else.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from tests.vm.machine import MachineError, run_in_machine

BUDGET = Path(__file__).resolve().parent / "budget.toml"
ROOM = 1.03
LEFT = ("instructions.json", "nodes.json")
Counted = dict[str, Any]
"""What `tests/vm/guest/instructions.py` leaves."""


def boot(timeout_s: float) -> Counted:
    """Count in a machine of its own. Raises MachineError."""
    with tempfile.TemporaryDirectory(prefix="hil-instructions-") as folder:
        result = run_in_machine(
            ["python", "tests/vm/guest/suite.py", "rehearsal", "instructions", "two_nodes"],
            timeout_s=timeout_s,
            out=Path(folder),
        )
        if not all((Path(folder) / name).is_file() for name in LEFT):
            raise MachineError(f"not all was counted: {result.stdout[-2000:]}{result.stderr[-2000:]}")
        return read(Path(folder))


def read(folder: Path) -> Counted:
    """What one boot counted: each drive and bus, then one node and two."""
    counted, nodes = (json.loads((folder / name).read_text()) for name in LEFT)
    return counted | {"buses": counted["buses"] | nodes}


def budget() -> dict[str, dict[str, float]]:
    """Each bus's budget: ``tick`` in all, and each phase as it was when the budget was set."""
    table: dict[str, dict[str, float]] = tomllib.loads(BUDGET.read_text())
    return table


def table_of(bus: Counted, before: dict[str, float] | None = None) -> str:
    """One bus: in all, the floor, then each phase, each beside what it was when the budget was set."""
    total, bare = total_of(bus), bus.get("bare")
    beside = f"   {total / bare:.2f} x the bare loop's {bare:.0f}" if bare else ""
    lines = [
        f"  {'in all':<18}{total:>9.0f}{beside}",
        f"  {'two runs apart':<18}{apart(bus):>9.0f}",
    ]
    for name, count in sorted(bus.get("phases", {}).items(), key=lambda one: -one[1]):
        was = (before or {}).get(name)
        note = "" if was is None else f"   was {was:.0f}, {count - was:+.0f}"
        lines.append(f"  {name:<18}{count:>9.0f}{note}")
    return "\n".join(lines)


def total_of(bus: Counted) -> float:
    """Instructions a tick: the lowest of the plain runs, since a stall of the machine only adds."""
    return float(min(bus["runs"]))


def apart(bus: Counted) -> float:
    """How far the two lowest runs are apart: instructions a tick."""
    runs = sorted(bus["runs"])[:2]
    return float(runs[-1] - runs[0])


def excess(name: str, bus: Counted) -> str:
    """ "" within the budget, else by how much it is over and which phases grew."""
    allowed = budget()[name]
    over = total_of(bus) - allowed["tick"]
    if over <= 0:
        return ""
    share = 100 * over / allowed["tick"]
    return (
        f"{name}: {total_of(bus):.0f} instructions a tick are {over:.0f} ({share:.1f} %) over the budget of "
        f"{allowed['tick']:.0f} in {BUDGET.name}\n{table_of(bus, allowed)}"
    )


def budget_text(counted: Counted) -> str:
    """The budget's file for what was counted."""
    lines = [
        "# Instructions a tick of the loop's thread in the bench machine: the one place of the budget.",
        "# tick: what is allowed (measured and 3 percent); the phases: what they were then, for the message.",
        "# Written by `python -m tests.vm.instructions --update`.",
    ]
    for name, bus in counted["buses"].items():
        lines += ["", f"[{name}]", f"tick = {round(total_of(bus) * ROOM)}"]
        lines += [f'"{phase}" = {round(count)}' for phase, count in bus.get("phases", {}).items()]
    return "\n".join(lines) + "\n"


def show(counted: Counted) -> str:
    """Every bus, with the guard's part."""
    known = budget() if BUDGET.is_file() else {}
    parts = [f"{name}\n{table_of(bus, known.get(name))}" for name, bus in counted["buses"].items()]
    return "\n".join([*parts, f"of control and guard, the guard: {counted['guard']:.0f}"])


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.vm.instructions", description=__doc__)
    parser.add_argument("--update", action="store_true", help="write the budget anew")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--timeout", type=float, default=900.0, metavar="S")
    args = parser.parse_args()
    try:
        counted = boot(args.timeout)
    except MachineError as error:
        print(f"instructions: {error}", file=sys.stderr)
        return 2
    print(json.dumps(counted, indent=2) if args.json else show(counted))
    if args.update:
        BUDGET.write_text(budget_text(counted))
        return 0
    over = [text for name, bus in counted["buses"].items() if (text := excess(name, bus))]
    print(*over, sep="\n", file=sys.stderr)
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
