"""``hil report``: what a run did, as a page or a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, keep_memory, one_thread, print_json
from hil.log.outputs import output_file


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "report", cmd_report, "Write one page (.html) or picture (.png) of LOG; several are compared."
    )
    command.add_argument("log", type=Path, nargs="+", metavar="LOG", help="an MCAP file of hil")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: LOG.html")
    command.add_argument("--strict", action="store_true", help="exit code 1 unless every check passes")
    command.add_argument("--no-replay", action="store_true", help="leave the replay out (no verdict)")


def cmd_report(args: argparse.Namespace) -> int:
    """Write a report."""
    one_thread()
    keep_memory()
    from hil.identify.section import identification
    from hil.log.parts import grouped
    from hil.report.build import build
    from hil.report.criteria import SIGNS, judge
    from hil.report.view import key_values, show

    out = output_file(args.output or args.log[0].with_suffix(".html"), ".html", ".png")
    report = build(grouped(args.log), out, verify=not args.no_replay, sections=identification)
    if args.json:
        print_json(report.as_dict())
    else:
        for run in report.runs:
            rows = {c.name: f"{SIGNS[c.outcome]}: {c.found} (wanted: {c.wanted})" for c in judge(run)}
            show(key_values(run.name, rows | {"report": report.path}))
    return EXIT_FAILED if args.strict and not report.passed else 0
