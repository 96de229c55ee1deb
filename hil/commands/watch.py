"""``hil watch``: a running run, live."""

from __future__ import annotations

import argparse
import contextlib
from typing import TYPE_CHECKING, Any

from hil.commands.common import Commands, print_json, say

if TYPE_CHECKING:
    from hil.watch.look import Look

WEB_PORT, FOXGLOVE_PORT = 8080, 8765
OPEN = (
    "--foxglove: that protocol has no password, so every program of this machine, other users' too, and "
    "every web page open here could read the run; say --open beside it where that is fine"
)


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("watch", cmd_watch, "Watch a run of this user live; the run never waits for it.")
    command.add_argument(
        "run_name", nargs="?", metavar="RUN", help="PID, channel or log; needed with several runs"
    )
    view = command.add_mutually_exclusive_group()
    view.add_argument("--once", action="store_true", help="print one frame and leave")
    view.add_argument("--web", action="store_true", help="a page on 127.0.0.1 with plots and a stop button")
    command.add_argument(
        "--port", type=_port, metavar="N", help="default 8080 for --web, 8765 for --foxglove; 0: any"
    )
    view.add_argument(
        "--foxglove", action="store_true", help="serve Foxglove, Lichtblick and PlotJuggler on 127.0.0.1"
    )

    command.add_argument(
        "--node",
        default="",
        metavar="NAME",
        help="of a run with several nodes the one to see (default: the first; --foxglove has all)",
    )
    command.add_argument(
        "--open",
        action="store_true",
        help="with --foxglove, whose protocol has no password: let every program and page here read the run",
    )


def _port(text: str) -> int:
    """A TCP port."""
    with contextlib.suppress(ValueError):
        if 0 <= (port := int(text)) <= 65535:
            return port
    raise argparse.ArgumentTypeError(f"{text!r} must be a port, 0 to 65535")


def _seen(look: Look) -> dict[str, Any]:
    """The figures of a run as JSON; of one with several nodes each one's, too."""
    from hil.watch.look import Look, figures

    entry, nodes = look.entry, {}
    for name in entry.nodes:
        with contextlib.closing(Look(entry, name)) as own:
            nodes[name] = figures(own, own.latest(entry.rate_hz))
    run = {"pid": entry.pid, "bus": entry.bus, "log": entry.log}
    return figures(look, look.latest(entry.rate_hz)) | run | ({"nodes": nodes} if nodes else {})


def cmd_watch(args: argparse.Namespace) -> int:
    """Watch a run."""
    from hil.runtime.registry import WatchError, choose
    from hil.watch import terminal
    from hil.watch.look import Look

    if args.web:
        from hil.watch import web

        web.run(args.run_name, WEB_PORT if args.port is None else args.port, say, args.node)
        return 0
    if args.foxglove:
        from hil.watch import stream

        if args.node:
            raise WatchError(f"--foxglove: has the ticks of all nodes; leave out --node {args.node}")
        if not args.open:
            raise WatchError(OPEN)
        stream.run(args.run_name, FOXGLOVE_PORT if args.port is None else args.port, say)
        return 0
    look = Look(choose(args.run_name), args.node)
    try:
        if args.json:
            print_json(_seen(look))
        elif args.once:
            terminal.once(look)
        else:
            say(f"hil: {terminal.live(look)}")
    finally:
        look.close()
    return 0
