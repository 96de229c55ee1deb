"""The client's way to a socket by the kernels of :mod:`drivers.posix`: two calls a tick."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from drivers.bus import SocketLink
from drivers.jit import entry, places_of
from drivers.posix import ARRAYS, DRAIN_MOST, FLAGS, FLAGS_AT, MORE, command, drain, exchange

Arrays = dict[str, Any]
"""What :data:`drivers.posix.ARRAYS` names."""


class SocketPort:
    """The kernels of one socket. ``shared``: the client's arrays that all of them use, by name."""

    def __init__(self, link: SocketLink, shared: Arrays) -> None:
        io = np.zeros(5, np.int64)
        self.io: Any = io.data
        self._shared: Arrays = {"fds": link.fds, "times": np.zeros(4, np.int64), "io": io, **shared}
        self._alive: dict[Any, Arrays] = {}

    def _over(self, kernel: Any, own: Arrays, *known: Any, free: tuple[Any, ...]) -> Callable[..., int]:
        """The compiled form; the call that makes it, with ``free``, has descriptors that lead nowhere."""
        arrays = self._shared | own
        self._alive[kernel] = arrays
        nowhere = np.full(4, -1, np.int32)
        compiled = entry(kernel, places_of(arrays | {"fds": nowhere}, ARRAYS), *known, *free)
        return partial(compiled, places_of(arrays, ARRAYS), *known)

    def drainer(self, own: Arrays, flags_at: int) -> Callable[[int, bool], int]:
        """:func:`drivers.posix.drain` over what :func:`drivers.wire.take` takes; the tick's flags' offset."""
        self.io[FLAGS], self.io[MORE], self.io[FLAGS_AT] = 0, 0, flags_at
        made = self._over(drain, own, free=(0, False))
        self.restart()
        return made

    def restart(self) -> None:
        """Let the next drain begin anew."""
        self.io[FLAGS], self.io[MORE] = 0, DRAIN_MOST

    def exchanger(self, own: Arrays, size: int) -> Callable[[int, int], int]:
        """:func:`drivers.posix.exchange` for a SYNC that is laid out; called with count and deadline."""
        made = self._over(exchange, own, size, free=(0, 0))
        self.restart()
        return made

    def commander(self, own: Arrays) -> Callable[[], int]:
        """:func:`drivers.posix.command` for one message."""
        return self._over(command, own, free=())
