"""``hil export``: a log in the formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, print_json


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "export",
        cmd_export,
        "Write LOG in another format, by the ending of FILE: ticks as .parquet .csv .mat .mf4, "
        "frames as .log (candump) .asc .blf.",
    )
    command.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", required=True)
    command.add_argument("--force", action="store_true", help="replace FILE when it exists")


def cmd_export(args: argparse.Namespace) -> int:
    """Write a log in another format."""
    from hil.convert.export import export
    from hil.view import key_values, show

    found = export(args.log, args.output, force=args.force).as_dict()
    if args.json:
        print_json(found)
    else:
        show(key_values("hil export", found))
    return 0
