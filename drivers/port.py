"""The client's way to a socket by the kernels of :mod:`drivers.posix`: two calls a tick."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.bus import SocketLink
from drivers.jit import entry, places_of
from drivers.posix import (
    ARRAYS,
    DRAIN_MOST,
    FLAGS,
    FLAGS_AT,
    MORE,
    STATE_AT,
    command,
    drain,
    exchange,
)
from drivers.wire import STATE

Arrays = dict[str, Any]
"""What :data:`drivers.posix.ARRAYS` names."""


class Saved(NamedTuple):
    """What the frames so far have left in a client: record of the kernels, last counters, own fields."""

    state: bytes
    counters: bytes


class Compiled(NamedTuple):
    """What a compiled tick calls the kernels of :mod:`drivers.posix` with.

    ``exchange``, ``receive`` and ``command`` are places, ``exchange`` None for a drive without SYNC;
    ``sync_bytes``: size of SYNC's frame, ``log``: the frames.
    """

    exchange: npt.NDArray[np.int64] | None
    receive: npt.NDArray[np.int64]
    command: npt.NDArray[np.int64]
    sync_bytes: int
    log: npt.NDArray[np.void]


class SocketPort:
    """The kernels of one socket. ``shared``: the client's arrays that all of them use, by name."""

    def __init__(self, link: SocketLink, shared: Arrays) -> None:
        io = np.zeros(STATE_AT + 1, np.int64)
        self.io: Any = io.data
        self.places: dict[Any, npt.NDArray[np.int64]] = {}
        """What each kernel is called with."""
        self._shared: Arrays = {"fds": link.fds, "times": np.zeros(4, np.int64), "io": io, **shared}
        self._alive: dict[Any, Arrays] = {}

    def _over(self, kernel: Any, own: Arrays, *known: Any, free: tuple[Any, ...]) -> Callable[..., int]:
        """The compiled form; the call that makes it, with ``free``, leads nowhere and leaves no trace."""
        arrays = self._shared | own
        self._alive[kernel] = arrays
        io, state = np.zeros_like(self.io), np.zeros(1, STATE)
        nowhere = {"fds": np.full(4, -1, np.int32), "io": io, "state": state}
        compiled = entry(kernel, places_of(arrays | nowhere, ARRAYS), *known, *free)
        self.places[kernel] = places_of(arrays, ARRAYS)
        return partial(compiled, self.places[kernel], *known)

    def drainer(self, own: Arrays, flags_at: int, state_at: int) -> Callable[[int, bool], int]:
        """:func:`drivers.posix.drain` over what :func:`drivers.wire.take` takes; offsets in the tick."""
        self.io[FLAGS], self.io[MORE], self.io[FLAGS_AT], self.io[STATE_AT] = 0, 0, flags_at, state_at
        made = self._over(drain, own, free=(0, False))
        self.restart()
        return made

    def restart(self) -> None:
        """Let the next drain begin anew."""
        self.io[FLAGS], self.io[MORE] = 0, DRAIN_MOST

    def begun(self, what: int) -> int:
        """What an EXCHANGED, COMMANDED or LATE that a kernel has begun came to; 0 for none."""
        code: int = self.io[what]
        self.io[what] = 0
        return code

    def exchanger(self, own: Arrays, size: int) -> Callable[[int], int]:
        """:func:`drivers.posix.exchange` for a SYNC that is laid out; called with the deadline."""
        made = self._over(exchange, own, size, free=(0,))
        self.restart()
        return made

    def commander(self, own: Arrays) -> Callable[[], int]:
        """:func:`drivers.posix.command` for the messages of a command."""
        return self._over(command, own, free=())
