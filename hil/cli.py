"""Command line of hil. Imports only what a command needs, so that ``hil --help`` answers at once."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.app import Overrides

DESCRIPTION = """\
Hardware-in-the-loop drive controller on a CAN bus, with a fixed-time disturbance observer.

  hil demo                     one minute: emulated drive, closed loop, load step, replay
  hil emulate CONFIG           the emulated drive as a process of its own
  hil run CONFIG               the controller, on the bus that CONFIG names
  hil simulate CONFIG          the same without a bus, as fast as the machine goes
  hil check CONFIG             is all ready for that bus and drive? sends nothing
  hil replay LOG               re-run the controller over a log, compare by bits
  hil info LOG, recover LOG    what is in a log; rewrite a damaged one
  hil paper                    everything the paper prints and draws, recomputed
"""
EXIT_FAILED, EXIT_REFUSED = 1, 2


def _bus_flags(parser: argparse.ArgumentParser) -> None:
    """python-can's own flags, on top of the config."""
    group = parser.add_argument_group("bus (as python-can; they override the config)")
    group.add_argument("-i", "--interface", help="python-can interface: hil-local, socketcan, ...")
    group.add_argument("-c", "--channel", help="channel: any name for hil-local, vcan0 or can0 for socketcan")
    group.add_argument("-b", "--bitrate", type=int, help="bitrate [bit/s]")
    group.add_argument("--fd", action="store_true", help="CAN FD")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a config key, e.g. loop.rate_hz=500",
    )


def _overrides(args: argparse.Namespace) -> Overrides:
    from hil.app import Overrides

    settings = list(args.set)
    if getattr(args, "lockstep", False):
        settings.append('loop.clock="lockstep"')
    if getattr(args, "shadow", False):
        settings.append("loop.shadow=true")
    if getattr(args, "duration", None) is not None:
        settings.append(f"loop.duration_s={float(args.duration)}")
    return Overrides(args.interface, args.channel, args.bitrate, args.fd, tuple(settings))


def _print_json(value: Any) -> None:
    print(json.dumps(_finite(value), indent=2, allow_nan=False))  # noqa: T201


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: they become null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201


def cmd_demo(args: argparse.Namespace) -> int:
    """Run the demo."""
    from hil.demo import demo
    from hil.view import demo_table, show

    _say("demo: emulated drive, closed loop at 1 kHz, load step, replay; about ten seconds")
    result = demo(args.config, _overrides(args))
    if args.json:
        _print_json(result)
    else:
        show(demo_table(result))
    good = result["ended"] == "stop_requested" and result["replay"]["verdict"] == "same"
    return 0 if good else EXIT_FAILED


def cmd_run(args: argparse.Namespace) -> int:
    """Run a config on its bus."""
    from hil.app import check_arming, is_emulated_bus, load_setup, run
    from hil.arming import confirm, requesting
    from hil.view import run_table, show

    setup = load_setup(args.config, _overrides(args))
    check_arming(setup, args.arm)
    if not (args.yes or args.shadow or is_emulated_bus(setup.config)):
        confirm(setup.config, sys.stdin, sys.stderr)
    with requesting(args.dead_man, sys.stdin, _say) as request:
        result = run(setup, arm=args.arm, request=request)
    if args.json:
        _print_json(result.as_dict())
    else:
        show(run_table(result))
    return 0 if result.ok else EXIT_FAILED


def cmd_check(args: argparse.Namespace) -> int:
    """Check everything before arming."""
    from hil.app import load_setup
    from hil.check import check, check_table, passed
    from hil.view import show

    rows = check(load_setup(args.config, _overrides(args)))
    if args.json:
        _print_json({"rows": [row.as_dict() for row in rows]})
    else:
        show(check_table(rows))
    return 0 if passed(rows) else EXIT_FAILED


def cmd_emulate(args: argparse.Namespace) -> int:
    """Serve the emulated drive until stopped."""
    from hil.emulate import serve

    serve(args.config, _overrides(args), args.plant_set)
    return 0


def cmd_simulate(args: argparse.Namespace) -> int:
    """Simulate a config."""
    from hil.app import load_setup
    from hil.simulate import simulate
    from hil.view import key_values, show

    result = simulate(load_setup(args.config, _overrides(args)), args.plant_set)
    if args.json:
        _print_json(result)
    else:
        show(key_values("simulation", result))
    return 0 if result["ok"] else EXIT_FAILED


def cmd_replay(args: argparse.Namespace) -> int:
    """Replay a log."""
    from hil.replay import replay
    from hil.view import replay_table, show

    verdict = replay(args.log)
    if args.json:
        _print_json(verdict.as_dict())
    else:
        show(replay_table(args.log, verdict))
    return verdict.exit_code


