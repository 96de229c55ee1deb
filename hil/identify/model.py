"""The exact sampled motor as an output-error predictor: speed and currents from known voltages.

State x = (w, i_q, i_d) under a voltage that is constant over a period, T_c the Coulomb friction:
    J dw/dt     = 1.5 n_p (psi_f + (L_d - L_q) i_d) i_q - B_f w - T_c sgn(w) - T_0
    L_q di_q/dt = u_q - R_s i_q - n_p w (L_d i_d + psi_f)
    L_d di_d/dt = u_d - R_s i_d + n_p w L_q i_q
In the products the measured w and i_d stand, their mean over the period; all else is simulated, so that the
back-EMF carries no noise of the speed. Where L_q saturates, i_q = phi + SATURATION phi^3, phi = psi_q / L_q:
in di_q/dt stands the secant of psi_q between the measured ends of the period, for psi_q their chord times the
simulated i_q. That is linear in where a segment starts: each sample is a forced response and one column for
each start. Where the shaft may stick, each period has the constant load that brings the speed to the measured
one: between its ends the speed is that of the torque.

On a soft coupling J = J_m + J_l, RATIO = J_l / J_m, and x = (w, i_q, i_d, q, w_l), q = w_r times the twist,
with the resonance w_r and its damping ratio z:
    J_m dw/dt = .. - T_k,  J_l dw_l/dt = T_k,  dq/dt = w_r (w - w_l),  T_k = J_e (w_r q + 2 z w_r (w - w_l))
J_e = J_m J_l / J. Friction acts on the motor; a constant load behind the coupling only twists it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from hil.control.jit import jit
from hil.control.linalg import Array

Flags = npt.NDArray[np.bool_]
TERMS: Final = 8
R_S, L_D, L_Q, PSI_F, J, B_F, COULOMB, LOAD, SATURATION, N_P, RESONANCE, DAMPING, RATIO = range(13)
"""Places of the parameters in the model's vector; the last three are read on a soft coupling alone."""
RIGID: Final = 3
"""States of a rigid shaft; on a soft coupling there are two more."""


@jit
def product(a: Array, b: Array, out: Array) -> None:
    """out = a b, n by n; out is neither."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            total = a[i, 0] * b[0, j]
            for k in range(1, n):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@jit
def sampled(A: Array, T: float, E: Array, I: Array, work: Array) -> None:  # noqa: E741
    """E = e^{A T}, I = int_0^T e^{A s} ds, as :func:`hil.control.linalg.integral_exponential`, in place."""
    norm, size = 0.0, A.shape[0]
    for i in range(size):
        row = abs(A[i, 0])
        for j in range(1, size):
            row += abs(A[i, j])
        norm = max(norm, row)
    halvings = max(0, math.frexp(norm * T)[1] + 1)
    h = T / 2.0**halvings
    I[:, :] = 0.0
    for k in range(TERMS, 0, -1):
        product(A, I, work)
        for i in range(size):
            for j in range(size):
                I[i, j] = work[i, j] * h / (k + 1.0)
            I[i, i] += 1.0
    for i in range(size):
        for j in range(size):
            I[i, j] *= h
    for n in range(halvings + 1):
        product(A, I, E)
        for i in range(size):
            E[i, i] += 1.0
        if n < halvings:
            product(E, I, work)
            for i in range(size):
                for j in range(size):
                    I[i, j] += work[i, j]


@jit
def unsaturated(i: float, saturation: float) -> float:
    """phi [A] of i = phi + saturation phi^3, in closed form."""
    if saturation == 0.0:
        return i
    root = math.sqrt(saturation)
    y = 1.5 * math.sqrt(3.0) * root * i
    return 2.0 / math.sqrt(3.0) * math.sinh(math.asinh(y) / 3.0) / root


@jit
def inductances(p: Array, before: float, after: float) -> tuple[float, float]:
    """Secant and chord of psi_q over i_q [H] in a period between two measured i_q."""
    s = p[SATURATION]
    if s == 0.0:
        return p[L_Q], p[L_Q]
    a, b = unsaturated(before, s), unsaturated(after, s)
    secant = p[L_Q] / (1.0 + s * (a * a + a * b + b * b))
    middle = 0.5 * (a + b)
    return secant, p[L_Q] / (1.0 + s * middle * middle)


@jit
def fill_matrix(p: Array, w: float, i_d: float, L: tuple[float, float], A: Array) -> None:
    """A (n, n) at the speed and the i_d of a period. ``L``: of psi_q."""
    n_p, (L_q, chord), J_m = p[N_P], L, p[J] / (1.0 + p[RATIO])
    A[0, 0] = -p[B_F] / J_m
    A[0, 1] = 1.5 * n_p * (p[PSI_F] + (p[L_D] - chord) * i_d) / J_m
    A[1, 0], A[1, 1], A[1, 2] = -n_p * p[PSI_F] / L_q, -p[R_S] / L_q, -n_p * w * p[L_D] / L_q
    A[2, 1], A[2, 2] = n_p * w * chord / p[L_D], -p[R_S] / p[L_D]
    if A.shape[0] > RIGID:
        r, w_r = p[RATIO], p[RESONANCE]
        own, behind = w_r * r / (1.0 + r), w_r / (1.0 + r)  # J_e w_r over J_m and J_l
        damped = 2.0 * p[DAMPING]
        A[0, 0] -= damped * own
        A[0, 3], A[0, 4] = -own, damped * own
        A[3, 0], A[3, 4] = w_r, -w_r
        A[4, 0], A[4, 3], A[4, 4] = damped * behind, behind, -damped * behind


@jit
def begin(w: float, free: bool, z: Array) -> None:
    """Columns of a segment's first sample: forced, then from each start; a given speed needs no start."""
    z[:, :] = 0.0
    z[0, 0] = 0.0 if free else w
    z[1, 0] = 1.0 if free else 0.0
    z[2, 1], z[3, 2] = 1.0, 1.0
    for i in range(RIGID, z.shape[1]):
        z[i + 1, i] = 1.0


