"""From the ticks of runs to a motor's parameters: what they tell, how well, and what is odd about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from hil.control.law import MotorModel
from hil.control.linalg import Array
from hil.identify.coupling import SURE, seen
from hil.identify.data import SHORTEST, Samples, joined, samples_of, turning
from hil.identify.fit import Fit, Shaft, bending, first_sigma, fit, frozen
from hil.identify.inner import InnerFit, evenly
from hil.identify.model import B_F, COULOMB, L_D, L_Q, LOAD, PSI_F, R_S, SATURATION, Flags, J, unsaturated
from hil.identify.shaft import calm, rough, times
from hil.signals import TickArray

MOST_DELAY: Final = 4
MOST_SEGMENTS: Final = 150
"""Of a long log so many segments are taken, evenly spread."""
TOLD: Final = 0.25
"""Half-width, as a share of the value, from which on a parameter counts as not told."""
EXACT: Final = 5e-4
"""Share of R_s, L, psi_f, J to which a model can be believed: the modulator rounds what it is sent."""
PLAIN: Final = 0.25
"""Share of the noise's variance by which other pole pairs must fit better: below it noise alone decides."""
ASTRAY: Final = (0.1, 10.0)
"""What a fit may leave of the speed: share of its motion within segments, and so many times its noise."""
SHAFT: Final = ("resonance", "resonance_damping", "inertia_ratio")
"""Parameters of a soft coupling, in the order of the fit's masses."""
ALIASES: Final = 0.25
"""Share of the rate above which a resonance is held against the one that the samples can't tell from it."""
J_UNKNOWN: Final = 0.5
"""Share by which J may be off where no shaft turns freely."""
BROKEN: Final = 4.0
"""A segment is left out when its speed is so many times further off than the usual one's."""

