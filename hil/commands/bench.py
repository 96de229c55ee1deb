"""``hil bench``: cost of a tick, rate and lateness on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, bus_flags, overrides, print_json, say
from hil.log.outputs import output_folder


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "bench",
        cmd_bench,
        "Measure cost of a tick, rate, lateness, replay and simulation beside a bare loop and cyclictest.",
    )
    command.add_argument("config", nargs="?", type=Path, help="configuration (default: configs/demo.toml)")
    bus_flags(command)
    command.add_argument(
        "--quick", action="store_true", help="seconds instead of minutes; no search of rates"
    )
    command.add_argument(
        "--awake", action="store_true", help="keep the cores from idling, as the kernel's idle=poll does"
    )
    command.add_argument("--compare", type=Path, metavar="FILE", help="an earlier --json output: show ratios")
    command.add_argument("-o", "--output", type=Path, metavar="DIR", help="write lateness.png and bench.html")


def cmd_bench(args: argparse.Namespace) -> int:
    """Run the bench."""
    from hil.bench.measure import FULL, QUICK, bench
    from hil.bench.page import write
    from hil.bench.view import ratio_rows, ratios, read_result, rows
    from hil.config.shipped import find_config
    from hil.report.view import key_values, show

    earlier = read_result(args.compare) if args.compare else None
    out = output_folder(args.output, "lateness.png", "bench.html") if args.output else None
    path = args.config or find_config("demo.toml")
    done = bench(path, overrides(args), QUICK if args.quick else FULL, say, keep_awake=args.awake)
    result = done.result
    if earlier is not None:
        result["compared"] = ratios(result, earlier)
    written = write(done, out) if out else []
    if args.json:
        print_json(result)
        return 0
    show(key_values("hil bench", dict(rows(result))))
    if earlier is not None:
        show(key_values(f"beside {args.compare}", dict(ratio_rows(result["compared"]))))
    for one in written:
        say(f"bench: {one}")
    return 0
