"""``hil demo``: one minute without hardware."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, overrides, print_json, say


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "demo", cmd_demo, "Start the emulator, close the loop, step the load, replay, show what happened."
    )
    command.add_argument("config", nargs="?", type=Path, help="configuration (default: configs/demo.toml)")
    command.add_argument(
        "--plant-set", action="append", default=[], metavar="KEY=VALUE", help="override a plant key"
    )
    bus_flags(command)
    command.add_argument("--lockstep", action="store_true", help="no real time: reproducible to the bit")


def cmd_demo(args: argparse.Namespace) -> int:
    """Run the demo."""
    from hil.report.view import demo_table, show
    from hil.sim.demo import demo

    say("demo: emulated drive, closed loop at 1 kHz, load step, replay; about ten seconds")
    result = demo(args.config, overrides(args), tuple(args.plant_set))
    if args.json:
        print_json(result)
    else:
        show(demo_table(result))
    good = result["ended"] == "stop_requested" and result["replay"]["verdict"] == "same"
    return 0 if good else EXIT_FAILED
