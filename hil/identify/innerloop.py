"""Estimates of a drive that takes a current or a torque: k_t / J, friction, the lag of its loop, the delay.

Of J, B_f and the friction's torque currents tell the ratio to k_t alone; they are given for the k_t of the
configuration, which is all that the law ``speed`` needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from hil.config.design import motor_model, speed_filter
from hil.config.motor import MotorTable
from hil.config.tables import RunConfig
from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.control.registry import SpeedFilter
from hil.control.speed import MOST_DELAY
from hil.identify import estimate as of_voltages
from hil.identify.data import SHORTEST, Samples, joined, turning
from hil.identify.estimate import (
    BROKEN,
    EXACT,
    TOLD,
    UNITS,
    Estimate,
    Parameter,
    excited,
    falling,
    thinned,
)
from hil.identify.facts import note_facts
from hil.identify.inner import TAU, B, C, Drive, G, InnerFit, L, at_delay, best_delay, fit, residual_of
from hil.identify.model import Flags
from hil.identify.shaft import calm, rough, times
from hil.signals import DriveState, RxFlag, TickArray

EXCITES: Final = {
    "k_t_over_J": "run-up under torque (step inertia)",
    "J": "run-up under torque (step inertia)",
    "B_f": "run-down over a range of speeds (step inertia)",
    "coulomb": "run-down over a range of speeds (step inertia)",
    "load": "runs in both directions (step inertia)",
    "lag": "steps of the current (step standstill or inertia)",
    "delay": "steps of the current (step standstill or inertia)",
}
START_LAG_S: Final = 3e-4
TREMBLES: Final = 200
"""Samples of motion below which friction is not told: in a tremble it falls with speed."""


def estimate_for(
    config: RunConfig, motor: MotorTable, runs: Sequence[TickArray], pulses: Sequence[TickArray] = ()
) -> Estimate:
    """What the runs tell of the motor of a configuration, by what its drive takes.

    ``pulses``: those of the step ``shaft`` (:func:`hil.identify.estimate.estimate`).
    """
    T_s = 1.0 / config.loop.rate_hz
    if config.drive.takes == "voltage":
        out = of_voltages.estimate(runs, T_s, motor_model(motor), pulses)
    else:
        out = estimate(runs, config, motor)
    note_facts(out, runs or pulses)
    return out


def estimate(runs: Sequence[TickArray], config: RunConfig, motor: MotorTable) -> Estimate:
    """What the runs tell of shaft and drive; ``motor`` starts the search and gives k_t."""
    out, guess = Estimate(), motor_model(motor)
    drive = drive_of(config, runs)
    u_i = config.drive_k_t if config.drive.takes == "torque" else 1.0
    parts = [samples_of(ticks, 1.0 / config.loop.rate_hz, u_i, drive.told) for ticks in runs]
    parts = [part for part in parts if len(part) >= SHORTEST]
    if not parts:
        out.faults.append("no samples with the gates on and an unbroken past: nothing to estimate from")
        return out
    everything = joined(parts)
    samples = thinned(excited(everything.with_free(turning(everything))))
    if not drive.told:
        samples = samples.segments(samples.free[samples.begins]) if len(samples) else samples
    if len(samples) < 50 or not samples.u.any():
        _at_rest(out, everything, drive)
        return out
    found, delay = _fitted(out, samples, drive, guess, config)
    _note(out, found, guess.k_t)
    _note_lag(out, found, drive, samples, delay)
    _note_noise(out, found, samples, drive)
    _compare(out, config)
    return out


def drive_of(config: RunConfig, runs: Sequence[TickArray]) -> Drive:
    """The filter of its speed, and whether it reports i_q."""
    given = speed_filter(config.drive.speed_filter, config.loop.rate_hz)
    told = any(bool(np.isfinite(ticks["i_q"]).any()) for ticks in runs)
    return Drive(given or SpeedFilter(), told)


def samples_of(ticks: TickArray, T_s: float, u_i: float, told: bool) -> Samples:
    """The samples of a run: y = (w, i_q or what was asked for, 0), u [A] by delay, one column each."""
    fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
    on = ticks["drive_state"] == int(DriveState.OPERATION_ENABLED)
    good: Flags = fresh & on & np.isfinite(ticks["w"]) & (np.isfinite(ticks["i_q"]) | (not told))
    known: Flags = good & (ticks["gap"] == 1)
    known[1:] &= good[:-1] & (ticks["limited"][:-1] == 0)
    known[: MOST_DELAY + 2] = False
    u = np.stack([np.roll(ticks["u_q"], delay + 1) / u_i for delay in range(MOST_DELAY + 1)], axis=1)
    i = ticks["i_q"] if told else u[:, 1]
    none = np.zeros(len(ticks))
    t = (ticks["t_ns"] - ticks["t_ns"][:1]) * 1e-9
    y = np.stack([ticks["w"], i, none], axis=1)
    return Samples(T_s, t, y, u, ~known, none > 0, none).where(good)


def _fitted(
    out: Estimate, samples: Samples, drive: Drive, guess: MotorModel, config: RunConfig
) -> tuple[InnerFit, Array]:
    """The fit at the best delay, without what was disturbed; what is left by delay."""
    kept, shaft = _calm(samples, guess)
    lag = max(config.drive.current_lag_ms * 1e-3, START_LAG_S)
    first = np.array([guess.k_t / guess.J, lag, *(np.array([guess.B_f, *shaft]) / guess.J)])
    sigma = np.array([_noise(samples.y[samples.free, 0]), _noise(samples.y[:, 1])])
    delay, left = best_delay(samples.segments(kept), drive, first, sigma)
    whole, turns = at_delay(samples, delay), samples.free[samples.begins]
    for _ in range(4):
        found = fit(whole.segments(kept), drive, first, sigma)
        again = _as_others(whole, drive, found, kept)
        if (again == kept).all() or (turns & again).sum() < 3:
            break
        kept, first, sigma = again, found.value, found.sigma
    for begin, end in times(whole, ~kept):
        out.findings.append(f"left out: another load between {begin:.2f} and {end:.2f} s")
    out.samples, out.fit = whole.segments(kept), found
    out.white = dict(zip(("w", "i_q"), (float(p) for p in found.white), strict=True))
    return found, left


def _calm(samples: Samples, guess: MotorModel) -> tuple[Flags, tuple[float, float]]:
    """Segments to begin with, by the balance of torque; Coulomb friction and load of most."""
    turns = samples.free[samples.begins]
    free = samples.segments(turns)
    if len(free) < 50:
        return np.ones(len(turns), bool), (0.0, 0.0)
    start, kept = rough(free, guess), ~turns
    kept[turns] = calm(free, guess)
    return kept, (start.coulomb, start.load)


def _as_others(samples: Samples, drive: Drive, found: InnerFit, kept: Flags) -> Flags:
    """Segments whose speed the fit explains as well as that of those it is made of."""
    residual = residual_of(samples, drive, found)[:, 0]
    spread = np.sqrt(np.bincount(samples.segment, residual**2) / np.bincount(samples.segment))
    turns = samples.free[samples.begins]
    usual = float(np.median(spread[turns & kept])) if (turns & kept).any() else 0.0
    out: Flags = ~turns | (spread <= BROKEN * usual)
    return out


def _noise(column: Array) -> float:
    """Noise by the second difference's median, at least a hair of the signal."""
    if len(column) < 3:
        return 1.0
    jump = float(np.median(np.abs(np.diff(column, 2)))) / (0.6745 * math.sqrt(6.0))
    return max(jump, 1e-4 * float(np.abs(column).max()) + 1e-9)


