"""The client's way to its bus by the kernels of :mod:`drivers.posix`: two calls a tick."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.bus import SocketLink
from drivers.jit import CALL, COMPILED, entry, places_of
from drivers.posix import (
    ARRAYS,
    DONE,
    DRAIN_MOST,
    FLAGS,
    IO_WORDS,
    LEFT,
    MORE,
    OVER,
    RAISED,
    RECEIVES,
    SENDS,
    TELLS,
)
from drivers.rawlink import RawLink

Arrays = dict[str, Any]
"""What :data:`drivers.posix.ARRAYS` names."""
NOWHERE: Final = np.full(4, -1, np.int32)
"""Descriptors of no file."""


class Saved(NamedTuple):
    """What the frames so far have left in a client: the kernels' record, last counters, others' commands."""

    state: bytes
    counters: bytes
    seen: bytes = b""


class Compiled(NamedTuple):
    """What a compiled tick calls the kernels of :mod:`drivers.posix` with.

    ``exchange``, ``receive`` and ``command`` are places; ``sync_bytes``: size of SYNC's frame, ``log``: the
    frames.
    """

    exchange: npt.NDArray[np.int64]
    receive: npt.NDArray[np.int64]
    command: npt.NDArray[np.int64]
    sync_bytes: int
    log: npt.NDArray[np.void]


class Port:
    """The kernels of one link. ``shared``: the client's arrays that all of them use, by name.

    ``buffer``: where what is received goes; ``now``: what frames are stamped with.
    """

    def __init__(self, link: RawLink, shared: Arrays, buffer: memoryview, now: Callable[[], int]) -> None:
        io = np.zeros(IO_WORDS, np.int64)
        self.io: Any = io.data
        self.places: dict[Any, Any] = {}
        """What each kernel is called with."""
        self.raised: BaseException | None = None
        """What a function of Python's has raised that a kernel has called."""
        self._alive: list[Any] = []
        fds = NOWHERE
        if COMPILED and isinstance(link, SocketLink):
            fds = link.fds
        else:
            io[RECEIVES] = self._called(lambda left_ns, _: link.receive_into(buffer, left_ns) or OVER)
            io[SENDS] = self._called(partial(_send, link))
        if not (COMPILED and now is time.monotonic_ns):
            io[TELLS] = self._called(lambda *_: now())
        self._shared: Arrays = {"fds": fds, "times": np.zeros(4, np.int64), "io": io, **shared}
        self.restart()

    def share(self, name: str, array: Any) -> None:
        """An array more that all use which are made from now on."""
        self._shared[name] = array

    def _called(self, act: Callable[[int, int], int]) -> int:
        """The address of a function that kernels call; it never raises."""

        def safe(first: int, second: int) -> int:
            try:
                return act(first, second)
            except BaseException as error:  # noqa: BLE001 - no exception passes through C: the client raises it
                self.raised = error
                return RAISED

        made = CALL(safe)
        self._alive.append(made)
        return ctypes.cast(made, ctypes.c_void_p).value or 0

    def over(self, kernel: Any, own: Arrays, *known: Any, free: tuple[Any, ...] = ()) -> Callable[..., int]:
        """The kernel over the client's arrays; it is called with what comes after ``known``.

        The call that makes the compiled form, with ``free``, leads nowhere and leaves no trace.
        """
        arrays = self._shared | own
        self.places[kernel] = places_of(arrays, ARRAYS)
        self._alive.append(arrays)
        compiled = kernel
        if COMPILED:
            copies = {name: array.copy() for name, array in arrays.items()}
            copies |= {"fds": NOWHERE, "io": np.zeros_like(arrays["io"])}
            compiled = entry(kernel, places_of(copies, ARRAYS), *known, *free)
        return partial(compiled, self.places[kernel], *known)

    def restart(self) -> None:
        """Let the next drain begin anew."""
        self.io[FLAGS], self.io[MORE] = 0, DRAIN_MOST

    def left(self) -> int:
        """What a kernel returned that a compiled tick has left to the client; 0 for nothing."""
        code: int = self.io[LEFT]
        self.io[LEFT] = 0
        return code


def _send(link: RawLink, address: int, size: int) -> int:
    """The frame at an address."""
    link.send_raw(memoryview(ctypes.string_at(address, size)))
    return DONE
