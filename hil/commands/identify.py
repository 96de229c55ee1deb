"""``hil identify``: a motor's parameters with error bars, by experiments on the bus or from logs."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.commands.common import (
    EXIT_FAILED,
    Commands,
    bus_flags,
    one_thread,
    overrides,
    print_json,
    say,
)
from hil.log.outputs import output_file, output_folder

if TYPE_CHECKING:
    from hil.config.tables import RunConfig
    from hil.runtime.setup import Overrides


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "identify", cmd_identify, "Find a motor's parameters with error bars: experiments, or from logs."
    )
    command.add_argument("config", type=Path, metavar="CONFIG", nargs="?", help="run configuration (TOML)")
    command.add_argument("--emulated", action="store_true", help="start the emulated drive of CONFIG, too")
    command.add_argument(
        "--steps",
        metavar="A,B",
        help="of sensors, standstill, spinning, inertia, shaft (all); cogging by itself",
    )
    command.add_argument(
        "--from",
        dest="logs",
        type=Path,
        nargs="+",
        metavar="LOG",
        help="estimate from logged runs; sends nothing",
    )
    command.add_argument("--arm", action="store_true", help="allow voltage on a bus that is not emulated")
    command.add_argument("--yes", action="store_true", help="with --arm: do not ask on the terminal")
    command.add_argument("--lockstep", action="store_true", help="the emulator advances by one period a SYNC")
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="TOML (logs/identify/CONFIG.toml)")
    bus_flags(command)


def cmd_identify(args: argparse.Namespace) -> int:
    """Identify."""
    one_thread()
    from hil.errors import HilError

    cogging = is_cogging(args.steps)
    if args.logs and (args.config or args.emulated or args.arm or (args.steps and not cogging)):
        raise HilError(
            "--from re-estimates from logs: it takes no CONFIG, --emulated or --arm, of --steps cogging alone"
        )
    if not args.logs and args.config is None:
        raise HilError("hil identify needs a CONFIG, or logs with --from")
    file = _output(args, "-cogging" if cogging else "-motor" if args.logs else "")
    if cogging:
        result = _cogging_from_logs(args, file) if args.logs else _on_the_bus(args, file, cogging=True)
    else:
        result = _from_logs(args, file) if args.logs else _on_the_bus(args, file)
    if args.json:
        print_json(result)
    else:
        from hil.identify.tables import shown
        from hil.report.view import show

        for table in shown(result):
            show(table)
        for line in (*result["findings"], *(f"look first: {fault}" for fault in result["faults"])):
            say(f"hil: {line}")
    return 0 if result["ok"] else EXIT_FAILED


def is_cogging(steps: str | None) -> bool:
    """True for the step that is a run of its own. Raises HilError when others are asked for beside it."""
    from hil.errors import HilError

    names = [name.strip() for name in (steps or "").split(",") if name.strip()]
    if "cogging" in names and set(names) != {"cogging"}:
        raise HilError("--steps: cogging writes a file of its own; run it by itself, after the others")
    return "cogging" in names


def _output(args: argparse.Namespace, end: str) -> Path:
    """Where the motor goes. Raises HilError before anything is done."""
    path = args.output
    if path is None:
        stem = args.config.stem if args.config else args.logs[0].stem
        path = output_folder(Path("logs/identify")) / f"{stem}{end}.toml"
    return output_file(path, ".toml", config=args.config)


def _write(file: Path, text: str) -> str | None:
    """Write the motor, if there is one."""
    if not text:
        return None
    file.write_text(text, encoding="utf-8")
    return str(file)


def _from_logs(args: argparse.Namespace, file: Path) -> dict[str, Any]:
    from hil.identify.fromlogs import from_logs
    from hil.identify.motorfile import toml_of

    result, found, motor, config = from_logs(args.logs)
    text = toml_of(found, motor, config, result["logs"]) if result["ok"] else ""
    return result | {"file": _write(file, text)}


def _cogging_from_logs(args: argparse.Namespace, file: Path) -> dict[str, Any]:
    from hil.identify.coggingrun import from_logs

    result, config = from_logs(args.logs)
    return _written(result, config, file)


def _written(result: dict[str, Any], config: RunConfig, file: Path) -> dict[str, Any]:
    """Write file and picture of what was learned, if there is anything."""
    from hil.identify.coggingrun import picture, table_of, toml_of

    found = result.pop("found")
    table = table_of(found, config, result["logs"]) if result["ok"] else None
    if table is None:
        return result | {"file": None, "picture": None}
    drawn = file.with_suffix(".png")
    drawn.write_bytes(picture(found))
    return result | {"file": _write(file, toml_of(table)), "picture": str(drawn)}


def _on_the_bus(args: argparse.Namespace, file: Path, cogging: bool = False) -> dict[str, Any]:
    """The experiments, with the emulator of the configuration where that is asked for."""
    from hil.errors import HilError
    from hil.identify.coggingrun import on_the_bus, ready
    from hil.identify.plan import chosen
    from hil.identify.session import checked, identify, motor_toml
    from hil.runtime.arming import confirm
    from hil.runtime.bus import is_emulated_bus
    from hil.runtime.refusals import check_arming
    from hil.runtime.setup import load_setup

    names, given = () if cogging else chosen(args.steps), overrides(args)
    if args.emulated and given.channel is None:
        from hil.sim.demo import own_channel

        given = replace(given, channel=own_channel("identify"))
    setup = load_setup(args.config, given)
    if cogging:
        ready(args.config, setup)
    else:
        checked(args.config, setup.config)
    emulated = is_emulated_bus(setup.config)
    if args.emulated and not emulated:
        raise HilError("--emulated: the bus may carry a real drive; take -i hil-local, or leave it out")
    check_arming(setup, args.arm)
    if not (args.yes or emulated):
        confirm([setup.config], sys.stdin, sys.stderr)
    with _emulator(args, given, setup.config):
        if cogging:
            learned = on_the_bus(args.config, setup.config, say, arm=args.arm)
            return _written(learned, setup.config, file)
        session = identify(args.config, setup.config, names, say, arm=args.arm)
    text = motor_toml(session) if not session.faults else ""
    return session.as_dict() | {"file": _write(file, text)}


@contextlib.contextmanager
def _emulator(args: argparse.Namespace, given: Overrides, config: RunConfig) -> Iterator[None]:
    """The emulator as a process, set up where its kind has to be, or nothing."""
    if not args.emulated:
        yield
        return
    from hil.sim.demo import emulator_process, set_up

    with emulator_process(args.config, given):
        if config.canopen is not None:
            set_up(args.config, config)
        yield
