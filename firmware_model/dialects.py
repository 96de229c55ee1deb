"""What an emulated drive speaks: the port of its frames, and the registry of what there is.

A package of somebody else's names a :class:`Dialect` in the entry point group ``hil.emulated``; the entry
point's name is what ``protocol`` of the plant's file says. A dialect is imported when it is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from drivers.plugins import loaded_as, names
from firmware_model.registry import PlantError

if TYPE_CHECKING:
    from drivers.bus import Frame
    from drivers.codec import Database
    from firmware_model.config import Wire
    from firmware_model.kernels import Kernels

GROUP: Final = "hil.emulated"
BUILT_IN: Final = {
    "house": "firmware_model.house",
    "inverter": "firmware_model.inverter",
    "cia402": "firmware_model.cia402",
    "odrive": "firmware_model.odrive",
    "moteus": "firmware_model.moteus",
}
"""Modules with a ``MEMBER``."""
Sent = tuple[int, bytes, bool]
"""Identifier as it stands in the frame, data, FD."""
Eds = tuple[Path, dict[int, dict[int, bytes]]]
"""A CANopen node's EDS, and what it has stored."""


class Frames(Protocol):
    """What a drive reads and writes. ``ignored`` counts frames that it did not take."""

    due: Sequence[Sent]
    """Answers to what was taken last."""
    sync_id: int | None
    """Identifier of SYNC, or of the message that asks the drive; None: it has neither."""
    answers_commands: bool
    """The message of ``sync_id`` is the command, which is taken before it is answered."""
    ignored: Counter[str]
    feedback: bool
    """Whether the measurements are among the next answer, which a drive that measures seldom leaves out."""

    @property
    def beat_ns(self) -> int:
        """Time between two heartbeats, 0 for none."""

    @property
    def counter_modulus(self) -> int:
        """Number of values of the command's counter."""

    @property
    def wire(self) -> Wire:
        """Resolution and range of the measured signals, in SI units."""

    @property
    def spoken(self) -> dict[int, int] | None:
        """Length of each message that it sends or takes, by identifier; None: whatever it is set to."""

    def boot(self) -> list[Sent]:
        """What it sends when it starts."""

    def beat(self) -> list[Sent]:
        """Its heartbeat."""

    def asks(self, data: bytes) -> bool:
        """True for the data of a SYNC, or of a request that it answers."""

    def take(self, frame: Frame, drive: Kernels, catch_up: Callable[[], None]) -> None:
        """Take a command, whole or not at all; ``catch_up`` brings the plant to now first."""

    def answer(self, out: dict[str, Any]) -> list[Sent]:
        """What it sends of a sample (:data:`firmware_model.plant.SAMPLE`), the measurements last."""


class Synchronous:
    """What most dialects have in common: nothing is due at once, no heartbeat, CANopen's SYNC."""

    due: Sequence[Sent] = ()
    answers_commands = False
    feedback = True

    def asks(self, data: bytes) -> bool:
        """CANopen's SYNC has no data or its counter."""
        return len(data) <= 1


@dataclass(frozen=True, slots=True)
class Dialect:
    """``frames(database, truth, eds)`` makes them; ``truth``: send what no real drive can tell.

    ``eds``: it needs a CANopen node's EDS. ``wire``: where it does not follow from the database.
    ``steps``: it keeps its own time but in lockstep, where ``sync_id`` moves it on.
    """

    doc: str
    frames: Callable[[Database, bool, Eds | None], Frames]
    eds: bool = False
    wire: Wire | None = None
    steps: bool = False


def dialects() -> tuple[str, ...]:
    """What ``protocol`` may be."""
    return names(GROUP, BUILT_IN)


def dialect(name: str) -> Dialect:
    """The dialect of that name. Raises PlantError."""
    if name in BUILT_IN:
        member: Dialect = import_module(BUILT_IN[name]).MEMBER
        return member
    named = list(entry_points(group=GROUP, name=name))
    if len(named) != 1:
        where = " and ".join(sorted(entry.value for entry in named)) or "no package"
        raise PlantError(f"{GROUP}: {name!r} is named by {where}; one must be installed")
    return loaded_as(named[0], Dialect, lambda why: PlantError(f"{GROUP}: {why}"))
