"""The drive laws `cascade` and `fac` out of the same parts, as kernels over two fixed-shape records.

State x = (w, i_q, i_d), input ua = (T_L, u_q, u_d) with B = diag(-1/J, 1/L_q, 1/L_d), one observer on the
joint state. A tick is :func:`observe` (advance the estimate by what was applied), :func:`command` (compute
from the state; the command acts one tick late) and :func:`apply` (tell what acts from now on).

Known nonlinear terms, added to the linear model through Ed:
    c = (1.5 n_p (L_d - L_q) i_d i_q / J,  -n_p w L_d i_d / L_q,  n_p w L_q i_q / L_d)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from hil.control.composite import composite_gain, predict
from hil.control.errors import ControlDesignError
from hil.control.fac import MAX_GAP, SampledModel, sample
from hil.control.jit import jit
from hil.control.linalg import Array, copy, matvec, matvec_add
from hil.control.observer import Window, conventional_dob, fill, ftdob, side_by_side, window_step

N_MAX: Final = 1024
"""Longest window D [ticks] that the record has room for."""

CASCADE: Final = 0
FAC: Final = 1

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
    ],
    align=True,
)

LAW_NEUTRAL: Final[dict[str, float]] = {}
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
    ],
    align=True,
)

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
    """One channel's window: FTDOB (gamma_1, gamma_2 [rad/s], D [s]) or conventional DOB (gamma_1)."""

    kind: Literal["ftdob", "dob"]
    gamma_1: float
    gamma_2: float = 0.0
    delay: float = 0.0

    def window(self, T_s: float) -> Window:
        """Design the window; raises ControlDesignError."""
        if self.kind == "dob":
            return conventional_dob(np.array([self.gamma_1]), T_s)
        return ftdob(np.array([self.gamma_1]), np.array([self.gamma_2]), self.delay, T_s)


@dataclass(frozen=True, slots=True)
class LawSpec:
    """Tuning of a drive law: poles [rad/s], windows, limits. Gains are derived, never given."""

    kind: Literal["cascade", "fac"]
    motor: MotorModel
    speed: ChannelSpec
    current: ChannelSpec
    speed_pole: float
    current_pole: float
    current_d_pole: float
    i_max: float
    T_L_max: float = 0.0
    coupling: bool = True


def sampled_model(motor: MotorModel, T_s: float) -> SampledModel:
    """Exact sampled form of the joint linear model."""
    return sample(motor.A(), motor.B(), T_s)


def law_window(spec: LawSpec, T_s: float) -> Window:
    """The joint window of the channels (w, q, d). Raises ControlDesignError, also for D over N_MAX ticks."""
    window = side_by_side(spec.speed.window(T_s), spec.current.window(T_s), spec.current.window(T_s))
    if window.N.max() >= N_MAX:
        raise ControlDesignError(
            f"D = {window.N.max()} ticks is longer than the {N_MAX - 1} kept; shorten D or lower the rate"
        )
    return window


def _check(spec: LawSpec) -> None:
    """Refuse a motor or limits that no law can be designed for."""
    m = spec.motor
    positive = {"R_s": m.R_s, "L_d": m.L_d, "L_q": m.L_q, "psi_f": m.psi_f, "n_p": m.n_p, "J": m.J}
    wrong = [name for name, value in (positive | {"i_max": spec.i_max}).items() if not value > 0]
    wrong += [name for name, value in {"B_f": m.B_f, "T_L_max": spec.T_L_max}.items() if not value >= 0]
    if wrong:
        raise ControlDesignError(f"{', '.join(wrong)} must be positive (B_f and T_L_max may be 0)")


def design_law(spec: LawSpec, T_s: float) -> Record:
    """Design a law: a one-element array of LAW_PARAMS. Raises ControlDesignError."""
    _check(spec)
    motor = spec.motor
    model, window = sampled_model(motor, T_s), law_window(spec, T_s)
    poles = (spec.speed_pole, spec.current_pole, spec.current_d_pole)
    gain = composite_gain(model, -np.diag(poles), np.eye(3))
    speed = sample(np.array([[-motor.B_f / motor.J]]), np.array([[motor.k_t / motor.J]]), T_s, 1)
    params = np.zeros(1, LAW_PARAMS)
    values = {
        "kind": FAC if spec.kind == "fac" else CASCADE,
        "coupling": int(spec.coupling),
        "Ad": model.Ad,
        "Bd": model.Bd,
        "Ed": model.Ed,
        "max_gap": len(model.gap_inverse),
        "lam": window.lam,
        "lam_N": window.lam_N,
        "theta": window.theta,
        "N": window.N,
        "closed": gain.closed,
        "Bd_inv": gain.Bd_inv,
        "T_s": T_s,
        "J": motor.J,
        "k_t": motor.k_t,
        "n_p": motor.n_p,
        "L_d": motor.L_d,
        "L_q": motor.L_q,
        "a_w": speed.Ad[0, 0],
        "e_w": speed.Ed[0, 0],
        "lam_w": math.exp(-spec.speed_pole * T_s),
        "lam_q": math.exp(-spec.current_pole * T_s),
        "lam_d": math.exp(-spec.current_d_pole * T_s),
        "i_max": spec.i_max,
        "T_L_max": spec.T_L_max,
    }
    for name, value in values.items():
        params[name] = value
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
    for c in range(3):
        s["d_hat"][c] = 0.0


