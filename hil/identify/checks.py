"""What a run shows that no estimate should be made of: a blocked shaft, an open phase, a wrong sign."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hil.identify.estimate import UNITS, Parameter
from hil.identify.plan import Step
from hil.report.metrics import operating
from hil.signals import TickArray

SETTLED: Final = 5
"""Ticks in which a drive's current comes to what is asked for."""
LOCKS_RAD: Final = math.radians(2.0)
"""Turn by which a shaft has moved that stands afterwards: noise of the speed adds up to a tenth of it."""
QUIET: Final = 20
"""Ticks at the start of a step without much current."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Faults a person must look at, and findings that are only said."""

    faults: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


def seen_in(step: Step, ticks: TickArray) -> Seen:
    """Judge a step's run."""
    own = operating(ticks)
    if len(own) < 10:
        return Seen(("the drive was not enabled long enough to see anything",))
    limited = float(np.mean(own["limited"] != 0))
    text = f"the drive was at its limit, of supply or current, in {100 * limited:.0f} % of the ticks"
    more = (f"{text}: left out",) if limited else ()
    pulses = _pulses if step.controller.get("passes") else _currents
    judged = {"sensors": _rest, "standstill": pulses, "spinning": _turns, "inertia": _turns, "shaft": _turns}[
        step.name
    ](step, own)
    return Seen(judged.faults, (*judged.findings, *more))


def _noise(own: TickArray) -> float:
    """Usual change of the speed from tick to tick."""
    return float(np.quantile(np.abs(np.diff(own["w"][:100])), 0.8)) + 1e-9


def _rest(step: Step, own: TickArray) -> Seen:
    speed = float(np.mean(own["w"]))
    if abs(speed) > 10.0 * _noise(own):
        return Seen(findings=(f"the shaft turns at {speed:.3g} rad/s without torque: a load drives it",))
    return Seen()


def _pulses(step: Step, own: TickArray) -> Seen:
    """Current must flow along the axis that is driven, and along that one alone."""
    reach = {axis: float(np.abs(own[axis]).max()) for axis in ("i_q", "i_d")}
    for axis, goal in (("i_q", step.controller["i_q_goal_a"]), ("i_d", step.controller["i_d_goal_a"])):
        if reach[axis] < 0.1 * goal:
            u = float(np.abs(own["u" + axis[1:]]).max())
            text = f"{axis} came to {reach[axis]:.3g} A only, with {u:.3g} V"
            return Seen((f"{text}: an open phase, no motor, or no supply",))
    alone = (np.abs(own["ua_d"]) > 0) & (np.abs(own["ua_q"]) == 0) & (np.abs(own["w"]) < 0.05 * _fast(own))
    late = alone & np.roll(alone, 5) & np.roll(alone, 10)
    across, along = (float(np.sqrt(np.mean(own[axis][late] ** 2))) if late.any() else 0.0 for axis in reach)
    if across > 0.25 * along > 0.0:
        return Seen(
            (
                f"a voltage along d drives {100 * across / along:.0f} % of its current along q: "
                "an open phase, or the rotor angle is off",
            )
        )
    return Seen()


def _currents(step: Step, own: TickArray) -> Seen:
    """The current that is asked for must flow, where the drive reports it."""
    asked, told = float(np.abs(own["i_q_ref"]).max()), np.isfinite(own["i_q"])
    reached = float(np.abs(own["i_q"][told]).max()) if told.any() else asked
    if reached < 0.5 * asked:
        text = f"of {asked:.3g} A that were asked for {reached:.3g} A came"
        return Seen((f"{text}: an open phase, no motor, no supply, or a drive that is limited",))
    return Seen()


def _fast(own: TickArray) -> float:
    return float(max(np.abs(own["w"]).max(), 20.0 * _noise(own)))


