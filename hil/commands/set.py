"""``hil set``: a live set-point for a running run."""

from __future__ import annotations

import argparse
import os

from hil.commands.common import Commands, print_json, say


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "set",
        cmd_set,
        "Set the reference of a running run of this user: w [rad/s], with controller fac i_q [A], too. It "
        "moves there at the config's rate, within the config's range, and is an event of the log.",
    )
    command.add_argument("items", nargs="+", metavar="NAME=VALUE", help="w=60; one RUN may stand beside it")
    command.add_argument(
        "--node",
        default="",
        metavar="NAME",
        help="of a run with several nodes the one whose reference is set (default: the first)",
    )
    command.add_argument(
        "--run", dest="run_name", metavar="RUN", help="PID, channel or log; with several runs"
    )


def parsed(items: list[str]) -> tuple[dict[str, float], list[str]]:
    """Values by name, and what names a run. Raises HilError for what is no value."""
    from hil.errors import HilError

    values: dict[str, float] = {}
    runs = [item for item in items if "=" not in item]
    for item in (item for item in items if "=" in item):
        name, _, text = item.partition("=")
        try:
            value = float(text)
        except ValueError:
            raise HilError(f"{item}: {text!r} is not a number; write it as w=60") from None
        if name in values:
            raise HilError(f"{item}: {name} is given twice")
        values[name] = value
    return values, runs


def cmd_set(args: argparse.Namespace) -> int:
    """Set references."""
    from hil.errors import HilError
    from hil.runtime.inbox import SetpointError, ask, outside, shown
    from hil.runtime.registry import choose, no_node

    values, runs = parsed(args.items)
    runs += [args.run_name] if args.run_name else []
    if not values or len(runs) > 1:
        raise HilError("say what to set and at most one run: hil set w=60 [PID, channel or log]")
    entry = choose(runs[0] if runs else None)
    if why := no_node(entry, args.node):
        raise SetpointError(f"{why}; nothing was set")
    takes, of = entry.takes_of(args.node), f"node {args.node} of {entry}" if args.node else str(entry)
    if why := outside(values, takes):
        raise SetpointError(f"{of}: {why}; nothing was set")
    who = f"hil set, PID {os.getpid()}, user id {os.getuid()}"
    ask(entry.pid, values, who, node=entry.place_of(args.node))
    if args.json:
        rates, node = {name: takes[name][2] for name in values}, {"node": args.node} if args.node else {}
        print_json({"pid": entry.pid, "log": entry.log} | node | {"set": values, "rate": rates})
    else:
        say(f"hil: {shown(values)} for {of}")
    return 0
