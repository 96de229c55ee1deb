"""The kernels of the drive laws, out of the same parts, over two fixed-shape records.

State x = (w, i_q, i_d), input ua = (T_L, u_q, u_d) with B = diag(-1/J, 1/L_q, 1/L_d), one observer on the
joint state. A tick is :func:`observe` (advance the estimate by what was applied), :func:`command` (compute
from the state; the command acts one tick late) and :func:`apply` (tell what acts from now on).

Known nonlinear terms, added to the linear model through Ed:
    c = (1.5 n_p (L_d - L_q) i_d i_q / J,  -n_p w L_d i_d / L_q,  n_p w L_q i_q / L_d)
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.control.adaptive import remember
from hil.control.cogging import ORDERS, Harmonics, ahead, cog_params, loaded, ripple
from hil.control.composite import predict
from hil.control.errors import ControlDesignError
from hil.control.fac import MAX_GAP, SampledModel, sample
from hil.control.jit import jit
from hil.control.linalg import Array, copy, exp, matvec, matvec_add
from hil.control.mtpa import POINTS, operating_point, voltage
from hil.control.observer import FIR_MAX, Window, fill, shape_fill, shape_step, side_by_side, window_step
from hil.control.regen import RegenLimit, braked, regen_params
from hil.control.registry import Channel, InnerLoop, Plan, Shaft, laws, member, observers
from hil.control.speed import COMMANDS, FOLLOWS, LEADS, ask_speed, share, slope_change
from hil.control.speedfilter import (
    PAST,
    ROOM,
    behind,
    enter,
    filter_params,
    hear,
    innovation,
    shaft_params,
    ticks_of,
)

N_MAX: Final = 1024
"""Longest window D [ticks] that the record has room for."""

CASCADE: Final = 0
FAC: Final = 1
PI: Final = 2
IDENTIFY: Final = 3
SPEED: Final = 4
MTPA: Final = 5
ROWS: Final = 32
"""Most rows of an experiment."""

LAW_PARAMS: Final = np.dtype(
    [
        ("kind", "i8"),
        ("coupling", "i8"),
        ("Ad", "f8", (3, 3)),
        ("Bd", "f8", (3, 3)),
        ("Ed", "f8", (3, 3)),
        ("gap_inverse", "f8", (MAX_GAP, 3, 3)),
        ("max_gap", "i8"),
        ("lam", "f8", (2, 3)),
        ("lam_N", "f8", (2, 3)),
        ("theta", "f8", (2, 3)),
        ("N", "i8", 3),
        ("closed", "f8", (3, 3)),
        ("Bd_inv", "f8", (3, 3)),
        ("T_s", "f8"),
        ("J", "f8"),
        ("k_t", "f8"),
        ("n_p", "f8"),
        ("L_d", "f8"),
        ("L_q", "f8"),
        ("a_w", "f8"),
        ("e_w", "f8"),
        ("lam_w", "f8"),
        ("lam_q", "f8"),
        ("lam_d", "f8"),
        ("i_max", "f8"),
        ("T_L_max", "f8"),
        ("shaped", "i8"),
        ("form", "i8", 3),
        ("third", "f8", (3, 3)),
        ("g", "f8", (FIR_MAX, 3)),
        ("M", "f8", (3, 3)),
        ("W", "f8", (3, 3)),
        ("filtered", "i8"),
        ("S", "f8", (3, 3)),
        ("k_p", "f8", 3),
        ("k_i", "f8", 3),
        ("rows", "i8"),
        ("passes", "i8"),
        ("row_q", "f8", ROWS),
        ("row_d", "f8", ROWS),
        ("row_w", "f8", ROWS),
        ("row_slew", "f8", ROWS),
        ("row_ticks", "i8", ROWS),
        ("u_start", "f8"),
        ("u_most", "f8"),
        ("goal", "f8", 3),
        ("w_run", "f8"),
        ("w_wrong", "f8"),
        ("i_brake", "f8"),
        ("k_u", "f8"),
        ("u_i", "f8"),
        ("told", "i8"),
        ("delay", "i8"),
        ("lag", "f8"),
        ("share", "f8"),
        ("kappa", "f8"),
        ("g_u", "f8"),
        ("order", "i8"),
        ("v_y", "f8", ROOM),
        ("v_u", "f8", ROOM),
        ("v_s", "f8", ROOM),
        ("w_y", "f8", ROOM),
        ("w_u", "f8", ROOM),
        ("w_s", "f8", ROOM),
        ("w_d", "f8"),
        ("gap_y", "f8", MAX_GAP),
        ("short", "i8", 3),
        ("first", "i8", 3),
        ("R_s", "f8"),
        ("u_share", "f8"),
        ("every", "i8"),
        ("span", "i8"),
        ("cogs", "i8"),
        ("cog_order", "i8", ORDERS),
        ("cog_a", "f8", ORDERS),
        ("cog_b", "f8", ORDERS),
        ("cog_lead", "f8"),
        ("cog_lag", "f8"),
        ("cog_slow", "f8"),
        ("regen", "i8"),
        ("p_regen", "f8"),
        ("v_regen", "f8"),
        ("g_regen", "f8"),
        ("points", "i8"),
        ("i_q_at", "f8", POINTS),
        ("i_d_at", "f8", POINTS),
        ("k_w2", "f8"),
        ("pair", "i8"),
        ("jerk", "i8"),
        ("k_th", "f8"),
        ("th_w", "f8"),
        ("th_i", "f8"),
        ("th_u", "f8"),
        ("th_d", "f8"),
        ("kappa_th", "f8"),
        ("rho_th", "f8"),
        ("theta_span", "f8"),
    ],
    align=True,
)
"""Parameters, from ``shaped`` on neutral at zero: observers of other forms than the pair of exponentials
(:class:`hil.control.observer.Window`), 1 in ``shaped`` when a channel has one, 1 in ``filtered`` when the law
takes x_hat; gains of the PI law (w, q, d); from ``rows`` on an experiment's table (:func:`identify_law`);
from ``k_u`` on the drive's own current loop and the speed law's gains (:mod:`hil.control.speed`); from
``order`` on the filter that the reported speed comes through (:mod:`hil.control.speedfilter`); lengths of an
adaptive window after a change (:mod:`hil.control.adaptive`), whose bounds are in ``g``; R_s and the share of
the voltage circle of :func:`mtpa_law`; ``every``: ticks from one measurement to the next where these are
several, else 0, and ``span``: what an innovation rests on then, where there is a filter; from ``cogs`` on the
load torque that is known over the shaft's angle (:mod:`hil.control.cogging`); from ``regen`` on what may go
back to the DC link (:mod:`hil.control.regen`); from ``points`` on the table of i_d* over |i_q*| of the law
``mtpa`` (:func:`hil.control.mtpa.by_table`); ``k_w2`` of the load that goes by the speed
squared; ``pair``: a node's part in the law ``fac`` over two nodes (:data:`hil.control.speed.LEADS`);
``jerk``: 1 when the reference's jerk is fed forward (:func:`hil.control.speed.slope_change`); from ``k_th``
on the law ``position`` (:mod:`hil.control.position`), ``k_th`` 0: no angle is followed."""

_SHAPES = ("shaped", "form", "third", "g", "M", "W", "filtered", "S", "k_p", "k_i", "short", "first")
_TABLE = ("rows", "passes", "row_q", "row_d", "row_w", "row_slew", "row_ticks")
_BOUNDS = ("u_start", "u_most", "goal", "w_run", "w_wrong", "i_brake")
_INNER = ("k_u", "u_i", "told", "delay", "lag", "share", "kappa", "g_u")
_FILTER = ("order", "v_y", "v_u", "v_s", "w_y", "w_u", "w_s", "w_d", "gap_y")
_SALIENT = ("R_s", "u_share")
_SELDOM = ("every", "span")
_COGGING = ("cogs", "cog_order", "cog_a", "cog_b", "cog_lead", "cog_lag", "cog_slow")
_REGEN = ("regen", "p_regen", "v_regen", "g_regen")
_TABLED = ("points", "i_q_at", "i_d_at")
_QUADRATIC = ("k_w2",)
_PAIRED = ("pair",)
_JERK = ("jerk",)
_POSITION = ("k_th", "th_w", "th_i", "th_u", "th_d", "kappa_th", "rho_th", "theta_span")
LAW_NEUTRAL: Final[dict[str, float]] = dict.fromkeys(
    (
        *_SHAPES,
        *_TABLE,
        *_BOUNDS,
        *_INNER,
        *_FILTER,
        *_SALIENT,
        *_SELDOM,
        *_COGGING,
        *_REGEN,
        *_TABLED,
        *_QUADRATIC,
        *_PAIRED,
        *_JERK,
        *_POSITION,
    ),
    0.0,
)
"""Parameters newer than log format 1, each with the value that means "as before it was there".

