"""The linear closed loop that laws are tuned on: the very kernels of the tick against exact sampled plants.

About i_d = 0, without limits and rounding, one tick late. A law is a record of LAW_PARAMS, so whatever is
registered can be tuned; nothing of it is written down twice. `hil simulate` is the judge of what comes out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from hil.control.jit import jit
from hil.control.law import MotorModel, apply, command, observe, reset
from hil.control.linalg import Array

Record = npt.NDArray[np.void]
LOAD, PULSE_W, PULSE_I, PULSE_U, PULSE_TH = range(5)
"""What disturbs the loop: a unit step of the load, a unit pulse on a measurement or on the voltage;
the last of a law that follows an angle."""
QUIET: Final = 3
"""Ticks at rest before it, at least: the observer's memory is filled by then."""
NO_LIMIT: Final = 1e300
SETTLED: Final = 6
"""Windows, of 50 ticks at least, after which a turning motor is at rest but for that."""
SMALL: Final = (0.1, 0.01, 0.01, 0.1, 0.1)
"""Pulses of :func:`respond_turning` [rad/s, A, A, V, V]."""

KICK: Final = 0.01
"""Start of :func:`vibrate` [rad/s]."""
GROWN: Final = 100.0
"""Kicks at which its loop counts as unstable."""


@dataclass(frozen=True, slots=True)
class Plant:
    """x+ = A x + b u + e T_L, y = C x, x = (w, i_q, ...): A (n, n), b, e, C (n,); y is what is told of w."""

    A: Array
    b: Array
    e: Array
    C: Array


def sampled(A: Array, B: Array, T_s: float, C: Array | None = None) -> Plant:
    """Exact for u and T_L held over a tick; B (n, 2); y = w where no C is given."""
    n = len(A)
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n:] = A, B
    step = expm(whole * T_s)
    parts = step[:n, :n], step[:n, n], step[:n, n + 1], np.eye(n)[0] if C is None else C
    return Plant(*(np.ascontiguousarray(part) for part in parts))


def one_mass(motor: MotorModel) -> tuple[Array, Array]:
    """A (2, 2) of (w, i_q), and what a load torque does to it (2,)."""
    return motor.A()[:2, :2], np.array([-1 / motor.J, 0.0])


def two_masses(
    motor: MotorModel, hz: float, damping: float = 0.01, share: float = 0.5, brake: bool = False
) -> tuple[Array, Array]:
    """A (4, 4) and the load's effect (4,): two inertias on an elastic shaft.

    Resonance [Hz], its damping, the motor's share of J; x = (w, i_q, torsion, w_load);
    k = w_r^2 J_m J_l / J, c = 2 damping k / w_r. A load acts behind the shaft, a ``brake`` on the motor.
    """
    J_m, J_l, w_r = motor.J * share, motor.J * (1 - share), 2 * np.pi * hz
    k = w_r**2 * J_m * J_l / motor.J
    c = 2 * damping * k / w_r
    A = np.zeros((4, 4))
    A[0] = -(c + motor.B_f) / J_m, motor.k_t / J_m, -k / J_m, c / J_m
    A[1, :2] = motor.A()[1, :2]
    A[2] = 1, 0, 0, -1
    A[3] = c / J_l, 0, k / J_l, -c / J_l
    return A, np.array([-1 / J_m, 0.0, 0.0, 0.0] if brake else [0.0, 0.0, 0.0, -1 / J_l])


def rigid(motor: MotorModel, T_s: float) -> Plant:
    """Motor and load as one inertia."""
    return _by_voltage(motor, T_s, *one_mass(motor))


def shaft(
    motor: MotorModel, T_s: float, hz: float, damping: float = 0.01, share: float = 0.5, brake: bool = False
) -> Plant:
    """Motor and load on an elastic shaft (:func:`two_masses`)."""
    return _by_voltage(motor, T_s, *two_masses(motor, hz, damping, share, brake))


def _by_voltage(motor: MotorModel, T_s: float, A: Array, load: Array) -> Plant:
    """u is the q voltage."""
    return sampled(A, np.column_stack([np.eye(len(A))[1] / motor.L_q, load]), T_s)


@jit
def step(A: Array, b: Array, e: Array, u: float, load: float, x: Array, new: Array) -> None:
    """x+ = A x + b u + e load, in place; ``new`` (n,) is room for it."""
    n = len(x)
    for r in range(n):
        total = b[r] * u + e[r] * load
        for c in range(n):
            total += A[r, c] * x[c]
        new[r] = total
    x[:] = new


