"""``hil tune``: a configuration for the identified motor, with what it will do and its yield."""

from __future__ import annotations

import argparse
from pathlib import Path

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, one_thread, overrides, print_json, say
from hil.commands.tuning import _above_one, _not_negative, _positive, noise_flags
from hil.log.outputs import output_file


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("tune", cmd_tune, "From the identified motor and a wish to a tuned configuration.")
    command.add_argument("config", type=Path, metavar="CONFIG", help="run configuration (TOML)")
    command.add_argument(
        "--motor", type=Path, metavar="FILE", help="motor that hil identify wrote (default: CONFIG's own)"
    )
    command.add_argument("--dip", type=_positive, metavar="RAD_S", help="largest dip; noise is made least")
    command.add_argument(
        "--settle-ms", type=_positive, metavar="MS", help="back in 0.5 rad/s; noise is made least"
    )
    noise_flags(command)
    command.add_argument(
        "--ms", type=_above_one, default=1.6, metavar="MS", help="peak of the sensitivity (1.6)"
    )
    command.add_argument("--load", type=_not_negative, metavar="N_M", help="the load step (the plant's file)")
    command.add_argument(
        "--cases",
        type=_cases,
        default=32,
        metavar="N",
        help="simulated motors of the intervals (32; 0: none)",
    )
    command.add_argument(
        "--effort", type=_positive, default=0.2, metavar="X", help="length of the search (0.2)"
    )
    command.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="TOML (beside CONFIG: NAME-tuned.toml)"
    )
    bus_flags(command)


def _cases(text: str) -> int:
    if text.isdecimal() and int(text) <= 100_000:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 100000")


def cmd_tune(args: argparse.Namespace) -> int:
    """Tune."""
    one_thread()
    from hil.identify.tune import at_motor, tune, written
    from hil.report.view import key_values, progress, show
    from hil.tuning.design import Wish

    to = args.output or args.config.with_name(f"{args.config.stem}-tuned.toml")
    to = output_file(to, ".toml", config=args.config)
    wish = Wish(
        args.u_noise_mv,
        args.ms,
        max(2.2, args.ms),
        args.dip,
        args.settle_ms,
        laws=("ftdob",),
        effort=args.effort,
        command_noise=args.command_noise,
    )
    given = at_motor(overrides(args), args.motor)
    with progress("cases", args.cases) as seen:
        result, data = tune(args.config, given, wish, args.load, args.cases, seen)
    to.write_text(written(data, args.config, to), encoding="utf-8")
    result["file"] = str(to)
    if args.json:
        print_json(result)
    else:
        predicted, found = result["predicted"], result["yield"]
        dips = (
            f"{predicted['dip_rad_s']:.3g} rad/s, worst in the intervals {predicted['worst_dip_rad_s']:.3g}"
        )
        rows = {
            "dip": dips,
            "recovery": f"{predicted['recovery_ms']:.0f} ms",
            "limited by": result["limits"],
            "yield": f"{found['passed']} of {found['cases']}" if found else "no plant to simulate",
            "file": str(to),
        }
        show(key_values("hil tune", rows))
    for line in result["findings"]:
        say(f"hil: {line}")
    if not result["identified"]:
        say("hil: the motor has no intervals: 30 % are taken; hil identify finds them")
    return 0 if not result["yield"] or result["yield"]["share"] >= 0.9 else EXIT_FAILED