A log that lacks one replays with that value; a test refuses a new parameter without one (docs/log-format.md).
"""

LAW_STATE: Final = np.dtype(
    [
        ("x", "f8", 3),
        ("x_open", "f8", 3),
        ("c", "f8", 3),
        ("ua", "f8", 3),
        ("v", "f8", 3),
        ("h", "f8", (2, 3)),
        ("past", "f8", (N_MAX, 2, 3)),
        ("head", "i8"),
        ("d_hat", "f8", 3),
        ("gap", "i8"),
        ("started", "i8"),
        ("filled", "i8"),
        ("x_p", "f8", 3),
        ("d_p", "f8", 3),
        ("work", "f8", 3),
        ("u", "f8", 3),
        ("i_q_ref", "f8"),
        ("h_3", "f8", 3),
        ("past_3", "f8", (N_MAX, 3)),
        ("rho", "f8", 3),
        ("d_filter", "f8", 3),
        ("x_hat", "f8", 3),
        ("I", "f8", 3),
        ("row", "i8"),
        ("row_ticks", "i8"),
        ("passes", "i8"),
        ("cut", "i8"),
        ("level", "f8", 2),
        ("peak", "f8", 3),
        ("inner", "f8"),
        ("commands", "f8", COMMANDS),
        ("y", "f8", PAST),
        ("flow", "f8", PAST),
        ("bend", "f8", PAST),
        ("place", "i8"),
        ("heard", "i8"),
        ("length", "i8", 3),
        ("hold", "i8", 3),
        ("still", "i8", 3),
        ("doubt", "i8", 3),
        ("x_last", "f8", 3),
        ("i_d_ref", "f8"),
        ("capped", "i8"),
        ("theta", "f8"),
        ("v_dc", "f8"),
        ("asked", "f8"),
        ("load", "f8"),
        ("slope", "f8"),
        ("turned", "f8"),
        ("origin", "f8"),
        ("theta_ref", "f8"),
        ("theta_seen", "f8"),
        ("w_seen", "f8"),
        ("turns", "i8"),
        ("rounds", "i8"),
        ("unseen", "i8"),
        ("located", "i8"),
    ],
    align=True,
)
"""State; from ``h_3`` on of :func:`shape_step` (third exponential, filter), the PI law's integrators ``I``
[A, V, V], and an experiment's place in its table, voltage level [V] of q and d, peaks of w, i_q, i_d;
of a drive's own current loop what flows, and the commands on their way, newest first; of a filtered speed
rings of what was reported and what flowed, with their newest place, and how many samples were heard; of an
adaptive window its length, its dwell, and how long the measurements ``x_last`` have stood still; i_d*, and
whether what was asked for was capped; the measured angle of the shaft, where a load over it is known, and the
measured DC link, where it limits; the torque of a table over k_t [A]; the torque that a
load machine was last told to give [N m]; the reference's slope in the tick before [rad/s2]; from ``turned``
on the angle over turns [rad], where its reference is 0, that reference, the newest angle as measured and the
speed then, whole turns and rounds of the drive's counter, ticks since then, and whether there is one."""

