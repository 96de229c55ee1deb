"""The controller that wrote a log: its parameters and kept state by name, checked before a kernel sees them.

The parameters in the log decide, not what today's code would design from the config in it: that is compared,
and where another version wrote the log a difference is noted.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.config.design import Machine, SlowMessage, WireFacts, build
from hil.config.tables import RunConfig, validate
from hil.control.law import LAW_NEUTRAL, LAW_PARAMS, new_law_state
from hil.control.references import REFERENCE, REFERENCE_NEUTRAL
from hil.errors import HilError
from hil.log.named import Record, fill, read_named, to_named
from hil.log.origin import is_own
from hil.log.reader import Log
from hil.replay.ranges import COUNTERS, check_ranges
from hil.tick.guard import SAFETY_NEUTRAL, SAFETY_PARAMS
from hil.tick.kernel import new_safety_state

_UNUSABLE = (KeyError, ValueError, TypeError, RecursionError)
_PARAMETERS = {
    "safety": (SAFETY_PARAMS, SAFETY_NEUTRAL),
    "law": (LAW_PARAMS, LAW_NEUTRAL),
    "reference": (REFERENCE, REFERENCE_NEUTRAL),
}


@dataclass(frozen=True, slots=True)
class Logged:
    """The controller of a log, and what of it this version had to fill in or would do otherwise."""

    machine: Machine
    notes: tuple[str, ...]


def wire_of_log(log: Log) -> WireFacts:
    """The wire facts in a log's metadata. Raises HilError."""
    try:
        wire = json.loads(log.metadata["run"]["wire"])
        steps = [float(wire[name]) for name in ("u_lsb", "T_L_lsb", "u_top")]
        x_lsb = tuple(float(value) for value in wire["x_lsb"])
        modulus = wire["counter_modulus"]
        if type(modulus) is not int or not 1 <= modulus <= COUNTERS:
            raise ValueError(f"counter_modulus is {modulus!r:.20}, not within 1 to {COUNTERS}")
        if len(x_lsb) != 3 or not all(math.isfinite(value) and value > 0 for value in (*steps, *x_lsb)):
            raise ValueError("a resolution is no positive number")
        load_top = float(wire.get("T_L_top", math.inf))
        if not load_top >= 0:
            raise ValueError(f"T_L_top is {load_top}")
        slow = tuple(_slow(one) for one in wire.get("slow", ()))
        measured = tuple(str(part) for part in wire.get("measured", ()))
        span = float(wire.get("theta_span", 0.0))
        if not 0.0 <= span < math.inf:
            raise ValueError(f"theta_span is {span}")
        return WireFacts(steps[0], steps[1], modulus, x_lsb, steps[2], load_top, slow, measured, span)
    except _UNUSABLE as error:
        raise HilError(f"{log.path}: has no usable wire facts in it ({error})") from error


def _slow(given: Any) -> SlowMessage:
    """A slow message as a log names it. Raises ValueError, TypeError or KeyError."""
    cycles = float(given["cycle_s"]), float(given["cycle_syncs"])
    if not all(0.0 <= cycle <= 1e6 for cycle in cycles):
        raise ValueError(f"a cycle of {given['name']!r:.40} is out of range")
    return SlowMessage(str(given["name"]), tuple(str(part) for part in given["parts"]), *cycles)


def machine_of(log: Log) -> Machine:
    """The controller that wrote a log. Raises HilError."""
    return logged_machine(log).machine


