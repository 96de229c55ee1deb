"""``hil info`` and ``hil recover``: what is in a log."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, one_run, print_json
from hil.log.outputs import output_log


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("info", cmd_info, "Say what is in LOG, from its summary alone.")
    command.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a log, or the parts of one run")
    command = commands.add(
        "recover", cmd_recover, "Rewrite a damaged LOG with its summary and say what is missing."
    )
    command.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: LOG.recovered.mcap")


def cmd_info(args: argparse.Namespace) -> int:
    """Say what is in a log."""
    from hil.log.info import info, info_of
    from hil.report.view import key_values, show

    paths = one_run(args.logs)
    found = (info(paths[0]) if len(paths) == 1 else info_of(paths)).as_dict()
    if args.json:
        print_json(found)
    else:
        show(key_values("hil info", found))
    return 0


def cmd_recover(args: argparse.Namespace) -> int:
    """Rewrite a damaged log."""
    from hil.log.recover import recover
    from hil.report.view import key_values, show

    out = output_log(args.output or args.log.with_suffix(".recovered.mcap"))
    found = recover(args.log, out).as_dict() | {"written": str(out)}
    if args.json:
        print_json(found)
    else:
        show(key_values("hil recover", found))
    return 0
