"""What a law is judged by on the linear loop: dip, recovery, IAE, noise, sensitivity, margins, corners.

S = 1 / (1 + L) is the transfer function from a voltage that nobody announced to the voltage at the plant
(:mod:`hil.tuning.sensitivity`); of a drive with its own current loop from a step of the reported speed that
nobody filtered to what the observer gets (:mod:`hil.tuning.current`), as `hil check` has it. Its dip is that
of the reported speed, which logs have and `hil report` judges.
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

from hil.control.law import SPEED, MotorModel, new_law_state
from hil.control.linalg import Array
from hil.control.registry import InnerLoop, SpeedFilter
from hil.report.metrics import RECOVERED_RAD_S
from hil.tuning.current import Regulator, respond_each, shaft_of
from hil.tuning.loop import (
    LOAD,
    PULSE_I,
    PULSE_TH,
    PULSE_U,
    PULSE_W,
    Plant,
    Record,
    one_mass,
    respond_all,
    respond_loaded,
    respond_turning,
    rigid,
    shaft,
    turning,
    two_masses,
    vibrate_all,
)
from hil.tuning.rounding import through_rounding
from hil.tuning.sensitivity import margins_of, peak_of

RESPONSE_S: Final = 0.4
"""Length of the responses; a loop that has not come to rest by then counts as unstable."""
RESTLESS: Final = 0.1
"""Share of the dip that may be left in the last tenth of the response."""
SPARE: Final = 0.5
"""Share of an elastic shaft's damping with which a design has to be stable: what it may take is the rest."""
RINGING_S: Final = 4.0
"""Length of the responses on an elastic shaft, whose vibration outlasts the others."""
UNQUIET: Final = (math.inf, math.inf)
"""Of a loop that does not come to rest."""
Elastic = tuple[float, float, float]
"""An elastic shaft: resonance [Hz], damping ratio, the motor's share of J."""
Place = tuple[MotorModel, Elastic | None]
"""A motor, on an elastic shaft or rigid."""
_MODES: Final[tuple[Literal["short", "N"], ...]] = ("short", "N")
_STEP, _OWN_STEP = np.array([LOAD, PULSE_U]), np.array([LOAD, PULSE_W])
_NOISE: Final = np.array([PULSE_W, PULSE_I, PULSE_U])
_ANGLE_NOISE: Final = np.array([PULSE_W, PULSE_I, PULSE_U, PULSE_TH])