def _note(out: Estimate, found: InnerFit, k_t: float) -> None:
    """k_t / J, and with the k_t of the configuration J, B_f, friction and load."""
    assert out.samples is not None  # noqa: S101 - called after the fit
    g, value = float(found.value[G]), found.value
    turns = bool(out.samples.free.any())
    share = math.hypot(float(found.half[G]) / g, EXACT)
    why = "" if turns and share <= TOLD else _why("J")
    out.put("k_t_over_J", g, share * g, why)
    J = k_t / g
    out.put("J", J, share * J, why)
    fastest, slides = float(np.abs(out.samples.y[:, 0]).max()), int(out.samples.free.sum()) >= TREMBLES
    friction = J * (abs(float(value[C])) + abs(float(value[B])) * fastest)
    for name, place, scale in (("B_f", B, fastest), ("coulomb", C, 1.0), ("load", L, 1.0)):
        torque = J * float(value[place])
        half = math.hypot(J * float(found.half[place]), share * torque)
        both = name != "load" or len(set(np.sign(out.samples.y[out.samples.free, 0]))) > 1
        told = slides and both and half * scale <= max(TOLD * abs(torque) * scale, 0.1 * friction)
        out.put(name, torque, half, falling(name, torque, half, fastest) if told else _why(name))
    load = out.parameters["load"]
    if load.told and abs(load.value) > load.half + 0.05 * abs(out.parameters["coulomb"].value):
        out.findings.append(f"a load of {load.value:.3g} N m acts on the shaft all the time")
    if turns:
        out.findings.append(
            f"J, B_f and friction are for k_t = {k_t:.4g} N m/A, which currents alone can't tell"
        )


