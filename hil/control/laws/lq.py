"""Linear-quadratic state feedback on (w, i_q) by the sampled model, run as a cascade with the same two gains.

K = dlqr(Ad, Bd, diag(Q_w, Q_i), 1) for u_q = -K_w e_w - K_i e_i. The cascade is linear in both errors too, so
    lam_q = Ad_qq - Bd_qq K_i,   lam_w = a_w - F k_t e_w / J,   F = (Bd_qq K_w - Ad_qw) / (1 - lam_q)
give exactly K, and i_q* keeps its limit. The state is the predicted one: optimal with one tick of delay.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.control.errors import ControlDesignError
from hil.control.fac import sample
from hil.control.linalg import Array, product, riccati, solve
from hil.control.registry import Key, Law, Plan, Values


def lq_gain(A: Array, B: Array, weights: Array) -> Array:
    """K (1, n) of least sum x' diag(weights) x + u^2; B (n, 1). Raises ControlDesignError."""
    A, B = (np.ascontiguousarray(m) for m in (A, B))
    across = np.ascontiguousarray(B.T)
    with np.errstate(all="ignore"):  # what does not converge overflows
        P = riccati(A, product(B, across), np.diag(weights))
    if not np.isfinite(P).all():
        raise ControlDesignError(f"no LQ gain for the weights {weights}; change them")
    PB = product(P, B)
    K: Array = solve(np.eye(1) + product(across, PB), product(np.ascontiguousarray(PB.T), A))
    return K


def design(values: Values, plan: Plan) -> dict[str, Any]:
    """The cascade's factors that make K. Raises ControlDesignError."""
    Ad, B, motor = plan.model.Ad, plan.model.Bd[:2, 1:2], plan.motor
    weights = np.array([values["speed_weight"], values["current_weight"]])
    K_w, K_i = lq_gain(Ad[:2, :2], B, weights)[0]
    speed = sample(np.array([[-motor.B_f / motor.J]]), np.eye(1), plan.T_s, 1)
    lam_q = Ad[1, 1] - B[1, 0] * K_i
    F = (B[1, 0] * K_w - Ad[1, 0]) / (1 - lam_q)
    K_d = lq_gain(Ad[2:, 2:], plan.model.Bd[2:, 2:], weights[1:])[0, 0]
    return {
        "lam_w": speed.Ad[0, 0] - F * motor.k_t * speed.Ed[0, 0] / motor.J,
        "lam_q": lam_q,
        "lam_d": Ad[2, 2] - plan.model.Bd[2, 2] * K_d,
    }


MEMBER = Law(
    "lq",
    "linear-quadratic state feedback, disturbance compensated",
    0,
    design,
    {
        "speed_weight": Key("weight of the speed error squared; that of u_q^2 is 1", unit="V^2 s^2/rad^2"),
        "current_weight": Key(
            "weight of the current error squared", 1e-3, above=None, least=0.0, unit="V^2/A^2"
        ),
    },
)
