"""The port of a drive, all that a run uses of one, and the registry of the kinds of drives.

A kind says how frames are exchanged with the drive; what stands in them its DBC and its map say, so that
check, limits, bus load, log and replay read any kind alike. A package of somebody else's names a
:class:`DriveKind` in the entry point group ``hil.drive``, as one names a bus for python-can in
``can.interface``; the entry point's name is what ``drive.kind`` says. A kind is imported when it is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from drivers.errors import DriverError
from drivers.plugins import loaded_as, names

if TYPE_CHECKING:
    from drivers.bcm import KernelSync
    from drivers.binding import Binding
    from drivers.bus import Link
    from drivers.codec import Database
    from drivers.mapping import DriveMap
    from drivers.port import Compiled, Saved

GROUP: Final = "hil.drive"
USUAL: Final = "dbc"
Seen = npt.NDArray[np.float64]
"""What another controller was last heard to command with each counter, which a drive with an echo names: q, d
[V, A or N m], then those of the next; of a drive without echo the newest alone."""
OnFrames = Callable[[memoryview], None]
"""Takes the bytes of :data:`drivers.wire.FRAME` records, in the order in which they came and went."""


class DriveKindError(DriverError, ValueError):
    """A kind of drive that is not there or can't be used: says which, and what to do."""


@runtime_checkable
class Drive(Protocol):
    """A drive on a link. ``tick`` is one record, filled in place, its fields found by name.

    Nothing is sent before :meth:`start` or the first :meth:`exchange`, but for what :meth:`wait_for_drive`
    may ask; :meth:`stop` and :meth:`leave` never raise.
    """

    binding: Binding
    """Its messages, from the DBC and the map."""

    def overhear(self) -> Seen:
        """Before :meth:`prepare`: take another controller's commands for what the drive applies.

        They no longer count as a second master's. Raises DatabaseError where that can't be.
        """

    def prepare(self, tick: Any) -> None:
        """Get ready for this very record, which every tick fills; sends nothing. Once, before the first."""

    def exchange(self, tick: Any, deadline_ns: int) -> None:
        """:meth:`sync`, then :meth:`receive`. Raises OSError when it can't be sent."""

    def sync(self, tick: Any) -> None:
        """Begin the drive's cycle: CANopen's SYNC, or what asks it; what came before is taken as late."""

    def receive(self, tick: Any, deadline_ns: int) -> None:
        """Drain the bus until the measurements came or ``deadline_ns`` (monotonic) passed; 0: what is there.

        Fills ``rx_flags`` and, for what arrived whole and valid, the measured fields.
        """

    def send(self, tick: Any) -> None:
        """Encode and send the tick's command. Raises EncodeError or LinkError."""

    def start(self) -> None:
        """What is sent once after arming, before the first command. Raises DriverError."""

    def leave(self) -> None:
        """Undo :meth:`start`."""

    def stop(self) -> None:
        """Send a command without torque and the disable, repeated, then :meth:`leave`."""

    def stop_from(self, counter: int) -> None:
        """:meth:`stop` for another process than the one that sent, whose last command had this counter."""

    def wait_for_drive(self, timeout_s: float, ask: bool = False) -> bool:
        """Wait until the drive is heard. ``ask``: it may be asked for what it measures, as it must be."""

    def other_master(self, seconds: float) -> int | None:
        """Listen for what only this client should send: the identifier heard, or None."""

    def listen(self, seconds: float) -> Counter[int]:
        """Only listen; how often each identifier was seen."""

    def odd_length(self) -> str:
        """Which message came with another length than the DBC gives it, in words; empty when none did."""

    def discard(self) -> None:
        """Throw away what was received before the run."""

    def flush(self) -> None:
        """Hand on the frames that came and went since the last time."""

    def compiled(self) -> Compiled | None:
        """What a compiled tick calls; None: the loop calls the methods."""

    @property
    def timed(self) -> KernelSync | None:
        """What sends SYNC in the client's place, if anything."""

    def saved(self) -> Saved:
        """What its frames have left in it; :meth:`restore` goes back there."""

    def restore(self, saved: Saved) -> None:
        """Be as one was when that was saved."""

    def close(self) -> None:
        """Close the link."""


class Opens(Protocol):
    """Makes a drive's client on a link; sends nothing."""

    def __call__(
        self,
        link: Link,
        database: Database,
        *,
        load: bool = False,
        on_frames: OnFrames | None = None,
        now: Callable[[], int] = ...,
        drive_map: DriveMap | None = None,
        timed: KernelSync | None = None,
    ) -> Drive:
        """``now`` stamps frames, ``on_frames`` sees each; ``load``: a load machine is commanded, too."""


@dataclass(frozen=True, slots=True)
class DriveKind:
    """A kind of drive. ``asked``: it says nothing by itself, and answers the message that ``sync`` names."""

    doc: str
    open: Opens
    asked: bool = False


BUILT_IN: Final = {USUAL: "drivers.client"}
"""Modules with a ``MEMBER``."""


def kinds() -> tuple[str, ...]:
    """What ``drive.kind`` may be."""
    return names(GROUP, BUILT_IN)


def drive_kind(name: str) -> DriveKind:
    """The kind of that name. Raises DriveKindError."""
    if name in BUILT_IN:
        kind: DriveKind = import_module(BUILT_IN[name]).MEMBER
        return kind
    named = list(entry_points(group=GROUP, name=name))
    if not named:
        raise DriveKindError(
            f"{name!r} is not one of {', '.join(kinds())}; install the package that has it "
            f"(entry point {GROUP})"
        )
    if len(named) > 1:
        where = " and ".join(sorted(entry.value for entry in named))
        raise DriveKindError(f"{name!r} is named by {where}; uninstall one")
    return loaded_as(named[0], DriveKind, DriveKindError)