@dataclass(frozen=True, slots=True)
class Bench:
    """What a law is tuned for: believed motor, T_s [s], load step [N m], noise of w, i_q [rad/s, A], u [V].

    Noises are standard deviations with the resolution in them; at the speed ``w_0`` [rad/s], where the
    axes are coupled; ``spread`` is the share by which J, psi_f, R_s
    and L may each be off; ``shafts`` are resonances (Hz, damping, motor's share of J) to stay stable with;
    ``elastic``: the first of them is known to be there, so dip and recovery are those on it;
    ``brake``: the load step acts on the motor, not behind the shaft;
    ``i_d_noise`` is that of i_d with the resolution ``i_d_lsb`` [A] of its frame, which may be coarser than
    i_q's. Of a drive with a current loop of its own (``inner``) u is in its ``unit``, A or N m, and
    ``filter`` is what its speed really comes through, and ``regulator`` its loop, where more is known of it
    than the lag that the law believes in. ``known``: the shaft that the observer of a drive by
    voltage has in its model.
    """

    motor: MotorModel
    T_s: float
    load: float
    w_noise: float
    i_noise: float
    u_noise: float = 0.0
    w_0: float = 0.0
    spread: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("J", "psi_f", "R_s", "L"), 0.3))
    shafts: tuple[Elastic, ...] = ()
    elastic: bool = False
    brake: bool = False
    i_d_noise: float = 0.0
    i_d_lsb: float = 0.0
    inner: InnerLoop | None = None
    filter: SpeedFilter | None = None
    unit: str = "V"
    known: Elastic | None = None
    regulator: Regulator | None = None
    theta_noise: float | None = None
    """Deviation of the angle's steps [rad], of the law position; None: of a law that follows no angle."""

    @property
    def every(self) -> int:
        """Ticks from one measurement to the next."""
        return 1 if self.inner is None else self.inner.every

    @property
    def ticks(self) -> int:
        """Length of a response; a loop that measures seldom takes longer to come to rest."""
        longer = 5 if self.known else min(self.every, 5)  # a shaft rings
        return min(max(round(RESPONSE_S / self.T_s), 200) * longer, 8000)

    def corners(self) -> list[MotorModel]:
        """The motors at the corners of the spread."""
        signs = [(1 - share, 1 + share) if share else (1.0,) for share in self.spread.values()]
        every = (dict(zip(self.spread, factors, strict=True)) for factors in itertools.product(*signs))
        return [self._off(**factors) for factors in every if set(factors.values()) != {1.0}]

    def _off(self, J: float = 1.0, psi_f: float = 1.0, R_s: float = 1.0, L: float = 1.0) -> MotorModel:
        m = self.motor
        return replace(m, J=m.J * J, psi_f=m.psi_f * psi_f, R_s=m.R_s * R_s, L_d=m.L_d * L, L_q=m.L_q * L)

    def plants(self) -> list[Plant]:
        """The believed motor, then every corner."""
        return [self.plant(motor) for motor in (self.motor, *self.corners())]

    def plant(self, motor: MotorModel, at: Elastic | None = None) -> Plant:
        """A motor, on an elastic shaft (Hz, damping, share) where one is given, behind what drives it.

        Without one on that which the observer knows.
        """
        if self.inner is None:
            at = at or self.known
            return shaft(motor, self.T_s, *at, self.brake) if at else rigid(motor, self.T_s)
        if at is None and self.inner.shaft is not None:
            at = self.inner.shaft.elastic
        inner = replace(self.inner, k_u=self.inner.k_u * motor.k_t / self.motor.k_t)
        masses = two_masses(motor, *at, self.brake) if at else None
        return shaft_of(motor, inner, self.filter, self.T_s, masses, self.regulator)

    def shaft_places(self) -> list[Place]:
        """The believed motor and every corner on each elastic shaft, of whose damping SPARE is left."""
        motors, shafts = (self.motor, *self.corners()), self.shafts
        return [(motor, (hz, SPARE * d, share)) for motor in motors for hz, d, share in shafts]

    def turns(self) -> list[Elastic | None]:
        """The elastic shaft of each of :meth:`plants`, of several in turn; None where there is none.

        Neighbours among the corners get resonances far apart, so that none goes with a low J alone.
        """
        count, shafts = 1 + len(self.corners()), self.shafts or (None,)
        return [shafts[7 * j % len(shafts)] for j in range(count)]


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
def state() -> Record:
    """A law's state that is used again; each response begins with a reset."""
    return new_law_state()


def free(law: Record) -> Record:
    """The law without the limit of the current; and a load that is known is no part of its loop."""
    own = law.copy()
    own["cogs"], own["k_w2"], own["i_max"] = 0, 0.0, np.inf
    return own


def responses(law: Record, plants: Sequence[Plant], kinds: Array, ticks: int, closed: bool = True) -> Array:
    """Responses (plants, kinds, 4, ticks), valid until the next call; without the limit of the current.

    Not ``closed``: those of the observer alone, of a drive with a current loop of its own.
    """
    own = free(law)
    out = _buffer((len(plants), len(kinds), 4, ticks))
    A, b, e, C = (np.array([getattr(plant, name) for plant in plants]) for name in ("A", "b", "e", "C"))
    with np.errstate(over="ignore", invalid="ignore"):
        if own_loop(law):
            respond_each(own[0], state()[0], A, b, e, C, kinds, closed, out)
        else:
            respond_all(own[0], state()[0], A, b, e, kinds, out)
    return out


def own_loop(law: Record) -> bool:
    """Whether the law is one for a drive with a current loop of its own."""
    return bool(law["kind"][0] == SPEED)


def _steps(law: Record) -> Array:
    """A step of the load, and the pulse that S is the response to."""
    return _OWN_STEP if own_loop(law) else _STEP


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
    out, told = responses(law, plants, _steps(law), bench.ticks), 1 if own_loop(law) else 2
    return [_loop(one[0, told] * bench.load, one[1, 1, :: bench.every], bench.T_s) for one in out]