Record = npt.NDArray[np.void]


@dataclass(frozen=True, slots=True)
class MotorModel:
    """What the controller believes of the motor; SI units, amplitude-invariant dq, mechanical speed."""

    R_s: float
    L_d: float
    L_q: float
    psi_f: float
    n_p: int
    J: float
    B_f: float

    @property
    def k_t(self) -> float:
        """Torque constant 1.5 n_p psi_f [N m / A]."""
        return 1.5 * self.n_p * self.psi_f

    def A(self) -> Array:
        """Linear part of (32) with the right sign of a1 b1: torque accelerates (errata 3)."""
        return np.array(
            [
                [-self.B_f / self.J, self.k_t / self.J, 0.0],
                [-self.n_p * self.psi_f / self.L_q, -self.R_s / self.L_q, 0.0],
                [0.0, 0.0, -self.R_s / self.L_d],
            ]
        )

    def B(self) -> Array:
        """Input matrix of (T_L, u_q, u_d)."""
        return np.diag([-1.0 / self.J, 1.0 / self.L_q, 1.0 / self.L_d])


@dataclass(frozen=True, slots=True)
class ChannelSpec:
    """One channel's window: FTDOB (gamma_1, gamma_2 [rad/s], D [s]), conventional DOB (gamma_1), or another.

    ``more`` are the keys of the other kinds, as their tables have them.
    """

    kind: str
    gamma_1: float = 0.0
    gamma_2: float = 0.0
    delay: float = 0.0
    more: Mapping[str, Any] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """What the registered design takes."""
        own = {"gamma_1_rad_s": self.gamma_1, "gamma_2_rad_s": self.gamma_2, "delay_ms": self.delay * 1e3}
        return dict(self.more) if self.more else own


@dataclass(frozen=True, slots=True)
class LawSpec:
    """Tuning of a drive law: poles [rad/s], windows, limits. Gains are derived, never given.

    ``more`` are the keys of other laws than cascade and fac, as their tables have them.
    """

    kind: str
    motor: MotorModel
    speed: ChannelSpec
    current: ChannelSpec
    speed_pole: float = 30.0
    current_pole: float = 250.0
    current_d_pole: float = 250.0
    i_max: float = 0.0
    T_L_max: float = 0.0
    coupling: bool = True
    more: Mapping[str, Any] = field(default_factory=dict)
    inner: InnerLoop | None = None
    """The drive's own current loop; None for a drive that takes voltages."""
    cogging: Harmonics | None = None
    """The load torque that is known over the shaft's angle."""
    regen: RegenLimit | None = None
    """What may go back to the DC link."""
    k_w2: float = 0.0
    """Known load over the speed squared [N m s2/rad2]."""
    shaft: Shaft | None = None
    """Behind which the observer of a drive that takes voltages knows the load to be."""

    def values(self) -> dict[str, Any]:
        """What the registered design takes."""
        poles = (self.speed_pole, self.current_pole, self.current_d_pole)
        names = ("speed_pole_rad_s", "current_pole_rad_s", "current_d_pole_rad_s")
        return dict(self.more) if self.more else dict(zip(names, poles, strict=True))


@functools.lru_cache(64)
def sampled_model(motor: MotorModel, T_s: float) -> SampledModel:
    """Exact sampled form of the joint linear model."""
    return sample(motor.A(), motor.B(), T_s)


@functools.lru_cache(64)
def speed_model(motor: MotorModel, k_u: float, T_s: float) -> SampledModel:
    """Exact sampled form of J dw/dt = k_u u - B_f w + J d; the channels of the currents stand still."""
    A, B = np.diag([-motor.B_f / motor.J, 0.0, 0.0]), np.diag([k_u / motor.J, 1.0, 1.0])
    return sample(A, B, T_s)


def model_of(spec: LawSpec, T_s: float) -> SampledModel:
    """The sampled model that observer and law of this drive rest on."""
    return (
        sampled_model(spec.motor, T_s) if spec.inner is None else speed_model(spec.motor, spec.inner.k_u, T_s)
    )


def law_window(spec: LawSpec, T_s: float) -> Window:
    """The joint window of the channels (w, q, d). Raises ControlDesignError, also for D over N_MAX ticks."""
    window = _window(spec, T_s)
    if window.N.max() >= N_MAX:
        raise ControlDesignError(
            f"D = {window.N.max()} ticks is longer than the {N_MAX - 1} kept; shorten D or lower the rate"
        )
    return window


def _window(spec: LawSpec, T_s: float) -> Window:
    """Channel by channel, or all at once by an observer that needs them so."""
    own = [member(channel.kind, observers()) for channel in (spec.speed, spec.current)]
    if any(observer.joint for observer in own):
        if own[0] is not own[1]:
            joint = next(observer.kind for observer in own if observer.joint)
            raise ControlDesignError(f"observer kind {joint} is one for all channels: give it to both")
        if spec.shaft is not None:
            raise ControlDesignError(
                f"motor.shaft: observer kind {own[0].kind} has a model of its own, without a shaft; "
                "take another, or leave the shaft out"
            )
        whole: Window = own[0].joint(spec.speed.values(), spec.current.values(), model_of(spec, T_s))
        return whole
    speed = _shortened(spec.speed, spec.inner, T_s, spec.shaft)
    rows = ((own[0], speed), (own[1], spec.current), (own[1], spec.current))
    model = model_of(spec, T_s)
    return side_by_side(*(_channel(o, c, i, model, T_s) for i, (o, c) in enumerate(rows)))


def _channel(observer: Any, given: ChannelSpec, index: int, model: SampledModel, T_s: float) -> Window:
    """The window of one channel."""
    window: Window = observer.design(given.values(), Channel(index, T_s, model))
    return window


