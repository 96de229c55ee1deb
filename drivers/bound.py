"""What a drive map comes to once it is bound to a DBC: messages with their parts, in SI units."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from drivers.codec import Message
from drivers.mapping import COMMANDED_D, COMMANDED_Q, MEASURED, DriveMap
from drivers.oneshot import Shot
from drivers.payload import NO_PAYLOAD, Payload
from drivers.signal import Signal

MOST_COUNTS = 256


@dataclass(frozen=True, slots=True)
class Bound:
    """One message of the map: its counter (may be empty) and (part, signal) pairs, in SI units.

    A counter counts from 0 here, whatever number the drive begins with. ``selector``: the multiplexer behind
    which the parts of a received message lie, and its values; ``payload``: what stands under a command.
    """

    message: Message
    counter: str
    parts: tuple[tuple[str, str], ...]
    payload: Payload = NO_PAYLOAD
    selector: str = ""
    wanted: tuple[int, ...] = ()

    @property
    def counter_modulus(self) -> int:
        """Number of values of this message's counter, by bits and range; 256 when it has none."""
        return self.message.signals[self.counter].raw_count if self.counter else MOST_COUNTS

    def has(self, parts: Collection[str]) -> bool:
        """True when it carries one of these parts."""
        return any(part in parts for part, _ in self.parts)

    def encode(self, values: Mapping[str, float]) -> bytes:
        """A frame of a command: ``values`` by signal over the payload. Raises EncodeError."""
        return self.message.encode(values, self.payload.data)


@dataclass(frozen=True, slots=True)
class Binding:
    """The map's messages: to read, and to write in this order (the one with the command last)."""

    map: DriveMap
    incoming: tuple[Bound, ...]
    outgoing: tuple[Bound, ...]
    sync: Message | None
    emergency: Message | None
    heartbeat: Message | None
    factors: Mapping[str, float] = field(default_factory=dict)
    """From the DBC's unit of each part to SI, where they differ."""
    start: tuple[Shot, ...] = ()
    stop: tuple[Shot, ...] = ()
    nmt: Message | None = None
    node_id: int = 1

    @property
    def opener(self) -> Message | None:
        """What begins the drive's cycle: SYNC, or the command that it answers, which is the last tick's."""
        return self.command.message if self.map.poll else self.sync

    def signal(self, part: str) -> Signal | None:
        """The signal of a part, in SI units; None when the drive has none."""
        for bound in self.incoming + self.outgoing:
            for name, signal in bound.parts:
                if name == part:
                    return bound.message.signals[signal]
        return None

    @property
    def slow(self) -> tuple[Bound, ...]:
        """Messages to read besides those that measure, in the order of their bits.

        What only tells the truth of an emulator is none of them.
        """
        return tuple(
            b for b in self.incoming if not b.has(MEASURED) and {p for p, _ in b.parts} != {"load_true"}
        )

    def _commanded(self) -> list[Signal]:
        """The signals of the command."""
        parts = (*COMMANDED_Q, *COMMANDED_D)
        return [signal for part in parts if (signal := self.signal(part))]

    @property
    def u_step(self) -> float:
        """Step of the command [V, A or N m] that both axes can carry: the coarser one's."""
        return max(signal.step for signal in self._commanded())

    @property
    def u_top(self) -> float:
        """Largest command [V, A or N m] of either sign that both axes can carry."""
        return min(signal.top for signal in self._commanded())

    @property
    def counters(self) -> dict[str, str]:
        """The counter of each message that has one, by message name."""
        bounds = self.incoming + self.outgoing
        return {bound.message.name: bound.counter for bound in bounds if bound.counter}

    @property
    def command(self) -> Bound:
        """The message with the command."""
        return self.outgoing[-1]

    @property
    def counter_modulus(self) -> int:
        """Number of values of the command's counter, as echoed."""
        return self.command.counter_modulus
