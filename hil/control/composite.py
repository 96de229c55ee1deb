"""Composite control (19)-(21): u = u_b + u_k, and its gain by Theorem 2, continuous and sampled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.fac import SINGULAR, SampledModel
from hil.control.jit import jit
from hil.control.linalg import (
    Array,
    halvings_of,
    integral_exponential,
    inverse,
    matvec,
    matvec_add,
    product,
)


@dataclass(frozen=True, slots=True)
class CompositeGain:
    """Gains of a fully actuated system. ``Pi`` is (24); ``closed`` = Z e^{Upsilon T_s} Z^-1 (n, n)."""

    Pi: Array
    Pi_d: Array
    closed: Array
    Bd_inv: Array


def _check(B: Array, Upsilon: Array, Z: Array) -> tuple[Array, Array, Array]:
    """Conditions of Theorem 2: B square and invertible, Upsilon Hurwitz, det(Z) != 0."""
    B, Upsilon, Z = (np.array(m, float) for m in (B, Upsilon, Z))
    if not all(np.isfinite(m).all() for m in (B, Upsilon, Z)):
        raise ControlDesignError("B, Upsilon and Z must be finite; is a pole or a motor parameter missing?")
    if B.ndim != 2 or B.shape[0] != B.shape[1] or np.linalg.cond(B) > SINGULAR:
        raise ControlDesignError(f"B must be square and invertible (full actuation), not {B.tolist()}")
    if Upsilon.shape != B.shape or Z.shape != B.shape:
        raise ControlDesignError(f"Upsilon and Z must have the shape of B, {B.shape}")
    poles = np.linalg.eigvals(Upsilon)
    if not (poles.real < 0).all():
        raise ControlDesignError(f"Upsilon must be Hurwitz (Theorem 2, 1), but has the eigenvalues {poles}")
    if np.linalg.cond(Z) > SINGULAR:
        raise ControlDesignError("Z must be non-singular (Theorem 2, 2)")
    return B, Upsilon, Z


def continuous_gain(A: Array, B: Array, Upsilon: Array, Z: Array) -> Array:
    """Pi = B^-1 (Z Upsilon - A Z) Z^-1, eqs. (24)-(26)."""
    B, Upsilon, Z = _check(B, Upsilon, Z)
    return product(inverse(B), product(product(Z, Upsilon) - product(np.array(A, float), Z), inverse(Z)))


def composite_gain(model: SampledModel, Upsilon: Array, Z: Array) -> CompositeGain:
    """Sampled gain Pi_d = Bd^-1 (Z e^{Upsilon T_s} Z^-1 - Ad): closed loop e^{Upsilon T_s} exactly."""
    _, Upsilon, Z = _check(model.B, Upsilon, Z)
    decay, _ = integral_exponential(Upsilon, model.T_s, halvings_of(Upsilon, model.T_s))
    closed, Bd_inv = product(product(Z, decay), inverse(Z)), inverse(model.Bd)
    Pi_d = product(Bd_inv, closed - model.Ad)
    return CompositeGain(continuous_gain(model.A, model.B, Upsilon, Z), Pi_d, closed, Bd_inv)


@jit
def predict(Ad: Array, Bd: Array, Ed: Array, x: Array, ua: Array, d: Array, x_p: Array) -> None:
    """x_p = Ad x + Bd ua + Ed d: the state one tick on, under the input that acts now."""
    matvec(Ad, x, x_p)
    matvec_add(Bd, ua, x_p)
    matvec_add(Ed, d, x_p)


@jit
def composite_command(Pi_d: Array, B_inv: Array, x: Array, d_hat: Array, xi: Array, u: Array) -> None:
    """u = Pi_d x - B^-1 d_hat + xi, eqs. (19)-(21) in sampled form (Bd^-1 Ed = B^-1)."""
    matvec(Pi_d, x, u)
    for i in range(u.shape[0]):
        total = 0.0
        for j in range(d_hat.shape[0]):
            total += B_inv[i, j] * d_hat[j]
        u[i] = u[i] - total + xi[i]
