"""``hil replay``: the controller over a log, or over many; or another controller over one."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from hil.commands.common import Commands, keep_memory, one_run, print_json, say
from hil.log.outputs import output_file, output_log

if TYPE_CHECKING:
    from hil.replay import Verdict, Window

TEXT = "Re-run the controller over LOG; exit 0 same to the bit, 1 differs, 2 cannot; the worst of many."


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("replay", cmd_replay, TEXT)
    command.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="MCAP files of hil")
    command.add_argument(
        "--fleet",
        nargs="+",
        metavar="GLOB|DIR",
        help="verdict and figures of many logs, on all cores; -o DIR: as Parquet",
    )
    command.add_argument("-j", "--workers", type=int, metavar="N", help="with --fleet: local processes")
    command.add_argument("--resume", action="store_true", help="with --fleet -o: go on with that folder")
    command.add_argument(
        "--from",
        dest="start",
        type=float,
        default=0.0,
        metavar="S",
        help="compare from S seconds of the run on (the controller's state still comes from its start)",
    )
    command.add_argument("--to", dest="end", type=float, metavar="S", help="compare up to S seconds")
    command.add_argument("--junit", type=Path, metavar="FILE", help="verdicts as JUnit XML")
    command.add_argument(
        "--config",
        type=Path,
        metavar="NEW",
        help="instead: what the controller of NEW would have estimated and asked for (open loop)",
    )
    command.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="with --config: its ticks as MCAP; with --fleet: a folder of rows",
    )


def cmd_replay(args: argparse.Namespace) -> int:
    """Replay logs."""
    keep_memory()
    from hil.errors import HilError
    from hil.log.parts import grouped
    from hil.replay import Window

    if args.fleet:
        return _fleet(args)
    if not args.logs:
        raise HilError("name one or more logs, or --fleet with a folder or a pattern")
    end = float("inf") if args.end is None else args.end
    if args.config:
        if args.junit or args.start or args.end is not None:
            raise HilError("--config takes no --junit, --from or --to")
        return _what_if(args)
    if args.output:
        raise HilError("-o needs --config; a replay itself writes nothing")
    if not 0 <= args.start < end:
        raise HilError(f"--from {args.start:g} --to {end:g}: no such window")
    if args.junit:
        output_file(args.junit, ".xml")
    results = [_timed(paths, Window(args.start, end)) for paths in grouped(args.logs)]
    _report(args, results)
    return max(verdict.exit_code for _, verdict, _ in results)


def _timed(paths: tuple[Path, ...], window: Window) -> tuple[Path, Verdict, float]:
    from hil.replay import replay
    from hil.report.view import progress

    start = time.perf_counter()
    with progress(f"replay {paths[0].name}", _ticks_of(paths[0]) if len(paths) == 1 else None) as seen:
        verdict = replay(paths, window, seen)
    return paths[0], verdict, time.perf_counter() - start


def _ticks_of(path: Path) -> int | None:
    """How many ticks the summary counts, None where there is none: for the progress bar alone."""
    from hil.errors import HilError
    from hil.log.info import info

    try:
        return info(path).counts.get("/tick") if path.is_file() else None
    except HilError:
        return None


def _report(args: argparse.Namespace, results: list[tuple[Path, Verdict, float]]) -> None:
    from hil.report.view import replay_table, show

    if args.junit:
        from hil.report.junit import junit

        args.junit.write_text(junit(results), encoding="utf-8")
    if not args.json:
        show(replay_table(results))
    elif len(results) == 1:
        print_json(results[0][1].as_dict())
    else:
        print_json({"rows": [{"log": str(path)} | verdict.as_dict() for path, verdict, _ in results]})


def _fleet(args: argparse.Namespace) -> int:
    """The worst verdict of all is the exit code."""
    from hil.campaign.fleet import counts, fleet
    from hil.campaign.view import fleet_table
    from hil.commands.campaign import progress as rate
    from hil.errors import HilError
    from hil.report.view import show

    if args.config or args.junit or args.start or args.end is not None:
        raise HilError(
            "--fleet takes no --config, --junit, --from or --to; hil campaign --what-if tries a config"
        )
    places = [*args.fleet, *map(str, args.logs)]
    with rate("logs") as seen:
        rows, _ = fleet(places, folder=args.output, workers=args.workers, resume=args.resume, seen=seen)
    if args.json:
        folder = None if args.output is None else str(args.output)
        print_json({**counts(rows), "folder": folder, "rows": rows})
    else:
        show(fleet_table(rows))
    return max(({"same": 0, "differs": 1}.get(row["verdict"], 2) for row in rows), default=0)


def _what_if(args: argparse.Namespace) -> int:
    from hil.config.nodefile import load_nodes
    from hil.config.tables import RunConfig, load_toml
    from hil.errors import HilError
    from hil.log.info import info_of
    from hil.replay.whatif import what_if
    from hil.report.view import show, what_if_table

    nodes = load_nodes(args.config)
    if nodes and args.output:
        raise HilError(f"{args.config}: has {len(nodes)} nodes, -o takes one's ticks; leave it out")
    configs = nodes or {"": load_toml(args.config, RunConfig, [])}
    out = output_log(args.output) if args.output else None
    run = one_run(args.logs)
    first, *_ = [*info_of(run).nodes, ""]
    found = {
        name: what_if(run, args.config, config, out, "" if name == first else name)
        for name, config in configs.items()
    }
    if args.json:
        print_json({"nodes": {n: f.as_dict() for n, f in found.items()}} if nodes else found[""].as_dict())
        return 0
    for name, one in found.items():
        if name:
            say(f"node {name}:")
        show(what_if_table(one))
    say("open loop: the motor answered to the logged commands, not to these")
    return 0
