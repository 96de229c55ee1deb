"""A recording of a bus in another tool's format: gone through once to see if it can be trusted, then read.

The first pass counts frames and kinds, channels, stamps and what can't be read, so that whatever is refused
is refused before anything is written or sent.
"""

from __future__ import annotations

import gzip
import io
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final

import numpy as np

from hil.exchange.periods import Heard
from hil.exchange.readers import asc, blf, candump, library, mf4, trc
from hil.exchange.readers.recorded import ERROR, REMOTE, Found, NotThisFormatError, Recorded
from hil.log.errors import LogError

TEXTS: Final = {".log": candump.read, ".asc": asc.read, ".trc": trc.read}
BINARIES: Final = {".blf": blf.read, ".mf4": mf4.read}
TABLES: Final = (".csv", ".db")
"""python-can's own two, by python-can."""
ENDINGS: Final = (*TEXTS, *BINARIES, *TABLES, *(f"{ending}.gz" for ending in (*TEXTS, *BINARIES)))
UNORDERED: Final = frozenset(BINARIES)
"""Formats whose loggers write buffer by buffer; in the others a stamp that goes back is a fault."""
BACK_NS: Final = 1_000_000
"""A stamp that is before its predecessor's by less than this is taken as that: rounding, two buffers."""
FEW: Final = 100
"""So many frames tell in which steps a recorder's clock goes."""


def ending_of(path: Path) -> str:
    """The ending that names the format, .gz left out. Raises LogError."""
    name = path.name.lower()
    ending = Path(name.removesuffix(".gz")).suffix
    if not name.endswith(ENDINGS):
        raise LogError(f"{path}: a recording ends in one of {' '.join(ENDINGS)}")
    return ending


def kinds_of(identifiers: Counter[int]) -> dict[str, int]:
    """How many data, remote and error frames there are among those with such identifiers."""
    kinds = {"data": 0, "remote": 0, "error": 0}
    for can_id, count in identifiers.items():
        kinds["error" if can_id & ERROR else "remote" if can_id & REMOTE else "data"] += count
    return kinds


@dataclass(slots=True)
class Recording:
    """A recording's file and what it holds. Raises LogError for what can't be read, or not be trusted.

    ``channel``: only frames of that one; without it the file must hold a single one. ``partial``: take what
    there is of a recording of which a part can't be read. ``asking``: the option that names a channel.
    ``step_ns``: the steps in which its clock goes, 0 when too few frames tell; ``longest``: the longest time
    without a frame, and after which time from the first.
    """

    path: Path
    channel: str | None = None
    partial: bool = False
    asking: str = "--channel"
    start_ns: int = 0
    count: int = 0
    set_right: int = 0
    step_ns: int = 0
    longest: tuple[int, int] = (0, 0)
    damage: str | None = None
    notes: list[str] = field(default_factory=list)
    identifiers: Counter[int] = field(default_factory=Counter)
    channels: Counter[str] = field(default_factory=Counter)
    _ordered: bool = True

    def __post_init__(self) -> None:
        if not self.path.is_file():
            raise LogError(f"{self.path}: no such file")
        found, stamps = Found(), array("q")
        for one in self._read(found):
            self.channels[one.channel] += 1
            if self.channel in (None, one.channel):
                stamps.append(one.t_ns)
                self.identifiers[one.can_id] += 1
        self._check_found(found)
        self.count, self.start_ns = len(stamps), min(stamps) if self._unordered else stamps[0]
        self._check_times(np.frombuffer(stamps, np.int64))

    def frames(self) -> Iterator[Recorded]:
        """Every frame of the channel, in the order of time."""
        mine = (one for one in self._read(Found()) if self.channel in (None, one.channel))
        yield from mine if self._ordered else sorted(mine, key=lambda one: one.t_ns)

    def heard(self) -> Iterator[Heard]:
        """The same with times from the first frame on, none before its predecessor's."""
        last_ns = self.start_ns
        for t_ns, _, can_id, received, fd, data in self.frames():
            last_ns = max(last_ns, t_ns)
            yield Heard(last_ns - self.start_ns, can_id, received, fd, data)

    @property
    def _unordered(self) -> bool:
        return ending_of(self.path) in UNORDERED

    def _read(self, found: Found) -> Iterator[Recorded]:
        ending = ending_of(self.path)
        try:
            if ending in TABLES:
                yield from library.read_table(self.path, found)
            elif ending in TEXTS:
                with _unpacked(self.path) as file, io.TextIOWrapper(file, "utf-8", "replace") as text:
                    yield from TEXTS[ending](text, found)
            else:
                with _unpacked(self.path) as file:
                    yield from BINARIES[ending](file, found)
        except NotThisFormatError as error:
            raise LogError(f"{self.path}: {error}") from error
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            found.cut = (
                f"the compressed file is damaged or cut off after {found.places} {found.unit}: {error}"
            )
        except OSError as error:
            raise LogError(f"{self.path}: can't be read: {error.strerror or error}") from error

    def _check_found(self, found: Found) -> None:
        """Raise LogError without frames, without a clear channel, for damage that nobody allowed."""
        self.damage, self.notes = found.damage, [f"{count} {what}" for what, count in found.notes.items()]
        counted = ", ".join(f"{name}: {count} frames" for name, count in sorted(self.channels.items()))
        if self.damage and not (self.partial and self.channels):
            there = sum(self.channels.values())
            remedy = f"; --partial takes the {there} frames that there are" if there else ""
            raise LogError(f"{self.path}: {self.damage}{remedy}")
        if not self.channels:
            raise LogError(f"{self.path}: has no frames")
        if self.channel is None and len(self.channels) > 1:
            raise LogError(f"{self.path}: holds several channels ({counted}); name one with {self.asking}")
        if not self.identifiers:
            raise LogError(f"{self.path}: has no frames of channel {self.channel}; there are {counted}")

    def _check_times(self, stamps: np.ndarray) -> None:
        """Note the steps of the stamps and what goes back. Raises LogError for a clock that was set back."""
        steps = np.diff(stamps)
        if len(stamps) >= FEW and not steps.any():
            raise LogError(f"{self.path}: its {len(stamps)} stamps are all the same: its clock stands still")
        self.step_ns = int(np.gcd.reduce(steps)) if len(stamps) >= FEW else 0
        if len(steps):
            self.longest = int(steps.max()), int(stamps[steps.argmax()]) - self.start_ns
        back = np.flatnonzero(steps < 0)
        if not len(back):
            return
        worst = int(steps.min())
        if self._unordered:
            self._ordered = False
            self.notes.append(
                f"{len(back)} times the stamps go back, by {-worst * 1e-9:g} s at most: ordered by time"
            )
            return
        if -worst > BACK_NS:
            raise LogError(
                f"{self.path}: time goes back by {-worst * 1e-9:.6f} s at frame {int(steps.argmin()) + 1}; "
                "cut the recording there"
            )
        self.set_right = int((stamps < np.maximum.accumulate(stamps)).sum())


def _unpacked(path: Path) -> IO[bytes]:
    """The file's bytes; a compressed one goes through memory where its reader seeks."""
    if path.suffix.lower() != ".gz":
        return path.open("rb")
    stream = gzip.open(path, "rb")  # noqa: SIM115 - the caller closes it
    if ending_of(path) in TEXTS:
        return stream  # type: ignore[return-value]
    with stream:
        return io.BytesIO(stream.read())
