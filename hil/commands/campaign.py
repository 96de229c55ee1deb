"""``hil campaign``: a plan's cases over cores or a cluster; campaigns compared; logs under a new config."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.common import EXIT_FAILED, Commands, print_json, say

if TYPE_CHECKING:
    from hil.campaign.engine import Rate

EVERY_S = 10.0
MANY = 1000
"""A plan of so many samples is not done in this process."""


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "campaign", cmd_campaign, "Run every case of PLAN into a folder of rows and a report."
    )
    command.add_argument(
        "what",
        nargs="*",
        type=Path,
        metavar="PLAN",
        help="the plan; for --compare two folders, for --what-if logs",
    )
    command.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder of the results (default: PLAN without .toml)"
    )
    command.add_argument(
        "-j",
        "--workers",
        type=int,
        metavar="N",
        help="local processes (default: one a core; 0: none but this)",
    )
    command.add_argument(
        "--scheduler", metavar="ADDRESS", help="an existing scheduler of Dask, tcp://HOST:PORT"
    )
    command.add_argument("--resume", action="store_true", help="go on with what the folder holds")
    command.add_argument(
        "--dry-run", action="store_true", help="say how many cases, how long, how large; run none"
    )
    command.add_argument("--case", type=int, metavar="N", help="run case N alone and print its row")
    command.add_argument(
        "--compare", action="store_true", help="instead: two folders of campaigns, DIR BEFORE AFTER"
    )
    command.add_argument(
        "--what-if", type=Path, metavar="NEW", help="instead: the controller of NEW over logs, open loop"
    )
    command.add_argument("--strict", action="store_true", help="exit code 1 unless every case passes")


def cmd_campaign(args: argparse.Namespace) -> int:
    """Run a campaign."""
    from hil.errors import HilError

    if args.compare:
        return _compare(args)
    if args.what_if:
        return _what_if(args)
    if len(args.what) != 1:
        raise HilError(f"hil campaign takes one PLAN, not {len(args.what)}")
    if args.dry_run:
        return _dry_run(args)
    if args.case is not None:
        return _case(args)
    return _run(args)


def _dry_run(args: argparse.Namespace) -> int:
    from hil.campaign.run import dry_run
    from hil.report.view import key_values, show

    found = dry_run(args.what[0], args.workers)
    if args.json:
        print_json(found)
    else:
        rows = {
            "cases": found["cases"],
            "time": f"about {found['seconds']:.0f} s with {found['workers'] or 'this process, no'} workers",
            "size": f"about {found['bytes'] / 1e6:.1f} MB",
            "varied": ", ".join(found["keys"]),
        }
        show(key_values(args.what[0].name, rows))
    return 0


def _case(args: argparse.Namespace) -> int:
    from hil.campaign.run import one_case
    from hil.report.view import key_values, show

    row = one_case(args.what[0], args.case)
    if args.json:
        print_json(row)
    else:
        show(key_values(f"case {args.case}", row))
    return EXIT_FAILED if args.strict and not row["passed"] else 0


def _begin_early(args: argparse.Namespace) -> None:
    """Begin what workers are forked from before this process imports, where they will surely be wanted."""
    import tomllib

    from hil.campaign.engine import begin_forks

    try:
        samples = tomllib.loads(args.what[0].read_text(encoding="utf-8")).get("samples")
    except (OSError, ValueError):
        return  # said by what reads it in earnest
    many = isinstance(samples, int) and samples >= MANY
    if not args.scheduler and (many if args.workers is None else args.workers > 0):
        begin_forks()


def _run(args: argparse.Namespace) -> int:
    _begin_early(args)
    from hil.campaign.run import campaign
    from hil.report.view import key_values, show

    folder = args.output or args.what[0].with_suffix("")
    options: dict[str, Any] = {"workers": args.workers, "scheduler": args.scheduler, "resume": args.resume}
    with progress("cases") as seen:
        result = campaign(args.what[0], folder, **options, seen=seen)
    if args.json:
        print_json(result.as_dict())
    else:
        show(key_values(f"hil campaign {args.what[0].name}", result.as_dict()))
    return EXIT_FAILED if args.strict and result.failed else 0


def _compare(args: argparse.Namespace) -> int:
    """Exit code 1 when a case that passed before does not any more."""
    from hil.campaign.compare import compare
    from hil.campaign.view import compare_tables
    from hil.errors import HilError
    from hil.report.view import show

    if len(args.what) != 2:
        raise HilError("--compare takes two folders, that of before and that of after")
    found = compare(*args.what)
    if args.json:
        print_json(found)
    else:
        for table in compare_tables(found):
            show(table)
    return EXIT_FAILED if found.get("regressions") else 0


def _what_if(args: argparse.Namespace) -> int:
    from hil.campaign.fleet import counts, fleet
    from hil.campaign.view import what_if_table
    from hil.report.view import show

    options: dict[str, Any] = {"workers": args.workers, "scheduler": args.scheduler, "resume": args.resume}
    with progress("logs") as seen:
        rows, _ = fleet(
            [str(path) for path in args.what], config=args.what_if, folder=args.output, **options, seen=seen
        )
    if args.json:
        folder = None if args.output is None else str(args.output)
        print_json({**counts(rows), "folder": folder, "open_loop": True, "rows": rows})
    else:
        show(what_if_table(rows))
        say("open loop: the motors answered to the logged commands, not to these")
    return EXIT_FAILED if any(row["verdict"] == "cannot" for row in rows) else 0


@contextlib.contextmanager
def progress(unit: str) -> Iterator[Callable[[Rate], None]]:
    """Rate and time left on standard error: a line that is rewritten, or one every ten seconds."""
    terminal, last = sys.stderr.isatty(), [0.0]

    def seen(rate: Rate) -> None:
        line = rate.line(unit)
        if terminal:
            sys.stderr.write(f"\r\x1b[K{line}")
        elif rate.seconds - last[0] >= EVERY_S:
            last[0] = rate.seconds
            say(f"hil: {line}")

    try:
        yield seen
    finally:
        if terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
