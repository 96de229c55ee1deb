"""``hil export`` and ``hil import``: a log in the formats of other tools, and the way back."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import Commands, one_run, print_json
from hil.log.outputs import output_file


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "export",
        cmd_export,
        "Write LOG in another format, by the ending of FILE: ticks as .parquet .csv .mat .mf4, "
        "frames as .log (candump) .asc .blf, .mf4 with --frames. Of a run with several nodes ticks of each: "
        "those of the first are FILE, others have their names before the ending.",
        mf4=True,
    )
    command.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="a log, or the parts of one run")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", required=True)
    command.add_argument(
        "--frames", action="store_true", help="the frames, where FILE may hold either (.mf4)"
    )
    command.add_argument("--node", default="", metavar="NAME", help="the ticks of this node alone, as FILE")
    command.add_argument("--force", action="store_true", help="replace FILE when it exists")
    command = commands.add(
        "import",
        cmd_import,
        "Write REC, a recording of the bus (candump .log, .asc, .blf, .mf4, .trc), "
        "as a log of CONFIG's controller",
        mf4=True,
    )
    command.add_argument("recording", type=Path, metavar="REC", help="a recording of frames")
    command.add_argument("-o", "--output", type=Path, metavar="LOG", required=True, help="an MCAP file")
    command.add_argument("--config", type=Path, metavar="CONFIG", required=True, help="run configuration")
    command.add_argument("--channel", metavar="NAME", help="the recording's channel, where it has several")
    command.add_argument("--partial", action="store_true", help="take what can be read of a damaged one")
    command.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as hil run's")
    command.add_argument("--force", action="store_true", help="replace LOG when it exists")


def cmd_export(args: argparse.Namespace) -> int:
    """Write a log in another format."""
    from hil.exchange.export import FORMATS, export_nodes
    from hil.report.view import key_values, show

    if args.output.suffix.lower() in FORMATS:
        output_file(args.output, *FORMATS)
    options = {"frames": args.frames, "force": args.force, "node": args.node}
    made = export_nodes(one_run(args.logs), args.output, **options)
    found = {name: one.as_dict() for name, one in made.items()}
    if args.json:
        first = next(iter(found.values()))
        print_json(first | ({"nodes": found} if len(found) > 1 else {}))
    else:
        for name, one in found.items():
            show(key_values(f"hil export {name}".rstrip(), one))
    return 0


def cmd_import(args: argparse.Namespace) -> int:
    """Write a recording as a log."""
    from hil.errors import HilError
    from hil.exchange.importing import import_recording
    from hil.report.view import key_values, show

    if args.output.exists() and args.recording.exists() and args.output.samefile(args.recording):
        raise HilError(f"{args.output}: is the recording itself; name another file")
    options = {"channel": args.channel, "force": args.force, "partial": args.partial}
    found = import_recording(args.recording, args.output, args.config, tuple(args.set), **options).as_dict()
    if args.json:
        print_json(found)
    else:
        show(key_values("hil import", found))
    return 0