def _shortened(
    given: ChannelSpec, inner: InnerLoop | None, T_s: float, shaft: Shaft | None = None
) -> ChannelSpec:
    """The window that is left of D when each innovation needs ticks itself, for the states of a filter."""
    every, values = 1 if inner is None else inner.every, given.values()
    ticks = whole_gaps(ticks_of(inner, shaft), every)
    if given.kind == "adaptive" and (ticks or every > 1):
        of = "without drive.speed_filter and motor.shaft" if ticks else "in each tick, no feedback.period_ms"
        raise ControlDesignError(
            f"observer.speed.kind adaptive: its thresholds are those of a speed {of}; take another kind"
            + (", or leave those out" if ticks else "")
        )
    delay = values.get("delay_ms")
    if (not ticks and every == 1) or given.kind == "dob" or delay is None:  # a dob has no window
        return given
    left, tick_ms = delay - ticks * T_s * 1e3, T_s * 1e3
    if left < 0.999999 * every * tick_ms:
        raise ControlDesignError(
            f"observer.speed.delay_ms = {delay:g}: {_taken(ticks, every, tick_ms)}; take a longer one"
        )
    return replace(given, more=values | {"delay_ms": left}) if ticks else given


def whole_gaps(ticks: int, every: int) -> int:
    """Ticks as whole gaps between measurements: the first innovation without what was before is of such."""
    return ticks + -ticks % every


def _taken(ticks: int, every: int, tick_ms: float) -> str:
    """What is taken of a window that is too short."""
    states = f"the states of drive.speed_filter and motor.shaft take {ticks * tick_ms:g} ms of it"
    if every == 1:
        return f"{states}, and nothing is left"
    seldom = f"measurements come every {every * tick_ms:g} ms (feedback.period_ms)"
    return (
        f"{seldom}, {states}, and at least one must be left" if ticks else f"{seldom}, no one in the window"
    )


def exact_after(law: Record) -> tuple[int, int]:
    """Ticks after its last change from which a constant d is known: speed and current channel.

    Of a drive that measures in each m-th tick: when the change came just after a measurement, which the
    whole of the next gap then tells as its mean.
    """
    N, every = int(law["N"][0, 0]), max(int(law["every"][0]), 1)
    states = int(law["order"][0]) if every == 1 else whole_gaps(max(int(law["span"][0]) - every, 0), every)
    return N + states + every - 1 + -N % every, int(law["N"][0, 1])


def _check(spec: LawSpec) -> None:
    """Refuse a motor or limits that no law can be designed for."""
    m = spec.motor
    positive = {"R_s": m.R_s, "L_d": m.L_d, "L_q": m.L_q, "psi_f": m.psi_f, "n_p": m.n_p, "J": m.J}
    wrong = [name for name, value in (positive | {"i_max": spec.i_max}).items() if not value > 0]
    wrong += [name for name, value in {"B_f": m.B_f, "T_L_max": spec.T_L_max}.items() if not value >= 0]
    if wrong:
        raise ControlDesignError(f"{', '.join(wrong)} must be positive (B_f and T_L_max may be 0)")


def _check_takes(spec: LawSpec, law: Any) -> None:
    """Refuse a law for a drive that does not take what it asks for."""
    if (spec.inner is None and "voltage" in law.takes) or (spec.inner and set(law.takes) - {"voltage"}):
        return
    takes = "voltages" if spec.inner is None else "a current or a torque"
    own = {"voltage"} if spec.inner is None else {"current", "torque"}
    fit = [one.kind for one in laws().values() if own & set(one.takes)]
    raise ControlDesignError(
        f"controller.kind: {spec.kind} asks for {' or '.join(law.takes)}, the drive takes {takes}; "
        f"take {', '.join(fit)}"
    )


def _lead(spec: LawSpec, values: Mapping[str, Any], T_s: float) -> tuple[float, float]:
    """(lead [s], lam) of :func:`hil.control.cogging.ahead`; of the law speed when its command acts."""
    if spec.inner is not None:
        return (1.0 + spec.inner.delay) * T_s, 0.0
    if spec.kind == "fac":  # it commands the load itself, without a current's lag
        return 1.5 * T_s, 0.0
    lam = float(values.get("lam_q", 0.0))
    if spec.kind == "pi":
        lam = exp(-float(values["k_p"][1]) / spec.motor.L_q * T_s)
    return (2.0 * T_s, lam) if lam > 0.0 else (1.5 * T_s, 0.0)


def design_law(spec: LawSpec, T_s: float) -> Record:
    """Design a law: a one-element array of LAW_PARAMS. Raises ControlDesignError."""
    _check(spec)
    motor, law = spec.motor, member(spec.kind, laws())
    _check_takes(spec, law)
    window, model = law_window(spec, T_s), model_of(spec, T_s)
    speed = sample(np.array([[-motor.B_f / motor.J]]), np.array([[motor.k_t / motor.J]]), T_s, 1)
    params = np.zeros(1, LAW_PARAMS)
    values = {
        "kind": law.code,
        "coupling": int(spec.coupling),
        "Ad": model.Ad,
        "Bd": model.Bd,
        "Ed": model.Ed,
        "max_gap": len(model.gap_inverse),
        "lam": window.lam,
        "lam_N": window.lam_N,
        "theta": window.theta,
        "N": window.N,
        "T_s": T_s,
        "J": motor.J,
        "k_t": motor.k_t,
        "n_p": motor.n_p,
        "L_d": motor.L_d,
        "L_q": motor.L_q,
        "a_w": speed.Ad[0, 0],
        "e_w": speed.Ed[0, 0],
        "i_max": spec.i_max,
        "T_L_max": spec.T_L_max,
    }
    values |= law.design(spec.values(), Plan(motor, model, T_s, spec.inner))
    if spec.inner and spec.inner.every > 1:
        values["every"] = spec.inner.every
    gain = spec.inner.k_u / motor.J if spec.inner else 0.0
    values |= cog_params(spec.cogging, *_lead(spec, values, T_s), T_s, spec.k_w2)
    values |= regen_params(spec.regen, motor.R_s)
    values |= filter_params(spec.inner, -motor.B_f / motor.J, gain, T_s)
    if spec.shaft is not None:
        values |= shaft_params(spec.shaft, motor.A()[:2, :2], T_s)
    for name, value in values.items():
        params[name] = value
    for name in ("form", "third", "g", "M", "W", "S", "short", "first"):
        if (part := getattr(window, name)).size:
            params[name] = part
    params["shaped"], params["filtered"] = params["form"].any(), params["S"].any()
    params["gap_inverse"][0, : len(model.gap_inverse)] = model.gap_inverse
    return params