def _turns(step: Step, own: TickArray) -> Seen:
    """The shaft must turn, and first the way of the torque, by no other current than is asked for."""
    peak, current = float(np.abs(own["w"]).max()), float(np.abs(_flowed(own)).max())
    first_way = float(np.sign(step.controller["q"][0]))
    wrong = step.controller["w_wrong_rad_s"]
    begun = np.flatnonzero(np.abs(own["w"]) > wrong)
    if len(begun) and first_way * float(own["w"][begun[0]]) < 0.0:
        text = "the shaft turns against the torque: phase order or encoder direction is wrong"
        return Seen((f"{text}, or a load drives it",))
    if astray := _astray(own):
        return Seen((astray,))
    pushed = np.abs(own["i_q_ref"]) > 0.9 * float(np.abs(own["i_q_ref"]).max())
    stands = len(begun) == 0 and abs(float(np.nanmean(own["w"][pushed]))) < 0.1 * wrong
    angle = _turned(own)
    if stands and abs(angle) > LOCKS_RAD:
        text = f"the shaft turns by {math.degrees(angle):.0f} degrees, then stands with {current:.3g} A"
        return Seen((f"{text}: phase order or encoder direction is wrong, or something holds it",))
    if len(begun) == 0 or peak < 0.1 * abs(step.controller["w_rad_s"][0]):
        text = f"the shaft does not turn with {current:.3g} A: it is blocked, or its load needs more than"
        return Seen((f"{text} limits.i_max_a allows",))
    return Seen()


def _turned(own: TickArray) -> float:
    """By how much the shaft turned [rad], from where it stood at first."""
    seconds = np.diff(own["t_ns"], append=own["t_ns"][-1:]) * 1e-9
    return float(np.nansum((own["w"] - np.nanmean(own["w"][:QUIET])) * seconds))


def _astray(own: TickArray) -> str:
    """Where current flows that nobody asked for while what is asked for stands: i_d, or i_q off what was."""
    asked, told = own["i_q_ref"], np.isfinite(own["i_d"])
    stands = np.abs(asked - np.roll(asked, SETTLED)) < 0.02 * float(np.abs(asked).max())
    stands[:SETTLED] = False
    rows = stands & (own["limited"] == 0) & np.isfinite(_flowed(own))
    off = np.where(told, own["i_d"], _flowed(own) - asked)
    if int(rows.sum()) < 50:
        return ""
    size, along = (float(np.sqrt(np.mean(column[rows] ** 2))) for column in (off, _flowed(own)))
    if size < max(0.25 * along, 6.0 * float(np.std(off[:QUIET]))):
        return ""
    name = "i_d" if told[rows].all() else "i_q"
    return (
        f"{name} is {size:.3g} A off what is asked for, with {along:.3g} A of i_q: an open phase, "
        "or the rotor angle is off"
    )


def _flowed(own: TickArray) -> npt.NDArray[np.float64]:
    """i_q, or where the drive does not report it what was asked for."""
    out: npt.NDArray[np.float64] = np.where(np.isfinite(own["i_q"]), own["i_q"], own["i_q_ref"])
    return out


def breakaway(ticks: TickArray, k_t: Parameter) -> Parameter | None:
    """Torque at which a shaft begins to turn as it grows slowly: between rest and motion that is seen."""
    own = operating(ticks)
    moves = np.abs(own["w"]) > 10.0 * _noise(own)
    if not moves.any() or not k_t.told:
        return None
    at = int(np.argmax(moves))
    last = np.flatnonzero(np.abs(own["w"][:at]) <= 2.0 * _noise(own))
    before = int(last[-1]) if len(last) else 0
    smooth = np.convolve(_flowed(own), np.ones(5) / 5.0, "same")
    rest = max(before - 2 * (at - before) - 10, 0)  # it had moved before that showed
    low, high = sorted(abs(k_t.value * float(smooth[k])) for k in (rest, at))
    return Parameter(0.5 * (low + high), low, high, UNITS["coulomb"])