def _loop(w: Array, u: Array, T_s: float) -> Loop:
    """Measures from speed after the load step, and from what acts after the pulse on it."""
    error, tail = np.abs(w), len(w) // 10
    if not (np.isfinite(w).all() and np.isfinite(u).all()) or error[-tail:].max() > RESTLESS * error.max():
        return UNSTABLE
    if np.abs(u[-(len(u) // 10) :]).max() > 0.01:
        return UNSTABLE
    recovery = _recovery_ms(error, T_s)
    return Loop(float(error.max()), recovery, float(error.sum() * T_s), peak_of(u))


def noise(
    law: Record, bench: Bench, motor: MotorModel | None = None,
    at: Elastic | None = None, ticks: int | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Noise of the command [bench.unit] and of the true speed [rad/s], rms, for the bench's, at its speed.

    Of another ``motor`` than that of the bench, on an elastic shaft ``at``, from responses of ``ticks``.
    """
    law, motor, ticks = held(law, "N"), motor or bench.motor, ticks or bench.ticks
    if bench.inner is None:
        return _coupled_noise(turning_responses(law, bench, motor, at, ticks), bench)
    kinds = _NOISE if bench.theta_noise is None else _ANGLE_NOISE
    out = responses(law, [bench.plant(motor, at)], kinds, ticks)[0][:, (0, 2)]
    every = (bench.w_noise, bench.i_noise * bench.inner.u_i, bench.u_noise, bench.theta_noise or 0.0)
    sigma = np.array(every[: len(kinds)])
    u, w = np.sqrt((sigma[:, None] ** 2 * (out**2).sum(axis=2) / bench.every).sum(axis=0))
    return float(u), float(w)


def _coupled_noise(out: Array, bench: Bench) -> tuple[float, float]:
    """Of :func:`noise`, from :func:`turning_responses`; the frame's i_d is rounded in the loop.

    Infinite where the loop is unstable.
    """
    if not np.isfinite(out).all():
        return UNQUIET
    sigma = np.array([bench.w_noise, bench.i_noise, bench.i_noise, bench.u_noise, bench.u_noise])
    u, w, _ = through_rounding(out, sigma, 2, 2, bench.i_d_lsb)
    return float(u), float(w)


def turning_responses(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None, ticks: int) -> Array:
    """u_q, speed, i_d (5, 3, ticks) of :func:`hil.tuning.loop.respond_turning`, at the bench's speed."""
    at = at or bench.known
    own, plant = free(law), turning_of(motor, bench.T_s, bench.w_0, at)
    out = _buffer((5, 3, ticks))
    with np.errstate(over="ignore", invalid="ignore"):
        respond_turning(own[0], state()[0], *plant, bench.w_0, at is None and motor is bench.motor, out)
    return out


def on_shaft(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None, rigid: Loop) -> Loop:
    """The measures on a rigid shaft with dip and recovery on an elastic one, which goes on to ring."""
    if at is None or not rigid.stable:
        return rigid
    error = np.abs(ringing(law, bench, motor, at))
    return replace(rigid, dip=float(error.max()), recovery_ms=_recovery_ms(error, bench.T_s))


def ringing(law: Record, bench: Bench, motor: MotorModel, at: Elastic | None) -> Array:
    """The speed after the load step (ticks,); of a drive by voltage at the bench's speed, axes coupled."""
    if bench.inner is None:
        own, out = free(law), _buffer((bench.ticks,))
        A, B = turning_of(motor, bench.T_s, bench.w_0, at or bench.known, bench.brake)
        with np.errstate(over="ignore", invalid="ignore"):
            respond_loaded(own[0], state()[0], A, B, bench.w_0, bench.load, out)
        return out
    stepped = to_unit_load(law, bench.load) if adapts(law) else law
    plant = bench.plant(motor, at)
    w: Array = (
        responses(stepped, [plant], _STEP[:1], bench.ticks)[0, 0, 1 if own_loop(law) else 2] * bench.load
    )
    return w


def _recovery_ms(error: Array, T_s: float) -> float:
    outside = np.nonzero(error > RECOVERED_RAD_S)[0]
    return (int(outside[-1]) + 1) * T_s * 1e3 if len(outside) else 0.0


def margins(law: Record, bench: Bench, plant: Plant) -> dict[str, float]:
    """Gain margin, phase margin [deg], delay margin [ms] where S is; of the short window."""
    pulse = responses(held(law, "short"), [plant], _steps(law)[1:], bench.ticks)[0, 0, 1, :: bench.every]
    return asdict(margins_of(pulse, bench.every * bench.T_s))


def quiet(
    law: Record, bench: Bench, places: Sequence[Place], seconds: float = 1.2,
    speeds: tuple[float, ...] | None = None,
) -> list[bool]:  # fmt: skip
    """Whether vibration dies away in each place: its rms falls from second to last third.

    With the axes coupled, at the first of ``speeds`` [rad/s] at which one does not; without them at the
    bench's and at rest. Behind a current loop of its own it is the vibration after a load step.
    """
    if not places:
        return []
    if adapts(law):
        both = (quiet(held(law, name), bench, places, seconds, speeds) for name in _MODES)
        return [short and long for short, long in zip(*both, strict=True)]
    ticks = round(seconds / bench.T_s)
    if bench.inner is not None:
        plants = [bench.plant(*place) for place in places]
        return _dying(responses(law, plants, _STEP[:1], ticks)[:, 0, 2] * bench.load)
    calm = [True]
    for w in speeds or dict.fromkeys((bench.w_0, 0.0)):
        calm = _dying(_vibrations(law, bench, places, ticks, w))
        if not all(calm):
            break
    return calm


@functools.lru_cache(4096)
def turning_of(
    motor: MotorModel, T_s: float, w: float, at: Elastic | None, brake: bool = False
) -> tuple[Array, Array]:
    """:func:`hil.tuning.loop.turning` in one place."""
    return turning(motor, T_s, w, *(two_masses(motor, *at, brake) if at else one_mass(motor)))


def _vibrations(law: Record, bench: Bench, places: Sequence[Place], ticks: int, w: float) -> Array:
    """:func:`hil.tuning.loop.vibrate` at w in places of one kind, rigid or not; (places, ticks)."""
    own, out, emf = free(law), _buffer((len(places), ticks)), bench.motor.n_p * w * bench.motor.psi_f
    A, B = (
        np.array(part)
        for part in zip(*(turning_of(motor, bench.T_s, w, at) for motor, at in places), strict=True)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        vibrate_all(own[0], state()[0], A, B, w, emf, out)
    return out


def _dying(signals: Array) -> list[bool]:
    """Whether the rms of each signal (m, ticks) falls from its second to its last third."""
    part = signals.shape[1] // 3
    with np.errstate(over="ignore", invalid="ignore"):
        first, last = (np.std(signals[:, part * j : part * (j + 1)], axis=1) for j in (1, 2))
    return [bool(b < a or b < 1e-8) for a, b in zip(first, last, strict=True)]


def noise_in(unit: str, value: float) -> dict[str, float]:
    """Noise of the command by its key: mV of voltages, the unit itself (A, N m) of others."""
    return {"u_noise_mv": value * 1e3} if unit == "V" else {"command_noise": value}


def noise_text(value: float, unit: str) -> str:
    """The same in words."""
    return f"{value * 1e3:.1f} mV" if unit == "V" else f"{value:.3g} {unit}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """All measures of a law: nominal and over the corners."""

    nominal: Loop
    worst: Loop
    u_noise: float
    w_noise: float

    def as_dict(self, unit: str = "V") -> dict[str, Any]:
        """JSON form, noise in mV or the command's own unit, and in mrad/s."""
        return {
            "dip": self.nominal.dip,
            "recovery_ms": self.nominal.recovery_ms,
            "iae": self.nominal.iae,
            **noise_in(unit, self.u_noise),
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
    """All measures of a law; the first plant is the nominal one. On the bench's own they are on its shaft."""
    every = loops(law, bench, bench.plants() if plants is None else plants)
    if plants is None and bench.elastic:
        motors = (bench.motor, *bench.corners())
        rows = zip(motors, bench.turns(), every, strict=True)
        every = [on_shaft(law, bench, *row) for row in rows]
    u, w = noise(law, bench)
    return Verdict(every[0], worst_of(every), u, w)
