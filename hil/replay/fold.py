"""The controller folded over logged ticks, and the outputs compared by bits."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.config.design import Machine
from hil.control.jit import jit
from hil.log.check import first_broken
from hil.replay.verdict import Difference
from hil.signals import FIELDS, OUTPUTS, TICK, TickArray, new_ticks
from hil.tick.kernel import step

_KINDS = {field.name: field.kind for field in FIELDS}
_GIVEN: Final = frozenset(field.name for field in FIELDS if field.role in ("time", "input"))
_COMPUTED: Final = frozenset(OUTPUTS)


@jit
def fold(sp: Any, ss: Any, lp: Any, ls: Any, ticks: Any) -> None:
    """Run the controller over ticks whose inputs are set, in place."""
    for j in range(ticks.shape[0]):
        step(sp, ss, lp, ls, ticks[j : j + 1])


def raw(ticks: TickArray) -> npt.NDArray[np.uint8]:
    """The records as rows of bytes, in place: what is done to all fields alike is done to them at once."""
    return np.ascontiguousarray(ticks).view(np.uint8).reshape(len(ticks), ticks.dtype.itemsize)


@cache
def bytes_of(names: frozenset[str]) -> npt.NDArray[np.uint8]:
    """0xFF where a record holds one of the fields, else 0."""
    out = np.zeros(TICK.itemsize, np.uint8)
    for name in names:
        kind, offset = TICK.fields[name][:2]  # type: ignore[index]
        out[offset : offset + kind.itemsize] = 0xFF
    return out


def set_inputs(ticks: TickArray, logged: TickArray) -> None:
    """Copy times and inputs of the logged ticks; every output is left to be computed."""
    given, own = bytes_of(_GIVEN), raw(ticks)
    own &= ~given
    own |= raw(logged) & given


def refold(machine: Machine, logged: TickArray) -> TickArray:
    """The ticks with every output computed anew; ``machine`` keeps its state for the ticks that follow."""
    ticks = new_ticks(len(logged))
    set_inputs(ticks, logged)
    fold(machine.safety, machine.safety_state, machine.law, machine.law_state, ticks)
    return ticks


def replayed(machine: Machine, logged: TickArray) -> TickArray:
    """A whole run computed anew from its first tick on."""
    return refold(machine.fresh(), logged)


def bits(values: npt.NDArray[Any], kind: str) -> npt.NDArray[np.int64]:
    """Bit patterns as integers, ordered so that neighbouring floats differ by 1."""
    raw = np.ascontiguousarray(values)
    if kind != "f8":
        return raw.astype(np.int64)
    pattern = raw.view(np.int64)
    return np.where(pattern < 0, np.int64(-(2**63)) - pattern, pattern)


def compare(logged: TickArray, again: TickArray, absent: frozenset[str] = frozenset()) -> Difference | None:
    """The first tick and field whose bits differ; what the log lacks is not compared."""
    unequal = (raw(logged) ^ raw(again)) & bytes_of(_COMPUTED - absent)
    if not unequal.any():
        return None
    row = int(np.argmax(unequal.any(axis=1)))
    name = next(name for name in OUTPUTS if (unequal[row] & bytes_of(frozenset({name}))).any())
    ours, theirs = logged[name][row : row + 1], again[name][row : row + 1]
    ulp = abs(int(bits(ours, _KINDS[name])[0]) - int(bits(theirs, _KINDS[name])[0]))
    return Difference(int(logged["k"][row]), name, float(ours[0]), float(theirs[0]), ulp)


def ulp_between(logged: float, other: float, kind: str) -> int:
    """Numbers between two values of a field."""
    if kind != "f8":
        return abs(int(logged) - int(other))
    a, b = (int(bits(np.array([value]), kind)[0]) for value in (logged, other))
    return abs(a - b)


def broken(logged: TickArray, absent: frozenset[str]) -> Difference | None:
    """The first tick that is not what was written, by the check that it carries."""
    found = first_broken(logged, absent)
    if found is None:
        return None
    ulp = ulp_between(found.logged, found.written, _KINDS[found.field])
    return Difference(int(logged["k"][found.row]), found.field, found.logged, found.written, ulp)


def earliest(*differences: Difference | None) -> Difference | None:
    """The one of the earliest tick, of one tick the first that is given."""
    return min((one for one in differences if one is not None), key=lambda one: one.tick, default=None)
