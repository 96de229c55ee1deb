"""A recording of a bus in another tool's format, frame by frame.

Reads by python-can's readers. What they raise for damaged bytes ends the recording there and is named; what
is no recording at all is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import can

from hil.convert.frame import MissingPackage
from hil.convert.periods import Heard
from hil.convert.recordings import ERROR, EXTENDED, REMOTE
from hil.log.errors import LogError

READERS: Final[dict[str, Callable[[Path], Any]]] = {
    ".log": can.CanutilsLogReader,
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".mf4": can.MF4Reader,
}
BACK_NS: Final = 1_000_000
"""A stamp that is before its predecessor's by less than this is taken as that: rounding, two buffers."""


@dataclass(slots=True)
class Recording:
    """A recording's file and, while :meth:`frames` goes through it, what was found of it.

    ``channel``: only frames of that one; without it the file must hold a single one.
    """

    path: Path
    channel: str | None = None
    start_us: int = 0
    count: int = 0
    set_right: int = 0
    damage: str | None = None
    identifiers: dict[int, int] = field(default_factory=dict)
    _channels: set[str] = field(default_factory=set)
    _last_us: int = 0

    def frames(self) -> Iterator[Heard]:
        """Every frame in the order of the file. Raises LogError."""
        for message in self._messages():
            if self._is_ours(message):
                yield self._heard(message)

    def _messages(self) -> Iterator[Any]:
        """The messages of the file, as far as its reader comes."""
        opened = READERS.get(self.path.suffix.lower())
        if opened is None:
            raise LogError(f"{self.path}: a recording ends in one of {' '.join(sorted(READERS))}")
        try:
            with opened(self.path) as reader:
                yield from reader
        except (ImportError, NotImplementedError) as error:
            raise MissingPackage(f"reading {self.path.suffix} needs asammdf: {error}") from error
        except OSError as error:
            raise LogError(f"{self.path}: can't be read: {error.strerror or error}") from error
        except Exception as error:  # noqa: BLE001 - another program's parser may raise anything on bad bytes
            self.damage = f"can't be read on after frame {self.count}: {error or type(error).__name__}"

    def _is_ours(self, message: Any) -> bool:
        """Whether a message is of the channel that is wanted. Raises LogError when that is not clear."""
        name = str(message.channel)
        self._channels.add(name)
        if self.channel is not None:
            return name == self.channel
        if len(self._channels) > 1:
            names = ", ".join(sorted(self._channels))
            raise LogError(f"{self.path}: holds several channels ({names}, ...); name one with --channel")
        return True

    def _heard(self, message: Any) -> Heard:
        """A message as a frame. Raises LogError for a time that goes back."""
        t_us = round(message.timestamp * 1e6)
        if self.count == 0:
            self.start_us = self._last_us = t_us
        if t_us < self._last_us:
            back_us = self._last_us - t_us
            if back_us * 1000 > BACK_NS:
                raise LogError(
                    f"{self.path}: time goes back by {back_us * 1e-6:.6f} s at frame {self.count}; "
                    "cut the recording there"
                )
            self.set_right += 1
        self._last_us = t_us = max(t_us, self._last_us)
        can_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        can_id |= (REMOTE if message.is_remote_frame else 0) | (ERROR if message.is_error_frame else 0)
        self.count += 1
        if can_id in self.identifiers or len(self.identifiers) < 1000:
            self.identifiers[can_id] = self.identifiers.get(can_id, 0) + 1
        data = b"" if message.is_remote_frame else bytes(message.data)
        return Heard((t_us - self.start_us) * 1000, can_id, bool(message.is_rx), bool(message.is_fd), data)

    @property
    def channels(self) -> str:
        """The channels that were seen, in words."""
        return ", ".join(sorted(self._channels)) or "none"