@jit
def respond(p: Any, s: Any, A: Array, b: Array, e: Array, kind: int, out: Array) -> None:
    """The loop's response from rest; ``out`` (4, K): command, voltage, w, i_q from the disturbance on."""
    n, K = A.shape[0], out.shape[1]
    x, new = np.zeros(n), np.zeros(n)
    reset(s)
    apply(s, 0.0, 0.0, 0.0)
    u = 0.0
    rest = QUIET
    for c in range(3):
        if p["short"][c] > 0:  # an adaptive window is to be at its full length
            rest = max(rest, p["N"][c] + QUIET)
    for k in range(-rest, K):
        ua = u
        w = x[0] + (1.0 if kind == PULSE_W and k == 0 else 0.0)
        i_q = x[1] + (1.0 if kind == PULSE_I and k == 0 else 0.0)
        observe(p, s, w, i_q, 0.0, True, 1)
        apply(s, 0.0, ua, 0.0)
        command(p, s, 0.0, 0.0, 0.0, NO_LIMIT)
        u = s["u"][1]
        given = ua + (1.0 if kind == PULSE_U and k == 0 else 0.0)
        load = 1.0 if kind == LOAD and k >= 0 else 0.0
        if k >= 0:
            out[0, k], out[1, k], out[2, k], out[3, k] = u, given, x[0], x[1]
        step(A, b, e, given, load, x, new)


@jit
def respond_all(p: Any, s: Any, A: Array, b: Array, e: Array, kinds: Any, out: Array) -> None:
    """:func:`respond` for every plant and kind; A (m, n, n), out (m, kinds, 4, K)."""
    for m in range(A.shape[0]):
        for j in range(kinds.shape[0]):
            respond(p, s, A[m], b[m], e[m], kinds[j], out[m, j])


def turning(motor: MotorModel, T_s: float, w: float, mechanics: Array, load: Array) -> tuple[Array, Array]:
    """A (n, n), B (n, 4) of (dw, i_q, ..., i_d) about the speed w: x+ = A x + B (u_q, u_d, 1, T_L).

    ``mechanics``, ``load`` are those of :func:`one_mass` or :func:`two_masses`; with omega = n_p w the axes
    are coupled by
        L_q di_q/dt = u_q - .. - omega (L_d i_d + psi_f),  L_d di_d/dt = u_d - R_s i_d + omega L_q i_q
    """
    n, omega = len(mechanics) + 1, motor.n_p * w
    whole = np.zeros((n + 4, n + 4))
    whole[: n - 1, : n - 1], whole[: n - 1, n + 3] = mechanics, load
    whole[1, n - 1], whole[1, n], whole[1, n + 2] = (
        np.array([-omega * motor.L_d, 1, -omega * motor.psi_f]) / motor.L_q
    )
    whole[n - 1, 1], whole[n - 1, n - 1], whole[n - 1, n + 1] = (
        np.array([omega * motor.L_q, -motor.R_s, 1]) / motor.L_d
    )
    step = expm(whole * T_s)
    return np.ascontiguousarray(step[:n, :n]), np.ascontiguousarray(step[:n, n:])


@jit
def move(A: Array, B: Array, u_q: float, u_d: float, rest: float, x: Array, new: Array) -> None:
    """x+ = A x + B (u_q, u_d, rest), in place; ``new`` (n,) is room for it."""
    n = len(x)
    for r in range(n):
        total = B[r, 0] * u_q + B[r, 1] * u_d + B[r, 2] * rest
        for c in range(n):
            total += A[r, c] * x[c]
        new[r] = total
    x[:] = new


@jit
def respond_turning(p: Any, s: Any, A: Array, B: Array, w: float, settles: bool, out: Array) -> None:
    """u_q, dw and i_d after pulses on w, i_q, i_d, u_q, u_d, one after the other; ``out`` (5, 3, K) per unit.

    The motor runs at w (:func:`turning`), so law and motor couple the axes. The pulses are so small that this
    is as good as linear; what the loop does without them is taken off: where it ``settles``, as with the
    motor that the law believes in, the rest that it has come to, else (a shaft rings) tick by tick.
    """
    n, K = A.shape[0], out.shape[2]
    x, new = np.empty(n), np.empty(n)
    rest = SETTLED * max(p["N"][0], p["N"][1], 50)
    for size in range(1 if settles else 0, 2):
        reset(s)
        x[:] = 0.0
        u_q, u_d = -B[1, 2] / B[1, 0], 0.0  # against the back-EMF
        apply(s, 0.0, u_q, u_d)
        for k in range(-rest, 5 * K):
            kind, at = k // K, k % K
            pulse = size * SMALL[kind] if k >= 0 and at == 0 else 0.0
            on_w, on_q, on_d = pulse * (kind == 0), pulse * (kind == 1), pulse * (kind == 2)
            observe(p, s, w + x[0] + on_w, x[1] + on_q, x[n - 1] + on_d, True, 1)
            apply(s, 0.0, u_q, u_d)
            command(p, s, w, 0.0, 0.0, NO_LIMIT)
            if k == -1 and settles:
                out[:, 0], out[:, 1], out[:, 2] = s["u"][1], x[0], x[n - 1]
            if k >= 0 and size == 0:
                out[kind, 0, at], out[kind, 1, at], out[kind, 2, at] = s["u"][1], x[0], x[n - 1]
            elif k >= 0:
                out[kind, 0, at] = (s["u"][1] - out[kind, 0, at]) / SMALL[kind]
                out[kind, 1, at] = (x[0] - out[kind, 1, at]) / SMALL[kind]
                out[kind, 2, at] = (x[n - 1] - out[kind, 2, at]) / SMALL[kind]
            q, d = u_q + pulse * (kind == 3), u_d + pulse * (kind == 4)
            move(A, B, q, d, 1.0, x, new)
            u_q, u_d = s["u"][1], s["u"][2]


