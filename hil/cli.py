"""Command line of hil. Imports only what a command needs, so that ``hil --help`` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any, NoReturn

from hil.commands import (
    begin,
    bench,
    campaign,
    config,
    configure,
    convert,
    demo,
    emulated,
    faults,
    identify,
    log,
    paper,
    play,
    replay,
    report,
    run,
    tune,
    tuning,
    watch,
)
from hil.commands import set as set_
from hil.commands.common import EXIT_REFUSED, Commands, say

DESCRIPTION = """\
Hardware-in-the-loop drive controller on a CAN bus, with a fixed-time disturbance observer.

  hil demo                     one minute: emulated drive, closed loop, load step, replay
  hil init DIR                 a configuration with motor, plant and DBC to start from
  hil emulate CONFIG           the emulated drive as a process of its own
  hil run CONFIG               the controller, on the bus that CONFIG names
  hil watch [PID|CHANNEL|LOG]  a running run live: terminal, --web, --foxglove; stops it, too
  hil set w=60 [RUN]           another reference for a running run, within its range
  hil simulate CONFIG          the same without a bus, as fast as the machine goes
  hil check CONFIG             is all ready for that bus and drive? sends nothing
  hil configure CONFIG         a CANopen CiA 402 drive set up from its EDS; enables nothing
  hil replay LOG               re-run the controller over a log, compare by bits
  hil report LOG [LOG ...]     one page of a run that works offline; several are compared
  hil info LOG, recover LOG    what is in a log; rewrite a damaged one
  hil export LOG -o FILE       ticks as Parquet, CSV, MAT, MF4; frames as candump, ASC, BLF
  hil import REC -o LOG        a recording of the bus as a log to replay and report
  hil play LOG -c vcan0        recorded frames back on a bus with their timing
  hil bench [CONFIG]           cost of a tick, rate and lateness on this machine
  hil faults [CONFIG]          every fault against the running loop, with a verdict on each
  hil campaign PLAN            thousands of cases over all cores: yield, what matters, worst
  hil compare CONFIG           laws tuned by one optimiser to the same limits, side by side
  hil design CONFIG            windows and poles for a motor, its noise and a wish
  hil config explain KEY       what a config key means: unit, range, default
  hil identify CONFIG          a motor's parameters with error bars; --from LOG for logged runs
  hil tune CONFIG              that motor and a wish to a configuration, with its yield
  hil completion bash          completion for the shell; also zsh, tcsh
  hil paper                    everything the paper prints and draws, recomputed
"""
MODULES = (
    demo,
    begin,
    run,
    watch,
    set_,
    configure,
    emulated,
    replay,
    report,
    log,
    convert,
    play,
    paper,
    bench,
    faults,
    campaign,
    tuning,
    identify,
    tune,
    config,
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hil", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action=_Version, help="print the version and leave")
    commands = Commands(parser)
    for module in MODULES:
        module.register(commands)
    return parser


class _Version(argparse.Action):
    """``--version``: looked up when it is asked for alone."""

    def __init__(self, **options: Any) -> None:
        super().__init__(nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from hil.log.origin import package_version

        print(f"hil {package_version('hil-drive')}")  # noqa: T201
        parser.exit()


def main(argv: list[str] | None = None) -> int:
    """Entry point; what nobody reads any more (``| head``) ends quietly with exit code 141."""
    _open_what_is_closed()
    try:
        try:
            return _command(argv)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        if not (left := _left_by_readers()):
            raise
        for number in left:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)  # what is still buffered goes nowhere
        return 128 + signal.SIGPIPE


def _left_by_readers() -> list[int]:
    """Of standard output and error those that are pipes without a reader."""
    watch = select.poll()
    for number in (1, 2):
        watch.register(number, 0)
    return [number for number, event in watch.poll(0) if event & select.POLLERR]


def _command(argv: list[str] | None) -> int:
    """One command; every refusal is one clear line on standard error and exit code 2."""
    args = _parser().parse_args(argv)
    try:
        with _signals_unwind():
            return int(args.run(args))
    except KeyboardInterrupt:
        say("hil: interrupted")
        return 130
    except Exception as error:
        if not _is_refusal(error):
            raise
        say("\n".join(f"hil: {line}" for line in _words(error).splitlines()))
        return EXIT_REFUSED


def _open_what_is_closed() -> None:
    """Standard streams that were closed (2>&-) lead nowhere, and no bus or log gets their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(null := os.open(os.devnull, os.O_RDWR), number)
            if null != number:
                os.close(null)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


@contextlib.contextmanager
def _signals_unwind() -> Iterator[None]:
    """SIGTERM and SIGHUP end a command as an exception does, so that nothing half-written and no process
    stays; a run has its own. A SIGHUP that is ignored (nohup) stays so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [number for number in (signal.SIGTERM, signal.SIGHUP) if _is_not_ignored(number)]
    before = {number: signal.signal(number, _terminate) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def _is_not_ignored(number: int) -> bool:
    return signal.getsignal(number) != signal.SIG_IGN


def _terminate(number: int, _: object) -> NoReturn:
    raise SystemExit(128 + number)


def _words(error: Exception) -> str:
    """What an error says; of the system's errors without their number."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def _is_refusal(error: Exception) -> bool:
    """True for errors that say what is wrong, where, and what to do."""
    from drivers.errors import DriverError
    from hil.control.errors import ControlDesignError
    from hil.errors import HilError

    return isinstance(error, (HilError, DriverError, ControlDesignError))


if __name__ == "__main__":
    sys.exit(main())
