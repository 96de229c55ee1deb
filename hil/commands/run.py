"""``hil run`` and ``hil check``: the controller on a bus."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, overrides, print_json, say


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "run", cmd_run, "Close the loop on the bus of CONFIG. Sends nothing before the drive was armed."
    )
    command.add_argument("config", type=Path, metavar="CONFIG", help="run configuration (TOML)")
    command.add_argument("--arm", action="store_true", help="allow voltage on a bus that is not emulated")
    command.add_argument("--yes", action="store_true", help="with --arm: do not ask on the terminal")
    command.add_argument(
        "--shadow", action="store_true", help="read and compute, send nothing, not even SYNC"
    )
    command.add_argument(
        "--dead-man",
        action="store_true",
        help="stop when standard input closes or, on a terminal, when no key is held for a second",
    )
    command.add_argument("--duration", type=float, metavar="S", help="stop after S seconds")
    command.add_argument("--lockstep", action="store_true", help="the emulator advances by one period a SYNC")
    bus_flags(command)
    command = commands.add(
        "check",
        cmd_check,
        "Check interface, drive, limits, bus load and rights. Sends no SYNC and no command.",
    )
    command.add_argument("config", type=Path, metavar="CONFIG", help="run configuration (TOML)")
    bus_flags(command)


def cmd_run(args: argparse.Namespace) -> int:
    """Run a config on its bus."""
    from hil.runtime.arming import confirm, requesting
    from hil.runtime.bus import is_emulated_bus
    from hil.runtime.nodesession import run_nodes
    from hil.runtime.nodesetup import load_node_setups
    from hil.runtime.refusals import check_arming
    from hil.runtime.session import run
    from hil.runtime.setup import load_setup

    nodes = load_node_setups(args.config, overrides(args))
    setups = list(nodes.values()) if nodes else [load_setup(args.config, overrides(args))]
    for setup in setups:
        check_arming(setup, args.arm)
    if not (args.yes or args.shadow or is_emulated_bus(setups[0].config)):
        confirm([setup.config for setup in setups], sys.stdin, sys.stderr)
    with requesting(args.dead_man, sys.stdin, say) as request:
        if nodes:
            result = run_nodes(nodes, arm=args.arm, request=request)
        else:
            result = run(setups[0], arm=args.arm, request=request)
    if args.json:
        print_json(result.as_dict())
    else:
        from hil.report.view import (  # not before: what it imports would keep the drive waiting
            run_table,
            show,
        )

        show(run_table(result))
    return 0 if result.ok else EXIT_FAILED


def cmd_check(args: argparse.Namespace) -> int:
    """Check everything before arming."""
    from hil.check.checks import check, check_nodes, check_table, passed
    from hil.report.view import show
    from hil.runtime.nodesetup import load_node_setups
    from hil.runtime.setup import load_setup

    nodes = load_node_setups(args.config, overrides(args))
    rows = check_nodes(nodes) if nodes else check(load_setup(args.config, overrides(args)))
    if args.json:
        print_json({"rows": [row.as_dict() for row in rows]})
    else:
        show(check_table(rows))
    return 0 if passed(rows) else EXIT_FAILED
