"""Listens to a bus and counts what comes: rates, CRCs, counters, newest values. Sends nothing."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.binding import Binding
from drivers.bus import Frame, Link
from drivers.codec import Database, Message
from drivers.errors import LinkDown, LinkError
from drivers.local import ERR_FLAG
from drivers.states import translator


@dataclass(slots=True)
class Heard:
    """What was heard of one message; ``values`` are the newest, in the DBC's units.

    ``odd_length``: of the newest frame whose length is not the DBC's.
    """

    count: int = 0
    invalid: int = 0
    odd_length: int | None = None
    jumps: int = 0
    first_ns: int = 0
    last_ns: int = 0
    values: dict[str, float] = field(default_factory=dict)
    data: bytes = b""

    @property
    def rate_hz(self) -> float:
        """Mean rate between the first and the last frame; 0 for fewer than two."""
        span = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span if span > 0 else 0.0


@dataclass(slots=True)
class Traffic:
    """All of it: by message name, and frames that are in no message of the DBC."""

    messages: dict[str, Heard] = field(default_factory=dict)
    foreign: int = 0
    error_frames: int = 0
    down: bool = False

    def of(self, name: str) -> Heard:
        """What was heard of a message, empty when nothing was."""
        return self.messages.get(name, Heard())


def listen(link: Link, database: Database, seconds: float, counters: Mapping[str, str]) -> Traffic:
    """Listen for ``seconds``; a bus that goes down ends it early. ``counters``: signal by message."""
    traffic = Traffic()
    end = time.monotonic_ns() + round(seconds * 1e9)
    while (left := end - time.monotonic_ns()) > 0 and not traffic.down:
        try:
            frame = link.receive(left)
        except LinkDown:
            traffic.down = True
        except LinkError:
            traffic.error_frames += 1
        else:
            if frame is not None:
                _take(
                    traffic,
                    frame,
                    database.of_frame(frame.can_id | frame.flags),
                    counters,
                    time.monotonic_ns(),
                )
    return traffic


def _take(
    traffic: Traffic, frame: Frame, message: Message | None, counters: Mapping[str, str], now_ns: int
) -> None:
    if frame.flags & ERR_FLAG:
        traffic.error_frames += 1
    elif message is None:
        traffic.foreign += 1
    else:
        heard = traffic.messages.setdefault(message.name, Heard())
        _count(heard, message, counters.get(message.name, ""), frame.data, now_ns)


def _count(heard: Heard, message: Message, counter: str, data: bytes, now_ns: int) -> None:
    heard.count += 1
    heard.first_ns = heard.first_ns or now_ns
    heard.last_ns = now_ns
    if len(data) != message.length:
        heard.odd_length = len(data)
    if len(data) != message.length or not message.valid(data):
        heard.invalid += 1
        return
    heard.data = data
    before = heard.values.get(counter)
    heard.values = {**heard.values, **message.decode(data)}
    if before is not None:
        first, last = message.signals[counter].raw_range()
        heard.jumps += heard.values[counter] != (before + 1 if before < last else first)


def part_values(binding: Binding, traffic: Traffic) -> dict[str, float]:
    """Newest value of each received part that was heard, in SI units; the state as CiA 402's code."""
    translate = translator(binding.map.states, lambda: 0)
    values: dict[str, float] = {}
    for bound in binding.incoming:
        heard = traffic.of(bound.message.name).values
        for part, signal in bound.parts:
            if signal in heard:
                values[part] = heard[signal] * binding.factors.get(part, 1.0)
    state = binding.signal("state")
    if translate and state and "state" in values:
        values["state"] = translate(int(values["state"]) % (1 << state.length))
    return values
