"""``hil compare`` and ``hil design``: laws tuned alike and compared, and windows and poles from a wish."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from hil.commands.common import EXIT_FAILED, Commands, bus_flags, one_thread, overrides, print_json, say
from hil.log.outputs import output_file, output_folder

SPREAD = 0.3


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "compare",
        cmd_compare,
        "Tune several laws by one optimiser to the same limits and run them on the same seeds.",
    )
    command.add_argument(
        "config", type=Path, metavar="CONFIG", help="run configuration with an [emulator] table"
    )
    command.add_argument("--laws", metavar="A,B,C", help="laws to compare (all but the special ones)")
    _limits(command, "as the configuration itself")
    command.add_argument("--seeds", type=_count, default=3, metavar="N", help="simulated runs a law (3)")
    command.add_argument(
        "--spread", type=_share, default=SPREAD, metavar="S", help="J, psi, R, L off by S (0.3)"
    )
    command.add_argument(
        "--effort", type=_positive, default=1.5, metavar="X", help="length of the search (1.5)"
    )
    command.add_argument(
        "-o", "--output", type=Path, default=Path("logs/compare"), metavar="DIR", help="page"
    )
    bus_flags(command)
    command = commands.add("design", cmd_design, "Find windows and poles for a motor, its noise and a wish.")
    command.add_argument("config", type=Path, metavar="CONFIG", help="run configuration: motor, rate, frames")
    _limits(command, "100 mV or 1 %% of the largest command, 1.6, 2.2")
    command.add_argument("--dip", type=_positive, metavar="RAD_S", help="largest dip; noise is made least")
    command.add_argument(
        "--settle-ms", type=_positive, metavar="MS", help="back in 0.5 rad/s; noise is made least"
    )
    command.add_argument("--law", metavar="A,B", help="laws to try (ftdob, least-noise, cubic)")
    command.add_argument(
        "--spread",
        action="append",
        default=[],
        metavar="[NAME=]S",
        help="J, psi_f, R_s, L or all off by S (0.3)",
    )
    for name, unit in (("load", "N m: the step (the plant's file)"), ("w-noise", "rad/s"), ("i-noise", "A")):
        command.add_argument(
            f"--{name}", type=_not_negative, metavar="X", help=f"{unit}; default: plant's file"
        )
    command.add_argument("--shaft", type=_range, metavar="HZ[-HZ]", help="first resonance, or a range of it")
    command.add_argument(
        "--shaft-damping", type=_positive, default=0.01, metavar="D", help="its damping (0.01)"
    )
    command.add_argument(
        "--shaft-share", type=_inner, default=0.5, metavar="S", help="the motor's share of J (0.5)"
    )
    command.add_argument(
        "--effort", type=_positive, default=0.5, metavar="X", help="length of the search (0.5)"
    )
    command.add_argument("--verify", action="store_true", help="run it in simulation and on the lockstep bus")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="TOML (logs/design/CONFIG.toml)")
    bus_flags(command)


def _limits(command: argparse.ArgumentParser, default: str) -> None:
    group = command.add_argument_group(f"limits (default: {default})")
    noise_flags(group)
    group.add_argument("--ms", type=_above_one, metavar="MS", help="peak of the sensitivity")
    group.add_argument("--ms-worst", type=_above_one, metavar="MS", help="the same in the worst corner")


def noise_flags(group: Any) -> None:
    """The two wishes for noise, of which a drive has one."""
    pair = group.add_mutually_exclusive_group()
    pair.add_argument("--u-noise-mv", type=_positive, metavar="MV", help="noise in u_q, rms")
    pair.add_argument(
        "--command-noise",
        type=_positive,
        metavar="X",
        help="noise in the command, rms, in A or N m, of a drive with its own current loop",
    )


def _number(text: str, low: float, high: float, what: str, *, closed: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if low < value < high or (closed and value == low):
        return value
    raise argparse.ArgumentTypeError(f"{text!r} is not {what}")


def _positive(text: str) -> float:
    return _number(text, 0.0, float("inf"), "a positive number")


def _not_negative(text: str) -> float:
    return _number(text, 0.0, float("inf"), "a number of 0 or more", closed=True)


def _above_one(text: str) -> float:
    return _number(text, 1.0, float("inf"), "a number above 1")


def _share(text: str) -> float:
    return _number(text, 0.0, 0.9, "a share from 0 to 0.9", closed=True)


def _inner(text: str) -> float:
    return _number(text, 0.0, 1.0, "a share between 0 and 1")


def _count(text: str) -> int:
    if text.isdecimal() and 1 <= int(text) <= 100:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 100")


def _range(text: str) -> tuple[float, float]:
    low, _, high = text.partition("-")
    found = _positive(low), _positive(high or low)
    if found[0] > found[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is not a range LOW-HIGH in Hz")
    return found


def _spread(given: list[str]) -> dict[str, float]:
    """Shares by name. Raises HilError."""
    from hil.errors import HilError

    shares = dict.fromkeys(("J", "psi_f", "R_s", "L"), SPREAD)
    for text in given:
        name, equals, value = text.rpartition("=")
        try:
            shares |= dict.fromkeys([name] if equals else list(shares), _share(value))
        except argparse.ArgumentTypeError as error:
            raise HilError(f"--spread: {error}") from None
        if len(shares) != 4:
            raise HilError(f"--spread: no parameter {name!r}; there are J, psi_f, R_s, L")
    return shares


def cmd_compare(args: argparse.Namespace) -> int:
    """Compare laws."""
    one_thread()
    from hil.report.view import progress, show
    from hil.tuning.bench import speed_drive, takes_voltage
    from hil.tuning.compare import Wish, compare, default_laws, parse_laws
    from hil.tuning.page import comparison
    from hil.tuning.tables import comparison_table

    own = not takes_voltage(speed_drive(args.config, overrides(args)))
    families = parse_laws(",".join(default_laws(own)) if args.laws is None else args.laws, own)
    out = output_folder(args.output, "compare.html")
    wish = Wish(
        args.u_noise_mv, args.ms, args.ms_worst, args.spread, args.seeds, args.effort, args.command_noise
    )
    with progress(f"tune {len(families)} laws", len(families)) as seen:
        found = compare(args.config, overrides(args), families, wish, seen)
    page = out / "compare.html"
    page.write_text(comparison(found), encoding="utf-8")
    found["page"] = str(page)
    if args.json:
        print_json(found)
    else:
        show(comparison_table(found))
        say(f"page: {page}")
    return (
        0
        if all(row["feasible"] and row["ended"] == "stop_requested" for row in found["rows"])
        else EXIT_FAILED
    )


def cmd_design(args: argparse.Namespace) -> int:
    """Design windows and poles."""
    one_thread()
    from hil.tuning.design import WINDOWS, Wish, design

    path = args.output
    if path is None:
        path = output_folder(Path("logs/design")) / f"{args.config.stem}.toml"
    path = output_file(path, ".toml", config=args.config)
    laws = (
        WINDOWS if args.law is None else tuple(name.strip() for name in args.law.split(",") if name.strip())
    )
    ms, ms_worst = args.ms or 1.6, args.ms_worst or max(2.2, args.ms or 0.0)
    wish = Wish(
        args.u_noise_mv, ms, ms_worst, args.dip, args.settle_ms, args.shaft, args.shaft_damping,
        args.shaft_share, laws, args.effort, args.command_noise,
    )  # fmt: skip
    given = {"load": args.load, "w_noise": args.w_noise, "i_noise": args.i_noise}
    start = time.perf_counter()
    spread = _spread(args.spread)
    found, best = design(args.config, overrides(args), wish, given, spread, meanwhile=_load_output)
    found["seconds"] = time.perf_counter() - start
    from hil.report.view import show
    from hil.tuning.page import front_picture
    from hil.tuning.tables import design_table

    picture = path.with_suffix(".png")
    front_picture(found, picture)
    path.write_text(found["toml"], encoding="utf-8")
    found |= {"written": str(path), "picture": str(picture)}
    if args.verify:
        found["verified"] = _verify(args, best, given, wish)
    if args.json:
        print_json(found)
    else:
        show(design_table(found))
    for line in found["findings"]:
        say(f"hil: {line}")
    return 0 if found.get("verified", {"ok": True})["ok"] else EXIT_FAILED


def _load_output() -> None:
    """Load what draws and prints a design."""
    import matplotlib.figure  # noqa: F401

    import hil.report.view
    import hil.tuning.tables  # noqa: F401


def _verify(args: argparse.Namespace, best: Any, given: dict[str, Any], wish: Any) -> dict[str, Any]:
    from hil.report.view import progress
    from hil.tuning.bench import bench_of, spec_in, speed_drive
    from hil.tuning.optimise import law_of
    from hil.tuning.verify import verify

    setup, spread = speed_drive(args.config, overrides(args)), _spread(args.spread)
    law = law_of(best.tables, spec_in(setup), 1.0 / setup.config.loop.rate_hz)
    plants = 1 + len(bench_of(args.config, setup, spread=spread).plants())
    shafts = wish.shafts(plants - 1)
    with progress(f"verify on {plants} plants", plants) as seen:
        return verify(args.config, overrides(args), best.tables, given, spread, law, seen, shafts)