@jit
def start(p: Any, s: Any) -> None:
    """Take the measurement in s['x'] as the beginning of the observer's first period."""
    copy(s["x"], s["x_open"])
    known_terms(p, s["x"], s["c"])
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
    for c in range(3):
        s["v"][c] -= 0.5 * (s["work"][c] - s["c"][c])


@jit
def observe(p: Any, s: Any, w: float, i_q: float, i_d: float, fresh: bool, periods: int) -> None:
    """Advance the observer by the past ``periods`` ticks, in which s['ua'] was applied.

    Without a fresh measurement only the gap grows; the next one then makes up for all of it exactly. The
    memory starts filled with the first innovation (bumpless). A gap over max_gap ticks starts anew, and so
    does a count below 1: there is no such period, and no gap inverse that could be read for it.
    """
    if s["started"]:
        for _ in range(min(periods, p["max_gap"] + 1)):
            open_loop(p, s)
        s["gap"] += periods
        if periods < 1 or s["gap"] > p["max_gap"]:
            reset(s)
    if not fresh:
        return
    s["x"][0], s["x"][1], s["x"][2] = w, i_q, i_d
    if not s["started"]:
        start(p, s)
        return
    innovate(p, s)
    if s["filled"] == 0:
        fill(s["v"], s["h"], s["past"])
    for _ in range(s["gap"]):
        s["head"] = window_step(
            p["lam"], p["lam_N"], p["theta"], p["N"], s["v"], s["h"], s["past"], s["head"], s["d_hat"]
        )
    s["filled"] = min(s["filled"] + s["gap"], max(p["N"][0], p["N"][1], p["N"][2]))
    start(p, s)


@jit
def apply(s: Any, T_L: float, u_q: float, u_d: float) -> None:
    """Tell what is really applied over the period that begins now."""
    s["ua"][0], s["ua"][1], s["ua"][2] = T_L, u_q, u_d


@jit
def look_ahead(p: Any, s: Any) -> None:
    """x_p: the state one tick on under the input that acts now; d_p = d_hat + c(x_p)."""
    for c in range(3):
        s["d_p"][c] = s["d_hat"][c] + s["c"][c]
    predict(p["Ad"], p["Bd"], p["Ed"], s["x"], s["ua"], s["d_p"], s["x_p"])
    known_terms(p, s["x_p"], s["work"])
    for c in range(3):
        s["d_p"][c] = s["d_hat"][c] + s["work"][c]


@jit
def speed_law(p: Any, s: Any, w_ref: float, dw_ref: float) -> float:
    """i_q* that moves the speed error by e^{-p_w T_s} a tick, compensates d_hat_w, limited to i_max.

    w+ = a_w w + e_w (k_t i_q / J + d);  i_q* = J / (k_t e_w) (w*+ + lam (w - w*) - a_w w - e_w d)
    """
    target = w_ref + p["T_s"] * dw_ref
    wanted = target + p["T_s"] * dw_ref + p["lam_w"] * (s["x_p"][0] - target)
    drift = p["a_w"] * s["x_p"][0] + p["e_w"] * s["d_p"][0]
    i_q_ref = p["J"] * (wanted - drift) / (p["k_t"] * p["e_w"])
    return float(min(max(i_q_ref, -p["i_max"]), p["i_max"]))


@jit
def free_response(p: Any, s: Any) -> None:
    """work = Ad x_p + Ed d_p: the state two ticks on if nothing were applied in the second."""
    matvec(p["Ad"], s["x_p"], s["work"])
    matvec_add(p["Ed"], s["d_p"], s["work"])


@jit
def current_law(p: Any, s: Any) -> None:
    """u_q, u_d that move the current errors by e^{-p_q T_s} and e^{-p_d T_s} a tick; i_d* = 0."""
    free_response(p, s)
    q_wanted = s["i_q_ref"] + p["lam_q"] * (s["x_p"][1] - s["i_q_ref"])
    d_wanted = p["lam_d"] * s["x_p"][2]
    s["u"][0] = 0.0
    s["u"][1] = (q_wanted - s["work"][1]) / p["Bd"][1, 1]
    s["u"][2] = (d_wanted - s["work"][2]) / p["Bd"][2, 2]


@jit
def fac_law(p: Any, s: Any, w_ref: float, dw_ref: float, i_q_ref: float) -> None:
    """u = Bd^-1 (x* + Z e^{Upsilon T_s} Z^-1 (x_p - x*) - Ad x_p - Ed d_p), x* = (w*, i_q*, 0).

    i_q* is limited to i_max, T_L to T_L_max.
    """
    free_response(p, s)
    i_q_ref = min(max(i_q_ref, -p["i_max"]), p["i_max"])
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
    look_ahead(p, s)
    if p["kind"] == FAC:
        fac_law(p, s, w_ref, dw_ref, i_q_ref)
    else:
        s["i_q_ref"] = speed_law(p, s, w_ref, dw_ref)
        current_law(p, s)
    to_circle(s, u_limit)
