"""`hil replay`: re-run the controller over a log and compare every output by bits.

A pure fold: same inputs, same config, same code. Exit codes: 0 same, 1 differs, 2 cannot.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hil.config import RunConfig, validate
from hil.control.jit import jit
from hil.design import Machine, WireFacts, build
from hil.errors import HilError
from hil.kernel import step
from hil.log.reader import Log, open_log
from hil.signals import FIELDS, INPUTS, OUTPUTS, TickArray, new_ticks

_KINDS = {field.name: field.kind for field in FIELDS}


@dataclass(frozen=True, slots=True)
class Difference:
    """The first output that is not the same to the bit."""

    tick: int
    field: str
    logged: float
    replayed: float
    ulp: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a replay found; ``why`` says what kept it from comparing, or what the log lacks."""

    verdict: Literal["same", "differs", "cannot"]
    ticks: int
    first_difference: Difference | None = None
    why: str = ""

    @property
    def exit_code(self) -> int:
        """0 same, 1 differs, 2 cannot."""
        return {"same": 0, "differs": 1, "cannot": 2}[self.verdict]

    def as_dict(self) -> dict[str, Any]:
        """JSON form; values that are not finite as text, since JSON has none."""
        first = self.first_difference
        out: dict[str, Any] = {
            "verdict": self.verdict,
            "ticks": self.ticks,
            "first_difference": None,
            "why": self.why,
        }
        if first is not None:
            out["first_difference"] = {
                "tick": first.tick,
                "field": first.field,
                "logged": _json_number(first.logged),
                "replayed": _json_number(first.replayed),
                "ulp": first.ulp,
            }
        return out


def _json_number(value: float) -> float | str:
    return value if np.isfinite(value) else repr(value)


@jit
def fold(sp: Any, ss: Any, lp: Any, ls: Any, ticks: Any) -> None:
    """Run the controller over ticks whose inputs are set, in place."""
    for j in range(ticks.shape[0]):
        step(sp, ss, lp, ls, ticks[j : j + 1])


def machine_of(log: Log) -> Machine:
    """The controller that wrote a log, from the config and the wire facts in it. Raises HilError."""
    try:
        config = json.loads(log.attachments["config.json"])
        wire = json.loads(log.metadata["run"]["wire"])
        facts = WireFacts(
            wire["u_lsb"], wire["T_L_lsb"], wire["counter_modulus"], tuple(wire["x_lsb"]), wire["u_top"]
        )
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"{log.path}: has no usable config in it ({error})") from error
    machine = build(validate(config, RunConfig, f"{log.path}: config.json", log.path.parent), facts)
    try:
        return machine.with_parameters(log.attachments["controller.json"])
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"{log.path}: has no usable parameters in it ({error})") from error


def replayed(machine: Machine, logged: TickArray) -> TickArray:
    """The logged ticks with every output computed anew from the inputs."""
    ticks = new_ticks(len(logged))
    for field in FIELDS:
        if field.role == "time" or field.name in INPUTS:
            ticks[field.name] = logged[field.name]
    own = machine.fresh()
    fold(own.safety, own.safety_state, own.law, own.law_state, ticks)
    return ticks


def bits(values: npt.NDArray[Any], kind: str) -> npt.NDArray[np.int64]:
    """Bit patterns as integers, ordered so that neighbouring floats differ by 1."""
    raw = np.ascontiguousarray(values)
    if kind != "f8":
        return raw.astype(np.int64)
    pattern = raw.view(np.int64)
    return np.where(pattern < 0, np.int64(-(2**63)) - pattern, pattern)


def compare(logged: TickArray, again: TickArray) -> Difference | None:
    """The first tick and field whose bits differ."""
    first: tuple[int, str] | None = None
    for name in OUTPUTS:
        a, b = np.ascontiguousarray(logged[name]), np.ascontiguousarray(again[name])
        unequal = np.nonzero(a.view(f"u{a.itemsize}") != b.view(f"u{b.itemsize}"))[0]
        if len(unequal) and (first is None or unequal[0] < first[0]):
            first = (int(unequal[0]), name)
    if first is None:
        return None
    row, name = first
    ours, theirs = logged[name][row : row + 1], again[name][row : row + 1]
    ulp = abs(int(bits(ours, _KINDS[name])[0]) - int(bits(theirs, _KINDS[name])[0]))
    return Difference(int(logged["k"][row]), name, float(ours[0]), float(theirs[0]), ulp)


def replay_log(log: Log) -> Verdict:
    """Replay a log that has been read."""
    if len(log.ticks) == 0:
        return Verdict("cannot", 0, why=log.damage or "the log has no ticks")
    gaps, ticks = log.gaps, log.ticks
    if int(ticks["k"][0]) != 0:
        return Verdict(
            "cannot", 0, why=f"the log begins at tick {int(ticks['k'][0])}; its beginning is missing"
        )
    if gaps:
        k, missing = gaps[0]
        ticks = ticks[: int(np.searchsorted(ticks["k"], k))]
    difference = compare(ticks, replayed(machine_of(log), ticks))
    if difference is not None:
        return Verdict("differs", len(ticks), difference, log.damage or "")
    if gaps:
        why = f"same up to tick {int(ticks['k'][-1])}, then {missing} records are missing before tick {k}"
        return Verdict("cannot", len(ticks), why=why)
    return Verdict("same", len(ticks), why=log.damage or "")


def replay(path: Path) -> Verdict:
    """Replay a file; what can't be replayed is a verdict, not an exception."""
    try:
        return replay_log(open_log(path, frames=False))
    except (HilError, ValueError) as error:
        return Verdict("cannot", 0, why=str(error))
