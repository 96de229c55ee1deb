"""`hil replay`: re-run the controller over a log and compare every output by bits.

A pure fold: same inputs, same config, same code. Exit codes: 0 same, 1 differs, 2 cannot.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hil.config import RunConfig, validate
from hil.control.jit import jit
from hil.design import Machine, WireFacts, build
from hil.errors import HilError
from hil.kernel import step
from hil.log.reader import Log, Source, new_log, read_blocks
from hil.log.split import STATE
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


def wire_of_log(log: Log) -> WireFacts:
    """The wire facts in a log's metadata. Raises HilError."""
    try:
        wire = json.loads(log.metadata["run"]["wire"])
        lsb = tuple(wire["x_lsb"])
        top = wire.get("T_L_top", math.inf)
        return WireFacts(wire["u_lsb"], wire["T_L_lsb"], wire["counter_modulus"], lsb, wire["u_top"], top)
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"{log.path}: has no usable wire facts in it ({error})") from error


def machine_of(log: Log) -> Machine:
    """The controller that wrote a log, from the config and the wire facts in it. Raises HilError."""
    try:
        config = json.loads(log.attachments["config.json"])
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"{log.path}: has no usable config in it ({error})") from error
    where = f"{log.path}: config.json"
    machine = build(validate(config, RunConfig, where, log.path.parent), wire_of_log(log))
    try:
        return machine.with_parameters(log.attachments["controller.json"])
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"{log.path}: has no usable parameters in it ({error})") from error


def restored(machine: Machine, text: str) -> tuple[Machine, int]:
    """The machine in a kept state, and the last tick before it. Raises HilError."""
    fresh = machine.fresh()
    try:
        kept = json.loads(text)
        if "law_state" not in kept:
            raise HilError("ticks were lost before this part, so its state was not known")
        for own, name in ((fresh.safety_state, "safety_state"), (fresh.law_state, "law_state")):
            own[:] = np.frombuffer(bytes.fromhex(kept[name]), own.dtype)
        return fresh, int(kept["k"])
    except (KeyError, ValueError, TypeError) as error:
        raise HilError(f"the kept state is not usable ({error})") from error


def state_text(machine: Machine, k: int) -> str:
    """A machine's state after tick ``k``, as :func:`restored` reads it."""
    states = {"safety_state": machine.safety_state, "law_state": machine.law_state}
    return json.dumps({"k": k} | {name: state.tobytes().hex() for name, state in states.items()})


def set_inputs(ticks: TickArray, logged: TickArray) -> None:
    """Copy times and inputs of the logged ticks; every output is left to be computed."""
    for field in FIELDS:
        if field.role == "time" or field.name in INPUTS:
            ticks[field.name] = logged[field.name]


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


def compare(logged: TickArray, again: TickArray) -> Difference | None:
    """The first tick and field whose bits differ."""
    if logged.tobytes() == again.tobytes():
        return None
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


@dataclass(frozen=True, slots=True)
class Window:
    """The part of a run that is compared [s from its first tick]; the fold itself begins at the start."""

    start_s: float = 0.0
    end_s: float = math.inf

    def of(self, ticks: TickArray, first_ns: int) -> TickArray:
        """The ticks inside."""
        at = (ticks["t_ns"] - np.uint64(first_ns)) * 1e-9
        inside = (at >= self.start_s) & (at <= self.end_s)
        chosen: TickArray = ticks if inside.all() else ticks[inside]  # choosing copies field by field
        return chosen


