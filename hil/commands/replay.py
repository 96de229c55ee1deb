"""``hil replay``: the controller over a log."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, print_json


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "replay", cmd_replay, "Re-run the controller over LOG; exit 0 same to the bit, 1 differs, 2 cannot."
    )
    command.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")


def cmd_replay(args: argparse.Namespace) -> int:
    """Replay a log."""
    from hil.replay import replay
    from hil.view import replay_table, show

    verdict = replay(args.log)
    if args.json:
        print_json(verdict.as_dict())
    else:
        show(replay_table(args.log, verdict))
    return verdict.exit_code