def new_law_state() -> Record:
    """State before the first measurement: empty memory, nothing applied."""
    return np.zeros(1, LAW_STATE)


@jit
def known_terms(p: Any, x: Array, c: Array) -> None:
    """c(x): reluctance torque and cross-coupling, zero when they are switched off."""
    on = float(p["coupling"])
    c[0] = on * 1.5 * p["n_p"] * (p["L_d"] - p["L_q"]) * x[2] * x[1] / p["J"]
    c[1] = -on * p["n_p"] * x[0] * x[2] * p["L_d"] / p["L_q"]
    c[2] = on * p["n_p"] * x[0] * x[1] * p["L_q"] / p["L_d"]


@jit
def reset(s: Any) -> None:
    """Forget every measurement; what is applied is kept."""
    s["started"] = 0
    s["filled"] = 0
    s["gap"] = 0
    s["heard"] = 0
    for c in range(3):
        s["d_hat"][c] = 0.0
        s["rho"][c] = 0.0
        s["I"][c] = 0.0


@jit
def start(p: Any, s: Any) -> None:
    """Take the measurement in s['x'] as the beginning of the observer's first period."""
    copy(s["x"], s["x_open"])
    known_terms(p, s["x"], s["c"])
    if loaded(p):
        s["c"][0] += ripple(p, s, 0.0)
    s["started"] = 1
    s["gap"] = 0


@jit
def open_loop(p: Any, s: Any) -> None:
    """Advance the prediction with d = 0 by one period: x_open <- Ad x_open + Bd ua + Ed c."""
    matvec(p["Ad"], s["x_open"], s["work"])
    matvec_add(p["Bd"], s["ua"], s["work"])
    matvec_add(p["Ed"], s["c"], s["work"])
    copy(s["work"], s["x_open"])


@jit
def innovate(p: Any, s: Any) -> None:
    """v = (sum_{j<m} Ad^j Ed)^-1 (x - x_open), with the known terms averaged over both ends; m = s['gap']."""
    for c in range(3):
        s["work"][c] = s["x"][c] - s["x_open"][c]
    matvec(p["gap_inverse"][s["gap"] - 1], s["work"], s["v"])
    known_terms(p, s["x"], s["work"])
    if loaded(p):
        s["work"][0] += ripple(p, s, 0.0)
    for c in range(3):
        s["v"][c] -= 0.5 * (s["work"][c] - s["c"][c])


@jit
def hear_beside_current(p: Any, s: Any, before: float) -> int:
    """:func:`hear` after :func:`innovate`, of a drive that takes voltages; i_q was ``before``, is x_1 now.

    What the measured current and the known torques did over the past periods goes into the ring; between
    the ends of a gap it is taken for straight.
    """
    gap, per_torque = s["gap"], p["J"] / p["k_t"]
    first, last = before + per_torque * s["c"][0], s["x"][1] + per_torque * s["work"][0]
    bend = (last - first) / gap
    for period in range(gap):
        enter(s, first + (period + 0.5) * bend, bend)
    return int(hear(p, s))


@jit
def observe(p: Any, s: Any, w: float, i_q: float, i_d: float, fresh: bool, periods: int) -> None:
    """Advance the observer by the past ``periods`` ticks, in which s['ua'] was applied.

    Without a fresh measurement only the gap grows; the next one then makes up for all of it exactly. The
    memory starts filled with the first innovation (bumpless). A gap over max_gap ticks starts anew, and so
    does a count below 1: there is no such period, and no gap inverse that could be read for it.
    """
    if s["started"]:
        skipped = p["order"] > 0 and p["kind"] == SPEED and p["every"] < 2
        for _ in range(0 if skipped else min(periods, p["max_gap"] + 1)):
            open_loop(p, s)
        s["gap"] += periods
        if periods < 1 or s["gap"] > p["max_gap"]:
            reset(s)
    if not fresh:
        return
    before = s["x"][1]
    s["x"][0], s["x"][1], s["x"][2] = w, i_q, i_d
    if not s["started"]:
        if p["order"]:
            s["y"][s["place"]], s["heard"] = w, 1
        start(p, s)
        return
    steps = s["gap"]
    if p["order"] and p["kind"] == SPEED:
        steps = hear(p, s)
    else:
        innovate(p, s)
        if p["order"]:
            steps = hear_beside_current(p, s, before)
    for step in range(steps):
        if p["order"]:
            ago = steps - 1 - step
            s["v"][0] = innovation(p, s, (s["place"] - ago + ago % max(p["every"], 1)) % PAST)
        if s["filled"] == 0 and step == 0:
            fill(s["v"], s["h"], s["past"])
            if p["shaped"]:
                shape_fill(p, s)
        s["head"] = window_step(
            p["lam"], p["lam_N"], p["theta"], p["N"], s["v"], s["h"], s["past"], s["head"], s["d_hat"]
        )
        if p["shaped"]:
            shape_step(p, s)
    if p["shaped"]:
        remember(p, s, s["gap"])
    if p["order"] and p["kind"] == SPEED:
        behind(p, s)
    s["filled"] = min(s["filled"] + steps, max(p["N"][0], p["N"][1], p["N"][2]))
    start(p, s)


@jit
def between(p: Any, s: Any) -> None:
    """x_w in a tick between two measurements: what the model and d_hat make of the last one.

    x = x_open + (sum_{j<m} Ad^j Ed) d_hat, m ticks after it: where v is d_hat then, it is what is measured.
    """
    gap = s["gap"]
    if s["started"] and 0 < gap <= p["max_gap"]:
        s["x"][0] = s["x_open"][0] + s["d_hat"][0] / p["gap_inverse"][gap - 1, 0, 0]


