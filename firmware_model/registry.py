"""The registry of loads: what a load says of itself, and how its file is found.

A load is a module of ``firmware_model.loads`` with a ``MEMBER``; a package of somebody else's names one in
the entry point group ``hil.loads``. Its table is what the plant's configuration accepts; each number of it is
a field of the load's record under the same name, so that no position says what a number means.
"""

from __future__ import annotations

import functools
import importlib
import sys
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.errors import DriverError
from drivers.kernelcache import rests_on
from drivers.plugins import loaded
from firmware_model.tables import Table

GROUP: Final = "hil.loads"
Kernel = Callable[..., float]
NUMBERS: Final = frozenset({float, int, bool, type(None)})


class PlantError(DriverError, ValueError):
    """A load that can't be registered: says which, from where, and what it lacks."""


@dataclass(frozen=True, slots=True)
class Load:
    """A load torque on the shaft [N m], positive against positive speed; time t is plant time [s].

    ``load`` is its record: every number of its table, infinite where one is left out, and ``derived``.
    Of ``torque``, ``level`` and ``turned`` it has one.
    """

    table: type[Table]
    torque: Kernel | None = None
    """``torque(load, t, w)`` at speed w [rad/s]; without ``coefficient`` constant between its edges."""
    coefficient: Kernel | None = None
    """``coefficient(load, T, w, t, k)``: Taylor coefficient k of a torque that varies, about t; ``w`` has the
    coefficients of the speed up to k, ``T`` its own up to k - 1."""
    turned: Kernel | None = None
    """``turned(load, theta)``: torque by the shaft's angle theta [rad]; it goes with ``angular``."""
    angular: Kernel | None = None
    """``angular(load, T, Q, theta, k)``: its Taylor coefficient k; ``theta`` has the angle's coefficients up
    to k, ``T`` its own up to k - 1, ``Q`` is a row of its own beside ``T``."""
    level: Kernel | None = None
    """``level(load, t)``: dry friction, which holds the shaft and never drives it."""
    edge: Kernel | None = None
    """``edge(load, t_ns)``: the next time [ns] at which torque or level jumps, infinite for none."""
    derived: Mapping[str, Callable[[Any], float]] = field(default_factory=dict)
    """What is computed once from the table, by name."""

    @property
    def kind(self) -> str:
        """What the table's ``kind`` says."""
        return str(typing.get_args(self.table.model_fields["kind"].annotation)[0])

    @property
    def numbers(self) -> tuple[str, ...]:
        """Fields of the record: the table's numbers and what is derived."""
        return (*(name for name in self.table.model_fields if name != "kind"), *self.derived)

    def values(self, table: Any) -> dict[str, float]:
        """The record's fields for one table of it."""
        given = {name: getattr(table, name) for name in self.table.model_fields if name != "kind"}
        given |= {name: of(table) for name, of in self.derived.items()}
        return {name: np.inf if value is None else float(value) for name, value in given.items()}


@functools.cache
def loads() -> dict[str, Load]:
    """All loads by kind, those of the folder and those of other packages. Raises PlantError."""
    folder = Path(__file__).with_name("loads")
    names = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    modules = [f"firmware_model.loads.{name}" for name in names]
    found = [(name, importlib.import_module(name).MEMBER) for name in modules]
    for entry in entry_points(group=GROUP):
        found.append((entry.value, loaded(entry, lambda why: PlantError(f"{GROUP}: {why}"))))
        modules.append(entry.module)
    rests_on(__file__, [Path(str(sys.modules[module].__file__)) for module in modules])
    return _checked(found)


def _checked(found: Iterable[tuple[str, Any]]) -> dict[str, Load]:
    """Members by kind in the order of their kinds, which says nothing but where their code lies."""
    out: dict[str, Load] = {}
    for where, member in found:
        if mistake := _mistake(member, out):
            raise PlantError(f"{GROUP}: {where}: {mistake}")
        out[member.kind] = member
    return dict(sorted(out.items()))


def _mistake(member: Any, known: Mapping[str, Load]) -> str:
    """What is wrong with a member; empty for nothing."""
    if not isinstance(member, Load) or not issubclass(member.table, Table):
        return "MEMBER must be a firmware_model.registry.Load with a firmware_model.tables.Table"
    fields = member.table.model_fields
    if "kind" not in fields or typing.get_origin(fields["kind"].annotation) is not typing.Literal:
        return f'{member.table.__name__} must have kind: Literal["its name"]'
    if member.kind in known:
        return f"kind {member.kind!r} is taken"
    strange = [name for name, one in fields.items() if name != "kind" and not _is_number(one.annotation)]
    if strange:
        return f"{', '.join(strange)}: keys of a load are numbers"
    one = sum(kernel is not None for kernel in (member.torque, member.level, member.turned)) == 1
    if not one or (member.coefficient and not member.torque) or bool(member.angular) != bool(member.turned):
        return (
            "it has a torque, with a coefficient if it varies, or turned and angular, or a level of friction"
        )
    return ""


def _is_number(annotation: Any) -> bool:
    """True for a number, of a range or not, that may be left out."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _is_number(annotation.__origin__)
    parts = typing.get_args(annotation)
    return all(map(_is_number, parts)) if parts else annotation in NUMBERS