UNITS: Final = {
    "R_s": "ohm", "L_d": "H", "L_q": "H", "psi_f": "Wb", "k_t": "N m/A", "J": "kg m2", "B_f": "N m s",
    "coulomb": "N m", "load": "N m", "delay": "ticks", "lag": "s", "k_t_over_J": "rad/s2/A",
    "w_noise": "rad/s", "i_q_noise": "A", "i_d_noise": "A", "L_q_saturation": "A",
    "w_lsb": "rad/s", "i_q_lsb": "A", "i_d_lsb": "A", "arrival": "s", "arrival_jitter": "s",
    "echo_lag": "ticks", "resonance": "Hz", "resonance_damping": "1", "inertia_ratio": "J_l/J_m",
}  # fmt: skip
PLACES: Final = {
    "R_s": R_S, "L_d": L_D, "L_q": L_Q, "psi_f": PSI_F, "J": J, "B_f": B_F, "coulomb": COULOMB, "load": LOAD,
}  # fmt: skip
LEVELS: Final = (0.0, 0.5, 1.0)
"""Shares of the largest q current at which a saturating L_q is told."""
EXCITES: Final = {
    "R_s": "a current that stands for a few L/R",
    "L_d": "steps of u_d (step standstill)",
    "L_q": "steps of u_q (step standstill)",
    "psi_f": "a shaft that turns (step spinning)",
    "J": "run-up under torque (step inertia)",
    "B_f": "run-down over a range of speeds (step inertia)",
    "coulomb": "run-down over a range of speeds (step inertia)",
    "load": "runs in both directions (step inertia)",
    "resonance": "a shaft that turns under torque that reverses (step shaft)",
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value with its 95 % interval; ``told`` False: the data do not tell it, and ``why``."""

    value: float
    low: float
    high: float
    unit: str
    told: bool = True
    why: str = ""

    @property
    def half(self) -> float:
        """Half the interval."""
        return 0.5 * (self.high - self.low)

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        out: dict[str, Any] = {"value": self.value, "low": self.low, "high": self.high, "unit": self.unit}
        return out | {"told": self.told} | ({"why": self.why} if self.why else {})


def known_k_t(value: float) -> Parameter:
    """A torque constant that is believed."""
    return Parameter(value, value, value, UNITS["k_t"])


@dataclass(slots=True)
class Estimate:
    """Parameters by name; ``findings``: what is odd; ``faults``: what a person must look at first.

    ``white``: p-values of the residuals' whiteness by output. ``saturation``: L_q = psi_q / i_q at some
    currents, where it saturates. ``samples`` and ``fit`` are for a report.
    """

    parameters: dict[str, Parameter] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    white: dict[str, float] = field(default_factory=dict)
    saturation: list[dict[str, Any]] = field(default_factory=list)
    samples: Samples | None = None
    fit: Fit | InnerFit | None = None

    @property
    def tells(self) -> bool:
        """True when the data tell any parameter."""
        return any(p.told for p in self.parameters.values())

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "parameters": {name: p.as_dict() for name, p in self.parameters.items()},
            "findings": self.findings,
            "faults": self.faults,
            "white": self.white,
            "saturation": self.saturation,
        }

    def put(self, name: str, value: float, half: float, why: str = "") -> None:
        """Note a parameter with its half-width."""
        self.parameters[name] = Parameter(value, value - half, value + half, UNITS[name], not why, why)


def estimate(
    runs: Sequence[TickArray], T_s: float, guess: MotorModel, pulses: Sequence[TickArray] = ()
) -> Estimate:
    """What the runs tell of the motor; ``guess`` starts the search and gives n_p.

    ``pulses`` are runs that ring a soft coupling: without one they tell nothing else.
    """
    out = Estimate()
    runs, pulses = (runs, pulses) if runs else (pulses, ())
    everything = _everything(runs, T_s)
    if len(everything) == 0:
        out.faults.append("no samples with the gates on and an unbroken past: nothing to estimate from")
        return out
    samples = turning_in(everything)
    if len(samples) < 50:
        _at_rest(out, everything)
        return out
    whole = turning_in(_everything([*runs, *pulses], T_s)) if pulses else samples
    found = _on_a_coupling(out, whole, guess)
    if found is None:
        samples, shaft = _without_disturbed(out, samples, guess)
        found = _fitted(out, samples, guess, shaft)
    _note_parameters(out, found, guess)
    note_masses(out, found)
    note_saturation(out, found)
    _note_noise(out, everything)
    _note_delay(out, runs, T_s, guess)
    _note_pole_pairs(out, guess)
    return out


def _everything(runs: Sequence[TickArray], T_s: float) -> Samples:
    """All samples of the runs."""
    parts = [part for part in (samples_of(ticks, T_s) for ticks in runs) if len(part) >= SHORTEST]
    if not parts:
        return Samples(T_s, *(np.zeros(shape) for shape in (0, (0, 3), (0, 2), 0, 0, 0)))  # type: ignore[arg-type]
    return joined(parts)


def turning_in(samples: Samples) -> Samples:
    """The excited ones, with where the shaft turns."""
    return thinned(excited(samples.with_free(turning(samples))))


def _on_a_coupling(out: Estimate, samples: Samples, guess: MotorModel) -> Fit | None:
    """The fit of two inertias where a resonance shows and the data tell it; None for a rigid shaft."""
    shows = seen(samples, guess)
    if not shows.masses:
        note_rigid(out, f"it takes {EXCITES['resonance']}" if shows.up_to == 0.0 else _stiff(shows.up_to))
        return None
    trial, start = Estimate(), rough(samples.segments(samples.free[samples.begins]), guess)
    first = fit(samples, guess, start)  # what the coupling does not change is found by this faster one
    found = _fitted(trial, samples, _as_motor(first, guess), replace(start, masses=shows.masses))
    hz = shows.masses[0] / (2.0 * math.pi)
    why = ""
    if not found.masses or found.half[-1] > TOLD * found.value[-1]:
        why = f"the speed rings at about {hz:.3g} Hz, but the data do not tell what is behind the coupling"
    elif found.masses[0] * samples.T_s > 2.0 * math.pi * ALIASES and _aliased(samples, guess, found):
        rate = 1.0 / samples.T_s
        why = (
            f"the speed rings at {hz:.3g} Hz or at {rate - hz:.4g} Hz: samples at {rate:g} Hz alias, they "
            "can't tell which; it takes a higher loop.rate_hz"
        )
    if why:
        out.findings.append(why)
        note_rigid(out, why)
        return None
    out.samples, out.fit, out.white = trial.samples, found, trial.white
    out.findings += trial.findings
    return found


def _stiff(up_to: float) -> str:
    return f"no resonance is seen: up to {up_to:.0f} Hz a load as heavy as the motor would have shown"


def note_rigid(out: Estimate, why: str) -> None:
    """No soft coupling is told, and why."""
    for name in SHAFT:
        out.parameters[name] = Parameter(math.nan, math.nan, math.nan, UNITS[name], False, why)


def _aliased(samples: Samples, guess: MotorModel, found: Fit) -> bool:
    """Whether the samples fit as well with the resonance on the other side of half their rate."""
    w_r, damping, ratio = found.masses
    other = replace(found.shaft, masses=(2.0 * math.pi / samples.T_s - w_r, damping, ratio))
    again = fit(samples, _as_motor(found, guess), other)
    gain = 2.0 * float(samples.free.sum()) * math.log(float(again.sigma[0] / found.sigma[0]))
    return gain < SURE**2


def note_masses(out: Estimate, found: Fit) -> None:
    """Of a soft coupling the resonance [Hz], its damping ratio and J_l / J_m."""
    for name, value, half in zip(SHAFT, found.masses, found.half[-len(SHAFT) :], strict=False):
        unit = 2.0 * math.pi if name == "resonance" else 1.0
        out.put(name, value / unit, float(half) / unit)
    if found.masses:
        hz, _, ratio = found.masses
        out.findings.append(
            f"a soft coupling resonates at {hz / (2.0 * math.pi):.4g} Hz, with {ratio:.3g} times the motor's "
            "inertia behind it; J is that of both"
        )


def excited(samples: Samples) -> Samples:
    """Without the segments in which nothing happens: shaft at rest, currents within their noise."""
    if len(samples) == 0:
        return samples
    noise = np.array([step_of(column) for column in samples.y[:, 1:].T])
    seg, size = samples.segment, np.zeros((int(samples.segment[-1]) + 1, 2))
    np.maximum.at(size, seg, np.abs(samples.y[:, 1:]) / noise)
    moves = np.bincount(seg, samples.free) > 0
    return samples.segments(moves | (size > 12.0).any(axis=1))


def step_of(column: Array) -> float:
    """Usual change from sample to sample, at least one step of the resolution."""
    steps = np.abs(np.diff(column))
    return float(max(np.median(steps), steps[steps > 0].min(initial=math.inf))) if steps.any() else 1e-12


def thinned(samples: Samples) -> Samples:
    """Of very many segments some, evenly spread, turning ones and others."""
    if len(samples) == 0:
        return samples
    return evenly(samples, MOST_SEGMENTS)


def _without_disturbed(out: Estimate, samples: Samples, guess: MotorModel) -> tuple[Samples, Shaft]:
    """The samples without the segments in which another load acted; friction and load of the rest."""
    free = samples.segments(samples.free[samples.begins])
    if len(free) < 50:
        return samples, Shaft()
    start = rough(free, guess)
    good = calm(free, guess)
    kept = samples.free[samples.begins].copy()
    kept[kept] = good
    for begin, end in times(free, ~good):
        out.findings.append(f"left out: another load between {begin:.2f} and {end:.2f} s")
    return samples.segments(kept | ~samples.free[samples.begins]), start


def _fitted(out: Estimate, samples: Samples, guess: MotorModel, shaft: Shaft) -> Fit:
    """The fit, again without what it shows to be disturbed."""
    found = bent(samples, guess, fit(samples, guess, shaft))
    if astray(samples, found):
        out.findings.append(
            "the speed does not follow the torque as one inertia would: a soft coupling, or a load that "
            "changes; it tells nothing of J and friction"
        )
        samples = replace(samples, free=np.zeros(len(samples), bool))
        found = bent(samples, guess, fit(samples, guess, Shaft()))
    for _ in range(3):
        size = np.bincount(samples.segment)
        spread = np.sqrt(np.bincount(samples.segment, found.residual[:, 0] ** 2) / size)
        free = samples.free[samples.begins]
        usual = float(np.median(spread[free])) if free.any() else 0.0
        bad: Flags = free & (spread > BROKEN * usual)
        if not bad.any() or (free & ~bad).sum() < 3:
            break
        for begin, end in times(samples, bad):
            out.findings.append(f"left out: the load changed between {begin:.2f} and {end:.2f} s")
        samples = samples.segments(~bad)
        found = fit(samples, _as_motor(found, guess), found.shaft)
        found = found if found.saturation else bent(samples, guess, found)
    out.samples, out.fit = samples, found
    out.white = dict(zip(("w", "i_q", "i_d"), (float(p) for p in found.white), strict=True))
    return found


def astray(samples: Samples, found: Fit) -> bool:
    """True when the fit explains little of how a free shaft moves, far beyond the noise of its speed."""
    free = samples.free
    if not free.any():
        return False
    w, seg = samples.y[free, 0], samples.segment[free]
    size = np.maximum(np.bincount(seg), 1)
    motion = float(np.std(w - (np.bincount(seg, w) / size)[seg]))
    share, times_noise = ASTRAY
    return bool(found.sigma[0] > max(share * motion, times_noise * float(first_sigma(samples)[0])))


def bent(samples: Samples, guess: MotorModel, found: Fit) -> Fit:
    """The fit, again with a saturating L_q where its residuals ask for that and the data then tell it."""
    motor, shaft = _as_motor(found, guess), found.shaft
    saturation = bending(samples, motor, shaft, found.sigma)
    if saturation == 0.0:
        return found
    again = fit(samples, motor, replace(shaft, saturation=saturation))
    return again if again.half[SATURATION] < again.value[SATURATION] else found


def _as_motor(found: Fit, guess: MotorModel) -> MotorModel:
    """The fit as a motor."""
    v = [float(x) for x in found.value]
    return MotorModel(v[R_S], v[L_D], v[L_Q], v[PSI_F] or guess.psi_f, guess.n_p, v[J], v[B_F])


def _note_parameters(out: Estimate, found: Fit, guess: MotorModel) -> None:
    fastest = float(np.abs(out.samples.y[:, 0]).max()) if out.samples else 0.0
    turns = out.samples is not None and bool(out.samples.free.any())
    friction = abs(float(found.value[COULOMB])) + abs(float(found.value[B_F])) * fastest
    for name, place in PLACES.items():
        value, half = float(found.value[place]), float(found.half[place])
        half = math.hypot(half, EXACT * value, _by_inertia(out, found, guess) if place == L_Q else 0.0)
        least = TOLD * abs(value)
        if place in (B_F, COULOMB, LOAD):  # 0 is a value like any other
            least = max(least, 0.1 * friction) / (fastest if place == B_F else 1.0)
        told = bool(found.told[place] > 0.5) and half <= least
        told &= turns or place != PSI_F  # a shaft that trembles tells it in ratio to J and L_q
        why = falling(name, value, half, fastest) if told else _why(name)
        out.put(name, value, half, why)
    psi, k = out.parameters["psi_f"], 1.5 * guess.n_p
    out.put("k_t", k * psi.value, k * psi.half, psi.why)
    if psi.told and psi.value < 0:
        out.faults.append(
            "the back-EMF has the wrong sign: the encoder counts the wrong way, or two phases are swapped"
        )
    L_d, L_q = out.parameters["L_d"], out.parameters["L_q"]
    if L_d.told and L_q.told and L_d.low <= L_q.high and L_q.low <= L_d.high and out.samples:
        peak = float(np.abs(out.samples.y[:, 1:]).max())
        out.findings.append(f"L_d and L_q can't be told apart with currents up to {peak:.3g} A")
    load = out.parameters["load"]
    if load.told and abs(load.value) > load.half + 0.05 * abs(out.parameters["coulomb"].value):
        out.findings.append(f"a load of {load.value:.3g} N m acts on the shaft all the time")


def _by_inertia(out: Estimate, found: Fit, guess: MotorModel) -> float:
    """What of L_q [H] rests on a J that nothing tells: n_p psi_f k_t T^2 / (12 J), as the shaft trembles."""
    if out.samples is None or out.samples.free.any():
        return 0.0
    psi_f, T = float(found.value[PSI_F]), out.samples.T_s
    return J_UNKNOWN * 1.5 * (guess.n_p * psi_f * T) ** 2 / (12.0 * guess.J)


def note_saturation(out: Estimate, found: Fit) -> None:
    """Where L_q saturates: the current at which it has halved, and psi_q / i_q up to the largest current."""
    s = found.saturation
    if s == 0.0 or out.samples is None:
        return
    peak = float(np.abs(out.samples.y[:, 1]).max())
    half = 2.0 / math.sqrt(s)
    out.put("L_q_saturation", half, 0.5 * half * float(found.half[SATURATION]) / s)
    for share in LEVELS:
        value, error = chord(found, share * peak)
        row = Parameter(value, value - error, value + error, UNITS["L_q"])
        out.saturation.append({"i_q_a": share * peak, **row.as_dict()})
    words = ", ".join(f"{row['value']:.4g} H at {row['i_q_a']:.3g} A" for row in out.saturation)
    out.findings.append(f"L_q saturates: {words}; told with currents up to {peak:.3g} A")


def chord(found: Fit, current: float) -> tuple[float, float]:
    """psi_q / i_q at a current [A] by a fit with saturation, and its half-width, both [H]."""

    def logarithm(s: float) -> float:
        return math.log1p(s * unsaturated(current, s) ** 2)

    s = found.saturation
    slope = (logarithm(s * 1.001) - logarithm(s * 0.999)) / math.log(1.001 / 0.999)
    g = np.zeros(len(found.value))
    g[L_Q], g[SATURATION] = 1.0, -slope
    value = float(found.value[L_Q]) * math.exp(-logarithm(s))
    return value, value * math.hypot(math.sqrt(float(g @ found.cov @ g)), EXACT)


def _why(name: str) -> str:
    return f"not told by this excitation: it takes {EXCITES[name]}"


def falling(name: str, value: float, half: float, fastest: float) -> str:
    """Why B_f is not told where friction falls with speed, as by Stribeck near rest; empty otherwise."""
    if name != "B_f" or value + half >= 0.0:
        return ""
    return f"friction falls with speed up to {fastest:.3g} rad/s: it takes a faster run-down"


def _note_noise(out: Estimate, samples: Samples) -> None:
    """Deviations of the noise, resolution included: what the model leaves, the speed's else at rest."""
    assert out.fit is not None  # noqa: S101 - called after it
    sigma = out.fit.sigma.copy()
    if not np.isfinite(sigma[0]):
        sigma[0] = float(np.std(samples.y[:, 0] - np.median(samples.y[:, 0])))
    for name, value in zip(("w_noise", "i_q_noise", "i_d_noise"), sigma, strict=True):
        out.put(name, float(value), 1.96 * float(value) / math.sqrt(2 * len(samples)))


def _at_rest(out: Estimate, samples: Samples) -> None:
    """Of a drive in which nothing happens the noise alone can be told, and whether something turns it."""
    spread, mean = np.std(samples.y, axis=0), np.mean(samples.y, axis=0)
    for name, value in zip(("w_noise", "i_q_noise", "i_d_noise"), spread, strict=True):
        out.put(name, float(value), 1.96 * float(value) / math.sqrt(2 * len(samples)))
    for name, how in EXCITES.items():
        out.parameters[name] = Parameter(math.nan, math.nan, math.nan, UNITS[name], False, f"it takes {how}")
    note_rigid(out, f"it takes {EXCITES['resonance']}")
    if abs(mean[0]) > 6.0 * spread[0]:
        out.findings.append(f"the shaft turns at {mean[0]:.3g} rad/s without current: a load drives it")


def _note_delay(out: Estimate, runs: Sequence[TickArray], T_s: float, guess: MotorModel) -> None:
    """Ticks from sending a voltage to its effect: the shift under which the currents fit best."""
    assert isinstance(out.fit, Fit)  # noqa: S101 - called after it
    cost = _by_delay(runs, T_s, out.fit, guess)
    best, echoed = (
        int(np.argmin(cost)),
        int(np.argmin([_echo_off(runs, d) for d in range(2 * MOST_DELAY + 1)])),
    )
    if echoed != best:  # the fit rests on what was echoed: again, on what was sent
        _refitted(out, runs, T_s, guess, best)
        cost = _by_delay(runs, T_s, out.fit, guess)
        best = int(np.argmin(cost))
    motor = _as_motor(out.fit, guess)
    others = min(value for d, value in enumerate(cost) if d != best)
    why = "" if others > 1.1 * cost[best] else "the voltage hardly changes: the delay can't be told"
    out.put("delay", float(best), 0.0, why)
    own = _shifted(runs, T_s, out.fit, motor, None)
    out.put("echo_lag", float(echoed - best), 0.0, why)
    if not why and cost[best] < 0.7 * own:
        out.findings.append(
            f"the echo of the commands lags: with a delay of {best} ticks the currents fit "
            f"{own / cost[best]:.1f} times better"
        )


def _by_delay(runs: Sequence[TickArray], T_s: float, found: Fit, guess: MotorModel) -> list[float]:
    """What is left of the currents by how many ticks before the voltage was sent."""
    motor = _as_motor(found, guess)
    return [_shifted(runs, T_s, found, motor, d) for d in range(MOST_DELAY + 1)]


def _refitted(out: Estimate, runs: Sequence[TickArray], T_s: float, guess: MotorModel, delay: int) -> None:
    """The estimate from the voltages as sent so many ticks before, instead of the echoed ones."""
    assert isinstance(out.fit, Fit)  # noqa: S101 - called after it
    parts = [part for part in (samples_of(run, T_s, delay) for run in runs) if len(part) >= SHORTEST]
    everything = joined(parts)
    out.samples = thinned(excited(everything.with_free(turning(everything))))
    out.fit = fit(out.samples, _as_motor(out.fit, guess), out.fit.shaft)
    out.findings = [line for line in out.findings if "can't be told apart" not in line]
    _note_parameters(out, out.fit, guess)


def _echo_off(runs: Sequence[TickArray], delay: int) -> float:
    """How far what the echo says was applied is off what was sent so many ticks before [V], on average."""
    off = [
        np.abs(run[f"ua_{n}"] - np.roll(run[f"u_{n}"], delay + 1))[delay + 1 :] for run in runs for n in "qd"
    ]
    return float(np.nanmean(np.concatenate(off)))


def _shifted(
    runs: Sequence[TickArray], T_s: float, found: Fit, motor: MotorModel, delay: int | None
) -> float:
    """RMS of the currents' residual with the voltages of so many ticks before, the speed as measured."""
    parts = [part for part in (samples_of(run, T_s, delay) for run in runs) if len(part) >= SHORTEST]
    if not parts:
        return math.inf
    samples = excited(joined(parts).tidy())
    if len(samples) == 0:
        return math.inf
    residual = frozen(thinned(samples), motor, found.sigma, found.saturation)
    return float(np.sqrt(np.mean(residual[:, 1:] ** 2)))


def _note_pole_pairs(out: Estimate, guess: MotorModel) -> None:
    """n_p by the cross-coupling of the currents in a turning motor; psi_f n_p alone can't tell it."""
    assert out.samples is not None and isinstance(out.fit, Fit)  # noqa: S101 - called after them
    samples, found = out.samples, out.fit
    current = float(np.abs(samples.y[samples.free, 1]).max()) if samples.free.any() else 0.0
    if not out.parameters["psi_f"].told or current < 30 * float(found.sigma[1:].max()):
        return
    fast = samples.segments(samples.free[samples.begins])
    own = _as_motor(found, guess)
    costs = {}
    for n in range(1, 2 * guess.n_p + 5):
        motor = replace(own, n_p=n, psi_f=own.psi_f * guess.n_p / n)
        costs[n] = float(np.mean(frozen(fast, motor, found.sigma, found.saturation)[:, 2] ** 2))
    best = min(costs, key=lambda n: costs[n])
    if costs[best] < 0.9 * costs[guess.n_p] and costs[guess.n_p] - costs[best] > PLAIN:
        out.faults.append(f"the cross-coupling of the currents is that of {best} pole pairs, not {guess.n_p}")


def residuals(out: Estimate) -> Array:
    """Residuals (N, 3) of the fit."""
    assert out.fit is not None  # noqa: S101 - asked for after a fit
    return out.fit.residual
