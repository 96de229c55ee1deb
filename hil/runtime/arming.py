"""Before and while voltage is allowed: the summary of limits, the question, and the dead-man's switch."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import tty
from collections.abc import Callable, Iterator, Sequence
from typing import TextIO

from hil.config.tables import RunConfig
from hil.errors import ArmingError
from hil.runtime.clock import RealClock
from hil.runtime.loop import StopRequest

HOLD_NS = 1_000_000_000
"""How long after the last key the dead-man's switch still counts as held; key repeat is much faster."""


def summary(config: RunConfig) -> str:
    """What is about to be allowed, in a few lines."""
    bus, limits, loop = config.bus, config.limits, config.loop
    where = f"node {config.drive.node_id} on {bus.interface}:{bus.channel}"
    ends = f"{loop.duration_s:g} s" if loop.duration_s else "until stopped"
    takes = config.command
    soft = f"{limits.soft_start_s:g} s" if limits.soft_start_s else f"none: full {takes.takes} at once"
    what = f"{takes.takes + 's' if takes.takes == 'voltage' else 'a ' + takes.takes}"
    return "\n".join(
        (
            f"about to command {what} to {where}, {ends}",
            f"  {takes.takes:<11} up to {takes.most:g} {takes.unit}, by {takes.step:g} {takes.unit} a tick; "
            f"soft start {soft}",
            f"  current     limited to {limits.i_max_a:g} A, trips at {limits.i_trip_a:g} A",
            f"  speed       trips at {limits.w_max_rad_s:g} rad/s",
            f"  DC link     {limits.v_dc_min_v:g} .. {limits.v_dc_max_v:g} V",
            f"  temperature trips at {limits.temperature_max_c:g} degC",
        )
    )


def confirm(configs: Sequence[RunConfig], asking: TextIO, telling: TextIO) -> None:
    """Ask a person on a terminal; anything but ``yes`` raises ArmingError, and so does no terminal."""
    if not asking.isatty():
        raise ArmingError(
            "not armed: standard input is no terminal to ask on; nothing was sent; --yes arms without asking"
        )
    telling.write("\n".join(map(summary, configs)) + "\ntype yes to arm: ")
    telling.flush()
    if asking.readline().strip().lower() != "yes":
        raise ArmingError("not armed: the answer was not yes; nothing was sent")


class DeadMan(StopRequest):
    """A stop request that also comes when ``fd`` closes or, on a terminal, no key was seen for a second.

    Polled by the loop through :attr:`value`: one system call of no waiting. ``now_ns`` is monotonic; the
    first poll starts the time. What a dead-man's switch stops stops at once, without a ramp.
    """

    ramps = False
    polled = True

    def __init__(self, fd: int, now_ns: Callable[[], int], hold_ns: int = HOLD_NS) -> None:
        self._fd, self._now_ns = fd, now_ns
        self._hold_ns = hold_ns if os.isatty(fd) else None
        self._seen_ns: int | None = None
        self._released = False
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)
        super().__init__()

    @property
    def value(self) -> int:
        """The request of this moment."""
        if not self._released and not self._held():
            self._released = True
            self.stop_once()
        return int(self._cell[0])

    @value.setter
    def value(self, new: int) -> None:
        self._cell[0] = new

    def stop_once(self) -> None:
        """Ask for a stop, but leave a stop that was asked for already as it is."""
        if self._cell[0] not in self.STOPS:
            self.stop()

    def _held(self) -> bool:
        now = self._now_ns()
        if self._seen_ns is None:
            self._seen_ns = now
        if self._poll.poll(0):
            if not self._read():
                return False
            self._seen_ns = now
        return self._hold_ns is None or now - self._seen_ns <= self._hold_ns

    def _read(self) -> bool:
        """Take what was typed; False when there will be no more."""
        try:
            return bool(os.read(self._fd, 4096))
        except OSError:
            return False


@contextlib.contextmanager
def keys_at_once(fd: int) -> Iterator[None]:
    """On a terminal: keys come without Enter and are not shown; Ctrl-C stays. Restored afterwards."""
    if not os.isatty(fd):
        yield
        return
    before = termios.tcgetattr(fd)
    tty.setcbreak(fd)
    try:
        yield
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


@contextlib.contextmanager
def requesting(dead_man: bool, stdin: TextIO, say: Callable[[str], None]) -> Iterator[StopRequest]:
    """The operator's request for a run: signals alone, or with the dead-man's switch on ``stdin``."""
    if not dead_man:
        yield StopRequest()
        return
    fd = stdin.fileno()
    if os.isatty(fd):
        say("hold any key: the run stops one second after it is let go")
    with keys_at_once(fd):
        yield DeadMan(fd, RealClock().now_ns)
