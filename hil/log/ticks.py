"""Tick records of any version's log as today's: by field number and type, as the file's own schema says.

Fields that are not known here are skipped. What a log lacks is absent: an input takes the value that its
field declares, anything else NaN or 0, and :attr:`TickForm.absent` names it so that nobody compares it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hil.log.check import NAME, share
from hil.log.container import MESSAGE_HEAD
from hil.log.errors import DamagedError, LogError
from hil.log.layouts import TICK_FIELDS_1
from hil.log.schema import TYPES, Records
from hil.signals import FIELDS, TICK, Field, TickArray, new_ticks, tag

Shape = tuple[tuple[int, str, int], ...]
"""(number, name, protobuf type) of each field of a schema."""
_KINDS: Final[dict[int, Any]] = {
    int(number): kind for kind, number in TYPES.items() if kind not in ("bytes", "string")
}
_BY_NUMBER: Final = {field.number: field for field in FIELDS}
_NEEDED: Final = {
    field.name
    for field in FIELDS
    if field.number in TICK_FIELDS_1 and (field.role == "input" or field.name in ("k", "t_ns"))
}
_WIDTHS: Final = {1: 8, 5: 4}
OWN: Final[Shape] = tuple((field.number, field.name, int(TYPES[field.kind])) for field in FIELDS)


class TickForm(NamedTuple):
    """How the ticks of one file are laid out. Make one with :func:`form_of`."""

    shape: Shape
    layout: np.dtype[np.void]
    """One record as this program writes them: every field's tag and value, in the order of the schema."""
    message: np.dtype[np.void]
    """The same as a message of a chunk."""
    absent: frozenset[str]
    """Fields of today that the schema lacks."""
    unknown: tuple[str, ...]
    """Fields of the schema that today does not know."""


def form_of(fields: Sequence[tuple[int, str, int]]) -> TickForm:
    """The form of a file's ticks. Raises LogError for a schema that no version of hil wrote."""
    shape = tuple(fields)
    for number, name, kind in shape:
        if kind not in _KINDS:
            raise LogError(f"field {number} ({name}) of a tick is of a type that has no fixed width")
        own = _BY_NUMBER.get(number)
        if own is not None and (own.name, int(TYPES[own.kind])) != (name, kind):
            raise LogError(f"field {number} of a tick is {name} of type {kind}, not {own.name} ({own.kind})")
    there = {name for number, name, _ in shape if number in _BY_NUMBER}
    if len({number for number, *_ in shape}) < len(shape) or len({name for _, name, _ in shape}) < len(shape):
        raise LogError("two fields of a tick have one number or name")
    if lacking := sorted(_NEEDED - there):
        raise LogError(f"its ticks lack {', '.join(lacking)}, which every version of hil writes")
    layout = _layout(shape)
    return TickForm(
        shape,
        layout,
        np.dtype([*MESSAGE_HEAD, ("data", f"V{layout.itemsize}")]),
        frozenset(field.name for field in FIELDS if field.name not in there),
        tuple(name for number, name, _ in shape if number not in _BY_NUMBER),
    )


def _layout(shape: Shape) -> np.dtype[np.void]:
    """The packed record of a schema; today's own is TICK itself."""
    if shape == OWN:
        return TICK
    parts: list[tuple[str, str]] = []
    for number, name, kind in shape:
        code = _KINDS[kind]
        known = name if number in _BY_NUMBER else f"?{number}"
        parts += [(f"_{number}", f"S{len(tag(number, code))}"), (known, f"<{code}")]
    return np.dtype(parts)


