"""``hil paper``: the paper recomputed."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, say
from hil.log.outputs import output_folder


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "paper", cmd_paper, "Recompute all that the paper prints and draws, with a verdict on each item."
    )
    command.add_argument(
        "-o", "--output", type=Path, default=Path("logs/paper"), metavar="DIR", help="folder for all"
    )


def cmd_paper(args: argparse.Namespace) -> int:
    """Recompute the paper."""
    from hil.config.shipped import find_config
    from hil.paper import run
    from hil.report.view import show
    from hil.runtime.setup import Overrides
    from hil.sim.demo import closed_loop

    out = output_folder(args.output, "paper.html")
    say("paper: the corrected design on the bench over the bus (lockstep), then every figure; under a minute")
    settings = ('loop.clock="lockstep"', f'log.folder="{out.resolve()}"')
    _, _, log = closed_loop(find_config("paper.toml"), Overrides(settings=settings))
    result = run(out, log.ticks)
    if args.json:
        print(result.to_json())  # noqa: T201
    else:
        show(result.table())
        say(f"page: {result.page}")
    return 0