@jit
def run_noisy(p: Any, s: Any, A: Array, B: Array, w: float, noise: Array, lsb: float, out: Array) -> None:
    """u_q (K,) of a motor that runs at w (:func:`turning`), the last K ticks under ``noise`` (ticks, 5).

    That is of w, i_q, i_d as measured and of u_q, u_d as they act; i_d is then rounded to multiples of lsb.
    """
    n, first = A.shape[0], len(noise) - len(out)
    x, new = np.zeros(n), np.empty(n)
    reset(s)
    u_q, u_d = -B[1, 2] / B[1, 0], 0.0  # against the back-EMF
    apply(s, 0.0, u_q, u_d)
    for k in range(len(noise)):
        on = noise[k]
        i_d = np.rint((x[n - 1] + on[2]) / lsb) * lsb
        observe(p, s, w + x[0] + on[0], x[1] + on[1], i_d, True, 1)
        apply(s, 0.0, u_q, u_d)
        command(p, s, w, 0.0, 0.0, NO_LIMIT)
        if k >= first:
            out[k - first] = s["u"][1]
        move(A, B, u_q + on[3], u_d + on[4], 1.0, x, new)
        u_q, u_d = s["u"][1], s["u"][2]


@jit
def respond_loaded(p: Any, s: Any, A: Array, B: Array, w: float, load: float, out: Array) -> None:
    """dw (K,) after a step of the load [N m] on a motor that runs at w (:func:`turning`), axes coupled.

    What the loop does without it (a shaft rings, a motor that is off) is taken off tick by tick.
    """
    n, rest = A.shape[0], SETTLED * max(p["N"][0], p["N"][1], 50)
    x, new = np.empty(n), np.empty(n)
    for size in range(2):
        reset(s)
        x[:] = 0.0
        u_q, u_d = -B[1, 2] / B[1, 0], 0.0  # against the back-EMF
        apply(s, 0.0, u_q, u_d)
        for k in range(-rest, len(out)):
            observe(p, s, w + x[0], x[1], x[n - 1], True, 1)
            apply(s, 0.0, u_q, u_d)
            command(p, s, w, 0.0, 0.0, NO_LIMIT)
            if k >= 0:
                out[k] = x[0] - (out[k] if size else 0.0)
            move(A, B, u_q, u_d, 1.0, x, new)
            if size and k >= 0:
                for r in range(n):
                    x[r] += B[r, 3] * load
            u_q, u_d = s["u"][1], s["u"][2]


@jit
def vibrate(p: Any, s: Any, A: Array, B: Array, w: float, emf: float, out: Array) -> None:
    """dw from a start KICK off the speed w on, with the axes coupled (:func:`turning`); inf once it grew.

    What back-EMF the law does not know, a constant voltage, is left out: it would be the larger kick by far,
    and the loop is as good as linear for small ones alone. ``emf`` [V] is that which it knows.
    """
    n = A.shape[0]
    x, new = np.zeros(n), np.empty(n)
    reset(s)
    x[0] = KICK
    u_q, u_d = emf, 0.0
    apply(s, 0.0, u_q, u_d)
    for k in range(len(out)):
        out[k] = x[0]
        if not abs(x[0]) < GROWN * KICK:
            out[k:] = np.inf
            return
        observe(p, s, w + x[0], x[1], x[n - 1], True, 1)
        apply(s, 0.0, u_q, u_d)
        command(p, s, w, 0.0, 0.0, NO_LIMIT)
        move(A, B, u_q - emf, u_d, 0.0, x, new)
        u_q, u_d = s["u"][1], s["u"][2]


@jit
def vibrate_all(p: Any, s: Any, A: Array, B: Array, w: float, emf: float, out: Array) -> None:
    """:func:`vibrate` of every plant; A (m, n, n), B (m, n, 3), out (m, K)."""
    for m in range(len(A)):
        vibrate(p, s, A[m], B[m], w, emf, out[m])


@jit
def count_alarms(p: Any, s: Any, x: Array) -> int:
    """How often the adaptive windows of a motor at rest become shorter; x (K, 3): its measured state."""
    count = 0
    length = np.zeros(3, np.int64)
    for k in range(x.shape[0]):
        observe(p, s, x[k, 0], x[k, 1], x[k, 2], True, 1)
        for c in range(3):
            if s["length"][c] < length[c]:
                count += 1
            length[c] = s["length"][c]
    return count
