"""The object dictionary of a CANopen node from its EDS or DCF: what is there, and how it may be used.

The `canopen` library parses the file; this module says what is wrong with it in one line.
"""

from __future__ import annotations

import configparser
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import canopen
from canopen.objectdictionary import ODArray, ODVariable, datatypes

from drivers.errors import DatabaseError
from drivers.sdo import named

_PLACE: Final = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?(?:(?::|sub)([0-9A-Fa-f]{1,2})h?)?")
_PDOS: Final = range(0x1400, 0x1C00)


@dataclass(frozen=True, slots=True)
class Place:
    """Where an object is: index and sub-index."""

    index: int
    sub: int = 0

    def __str__(self) -> str:
        return named(self.index, self.sub)


def place_of(text: str) -> Place | None:
    """The place that "6041", "0x6041", "6041h" or "1018h:4" names; None for another text."""
    found = _PLACE.fullmatch(text.strip())
    return Place(int(found[1], 16), int(found[2] or "0", 16)) if found else None


class Dictionary:
    """The objects of an EDS or DCF for one node. Raises DatabaseError, here and wherever one is not there."""

    def __init__(self, path: Path, node_id: int) -> None:
        self.path = path
        if path.suffix.lower() not in (".eds", ".dcf"):
            raise DatabaseError(f"{path}: is no EDS and no DCF by its name; canopen.eds takes .eds or .dcf")
        try:
            with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # of logging's warn
                self._objects: Any = canopen.import_od(str(path), node_id)
        except OSError as error:
            raise DatabaseError(f"{path}: can't be read: {error.strerror or error}") from error
        except (configparser.Error, ValueError, KeyError, TypeError, UnicodeError) as error:
            first = (str(error).splitlines() or ["empty"])[0]
            raise DatabaseError(f"{path}: is no usable EDS or DCF: {first}") from error
        if not len(self._objects):
            raise DatabaseError(f"{path}: is no usable EDS or DCF: there is no object in it")
        self._check_node(node_id)

    def _check_node(self, node_id: int) -> None:
        """A DCF is of one node."""
        own = re.search(
            r"(?mi)^\s*NodeID\s*=\s*(\w+)", self.path.read_text(encoding="utf-8", errors="replace")
        )
        number = int(own[1], 0) if own and own[1].isalnum() and own[1][0].isdigit() else None
        if self.path.suffix.lower() == ".dcf" and number not in (None, 0, node_id):
            raise DatabaseError(f"{self.path}: is the DCF of node {number}; drive.node_id is {node_id}")

    def find(self, place: Place) -> ODVariable | None:
        """The object, None when it is not there; the library makes up what an array does not list."""
        found = self._objects.indices.get(place.index)
        if found is None or isinstance(found, ODVariable):
            return None if place.sub else found
        listed = found.subindices
        compact = isinstance(found, ODArray) and set(listed) == {0, 1} and place.sub
        return found[place.sub] if place.sub in listed or compact else None

    def has(self, index: int, sub: int = 0) -> bool:
        """Is the object there?"""
        return self.find(Place(index, sub)) is not None

    def object(self, place: Place, what: str) -> ODVariable:
        """The object. ``what`` it is for is told when it is not there."""
        found = self.find(place)
        if found is None:
            raise DatabaseError(f"{self.path}: has no object {place} ({what}); is it the drive's own EDS?")
        return found

    def number(self, place: Place, what: str) -> ODVariable:
        """The object, which must be a whole number of whole bytes."""
        found = self.object(place, what)
        if found.data_type not in datatypes.INTEGER_TYPES or len(found) % 8:
            raise DatabaseError(f"{self.path}: {place} ({what}) is no whole number; correct the EDS")
        return found

    def mapped(self, place: Place, what: str, *, sent: bool) -> ODVariable:
        """A number that a PDO can carry: to the drive when ``sent``, else from it."""
        found = self.number(place, what)
        if not found.pdo_mappable:
            raise DatabaseError(f"{self.path}: {place} ({what}) can't be mapped to a PDO (PDOMapping=0)")
        if not (found.writable if sent else found.readable):
            way = "written" if sent else "read"
            raise DatabaseError(
                f"{self.path}: {place} ({what}) can't be {way} (AccessType={found.access_type})"
            )
        return found

    def configured(self) -> Iterator[tuple[Place, int, int]]:
        """(place, value, bytes) of each number that a DCF sets, but for PDOs: those come from the mode.

        Nothing of an EDS: where one has such values they are of the node that its maker took them from.
        """
        if self.path.suffix.lower() != ".dcf":
            return
        for index in self._objects:
            found = self._objects[index]
            for one in [found] if isinstance(found, ODVariable) else found.values():
                if one.value is not None and one.writable and index not in _PDOS and _is_number(one):
                    yield Place(index, one.subindex), int(one.value), len(one) // 8

    def name(self, place: Place) -> str:
        """The object's name by the file."""
        found = self.find(place)
        return str(found.name) if found is not None else ""


def _is_number(one: ODVariable) -> bool:
    return one.data_type in datatypes.INTEGER_TYPES and one.subindex >= 0 and len(one) % 8 == 0


def is_signed(one: ODVariable) -> bool:
    """Is it a number that can be below zero?"""
    return one.data_type in datatypes.SIGNED_TYPES