def logged_machine(log: Log) -> Logged:
    """The controller that wrote a log, with what is to be said of it. Raises HilError."""
    design, notes = _design(log)
    lacking: set[str] = set()
    try:
        given = json.loads(log.attachments["controller.json"])
        safety, law = _record("safety", given["safety"], lacking), _record("law", given["law"], lacking)
        if "reference" in given:
            reference = _record("reference", given["reference"], lacking)
        else:  # format 1; what it gave is an input of each tick
            reference = np.zeros(1, REFERENCE) if design is None else design.reference
    except _UNUSABLE as error:
        raise HilError(f"{log.path}: has no usable parameters in it ({error})") from error
    machine = Machine(safety, new_safety_state(), law, new_law_state(), reference)
    notes += _filled_in(lacking)
    if design is not None:
        notes += _otherwise(log, design, machine, lacking)
    return Logged(machine, tuple(notes))


def _filled_in(lacking: set[str]) -> list[str]:
    """What the log lacks, by the value that was taken for it."""
    by_value: dict[float, list[str]] = {}
    for name in sorted(lacking):
        kind, _, parameter = name.partition(".")
        by_value.setdefault(_PARAMETERS[kind][1][parameter], []).append(name)
    return [f"the log lacks {', '.join(names)}, taken as {value:g}" for value, names in by_value.items()]


def _record(kind: str, given: Any, lacking: set[str]) -> Record:
    """A record of parameters from a log; what it lacks takes its neutral value and is named."""
    layout, neutral = _PARAMETERS[kind]
    record = np.zeros(1, layout)
    lacking |= {f"{kind}.{name}" for name in fill(record, read_named(kind, given), neutral)}
    check_ranges(kind, record)
    return record


def _design(log: Log) -> tuple[Machine | None, list[str]]:
    """What this version designs from the log's config; None and a note where it does not take the config.

    Raises HilError where the config is missing, or where this very code wrote it and so must take it.
    """
    try:
        config = json.loads(log.attachments["config.json"])
    except _UNUSABLE as error:
        raise HilError(f"{log.path}: has no usable config in it ({error})") from error
    wire = wire_of_log(log)
    try:
        return build(validate(config, RunConfig, f"{log.path}: config.json", None), wire), []
    except (*_UNUSABLE, HilError) as error:
        if is_own(log.metadata.get("run", {})):
            raise HilError(str(error)) from error
        return None, [f"this version does not take the config in the log ({str(error).splitlines()[0]})"]


def _otherwise(log: Log, design: Machine, machine: Machine, lacking: set[str]) -> list[str]:
    """Parameters that this version would design otherwise, by more than rounding (1e-9 relative).

    Raises HilError where this very code wrote the log: then the parameters are not of its config.
    """
    pairs = (("safety", design.safety, machine.safety), ("law", design.law, machine.law))
    names = [
        name
        for kind, ours, theirs in pairs
        for name in ours.dtype.names or ()
        if f"{kind}.{name}" not in lacking
        and not np.allclose(theirs[name], ours[name], rtol=1e-9, atol=0, equal_nan=True)
    ]
    if not names:
        return []
    if is_own(log.metadata.get("run", {})):
        why = f"the design of {names[0]} is not the one that wrote the log"
        raise HilError(f"{log.path}: has no usable parameters in it ({why})")
    return [f"this version would design {', '.join(names)} otherwise; the log's values stand"]


def restored(machine: Machine, text: str) -> tuple[Machine, int]:
    """The machine in a kept state, and the last tick before it. Raises HilError."""
    fresh = machine.fresh()
    try:
        kept = json.loads(text)
        if "law_state" not in kept:
            raise HilError("ticks were lost before this part, so its state was not known")
        for own, name in ((fresh.safety_state, "safety_state"), (fresh.law_state, "law_state")):
            fill(own, read_named(name, kept[name]))
            check_ranges(name, own)
        return fresh, int(kept["k"])
    except (*_UNUSABLE, OverflowError) as error:
        raise HilError(f"the kept state is not usable ({error})") from error


def state_text(machine: Machine, k: int) -> str:
    """A machine's state after tick ``k``, as :func:`restored` reads it."""
    states = {"safety_state": machine.safety_state, "law_state": machine.law_state}
    return json.dumps({"k": k} | {name: to_named(state) for name, state in states.items()})