@jit
def responses(p: Array, T: float, y: Array, u: Array, begins: Flags, free: Flags, z: Array) -> None:
    """Fill z (N, n + 1, n): forced response and those from w, i_q, i_d = 1 and so on; n = 3: a rigid shaft.

    y (N, 3): measured w, i_q, i_d; u (N, 2): (u_q, u_d) over the past period; begins: where segments start;
    free: where the speed is simulated.
    """
    A, E, I, work = np.zeros((4, z.shape[2], z.shape[2]))  # noqa: E741
    c, J_m = np.zeros(3), p[J] / (1.0 + p[RATIO])
    for k in range(y.shape[0]):
        if begins[k]:
            begin(y[k, 0], free[k], z[k])
            continue
        w, i_d = 0.5 * (y[k - 1, 0] + y[k, 0]), 0.5 * (y[k - 1, 2] + y[k, 2])
        L = inductances(p, y[k - 1, 1], y[k, 1])
        way = 1.0 if w > 0.0 else -1.0
        c[0] = -(p[COULOMB] * way + p[LOAD]) / J_m if free[k] else 0.0
        c[1], c[2] = u[k, 0] / L[0], u[k, 1] / p[L_D]
        fill_matrix(p, w, i_d, L, A)
        sampled(A, T, E, I, work)
        advance(E, I, c, z[k - 1], z[k])
        if not free[k]:  # by the load that brings the speed to the measured one
            for n in range(z.shape[1]):
                load = ((y[k, 0] if n == 0 else 0.0) - z[k, n, 0]) / I[0, 0]
                for i in range(z.shape[2]):
                    z[k, n, i] += I[i, 0] * load


@jit
def advance(E: Array, I: Array, c: Array, before: Array, after: Array) -> None:  # noqa: E741
    """Move the columns (n + 1, n) of a sample on by a period; c (3,): what is added to dw/dt and di/dt."""
    size = E.shape[0]
    for i in range(size):
        for n in range(size + 1):
            total = E[i, 0] * before[n, 0]
            for j in range(1, size):
                total += E[i, j] * before[n, j]
            after[n, i] = total
        after[0, i] += I[i, 0] * c[0] + I[i, 1] * c[1] + I[i, 2] * c[2]


@jit
def solve(a: Array, b: Array) -> None:
    """b <- a^-1 b for a symmetric a (n, n); a start that nothing depends on stays 0."""
    size = b.shape[0]
    for c in range(size):
        if a[c, c] < 1e-12:
            a[c, :] = 0.0
            a[:, c] = 0.0
            a[c, c], b[c] = 1.0, 0.0
        for i in range(c + 1, size):
            share = a[i, c] / a[c, c]
            for j in range(c, size):
                a[i, j] -= share * a[c, j]
            b[i] -= share * b[c]
    for c in range(size - 1, -1, -1):
        for j in range(c + 1, size):
            b[c] -= a[c, j] * b[j]
        b[c] /= a[c, c]


@jit
def outputs(y: Array, z: Array, begins: Flags, weight: Array, out: Array) -> None:
    """out (N, 3): every segment from the start that fits y best, weighted by weight (3,)."""
    size, N, k = z.shape[2], y.shape[0], 0
    a, b = np.zeros((size, size)), np.zeros(size)
    while k < N:
        end = k + 1
        while end < N and not begins[end]:
            end += 1
        a[:, :], b[:] = 0.0, 0.0
        for j in range(k, end):
            for i in range(3):
                g = weight[i] * weight[i]
                for n in range(size):
                    b[n] += g * z[j, n + 1, i] * (y[j, i] - z[j, 0, i])
                    for m in range(size):
                        a[n, m] += g * z[j, n + 1, i] * z[j, m + 1, i]
        solve(a, b)
        for j in range(k, end):
            for i in range(3):
                total = z[j, 0, i]
                for n in range(size):
                    total += b[n] * z[j, n + 1, i]
                out[j, i] = total
        k = end
