"""Frames that are sent once: to set a drive up after arming and before its first command, and after a stop.

Each may wait, and may expect what the drive then sends. Names and values are checked before anything is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from drivers.codec import Database, Message
from drivers.errors import DatabaseError, DriverError, EncodeError

MOST_MS: Final = 10_000.0


@dataclass(frozen=True, slots=True)
class OneShot:
    """A frame as the map has it: ``values`` by signal, the others the DBC's start value or 0.

    ``expect``: MESSAGE.Signal = value.
    """

    message: str
    values: Mapping[str, int | float] = field(default_factory=dict)
    wait_ms: float = 0.0
    expect: Mapping[str, int | float] = field(default_factory=dict)
    within_ms: float = 1000.0


@dataclass(frozen=True, slots=True)
class Expected:
    """What the drive must send: a signal of a message with a value."""

    message: Message
    signal: str
    value: float

    def said(self, whole_id: int, data: bytes) -> float | None:
        """What this frame says of it; None for another frame."""
        if whole_id != self.message.send_id or len(data) != self.message.length:
            return None
        return self.message.decode(data)[self.signal]

    @property
    def name(self) -> str:
        """MESSAGE.Signal."""
        return f"{self.message.name}.{self.signal}"

    def __str__(self) -> str:
        return f"{self.name} = {self.value:g}"


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame that is laid out, and what it waits for."""

    message: Message
    data: bytes
    wait_s: float
    expected: tuple[Expected, ...]
    within_s: float

    def unanswered(self, missing: Mapping[Expected, float | None]) -> str:
        """Why the drive is not started: what did not come, and what it said instead."""
        wanted = ", ".join(map(str, missing))
        said = [f"{one.name} = {value:g}" for one, value in missing.items() if value is not None]
        instead = f"it said {', '.join(said)}" if said else f"no {self._silent(missing)} came at all"
        return (
            f"{self.message.name} was sent, and {wanted} did not come within {self.within_s * 1e3:g} ms: "
            f"{instead}; look at the drive's state, errors and node number (drive.signals.start)"
        )

    @staticmethod
    def _silent(missing: Iterable[Expected]) -> str:
        return ", ".join(dict.fromkeys(one.message.name for one in missing))


def shots_from(value: Any) -> tuple[OneShot, ...] | None:
    """Frames from a config's array of tables; None when it has another form."""
    if not isinstance(value, list | tuple) or not all(isinstance(one, Mapping) for one in value):
        return None
    try:
        made = tuple(OneShot(**one) for one in value)
    except TypeError:
        return None
    return made if all(_right(one) for one in made) else None


def _right(one: OneShot) -> bool:
    tables = isinstance(one.values, Mapping) and isinstance(one.expect, Mapping)
    times = all(type(t) in (int, float) and 0 <= t <= MOST_MS for t in (one.wait_ms, one.within_ms))
    return isinstance(one.message, str) and tables and times


def bound_shots(
    what: str, given: tuple[OneShot, ...], database: Database, add: Callable[[str], None]
) -> tuple[Shot, ...]:
    """The frames laid out; each mistake is handed to ``add``."""
    return tuple(shot for one in given for shot in _bound(what, one, database, add))


def _bound(what: str, one: OneShot, database: Database, add: Callable[[str], None]) -> Iterator[Shot]:
    try:
        message = database.message(one.message, *one.values)
        data = message.encode(_started(message) | dict(one.values))
        expected = tuple(_expected(text, value, database) for text, value in _flat(one.expect))
        yield Shot(message, data, one.wait_ms * 1e-3, expected, one.within_ms * 1e-3)
    except (DatabaseError, EncodeError) as error:
        add(f"{what}: {str(error).removeprefix(f'{database.path}: ')}")


def _started(message: Message) -> dict[str, int | float]:
    """What is sent where nobody gives a value."""
    known = {name: message.signals[name] for name in message.start.keys() & message.signals.keys()}
    starts = {name: message.start[name] * one.scale + one.offset for name, one in known.items()}
    return dict.fromkeys(message.signals, 0) | starts


def _flat(expect: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """TOML reads A.B = 1 as a table in a table."""
    for name, value in expect.items():
        inner = value if isinstance(value, Mapping) else {"": value}
        yield from ((f"{name}.{signal}" if signal else name, number) for signal, number in inner.items())


def _expected(text: str, value: float, database: Database) -> Expected:
    name, dot, signal = text.partition(".")
    if not dot or isinstance(value, bool) or not isinstance(value, int | float):
        raise DatabaseError(f'expect "{text}": write it as "MESSAGE.Signal" = number')
    return Expected(database.message(name, signal), signal, float(value))


class NoAnswer(DriverError):
    """The drive did not say what a start frame expects."""
