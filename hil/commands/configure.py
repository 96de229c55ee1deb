"""``hil configure``: a CANopen CiA 402 drive set up from its EDS or DCF."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, overrides, print_json

if TYPE_CHECKING:
    from hil.runtime.configure import Result


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "configure",
        cmd_configure,
        "Set up the CiA 402 drive of CONFIG by SDO and read all back. Starts and enables nothing.",
    )
    command.add_argument("config", type=Path, metavar="CONFIG", help="run configuration with [canopen]")
    command.add_argument("--check", action="store_true", help="only compare, change nothing")
    command.add_argument("--store", action="store_true", help="save it in the drive (1010h)")
    command.add_argument("--dbc", type=Path, metavar="FILE", help="write the DBC of the drive's frames")
    bus_flags(command)


def cmd_configure(args: argparse.Namespace) -> int:
    """Set a node up, or only compare."""
    from hil.config.tables import RunConfig, load_toml
    from hil.errors import HilError
    from hil.runtime.bus import bus_settings
    from hil.runtime.configure import compare, configure, job_of

    if args.check and (args.store or args.dbc):
        raise HilError("--check changes nothing: leave --store and --dbc out")
    config = load_toml(args.config, RunConfig, overrides(args).as_settings())
    job = job_of(args.config, config, bus_settings(config))
    result = compare(job) if args.check else configure(job, store=args.store, dbc=args.dbc)
    if args.json:
        print_json(result.as_dict())
    else:
        _show(result, args.check)
    return EXIT_FAILED if result.problems else 0


def _show(result: Result, only_compared: bool) -> None:
    """Two tables: every object, and what the drive is."""
    from rich.table import Table

    from hil.report.view import key_values, show, words

    did = "compared" if only_compared else "set and read back"
    table = Table(title=f"node {result.node_id}, mode {result.mode}: {did}", title_justify="left")
    for title in ("object", "what", "wanted", "found", "same"):
        table.add_column(title, overflow="fold")
    for held in result.objects:
        size = 2 + 2 * held.entry.size
        row = (held.entry.place, held.entry.what, f"{held.wanted:#0{size}x}", f"{held.found:#0{size}x}")
        table.add_row(*map(words, row), "yes" if held.ok else "NO")
    show(table)
    facts = {"identity (1018h)": ", ".join(f"{k} 0x{v:X}" for k, v in result.identity.items())}
    facts |= result.units | {f"{o.what} ({o.place})": f"{o.code}, {o.text}" for o in result.options}
    facts |= {"stored": "yes, by 1010h"} if result.stored else {}
    facts |= {"DBC": str(result.dbc)} if result.dbc else {}
    facts |= {"not as it should be": "\n".join(result.problems)} if result.problems else {}
    show(key_values("what the drive is", facts))