@jit
def apply(s: Any, T_L: float, u_q: float, u_d: float) -> None:
    """Tell what is really applied over the period that begins now."""
    s["ua"][0], s["ua"][1], s["ua"][2] = T_L, u_q, u_d


@jit
def filtered_state(p: Any, s: Any) -> None:
    """x_hat = x - S rho, the filter's own state; the measured one where the law takes that."""
    copy(s["x"], s["x_hat"])
    if p["filtered"]:
        matvec(p["S"], s["rho"], s["work"])
        for c in range(3):
            s["x_hat"][c] -= s["work"][c]


@jit
def look_ahead(p: Any, s: Any) -> None:
    """x_p: the state one tick on under the input that acts now; d_p = d_hat + c(x_p)."""
    filtered_state(p, s)
    copy(s["c"], s["work"])
    if p["short"][2] > 0:  # an adaptive window's i_d is quieter than the measured one
        known_terms(p, s["x_hat"], s["work"])
        s["work"][0] += ripple(p, s, 0.0) if loaded(p) else 0.0
    for c in range(3):
        s["d_p"][c] = s["d_hat"][c] + s["work"][c]
    predict(p["Ad"], p["Bd"], p["Ed"], s["x_hat"], s["ua"], s["d_p"], s["x_p"])
    known_terms(p, s["x_p"], s["work"])
    if loaded(p):
        s["work"][0] += ahead(p, s)
    for c in range(3):
        s["d_p"][c] = s["d_hat"][c] + s["work"][c]


@jit
def asked_current(p: Any, s: Any, w_ref: float, dw_ref: float, change: float) -> float:
    """i_q* that moves the speed error by e^{-p_w T_s} a tick and compensates d_hat_w.

    w+ = a_w w + e_w (k_t i_q / J + d);  i_q* = J / (k_t e_w) (w*+ + lam (w - w*) - a_w w - e_w d)
    with the reference of the next two ticks by its slope, and that by its ``change`` a tick.
    """
    bend = 0.5 * p["T_s"] * change
    target = w_ref + p["T_s"] * dw_ref + bend
    wanted = target + p["T_s"] * (dw_ref + change) + bend + p["lam_w"] * (s["x_p"][0] - target)
    drift = p["a_w"] * s["x_p"][0] + p["e_w"] * s["d_p"][0]
    return float(p["J"] * (wanted - drift) / (p["k_t"] * p["e_w"]))


@jit
def lead_current(p: Any, s: Any, change: float, f: float) -> None:
    """Let i_q be where a moving i_q* needs it, f [Wb] being the torque's constant over 1.5 n_p.

    i_q* is what the next tick needs on average, the law sets i_q at its end, and i_q* moves on: with
    D = J change / (1.5 n_p f) a tick the end is i_q* + D / 2, and i+ = i* + D / 2 + lam_q (i - (i* - D / 2)).
    Within i_max, and not where less may go back to the DC link, or less voltage is there.
    """
    room = 0.0 if s["capped"] else p["i_max"] - abs(s["i_q_ref"])
    lead = 0.5 * (1.0 + p["lam_q"]) * p["J"] * change / (1.5 * p["n_p"] * f)
    s["u"][1] += min(max(lead, -room), room) / p["Bd"][1, 1]


@jit
def limited_current(p: Any, s: Any, w: float, i_q: float) -> float:
    """i_q within i_max, and within what may go back to the DC link at the speed w; i_d* = 0."""
    i_q = float(min(max(i_q, -p["i_max"]), p["i_max"]))
    if not p["regen"]:
        return i_q
    s["capped"] = 0
    return float(braked(p, s, p["n_p"] * w, 0.0, i_q))


@jit
def free_response(p: Any, s: Any) -> None:
    """work = Ad x_p + Ed d_p: the state two ticks on if nothing were applied in the second."""
    matvec(p["Ad"], s["x_p"], s["work"])
    matvec_add(p["Ed"], s["d_p"], s["work"])


@jit
def current_law(p: Any, s: Any) -> None:
    """u_q, u_d that move the current errors by e^{-p_q T_s} and e^{-p_d T_s} a tick; i_d* = 0 here."""
    free_response(p, s)
    q_wanted = s["i_q_ref"] + p["lam_q"] * (s["x_p"][1] - s["i_q_ref"])
    d_wanted = p["lam_d"] * s["x_p"][2]
    s["u"][0] = 0.0
    s["u"][1] = (q_wanted - s["work"][1]) / p["Bd"][1, 1]
    s["u"][2] = (d_wanted - s["work"][2]) / p["Bd"][2, 2]


@jit
def steady_room(p: Any, s: Any, w: float, u_limit: float) -> float:
    """Voltage [V] of the model that the next operating point may take at the electrical speed w.

    u_share of the circle, less by how much the point before takes more than by the model: it takes
    u - L d_hat, d_hat being known apart from the coupling only where that is a known term.
    """
    on = float(p["coupling"])
    u_d, u_q = voltage(p, w, s["i_d_ref"], s["i_q_ref"])
    e_d, e_q = u_d - on * p["L_d"] * s["d_hat"][2], u_q - on * p["L_q"] * s["d_hat"][1]
    more = math.sqrt(e_d * e_d + e_q * e_q) - math.sqrt(u_d * u_d + u_q * u_q)
    return float(max(p["u_share"] * u_limit - more, 0.0))


