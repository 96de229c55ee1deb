"""The kernels of a tick over one drive's records, ready to be called.

To unpack a record costs more than what most of them do, so each takes one array of the records' places.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

from firmware_model.config import Record
from firmware_model.drive import advance, on_command, on_load_command, on_sync
from firmware_model.jit import array_at, entry, jit, places_of
from firmware_model.plant import PARAMS, SAMPLE, STATE

ARRAYS: Final = {"params": PARAMS, "state": STATE, "sample": SAMPLE}
"""The records behind a kernel's places, in their order."""


class Kernels:
    """``advance(dt_ns)``, ``sync()``, ``command(counter, controlword, u_q, u_d)`` and ``load(T_L)``.

    They work on the records that were given, in place; ``params``, ``state`` and ``sample`` are views of
    those.
    """

    advance: Callable[[int], None]
    sync: Callable[[], None]
    command: Callable[[int, int, float, float], None]
    load: Callable[[float], None]

    def __init__(self, params: Record, state: Record, sample: Record) -> None:
        self._alive = {"params": params, "state": state, "sample": sample}
        self.params: Any = params[0]
        self.state: Any = state[0]
        self.sample: Any = sample[0]
        copies = {"params": params, "state": state.copy(), "sample": sample.copy()}
        trial, places = places_of(copies, ARRAYS), places_of(self._alive, ARRAYS)
        self.advance = partial(entry(advance_at, trial, 0), places)
        self.sync = partial(entry(on_sync_at, trial), places)
        self.command = partial(entry(on_command_at, trial, 0, 0, 0.0, 0.0), places)
        self.load = partial(entry(on_load_command_at, trial, 0.0), places)

    def sampled(self) -> dict[str, Any]:
        """The sample as plain numbers."""
        return dict(zip(SAMPLE.names or (), self.sample.item(), strict=True))


@jit
def advance_at(places: Any, dt_ns: int) -> None:
    """:func:`firmware_model.drive.advance`."""
    advance(array_at(places, 0, PARAMS)[0], array_at(places, 1, STATE)[0], dt_ns)


@jit
def on_sync_at(places: Any) -> None:
    """:func:`firmware_model.drive.on_sync`."""
    on_sync(array_at(places, 0, PARAMS)[0], array_at(places, 1, STATE)[0], array_at(places, 2, SAMPLE)[0])


@jit
def on_command_at(places: Any, counter: int, controlword: int, u_q: float, u_d: float) -> None:
    """:func:`firmware_model.drive.on_command`."""
    on_command(array_at(places, 1, STATE)[0], counter, controlword, u_q, u_d)


@jit
def on_load_command_at(places: Any, T_L: float) -> None:
    """:func:`firmware_model.drive.on_load_command`."""
    on_load_command(array_at(places, 1, STATE)[0], T_L)
