"""``hil faults``: every scripted fault against the running loop."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, print_json, say
from hil.log.outputs import output_file


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "faults", cmd_faults, "Run the fault matrix; exit 1 when a row is not as expected."
    )
    command.add_argument(
        "config", nargs="?", type=Path, help="matrix, or run configuration (default: configs/faults.toml)"
    )
    command.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="rows whose name contains NAME"
    )
    command.add_argument("--html", type=Path, metavar="FILE", help="write one self-contained page")
    command.add_argument(
        "--folder", type=Path, metavar="DIR", default=Path("logs/faults"), help="logs of the runs"
    )
    command.add_argument("-j", "--jobs", type=int, default=2, help="runs side by side (default: 2)")


def cmd_faults(args: argparse.Namespace) -> int:
    """Run the matrix."""
    from datetime import UTC, datetime

    from hil.config.shipped import find_config
    from hil.faults.judge import AS_EXPECTED
    from hil.faults.matrix import chosen, load_matrix
    from hil.faults.page import page
    from hil.faults.study import study
    from hil.faults.view import closing, table
    from hil.report.view import show

    html = output_file(args.html, ".html", ".htm") if args.html else None
    shipped = find_config("faults.toml")
    matrix, path = load_matrix(args.config or shipped, shipped)
    folder = args.folder.resolve() / datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    rows = chosen(matrix, args.only)
    say(f"faults: {len(rows)} runs; logs in {folder}")
    jobs = max(1, args.jobs)
    results = study(path, matrix, rows, folder, jobs, lambda r: say(f"  {r.fault}: {r.verdict}"))
    if html:
        html.write_text(page(results), encoding="utf-8")
    if args.json:
        good = sum(r.verdict == AS_EXPECTED for r in results)
        print_json({"rows": [r.as_dict() for r in results], "as_expected": good, "of": len(results)})
    else:
        show(table(results))
        say(closing(results))
    return 0 if all(r.verdict == AS_EXPECTED for r in results) else EXIT_FAILED
