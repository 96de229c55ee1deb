"""What the commands share: python-can's bus flags, overrides, and the two ways to print a result."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import plain

if TYPE_CHECKING:
    from hil.runtime.setup import Overrides

EXIT_FAILED, EXIT_REFUSED = 1, 2
Run = Callable[[argparse.Namespace], int]


@contextlib.contextmanager
def lean_imports() -> Iterator[None]:
    """Import python-can without asammdf and numba without coverage, which they take where they are.

    It is half a second or more of each command. asammdf, and pandas with it, is for MF4 files. coverage hears
    of compiled lines, where it measures; it is here already then.
    """
    hidden = [name for name in ("asammdf", "coverage") if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None: not to be imported
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


def one_thread() -> None:
    """One thread for matrices of three rows, which more make slower: set before numpy is imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
KEPT_BYTES, OWN_MAP_BYTES = 256 << 20, 32 << 20


def keep_memory() -> None:
    """Keep freed memory for the next block of a log.

    glibc hands blocks of this size back to the system, which clears each page anew: that was half of what the
    processor did for a replay. Other C libraries stay as they are.
    """
    import ctypes

    with contextlib.suppress(AttributeError, TypeError):  # no mallopt, or no library by that name
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
        mallopt(M_MMAP_THRESHOLD, OWN_MAP_BYTES)


class Commands:
    """The subcommands of ``hil``; each module of this package adds its own."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser
        self._commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(self, name: str, run: Run, text: str, *, mf4: bool = False) -> argparse.ArgumentParser:
        """Add one command with its ``--json`` flag and return its parser; ``mf4``: it takes such files."""
        command = self._commands.add_parser(name, help=text, description=text)
        command.set_defaults(run=run if mf4 else lean_imports()(run))
        command.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
        return command


def bus_flags(parser: argparse.ArgumentParser) -> None:
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


def overrides(args: argparse.Namespace) -> Overrides:
    """Overrides from the flags of a command."""
    from hil.runtime.setup import Overrides

    settings = list(args.set)
    if getattr(args, "lockstep", False):
        settings.append('loop.clock="lockstep"')
    if getattr(args, "shadow", False):
        settings.append("loop.shadow=true")
    if getattr(args, "duration", None) is not None:
        settings.append(f"loop.duration_s={float(args.duration)}")
    return Overrides(args.interface, args.channel, args.bitrate, args.fd, tuple(settings))


def one_run(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The parts of one run in order. Raises HilError for files of several runs."""
    from hil.errors import HilError
    from hil.log.parts import grouped

    runs = grouped(paths)
    if len(runs) > 1:
        names = ", ".join(run[0].name for run in runs)
        raise HilError(f"{names} are no parts of one run; this command takes one run at a time")
    return runs[0]


def print_json(value: Any) -> None:
    """Print ``value`` as JSON on standard output; its names are in lower snake case."""
    print(json.dumps(_finite(value), indent=2, allow_nan=False))  # noqa: T201


def _snake(key: Any) -> Any:
    """A name in lower snake case (T_L_hat: t_l_hat); what is no name, a config key or a path, stays."""
    is_name = isinstance(key, str) and re.fullmatch(r"[A-Za-z][\w-]*", key)
    return key.lower().replace("-", "_") if is_name else key


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: they become null."""
    if isinstance(value, dict):
        return {_snake(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value


def say(text: str) -> None:
    """Print a line on standard error."""
    print(plain(text), file=sys.stderr, flush=True)  # noqa: T201