def cmd_paper(args: argparse.Namespace) -> int:
    """Recompute the paper."""
    from hil.app import Overrides
    from hil.demo import closed_loop, find_config
    from hil.paper import run
    from hil.view import show

    _say(
        "paper: the corrected design on the bench over the bus (lockstep), then every figure; under a minute"
    )
    settings = ('loop.clock="lockstep"', f'log.folder="{args.output.resolve()}"')
    _, _, log = closed_loop(find_config("paper.toml"), Overrides(settings=settings))
    result = run(args.output, log.ticks)
    if args.json:
        print(result.to_json())  # noqa: T201
    else:
        show(result.table())
        _say(f"page: {result.page}")
    return 0


def cmd_info(args: argparse.Namespace) -> int:
    """Say what is in a log."""
    from hil.log.info import info
    from hil.view import key_values, show

    found = info(args.log).as_dict()
    if args.json:
        _print_json(found)
    else:
        show(key_values("hil info", found))
    return 0


def cmd_recover(args: argparse.Namespace) -> int:
    """Rewrite a damaged log."""
    from hil.log.recover import recover
    from hil.view import key_values, show

    out = args.output or args.log.with_suffix(".recovered.mcap")
    found = recover(args.log, out).as_dict() | {"written": str(out)}
    if args.json:
        _print_json(found)
    else:
        show(key_values("hil recover", found))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hil", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(run=run)
        command.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
        return command

    demo = add(
        "demo", cmd_demo, "Start the emulator, close the loop, step the load, replay, show what happened."
    )
    demo.add_argument("config", nargs="?", type=Path, help="configuration (default: configs/demo.toml)")
    _bus_flags(demo)
    demo.add_argument("--lockstep", action="store_true", help="no real time: reproducible to the bit")
    run = add(
        "run", cmd_run, "Close the loop on the bus of CONFIG. Sends nothing before the drive was armed."
    )
    run.add_argument("config", type=Path, metavar="CONFIG", help="run configuration (TOML)")
    run.add_argument("--arm", action="store_true", help="allow voltage on a bus that is not emulated")
    run.add_argument("--yes", action="store_true", help="with --arm: do not ask on the terminal")
    run.add_argument("--shadow", action="store_true", help="read and compute, send nothing, not even SYNC")
    run.add_argument(
        "--dead-man",
        action="store_true",
        help="stop when standard input closes or, on a terminal, when no key is held for a second",
    )
    run.add_argument("--duration", type=float, metavar="S", help="stop after S seconds")
    run.add_argument("--lockstep", action="store_true", help="the emulator advances by one period a SYNC")
    _bus_flags(run)
    check = add("check", cmd_check, "Check interface, drive, limits, bus load and rights. Sends nothing.")
    check.add_argument("config", type=Path, metavar="CONFIG", help="run configuration (TOML)")
    _bus_flags(check)
    emulate = add("emulate", cmd_emulate, "Serve the emulated drive that CONFIG names until Ctrl-C.")
    emulate.add_argument(
        "config", type=Path, metavar="CONFIG", help="run configuration with an [emulator] table"
    )
    emulate.add_argument("--lockstep", action="store_true", help="advance by one period a SYNC")
    emulate.add_argument(
        "--plant-set", action="append", default=[], metavar="KEY=VALUE", help="override a plant key"
    )
    _bus_flags(emulate)
    simulate = add(
        "simulate", cmd_simulate, "Run controller and emulated motor in one process without a bus."
    )
    simulate.add_argument(
        "config", type=Path, metavar="CONFIG", help="run configuration with an [emulator] table"
    )
    simulate.add_argument("--duration", type=float, metavar="S", help="simulate S seconds")
    simulate.add_argument(
        "--plant-set", action="append", default=[], metavar="KEY=VALUE", help="override a plant key"
    )
    _bus_flags(simulate)
    replay = add(
        "replay", cmd_replay, "Re-run the controller over LOG; exit 0 same to the bit, 1 differs, 2 cannot."
    )
    replay.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")
    paper = add(
        "paper", cmd_paper, "Recompute all that the paper prints and draws, with a verdict on each item."
    )
    paper.add_argument(
        "-o", "--output", type=Path, default=Path("logs/paper"), metavar="DIR", help="folder for all"
    )
    info = add("info", cmd_info, "Say what is in LOG, from its summary alone.")
    info.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")
    recover = add("recover", cmd_recover, "Rewrite a damaged LOG with its summary and say what is missing.")
    recover.add_argument("log", type=Path, metavar="LOG", help="an MCAP file of hil")
    recover.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: LOG.recovered.mcap")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Entry point; every refusal is one clear line on standard error and exit code 2."""
    args = _parser().parse_args(argv)
    try:
        return int(args.run(args))
    except KeyboardInterrupt:
        _say("hil: interrupted")
        return 130
    except Exception as error:
        if not _is_refusal(error):
            raise
        _say("\n".join(f"hil: {line}" for line in str(error).splitlines()))
        return EXIT_REFUSED


def _is_refusal(error: Exception) -> bool:
    """True for errors that say what is wrong, where, and what to do."""
    from drivers.errors import DriverError
    from hil.control.errors import ControlDesignError
    from hil.errors import HilError

    return isinstance(error, (HilError, DriverError, ControlDesignError))


if __name__ == "__main__":
    sys.exit(main())
