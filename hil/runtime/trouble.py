"""Trouble on the bus as events in the log: each kind when it begins, not again in every tick that has it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from hil.signals import RxFlag

KINDS: Final = (
    RxFlag.CRC_ERROR,
    RxFlag.COUNTER_REPEATED,
    RxFlag.COUNTER_JUMP,
    RxFlag.LENGTH_ERROR,
    RxFlag.EMERGENCY,
    RxFlag.ERROR_FRAME,
    RxFlag.BUS_DOWN,
    RxFlag.FOREIGN_COMMAND,
    RxFlag.SEND_FAILED,
)
TROUBLE: Final = sum(int(kind) for kind in KINDS)
QUIET_TICKS: Final = 1000
"""After so many ticks without any trouble, what begins again is noted again."""


class Trouble:
    """Takes the ticks whose ``rx_flags`` have a bit of TROUBLE; the loop asks it for no others."""

    def __init__(self, event: Callable[[int, int, str, str], None]) -> None:
        self._event = event
        self._noted = self._last_k = 0

    def note(self, t_ns: int, k: int, flags: int) -> None:
        """Log the kinds that are new, by the names of their bits."""
        if k - self._last_k > QUIET_TICKS:
            self._noted = 0
        self._last_k = k
        new = flags & TROUBLE & ~self._noted
        if new:
            self._noted |= new
            self._event(t_ns, k, "bus", ", ".join(kind.name for kind in KINDS if new & kind))
