"""Members that are found by entry point: their names, and what a name stands for.

``refused`` makes the error that is raised of what is wrong with a member, a text that names its package.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

Refused = Callable[[str], Exception]
Member = TypeVar("Member")


def names(group: str, built_in: Iterable[str]) -> tuple[str, ...]:
    """The names of the house's own, then those that other packages give, in their order."""
    own = tuple(built_in)
    return (*own, *sorted({entry.name for entry in entry_points(group=group)} - set(own)))


def loaded(entry: EntryPoint, refused: Refused) -> Any:
    """What an entry point names; what its package raises is said with its name."""
    try:
        return entry.load()
    except Exception as error:
        raise refused(f"{entry.name} = {entry.value}: {type(error).__name__}: {error}") from error


def loaded_as(entry: EntryPoint, kind: type[Member], refused: Refused) -> Member:
    """:func:`loaded`, which must be of this ``kind``."""
    member = loaded(entry, refused)
    if not isinstance(member, kind):
        raise refused(f"{entry.name} = {entry.value} is no {kind.__module__}.{kind.__name__}")
    return member
