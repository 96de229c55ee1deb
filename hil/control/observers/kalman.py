"""Steady-state Kalman filter for x and a d that walks at random, on the joint model; both channels or none.

    x+ = Ad x + Bd ua + Ed d,  d+ = d + n,  y = x + m,  std(n) = d_walk T_s a tick,  std(m) = x_noise
By its gains L1 (of x), L2 (of d), and rho = Ed^-1 (y - x_prediction):
    rho_k = M rho_{k-1} + v_k - d_hat_{k-1},  d_hat_k = d_hat_{k-1} + W rho_k,  x_hat = x - S rho
    M = Ed^-1 Ad (I - L1) Ed,   W = L2 Ed,   S = (I - L1) Ed
With ``filtered_state`` the law takes x_hat (LQG as in the books), else the measured x.
"""

from __future__ import annotations

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.fac import SampledModel
from hil.control.linalg import Array, inverse, product, riccati
from hil.control.observer import Window, linear_filter
from hil.control.registry import Key, Observer, Values


def gains(Ad: Array, Ed: Array, walk: Array, noise: Array) -> tuple[Array, Array]:
    """L1, L2 (n, n) of the filter for n states. Raises ControlDesignError."""
    n = len(noise)
    F = np.block([[Ad, Ed], [np.zeros((n, n)), np.eye(n)]])
    scale = np.r_[noise, np.maximum(walk, 1e-12)]  # of order one: walk and noise may differ by 1e6
    F, C = F * scale[None, :] / scale[:, None], np.eye(n, 2 * n) * scale[None, :] / noise[:, None]
    Q = np.diag(np.r_[np.full(n, 1e-12), np.ones(n)])
    across = np.ascontiguousarray(C.T)
    with np.errstate(all="ignore"):  # what does not converge overflows
        P = riccati(F.T, product(across, C), Q)
    if not np.isfinite(P).all():
        raise ControlDesignError("no Kalman filter for these; change d_walk_per_s")
    PC = product(P, across)
    L = scale[:, None] * product(PC, inverse(product(C, PC) + np.eye(n))) / noise[None, :]
    return L[:n], L[n:]


def joint(speed: Values, current: Values, model: SampledModel) -> Window:
    """The filter of (w, i_q) and that of i_d, which nothing couples to them. Raises ControlDesignError."""
    from scipy.linalg import block_diag  # loads as long as numpy

    walk = np.array([t["d_walk_per_s"] * model.T_s for t in (speed, current)])
    noise = np.array([t["x_noise"] for t in (speed, current)])
    one = gains(model.Ad[:2, :2], model.Ed[:2, :2], walk, noise)
    other = gains(model.Ad[2:, 2:], model.Ed[2:, 2:], walk[1:], noise[1:])
    L1, L2 = (block_diag(a, b) for a, b in zip(one, other, strict=True))
    S = product(np.eye(3) - L1, model.Ed)
    M = product(product(model.gap_inverse[0], model.Ad), S)
    return linear_filter(M, product(L2, model.Ed), S if speed["filtered_state"] else None)


MEMBER = Observer(
    "kalman",
    "steady-state Kalman filter, d a random walk",
    {
        "d_walk_per_s": Key("random walk of d: standard deviation a tick / T_s", unit="rad/s^3 or A/s^2"),
        "x_noise": Key("noise of the measured state, resolution included", unit="rad/s or A"),
        "filtered_state": Key("the law takes x_hat (the speed table says it)", False, "flag"),
    },
    joint=joint,
)