@dataclass(slots=True)
class Replay:
    """One pass over a log's ticks, block by block; memory holds one block."""

    log: Log
    window: Window = dataclasses.field(default_factory=Window)
    machine: Machine | None = None
    first_ns: int = 0
    last_k: int = -1
    ticks: int = 0
    compared: int = 0
    why: str = ""
    impossible: str = ""
    difference: Difference | None = None

    def feed(self, ticks: TickArray) -> bool:
        """Take the next ticks; False when there is no more to learn."""
        try:
            return not self.impossible and (len(ticks) == 0 or self._take(ticks))
        except (HilError, ValueError) as error:
            self.impossible = str(error)
            return False

    def _begin(self, ticks: TickArray) -> bool:
        """Design the controller at the first tick; False when the run's beginning is missing."""
        self.first_ns, self.last_k = int(ticks["t_ns"][0]), int(ticks["k"][0]) - int(ticks["gap"][0])
        kept = self.log.attachments.get(STATE)
        if kept is not None:
            self.machine, self.last_k = restored(machine_of(self.log), kept)
        elif int(ticks["k"][0]) != 0:
            self.why = f"the log begins at tick {int(ticks['k'][0])}; its beginning is missing"
            return False
        else:
            self.machine = machine_of(self.log).fresh()
        return True

    def _take(self, ticks: TickArray) -> bool:
        """Fold and compare a block; False when there is no more to learn."""
        if self.machine is None and not self._begin(ticks):
            return False
        assert self.machine is not None  # noqa: S101 - _begin made it
        whole = self._before_gap(ticks)
        if len(whole):
            again = refold(self.machine, whole)
            logged = self.window.of(whole, self.first_ns)
            self.difference = compare(logged, self.window.of(again, self.first_ns))
            self.ticks, self.compared = self.ticks + len(whole), self.compared + len(logged)
            self.last_k = int(whole["k"][-1])
        past = len(whole) > 0 and (int(whole["t_ns"][-1]) - self.first_ns) * 1e-9 > self.window.end_s
        return len(whole) == len(ticks) and self.difference is None and not past

    def _before_gap(self, ticks: TickArray) -> TickArray:
        """The ticks before the first that the loop ran and the log lacks; skipped periods are none."""
        k = ticks["k"].astype(np.int64)
        missing = np.diff(k, prepend=self.last_k) - ticks["gap"]
        at = np.nonzero(missing)[0]
        if not len(at):
            return ticks
        row = int(at[0])
        before = int(k[row - 1]) if row else self.last_k
        self.why = (
            f"same up to tick {before}, then {int(missing[row])} records are missing before tick {k[row]}"
        )
        return ticks[:row]

    def verdict(self) -> Verdict:
        """What the pass found; ``log.damage`` is known by now."""
        if self.impossible:
            return Verdict("cannot", 0, why=self.impossible)
        if self.difference is not None:
            return Verdict("differs", self.compared, self.difference, self.log.damage or "")
        if self.why:
            return Verdict("cannot", self.compared, why=self.why)
        if self.compared == 0:
            empty = "the log has no ticks" if self.ticks == 0 else "the window has no ticks"
            return Verdict("cannot", 0, why=self.log.damage or empty)
        return Verdict("same", self.compared, why=self.log.damage or "")


def _run(replay: Replay, blocks: Iterable[TickArray], seen: Callable[[int], None]) -> Verdict:
    for ticks in blocks:
        more = replay.feed(ticks)
        seen(replay.ticks)
        if not more:
            break
    return replay.verdict()


def replay_log(log: Log) -> Verdict:
    """Replay a log that has been read."""
    return _run(Replay(log), [log.ticks], lambda _: None)


def tick_blocks(log: Log) -> Iterator[TickArray]:
    """The ticks of a log file, block by block."""
    for block in read_blocks(log):
        if block.kind == "ticks":
            yield block.records


def replay(
    source: Source, window: Window | None = None, seen: Callable[[int], None] | None = None
) -> Verdict:
    """Replay a file; what can't be replayed is a verdict, not an exception.

    ``seen`` is told after each block how many ticks are done.
    """
    try:
        log = new_log(source)
        return _run(Replay(log, window or Window()), tick_blocks(log), seen or (lambda _: None))
    except (HilError, ValueError) as error:
        return Verdict("cannot", 0, why=str(error))