@jit
def mtpa_law(p: Any, s: Any, w_ref: float, dw_ref: float, u_limit: float) -> None:
    """The cascade, whose torque is made by the least current that the voltage allows; i_d follows i_d*.

    tau = psi_f i_q + (L_d - L_q) i_d i_q: the speed law's q current, and what c(x_p) has already put in for
    the reluctance torque. With rows the torque is that of a table (the law ``torque``), no speed's.
    """
    psi_f, w, change = p["k_t"] / (1.5 * p["n_p"]), p["n_p"] * s["x_p"][0], slope_change(p, s, dw_ref)
    if p["rows"] > 0:
        if w_ref != p["w_run"]:
            s["row"] = p["rows"]
        s["asked"] = torque_step(p, s, s["asked"])
        tau = psi_f * s["asked"]
    else:
        reluctance = (p["L_d"] - p["L_q"]) * s["x_p"][2] * s["x_p"][1]
        tau = psi_f * asked_current(p, s, w_ref, dw_ref, change) + reluctance
    i_d_ref, i_q_ref, capped = operating_point(p, tau, w, steady_room(p, s, w, u_limit))
    s["capped"] = int(capped)
    s["i_d_ref"], s["i_q_ref"] = i_d_ref, braked(p, s, w, i_d_ref, i_q_ref) if p["regen"] else i_q_ref
    current_law(p, s)
    s["u"][2] += (1.0 - p["lam_d"]) * i_d_ref / p["Bd"][2, 2]
    if change != 0.0:
        lead_current(p, s, change, psi_f + (p["L_d"] - p["L_q"]) * i_d_ref)


@jit
def fac_law(p: Any, s: Any, w_ref: float, dw_ref: float, i_q_ref: float) -> None:
    """u = Bd^-1 (x* + Z e^{Upsilon T_s} Z^-1 (x_p - x*) - Ad x_p - Ed d_p), x* = (w*, i_q*, 0).

    i_q* is limited to i_max and by what may go back to the DC link, T_L to T_L_max.
    """
    free_response(p, s)
    i_q_ref = limited_current(p, s, s["x_p"][0], i_q_ref)
    s["i_q_ref"] = i_q_ref
    target = w_ref + p["T_s"] * dw_ref
    e_w, e_q, e_d = s["x_p"][0] - target, s["x_p"][1] - i_q_ref, s["x_p"][2]
    closed = p["closed"]
    for c in range(3):
        goal = target + p["T_s"] * dw_ref if c == 0 else (i_q_ref if c == 1 else 0.0)
        error = closed[c, 0] * e_w + closed[c, 1] * e_q + closed[c, 2] * e_d
        s["work"][c] = goal + error - s["work"][c]
    matvec(p["Bd_inv"], s["work"], s["u"])
    s["u"][0] = min(max(s["u"][0], -p["T_L_max"]), p["T_L_max"])


@jit
def pi_law(p: Any, s: Any, w_ref: float, dw_ref: float, u_limit: float) -> None:
    """PI cascade on the measured state (:mod:`hil.control.laws.pi`); what is cut off is not integrated."""
    x, k_p, k_i, total = s["x"], p["k_p"], p["k_i"], s["I"]
    e_w = w_ref - x[0]
    asked = k_p[0] * e_w + total[0] + p["J"] * dw_ref / p["k_t"]
    if loaded(p):
        asked -= p["J"] * ahead(p, s) / p["k_t"]
    i_q_ref = limited_current(p, s, x[0], asked)
    total[0] += p["T_s"] * k_i[0] * (e_w + (i_q_ref - asked) / k_p[0])
    s["i_q_ref"] = i_q_ref
    psi_f = p["k_t"] / (1.5 * p["n_p"])
    u = s["u"]
    u[0] = 0.0
    u[1] = k_p[1] * (i_q_ref - x[1]) + total[1] + p["n_p"] * x[0] * (psi_f + p["L_d"] * x[2])
    u[2] = -k_p[2] * x[2] + total[2] - p["n_p"] * x[0] * p["L_q"] * x[1]
    u_q, u_d = u[1], u[2]
    to_circle(s, u_limit)
    total[1] += p["T_s"] * k_i[1] * (i_q_ref - x[1] + (u[1] - u_q) / k_p[1])
    total[2] += p["T_s"] * k_i[2] * (-x[2] + (u[2] - u_d) / k_p[2])
    u[1], u[2] = u_q, u_d


@jit
def identify_law(p: Any, s: Any, w_ref: float) -> None:
    """An experiment by its table: voltage pulses at rest (``passes`` > 0), or steps of torque by speed.

    It runs while w_ref is ``w_run``; after its last row, on a stop, and past ``goal[0]`` [rad/s] it brakes.
    """
    s["u"][0] = 0.0
    over = w_ref != p["w_run"] or abs(s["x"][0]) > p["goal"][0]
    if p["passes"] > 0:
        pulse_law(p, s, over)
        return
    if over:
        s["row"] = p["rows"]
    s["i_q_ref"] = fed_back(p, s, torque_step(p, s, s["i_q_ref"]))
    current_law(p, s)


@jit
def identify_speed(p: Any, s: Any, w_ref: float) -> None:
    """:func:`identify_law` for a drive with a current loop of its own: the row's current is the command."""
    if w_ref != p["w_run"] or abs(s["x"][0]) > p["goal"][0]:
        s["row"] = p["rows"]
    s["i_q_ref"] = fed_back(p, s, torque_step(p, s, s["i_q_ref"]))
    s["u"][0], s["u"][1], s["u"][2] = 0.0, s["i_q_ref"] * p["u_i"], 0.0


@jit
def given_current(p: Any, s: Any, i_q: float) -> float:
    """A reference current within i_max, and no more than may go back to the DC link."""
    return fed_back(p, s, min(max(i_q, -p["i_max"]), p["i_max"]))


@jit
def fed_back(p: Any, s: Any, i_q: float) -> float:
    """A row's current, no more than may go back to the DC link."""
    return limited_current(p, s, s["x"][0], i_q) if p["regen"] else i_q


