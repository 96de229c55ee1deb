"""The client's way to a socket by the kernels of :mod:`drivers.posix`: three calls a tick."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numba.core import config

from drivers.bus import SocketLink
from drivers.jit import entry
from drivers.posix import MORE, command, drain, latch

COMPILED = not config.DISABLE_JIT  # type: ignore[attr-defined]
"""The kernels call the C library, which the interpreted form can't."""


class SocketPort:
    """The kernels of one socket over their arrays. ``shared``: (state, words, log) of the client."""

    def __init__(self, link: SocketLink, shared: tuple[Any, Any, Any]) -> None:
        self._fds = link.fds
        self._state, self._words, self._log = shared
        self._times = np.zeros(4, np.int64)
        io = np.zeros(4, np.int64)
        self._io, self.io = io, io.data

    def _over(self, kernel: Any, fixed: tuple[Any, ...], *free: Any) -> Callable[..., int]:
        """The compiled form; the call that makes it has descriptors that lead nowhere."""
        nowhere = np.full(4, -1, np.int32)
        return partial(entry(kernel, nowhere, self._times, *fixed, *free), self._fds, self._times, *fixed)

    def drainer(self, taking: tuple[Any, ...]) -> Callable[[int, bool], int]:
        """:func:`drivers.posix.drain` over what :func:`drivers.wire.take` takes first."""
        self._io[MORE] = 0
        return self._over(drain, (self._io, *taking), 0, False)

    def latcher(self, raw: Any, size: int) -> Callable[[int], int]:
        """:func:`drivers.posix.latch` for a SYNC that is laid out in ``raw``; its count is to be given."""
        return self._over(latch, (raw, size, self._state, self._log), 0)

    def commander(
        self, raw: Any, commanding: tuple[Any, Any, Any], tick: Any, places: Any
    ) -> Callable[[], int]:
        """:func:`drivers.posix.command` for one message, of (values, messages, signals) and a tick."""
        shared = (self._state, self._words, self._log)
        return self._over(command, (raw, *commanding, *shared, tick, places))
