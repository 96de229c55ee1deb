"""``hil play``: recorded frames back on a bus."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hil.commands.common import Commands, print_json, say


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "play",
        cmd_play,
        "Send the data frames of LOG with their timing. By default only what the drive sent.",
        mf4=True,
    )
    command.add_argument("log", type=Path, metavar="LOG", help=".mcap of hil, or .log .asc .blf .mf4 ...")
    bus = command.add_argument_group("bus (as python-can)")
    bus.add_argument("-i", "--interface", default="socketcan", help="default: socketcan; or hil-local, ...")
    bus.add_argument("-c", "--channel", required=True, help="vcan0, can0; any name for hil-local")
    bus.add_argument("-b", "--bitrate", type=int, default=1_000_000, help="bitrate [bit/s]")
    bus.add_argument("--fd", action="store_true", help="CAN FD")
    command.add_argument("--rate", type=_positive, default=1.0, metavar="X", help="X times as fast")
    command.add_argument("--loop", type=_count, default=1, metavar="N", help="play N times")
    command.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S", help="start at S")
    command.add_argument("--to", dest="to_s", type=float, default=float("inf"), metavar="S", help="end at S")
    command.add_argument("--id", type=_number, action="append", default=[], metavar="ID", help="only this id")
    command.add_argument(
        "--not-id", type=_number, action="append", default=[], metavar="ID", help="all but this"
    )
    command.add_argument(
        "--direction", choices=("rx", "tx", "both"), default="rx", help="rx: what the drive sent (default)"
    )
    command.add_argument("--recorded-channel", metavar="NAME", help="the recording's, where it has several")
    command.add_argument("--partial", action="store_true", help="play what can be read of a recording")
    command.add_argument(
        "--paused", action="store_true", help="start paused; n sends one frame, space goes on and pauses"
    )
    command.add_argument(
        "--transmit-commands",
        action="store_true",
        help="allow frames that may command a drive on a bus that is not emulated",
    )
    command.add_argument("--yes", action="store_true", help="with it: do not ask on the terminal")


def _positive(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.0 < (value := float(text)) < float("inf"):
            return value
    raise argparse.ArgumentTypeError(f"{text!r} must be a number above 0 and finite")


def _count(text: str) -> int:
    with contextlib.suppress(ValueError):
        if (value := int(text)) >= 1:
            return value
    raise argparse.ArgumentTypeError(f"{text!r} must be a whole number, 1 or more")


def _number(text: str) -> int:
    """An identifier: decimal, or hexadecimal with 0x."""
    with contextlib.suppress(ValueError):
        if 0 <= (value := int(text, 0)) < 2**29:
            return value
    raise argparse.ArgumentTypeError(f"{text!r} must be an identifier below 2^29, as 385 or 0x181")


def cmd_play(args: argparse.Namespace) -> int:
    """Play a log."""
    from hil.errors import HilError
    from hil.exchange.play import Choice, Source, ahead, chosen, play
    from hil.log.errors import LogError
    from hil.report.view import key_values, show
    from hil.runtime.bus import sending_bus
    from hil.runtime.clock import RealClock

    if not 0.0 <= args.from_s <= args.to_s:
        raise HilError(f"--from {args.from_s:g} --to {args.to_s:g}: no such window")
    source = Source(args.log, args.recorded_channel, partial=args.partial)
    choice = Choice(args.direction, frozenset(args.id), frozenset(args.not_id), args.from_s, args.to_s)
    only_drive = source.roles_known and args.direction == "rx"
    allowed = only_drive or (args.transmit_commands and _confirmed(args))
    bus = (args.interface, args.channel, args.bitrate, args.fd)
    with contextlib.ExitStack() as stack:
        send = stack.enter_context(sending_bus(*bus, real_allowed=allowed))
        rounds = stack.enter_context(ahead(chosen(source, choice) for _ in range(args.loop)))
        before = stack.enter_context(_keys(args.paused))
        result = play(rounds, send, RealClock(), rate=args.rate, before=before)
    if not (result.sent or result.interrupted):
        raise LogError(f"{args.log}: no frame was chosen; see --direction, --id, --from and --to")
    found = result.as_dict() | source.left_out | ({"log": source.damage} if source.damage else {})
    if args.json:
        print_json(found)
    else:
        show(key_values("hil play", found))
    return 130 if result.interrupted else 0


def _confirmed(args: argparse.Namespace) -> bool:
    """A person's yes, or --yes; without a terminal nobody can be asked, so it is no."""
    if args.yes:
        return True
    if not sys.stdin.isatty():
        return False
    say(f"about to send recorded frames, commands among them, to {args.interface}:{args.channel}")
    say("type yes to send: ")
    return sys.stdin.readline().strip().lower() == "yes"


class Keys:
    """Space pauses and goes on, n sends one frame while paused; read from a terminal without waiting."""

    def __init__(self, fd: int, paused: bool) -> None:
        self._fd, self.paused = fd, paused

    def __call__(self, frame: Any) -> bool:
        """Hold the frame up while paused; True when it was."""
        held = False
        while select.select([self._fd], [], [], None if self.paused else 0)[0]:
            key = os.read(self._fd, 1)
            held = held or self.paused
            if key == b" ":
                self.paused = not self.paused
            elif key == b"n" and self.paused:
                return True
            elif not key:  # the terminal is gone: nobody could ever go on
                raise KeyboardInterrupt
        return held


@contextlib.contextmanager
def _keys(paused: bool) -> Iterator[Callable[[Any], bool]]:
    """Keys of the terminal while the block runs; without one nothing holds a frame up."""
    from hil.errors import HilError

    if not sys.stdin.isatty():
        if paused:
            raise HilError("--paused needs a terminal: no key could go on")
        yield lambda frame: False
        return
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    try:
        tty.setcbreak(fd)
        yield Keys(fd, paused)
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
