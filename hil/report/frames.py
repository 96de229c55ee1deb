"""What was on the bus: frames a direction and identifier, their spacing, and the load second by second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from hil.log.schema import Records

MOST_IDS: Final = 200
EXTENDED: Final = 0x8000_0000
REMOTE: Final = 0x4000_0000
ERROR: Final = 0x2000_0000
FrameTime = Callable[[int, bool], float]
"""Longest time on the bus [s] of a frame of that many bytes; True for an extended identifier."""


@dataclass(slots=True)
class Traffic:
    """Frames of one identifier and direction; spacings in ms."""

    can_id: int
    received: bool
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    shortest: float = float("inf")
    longest: float = 0.0
    bytes_low: int = 64
    bytes_high: int = 0

    def feed(self, records: Records) -> None:
        """Take frames of this identifier and direction."""
        t = records["t_ns"].astype(np.int64)
        spacing = np.diff(t, prepend=self.last_ns if self.count else t[0])[0 if self.count else 1 :] * 1e-6
        if len(spacing):
            self.shortest = min(self.shortest, float(spacing.min()))
            self.longest = max(self.longest, float(spacing.max()))
        self.first_ns = self.first_ns if self.count else int(t[0])
        self.count, self.last_ns = self.count + len(t), int(t[-1])
        self.bytes_low = min(self.bytes_low, int(records["size"].min()))
        self.bytes_high = max(self.bytes_high, int(records["size"].max()))

    @property
    def rate(self) -> float | None:
        """Mean rate [1/s]."""
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return (self.count - 1) / span_s if span_s > 0 else None


class Frames:
    """All traffic, and how busy the bus was in each second (with every stuff bit)."""

    def __init__(self) -> None:
        self.traffic: dict[tuple[int, bool], Traffic] = {}
        self.more_ids = False
        self._sizes: dict[tuple[int, int, bool], int] = {}

    def feed(self, records: Records) -> None:
        """Take FRAME records in the order of the file."""
        extended = (records["can_id"] & EXTENDED) != 0
        second = (records["t_ns"] // 1_000_000_000).astype(np.int64)
        kinds, counts = np.unique((second << 8) | (records["size"] << 1) | extended, return_counts=True)
        for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True):
            key = (kind >> 8, kind >> 1 & 0x7F, bool(kind & 1))
            self._sizes[key] = self._sizes.get(key, 0) + count
        for can_id in np.unique(records["can_id"]).tolist():
            for received in (True, False):
                own = records[(records["can_id"] == can_id) & ((records["received"] != 0) == received)]
                if len(own):
                    self._of(can_id, received, own)

    def _of(self, can_id: int, received: bool, own: Records) -> None:
        key = (can_id, received)
        if key not in self.traffic and len(self.traffic) >= MOST_IDS:
            self.more_ids = True
            return
        self.traffic.setdefault(key, Traffic(can_id, received)).feed(own)

    def load(self, frame_time: FrameTime) -> tuple[float, float] | None:
        """Mean and largest share of a second that the bus was busy, in percent; None without frames."""
        busy: dict[int, float] = {}
        for (second, size, extended), count in self._sizes.items():
            busy[second] = busy.get(second, 0.0) + count * frame_time(size, extended)
        if not busy:
            return None
        first, last = zip(*((t.first_ns, t.last_ns) for t in self.traffic.values()), strict=True)
        span_s = max((max(last) - min(first)) * 1e-9, 1e-3)
        return 100.0 * sum(busy.values()) / span_s, 100.0 * max(busy.values())


def id_text(can_id: int) -> str:
    """An identifier in hex, as candump prints it."""
    if can_id & ERROR:
        return f"error {can_id & 0x1FFF_FFFF:X}"
    text = f"{can_id & 0x1FFF_FFFF:08X}" if can_id & EXTENDED else f"{can_id & 0x7FF:03X}"
    return f"{text} remote" if can_id & REMOTE else text
