"""What a law is judged by on the linear loop: dip, recovery, IAE, noise, sensitivity, margins, corners.

S = 1 / (1 + L) is the transfer function from a voltage that nobody announced to the voltage at the plant:
    Ms = max |S|,  and from L = 1 / S - 1 gain, phase and delay margin.
A law with an adaptive window is two linear loops: that of the short window, whose margins count, and that of
the long one, whose noise it has. Dip, recovery and IAE are of the window as it runs; Ms is the larger one.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np

from hil.control.law import MotorModel, new_law_state
from hil.control.linalg import Array
from hil.report.metrics import RECOVERED_RAD_S
from hil.tuning.loop import LOAD, PULSE_I, PULSE_U, PULSE_W, Plant, Record, respond_all, rigid, shaft

RESPONSE_S: Final = 0.4
"""Length of the responses; a loop that has not come to rest by then counts as unstable."""
RESTLESS: Final = 0.1
"""Share of the dip that may be left in the last tenth of the response."""
POINTS: Final = 1 << 11
_MODES: Final[tuple[Literal["short", "N"], ...]] = ("short", "N")
_STEP, _NOISE = np.array([LOAD, PULSE_U]), np.array([PULSE_W, PULSE_I])


@dataclass(frozen=True, slots=True)
class Bench:
    """What a law is tuned for: believed motor, T_s [s], load step [N m], noise of w, i_q [rad/s, A], u [V].

    Noises are standard deviations with the resolution in them; at a speed ``w_0`` [rad/s] decoupling adds
    n_p w_0 L_d i_d's noise to u_q; ``spread`` is the share by which J, psi_f, R_s
    and L may each be off; ``shafts`` are resonances (Hz, damping, motor's share of J) to stay stable with;
    ``i_d_noise`` is that of i_d where its frame is coarser than i_q's.
    """

    motor: MotorModel
    T_s: float
    load: float
    w_noise: float
    i_noise: float
    u_noise: float = 0.0
    w_0: float = 0.0
    spread: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("J", "psi_f", "R_s", "L"), 0.3))
    shafts: tuple[tuple[float, float, float], ...] = ()
    i_d_noise: float = 0.0

    @property
    def ticks(self) -> int:
        """Length of a response."""
        return min(max(round(RESPONSE_S / self.T_s), 200), 8000)

    def corners(self) -> list[MotorModel]:
        """The motors at the corners of the spread."""
        signs = [(1 - share, 1 + share) if share else (1.0,) for share in self.spread.values()]
        return [self._off(*factors) for factors in itertools.product(*signs) if set(factors) != {1.0}]

    def _off(self, J: float, psi_f: float, R_s: float, L: float) -> MotorModel:
        m = self.motor
        return replace(m, J=m.J * J, psi_f=m.psi_f * psi_f, R_s=m.R_s * R_s, L_d=m.L_d * L, L_q=m.L_q * L)

    def plants(self) -> list[Plant]:
        """The believed motor, then every corner."""
        return [rigid(motor, self.T_s) for motor in (self.motor, *self.corners())]

    def shaft_plants(self) -> list[Plant]:
        """The believed motor on its elastic shafts."""
        return [shaft(self.motor, self.T_s, *one) for one in self.shafts]


@dataclass(frozen=True, slots=True)
class Loop:
    """Measures of the loop with one plant; an unstable one has infinite ones."""

    dip: float
    recovery_ms: float
    iae: float
    ms: float

    @property
    def stable(self) -> bool:
        """Whether the load step came to rest."""
        return math.isfinite(self.ms)


UNSTABLE: Final = Loop(math.inf, math.inf, math.inf, math.inf)


@functools.cache
def _buffer(shape: tuple[int, ...]) -> Array:
    """Memory that is used again: fresh pages would cost more than the loop."""
    return np.empty(shape)


@functools.cache
def _state() -> Record:
    return new_law_state()


def responses(law: Record, plants: Sequence[Plant], kinds: Array, ticks: int) -> Array:
    """Responses (plants, kinds, 4, ticks), valid until the next call; without the limit of the current."""
    own = law.copy()
    own["cogs"] = 0  # known over the angle: no part of the linear loop
    own["i_max"] = np.inf
    out = _buffer((len(plants), len(kinds), 4, ticks))
    A, b, e = (np.array([getattr(plant, name) for plant in plants]) for name in ("A", "b", "e"))
    with np.errstate(over="ignore", invalid="ignore"):
        respond_all(own[0], _state()[0], A, b, e, kinds, out)
    return out


def adapts(law: Record) -> bool:
    """Whether a window of the law is adaptive."""
    return bool(law["short"].any())


def held(law: Record, name: Literal["short", "N"]) -> Record:
    """The law with its adaptive windows held at that length; any other law as it is."""
    own = law.copy()
    for c in np.flatnonzero(law["short"][0]):
        own["N"][0, c] = own[name][0, c]
        own["first"][0, c] = own["short"][0, c]
        own["g"][0, :, c] = np.inf
    return own


def to_unit_load(law: Record, load: float) -> Record:
    """The law whose adaptive windows take a load of one for what they take ``load`` for."""
    own = law.copy()
    for c in np.flatnonzero(law["short"][0]):
        own["g"][0, :, c] /= load
    return own


def loops(law: Record, bench: Bench, plants: Sequence[Plant]) -> list[Loop]:
    """The measures with every plant."""
    if not adapts(law):
        return _loops(law, bench, plants)
    laws = (to_unit_load(law, bench.load), held(law, "short"), held(law, "N"))
    return [_joined(*three) for three in zip(*(_loops(one, bench, plants) for one in laws), strict=True)]


def _joined(whole: Loop, short: Loop, long: Loop) -> Loop:
    """What an adaptive window does, with the larger Ms of its modes; each must be stable by itself."""
    if not (whole.stable and short.stable and long.stable):
        return UNSTABLE
    return replace(whole, ms=max(short.ms, long.ms))


def _loops(law: Record, bench: Bench, plants: Sequence[Plant]) -> list[Loop]:
    out = responses(law, plants, _STEP, bench.ticks)
    return [_loop(one[0, 2] * bench.load, one[1, 1], bench.T_s) for one in out]


def _loop(w: Array, u: Array, T_s: float) -> Loop:
    """Measures from speed after the load step and voltage after the pulse."""
    error, tail = np.abs(w), len(w) // 10
    if not (np.isfinite(w).all() and np.isfinite(u).all()) or error[-tail:].max() > RESTLESS * error.max():
        return UNSTABLE
    if np.abs(u[-tail:]).max() > 0.01:
        return UNSTABLE
    outside = np.nonzero(error > RECOVERED_RAD_S)[0]
    recovery = (int(outside[-1]) + 1) * T_s * 1e3 if len(outside) else 0.0
    return Loop(float(error.max()), recovery, float(error.sum() * T_s), peak_of(u))


def peak_of(pulse: Array) -> float:
    """Ms, the largest |S|, from the response of what acts to a unit pulse added to it."""
    return float(np.abs(np.fft.rfft(pulse, max(POINTS, len(pulse)))).max())


def noise(law: Record, bench: Bench, plant: Plant) -> tuple[float, float]:
    """Noise of u_q [V] and of the true speed [rad/s], rms, for the noise that the bench has; at rest."""
    law = held(law, "N")
    kinds = np.r_[_NOISE, PULSE_U]
    out = responses(law, [plant], kinds, bench.ticks)[0]
    sigma = np.array([bench.w_noise, bench.i_noise, bench.u_noise])
    energy = (out[:, (0, 2)] ** 2).sum(axis=2)
    u, w = np.sqrt((sigma[:, None] ** 2 * energy).sum(axis=0))
    decoupling = bench.motor.n_p * bench.w_0 * bench.motor.L_d * bench.i_noise if law["coupling"][0] else 0.0
    if F := int(law["N"][0, 2] - law["short"][0, 2]) if law["short"][0, 2] else 0:
        decoupling *= math.sqrt(2.0 * (2 * F + 1) / ((F + 1) * (F + 2)))  # the end of a line through F + 1
    return math.hypot(float(u), decoupling), float(w)


@dataclass(frozen=True, slots=True)
class Margins:
    """Gain margin, phase margin [deg], delay margin [ms]."""

    gain: float
    phase_deg: float
    delay_ms: float


def margins(law: Record, bench: Bench, plant: Plant) -> dict[str, float]:
    """Gain margin, phase margin [deg], delay margin [ms] at the plant's voltage; of the short window."""
    return asdict(
        margins_of(responses(held(law, "short"), [plant], _STEP[1:], bench.ticks)[0, 0, 1], bench.T_s)
    )


def margins_of(pulse: Array, T_s: float) -> Margins:
    """Margins from the response of what acts to a unit pulse added to it: S, and L = 1 / S - 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        L = 1 / np.fft.rfft(pulse, 1 << 16) - 1
    w = np.linspace(0, np.pi / T_s, len(L))[1:-1]
    L = L[1:-1]
    cross = np.nonzero((np.abs(L[:-1]) - 1) * (np.abs(L[1:]) - 1) <= 0)[0]
    real = np.nonzero((L[:-1].imag * L[1:].imag <= 0) & (L[:-1].real < 0) & (np.abs(L[:-1]) < 1))[0]
    gains, phases = 1 / np.abs(L[real]), np.angle(-L[cross])
    delays = phases % (2 * np.pi) / w[cross] * 1e3
    return Margins(
        float(gains.min(initial=math.inf)),
        float(np.degrees(np.abs(phases)).min(initial=math.inf)),
        float(delays.min(initial=math.inf)),
    )


def quiet(law: Record, bench: Bench, plants: Sequence[Plant], seconds: float = 1.2) -> list[bool]:
    """Whether a load step's vibration dies away with each plant: its rms falls from second to last third."""
    if not plants:
        return []
    if adapts(law):
        both = (quiet(held(law, name), bench, plants, seconds) for name in _MODES)
        return [short and long for short, long in zip(*both, strict=True)]
    ticks = round(seconds / bench.T_s)
    w = responses(law, plants, _STEP[:1], ticks)[:, 0, 2] * bench.load
    thirds = [w[:, ticks // 3 * part : ticks // 3 * (part + 1)] for part in (1, 2)]
    with np.errstate(over="ignore", invalid="ignore"):
        first, last = (np.std(third, axis=1) for third in thirds)
    return [bool(b < a or b < 1e-6) for a, b in zip(first, last, strict=True)]


@dataclass(frozen=True, slots=True)
class Verdict:
    """All measures of a law: nominal and over the corners."""

    nominal: Loop
    worst: Loop
    u_noise: float
    w_noise: float

    def as_dict(self) -> dict[str, Any]:
        """JSON form, noise in mV and mrad/s."""
        return {
            "dip": self.nominal.dip,
            "recovery_ms": self.nominal.recovery_ms,
            "iae": self.nominal.iae,
            "u_noise_mv": self.u_noise * 1e3,
            "w_noise_mrad_s": self.w_noise * 1e3,
            "ms": self.nominal.ms,
            "ms_worst": self.worst.ms,
            "worst_dip": self.worst.dip,
            "worst_recovery_ms": self.worst.recovery_ms,
            "worst_iae": self.worst.iae,
        }


def worst_of(every: Sequence[Loop]) -> Loop:
    """The largest of each measure."""
    names = ("dip", "recovery_ms", "iae", "ms")
    return Loop(*(max(getattr(loop, name) for loop in every) for name in names))


def judge(law: Record, bench: Bench, plants: Sequence[Plant] | None = None) -> Verdict:
    """All measures of a law; the first plant is the nominal one."""
    plants = bench.plants() if plants is None else plants
    every = loops(law, bench, plants)
    u, w = noise(law, bench, plants[0])
    return Verdict(every[0], worst_of(every), u, w)