class Ticks:
    """Turns the tick messages of one form into today's records."""

    def __init__(self, form: TickForm) -> None:
        self.form = form

    @cached_property
    def _tags(self) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        """A record with nothing but its tags, and 0xFF where these are."""
        tags, where = np.zeros((2, self.form.layout.itemsize), np.uint8)
        fields: Any = self.form.layout.fields
        for number, _, kind in self.form.shape:
            own = np.frombuffer(tag(number, _KINDS[kind]), np.uint8)
            at = slice(fields[f"_{number}"][1], fields[f"_{number}"][1] + len(own))
            tags[at], where[at] = own, 0xFF
        return tags, where

    def fits(self, records: Records) -> bool:
        """True when every tag of the records is where the layout has it."""
        raw = records.view(np.uint8).reshape(len(records), self.form.layout.itemsize)
        tags, where = self._tags
        return not ((raw ^ tags) & where).any()

    def today(self, records: Records) -> TickArray:
        """Records of the form's layout as today's ticks."""
        if self.form.shape == OWN:
            return records
        out = self._empty(len(records))
        for number, name, _ in sorted(self.form.shape, key=lambda row: row[0] not in _BY_NUMBER):
            if number in _BY_NUMBER:
                out[name] = records[name]
            elif NAME not in self.form.absent:  # what is passed by is in no sum over what is kept
                out[NAME] -= share(records[f"?{number}"], number)
        return out

    def _empty(self, count: int) -> TickArray:
        out = new_ticks(count)
        for name in self.form.absent:
            out[name] = nothing(next(field for field in FIELDS if field.name == name))
        return out

    def spelled(self, messages: Sequence[bytes]) -> TickArray:
        """Any protobuf messages of the schema, field by field: another program may have encoded them anew.

        A field that a message leaves out is 0, as proto3 has it. Raises DamagedError.
        """
        out = self._empty(len(messages))
        for number, name, _ in self.form.shape:
            if number in _BY_NUMBER:
                out[name] = 0
        foreign = np.zeros(len(messages), np.uint64)
        for row, raw in enumerate(messages):
            for number, value in _fields(raw).items():
                field = _BY_NUMBER.get(number)
                if field is None and NAME not in self.form.absent:
                    foreign[row] += share(np.frombuffer(value, f"<u{len(value)}"), number)[0]
                if field is not None and field.name not in self.form.absent:
                    if len(value) != np.dtype(field.kind).itemsize:
                        raise DamagedError("tick records whose tags do not fit")
                    out[field.name][row] = np.frombuffer(value, f"<{field.kind}")[0]
        if NAME not in self.form.absent:
            out[NAME] -= foreign
        return out


def logged_as(ticks: TickArray, form: TickForm) -> Records:
    """Today's ticks as records of a form of fewer fields: the inverse of :meth:`Ticks.today`."""
    if form.shape == OWN:
        return np.ascontiguousarray(ticks)
    out = np.empty(len(ticks), form.layout)
    for number, name, kind in form.shape:
        out[f"_{number}"], out[name] = tag(number, _KINDS[kind]), ticks[name]
    return out


def nothing(field: Field) -> float:
    """What stands for a field that a log lacks."""
    if field.absent is not None:
        return field.absent
    return float("nan") if field.kind == "f8" else 0


def _fields(raw: bytes) -> dict[int, bytes]:
    """Number and bytes of each fixed-width field of a protobuf message; others are passed by."""
    out, at = {}, 0
    while at < len(raw):
        key, at = _varint(raw, at)
        if key < 8:
            raise DamagedError("tick records whose tags do not fit")
        if key & 7 in _WIDTHS:
            width = _WIDTHS[key & 7]
            out[key >> 3] = raw[at : at + width]
        elif key & 7 == 0:
            width = _varint(raw, at)[1] - at
        elif key & 7 == 2:
            size, start = _varint(raw, at)
            width = start - at + size
        else:
            raise DamagedError("tick records whose tags do not fit")
        at += width
    if at != len(raw):
        raise DamagedError("a tick record breaks off")
    return out


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(raw) and shift < 64:
        value |= (raw[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not raw[at - 1] & 0x80:
            return value, at
    raise DamagedError("a tick record breaks off")


def without(ticks: TickArray, absent: frozenset[str]) -> Records:
    """Ticks as a plain structured array of the fields that their log has."""
    names = [field.name for field in FIELDS if field.name not in absent]
    out = np.empty(len(ticks), [(name, ticks.dtype[name]) for name in names])
    for name in names:
        out[name] = ticks[name]
    return out