@jit
def torque_step(p: Any, s: Any, before: float) -> float:
    """i_q* of the row, reached at its slew [A/tick]; the row ends at its speed, or after its ticks.

    A shaft that turns against the first row's torque by ``w_wrong`` gets no torque any more.
    """
    w, row = s["x"][0], s["row"]
    if row == 0 and p["row_q"][0] * w < -abs(p["row_q"][0]) * p["w_wrong"]:
        s["cut"], s["row"] = 1, p["rows"]
    if row < p["rows"] and s["row"] == row:
        q, until = p["row_q"][row], p["row_w"][row]
        reached = abs(w) <= until if q == 0.0 else (w >= until if q > 0.0 else w <= until)
        s["row_ticks"] += 1
        if reached or s["row_ticks"] > p["row_ticks"][row]:
            s["row"], s["row_ticks"] = row + 1, 0
    if s["cut"]:
        return 0.0
    if s["row"] >= p["rows"]:  # to rest: full torque down to a tenth of the speed, then in proportion
        return float(-p["i_brake"] * min(max(10.0 * w / p["goal"][0], -1.0), 1.0))
    most = p["row_slew"][s["row"]]
    return float(min(max(p["row_q"][s["row"]], before - most), before + most))


@jit
def pulse_law(p: Any, s: Any, over: bool) -> None:
    """u = row times level; a row whose current reaches 1.3 times its goal is cut short."""
    s["u"][1], s["u"][2] = 0.0, 0.0
    s["i_q_ref"] = 0.0
    if over or s["passes"] >= p["passes"] or s["row"] >= p["rows"]:
        s["passes"] = p["passes"]
        return
    for c in range(3):
        s["peak"][c] = max(s["peak"][c], abs(s["x"][c]))
        if c > 0 and abs(s["x"][c]) > 1.3 * p["goal"][c]:
            s["cut"] = 1
    if s["row_ticks"] >= p["row_ticks"][s["row"]]:
        s["row"], s["row_ticks"], s["cut"] = s["row"] + 1, 0, 0
        if s["row"] >= p["rows"]:
            end_pass(p, s)
            if s["passes"] >= p["passes"]:
                return
    s["row_ticks"] += 1
    for c in range(2):
        s["level"][c] = max(s["level"][c], p["u_start"])
    if s["cut"] == 0:
        s["u"][1] = p["row_q"][s["row"]] * s["level"][0]
        s["u"][2] = p["row_d"][s["row"]] * s["level"][1]


@jit
def end_pass(p: Any, s: Any) -> None:
    """Raise the levels to where the peaks come to 0.9 of their goals, at most fourfold; near it vary them.

    Levels that differ let the steps of the wire average out.
    """
    peak, goal, level = s["peak"], p["goal"], s["level"]
    for c in range(2):
        ratio = goal[1 + c] / max(peak[1 + c], 0.01 * goal[1 + c])
        if c == 0:  # torque turns the shaft
            ratio = min(ratio, 0.3 * goal[0] / max(peak[0], 0.003 * goal[0]))
        factor = 0.93 if 1.0 <= ratio < 1.6 else min(max(0.9 * ratio, 0.25), 4.0)
        level[c] = min(level[c] * factor, p["u_most"])
    for c in range(3):
        peak[c] = 0.0
    s["row"] = 0
    s["passes"] += 1


@jit
def to_circle(s: Any, u_limit: float) -> None:
    """Limit (u_q, u_d) to the voltage circle, u_d first: it keeps the field, u_q gets what is left."""
    s["u"][2] = min(max(s["u"][2], -u_limit), u_limit)
    rest = math.sqrt(u_limit * u_limit - s["u"][2] * s["u"][2])
    s["u"][1] = min(max(s["u"][1], -rest), rest)


@jit
def command(p: Any, s: Any, w_ref: float, dw_ref: float, i_q_ref: float, u_limit: float) -> None:
    """Compute s['u'] = (T_L, u_q, u_d) for the period after the one that :func:`apply` announced.

    w_ref, dw_ref are those of this tick; u_limit [V] is the radius of the voltage circle.
    """
    ask(p, s, w_ref, dw_ref, i_q_ref, u_limit)
    to_circle(s, u_limit)


@jit
def ask(p: Any, s: Any, w_ref: float, dw_ref: float, i_q_ref: float, u_limit: float) -> None:
    """:func:`command` before the voltage circle: s['u'] is what the law asks for."""
    if p["kind"] == SPEED and p["rows"] > 0:
        identify_speed(p, s, w_ref)
        return
    if p["kind"] == SPEED and p["pair"] == FOLLOWS:
        s["i_q_ref"] = given_current(p, s, i_q_ref)
        s["u"][0], s["u"][1], s["u"][2] = 0.0, s["i_q_ref"] * p["u_i"], 0.0
        return
    if p["kind"] == SPEED:
        ask_speed(p, s, w_ref, dw_ref)
        if p["pair"] == LEADS:
            share(p, s, given_current(p, s, i_q_ref))
        return
    look_ahead(p, s)
    if p["kind"] == FAC:
        fac_law(p, s, w_ref, dw_ref, i_q_ref)
    elif p["kind"] == PI:
        pi_law(p, s, w_ref, dw_ref, u_limit)
    elif p["kind"] == IDENTIFY:
        identify_law(p, s, w_ref)
    elif p["kind"] == MTPA:
        mtpa_law(p, s, w_ref, dw_ref, u_limit)
    else:
        change = slope_change(p, s, dw_ref)
        i_q = asked_current(p, s, w_ref, dw_ref, change)
        s["i_q_ref"] = limited_current(p, s, s["x_p"][0], i_q)
        current_law(p, s)
        if change != 0.0:
            lead_current(p, s, change, p["k_t"] / (1.5 * p["n_p"]))


@jit
def is_saturated(p: Any, s: Any, u_limit: float) -> bool:
    """True when what :func:`ask` asked for is on or past a limit: the circle, i_max, the torque, T_L_max."""
    u_q, u_d = s["u"][1], s["u"][2]
    if u_q * u_q + u_d * u_d >= u_limit * u_limit or abs(s["i_q_ref"]) >= p["i_max"]:
        return True
    if (p["kind"] == MTPA or p["regen"]) and s["capped"] != 0:
        return True
    return bool((p["kind"] == FAC or p["pair"] == LEADS) and abs(s["u"][0]) >= p["T_L_max"])
