"""``hil emulate`` and ``hil simulate``: the emulated drive, on a bus or without one."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, overrides, print_json, say


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("emulate", cmd_emulate, "Serve the emulated drive that CONFIG names until Ctrl-C.")
    command.add_argument(
        "config", type=Path, metavar="CONFIG", help="run configuration with an [emulator] table"
    )
    command.add_argument("--lockstep", action="store_true", help="advance by one period a SYNC")
    command.add_argument(
        "--plant-set", action="append", default=[], metavar="KEY=VALUE", help="override a plant key"
    )
    command.add_argument("--parent", type=int, help=argparse.SUPPRESS)  # end with this process
    bus_flags(command)
    command = commands.add(
        "simulate", cmd_simulate, "Run controller and emulated motor in one process without a bus."
    )
    command.add_argument(
        "config", type=Path, metavar="CONFIG", help="run configuration with an [emulator] table"
    )
    command.add_argument("--duration", type=float, metavar="S", help="simulate S seconds")
    command.add_argument("--no-log", action="store_true", help="write no log")
    for flag, what in (("--sweep", "config"), ("--plant-sweep", "plant")):
        command.add_argument(
            flag,
            action="append",
            default=[],
            metavar="KEY=[V,...]",
            help=f"a table over all combinations of values of {what} keys, without logs",
        )
    command.add_argument(
        "--plant-set", action="append", default=[], metavar="KEY=VALUE", help="override a plant key"
    )
    bus_flags(command)


def cmd_emulate(args: argparse.Namespace) -> int:
    """Serve the emulated drive until stopped."""
    from hil.runtime.lifeline import end_with

    if args.parent is not None:
        end_with(args.parent)
    from hil.sim.emulate import serve

    serve(args.config, overrides(args), args.plant_set)
    return 0


def cmd_simulate(args: argparse.Namespace) -> int:
    """Simulate a config, or a sweep over it."""
    from hil.report.view import end_rows, key_values, progress, show
    from hil.runtime.setup import load_setup
    from hil.sim.simulate import simulate

    if args.sweep or args.plant_sweep:
        return _sweep(args)
    setup = load_setup(args.config, overrides(args))
    for line in setup.warnings:
        say(f"warning: {line}")
    loop = setup.config.loop
    total = None if loop.duration_s is None else round(loop.duration_s * loop.rate_hz)
    with progress("simulate", total) as seen:
        result = simulate(setup, args.plant_set, log=not args.no_log, seen=seen)
    if args.json:
        print_json(result)
    else:
        rows = {key: value for key, value in result.items() if key != "end"}
        show(key_values("hil simulate", rows | end_rows(result["end"])))
    return 0 if result["ok"] else EXIT_FAILED


def _sweep(args: argparse.Namespace) -> int:
    from hil.campaign.sweep import job_of_sweep, sweep
    from hil.report.view import progress, show, sweep_table

    job, stand = job_of_sweep(args.config, overrides(args), args.plant_set, args.sweep, args.plant_sweep)
    count = stand.plan.count
    with progress(f"simulate {count} cases", count) as seen:
        rows = sweep(job, stand, seen)
    if args.json:
        print_json({"rows": rows})
    else:
        show(sweep_table(rows))
    return 0 if all(row["ended"] == "stop_requested" for row in rows) else EXIT_FAILED