def _why(name: str) -> str:
    return f"not told by this excitation: it takes {EXCITES[name]}"


def _note_lag(out: Estimate, found: InnerFit, drive: Drive, samples: Samples, left: Array) -> None:
    """Lag of the drive's loop and delay, where the commands changed enough to tell them."""
    best = int(np.argmin(left))
    told = len(left) > 1 and np.sort(left)[1] > 1.1 * left[best]
    out.put("delay", float(best), 0.0, "" if told else _why("delay"))
    tau, half = float(found.value[TAU]), float(found.half[TAU])
    half = min(half, 1.0)
    fine = half <= max(TOLD * tau, 0.1 * samples.T_s)
    out.put("lag", tau, half, "" if told and fine else _why("lag"))


def _note_noise(out: Estimate, found: InnerFit, samples: Samples, drive: Drive) -> None:
    """Deviations of the noise, resolution included: what the model leaves."""
    counts = {"w_noise": int(samples.free.sum()), "i_q_noise": len(samples) if drive.told else 0}
    for (name, count), value in zip(counts.items(), found.sigma, strict=True):
        if count:
            out.put(name, float(value), 1.96 * float(value) / math.sqrt(2 * count))


def _at_rest(out: Estimate, samples: Samples, drive: Drive) -> None:
    """Of a drive that is asked for nothing the noise alone can be told, and whether something turns it."""
    trend = [np.polyval(np.polyfit(samples.t, column, 2), samples.t) for column in samples.y.T]
    spread = np.std(samples.y - np.array(trend).T, axis=0)
    names = ("w_noise", "i_q_noise") if drive.told else ("w_noise",)
    for name, value in zip(names, spread, strict=False):
        out.put(name, float(value), 1.96 * float(value) / math.sqrt(2 * len(samples)))
    for name, how in EXCITES.items():
        out.parameters[name] = Parameter(math.nan, math.nan, math.nan, UNITS[name], False, f"it takes {how}")
    fastest = float(trend[0][np.argmax(np.abs(trend[0]))])
    if abs(fastest) > 6.0 * spread[0]:
        out.findings.append(f"the shaft turns at {fastest:.3g} rad/s without current: a load drives it")


def _compare(out: Estimate, config: RunConfig) -> None:
    """What the configuration says of the drive's loop, where it is something else."""
    lag, delay, given = out.parameters["lag"], out.parameters["delay"], config.drive
    own = given.current_lag_ms * 1e-3
    if lag.told and not lag.low - 0.05 * lag.value <= own <= lag.high + 0.05 * lag.value:
        out.findings.append(
            f"drive.current_lag_ms is {given.current_lag_ms:g}, the drive's loop has {1e3 * lag.value:.3g} ms"
        )
    if delay.told and round(delay.value) != 1 + given.delay_ticks:
        out.findings.append(
            f"drive.delay_ticks is {given.delay_ticks}, the commands act {round(delay.value) - 1} later"
        )
