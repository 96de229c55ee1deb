"""The angle on top of the law ``speed``: an angle over turns, and two poles in place of the speed's one.

What is measured is an angle within a turn, or one that counts on until its counter begins anew. From one
measurement to the next the shaft has turned by about the mean of the two speeds; what else the angle moved is
whole turns or a round of the counter, or the encoder jumped:
    theta = theta_measured + 2 pi turns + span rounds
A sum of whole numbers of turns loses nothing over hours. The law is that of :mod:`hil.control.speed` with
    theta+ = theta + t_w w + t_i i + t_u u + t_d d
beside it. Of (theta, w, i) the combinations that the inner loop's own mode is no part of are
    phi = theta + kappa_t i,  sigma = w + kappa i,   kappa_t = (t_i - t_w kappa) / (1 - l)
    phi+ = phi + t_w sigma + g_t u + ..,   sigma+ = a sigma + g u + ..,   g_t = t_u + kappa_t (1 - l)
and sigma+ = sigma*+ + m (sigma - sigma*) - k (phi - phi*) has the eigenvalues l_1, l_2 for
    k = (1 - l_1) (1 - l_2) / (t_w + r (1 - a)),   m = l_1 + l_2 - 1 + r k,   r = g_t / g
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from hil.control.fac import sample
from hil.control.jit import jit

TURN: Final = 2.0 * math.pi


def angle_gains(
    pole: float, gain: float, lag: float, own: dict[str, Any], a: float, lams: tuple[float, float], T_s: float
) -> dict[str, float]:
    """The part of LAW_PARAMS of w' = pole w + gain i, tau i' = u - i; ``own``: those of the law speed."""
    A, of_u = np.array([[0.0, 1.0], [0.0, pole]]), np.array([0.0, gain])
    if lag:
        A = np.array([[0.0, 1.0, 0.0], [0.0, pole, gain], [0.0, 0.0, -1.0 / lag]])
        of_u = np.array([0.0, 0.0, 1.0 / lag])
    model = sample(A, of_u[:, None], T_s, 1)
    t_w, t_u, t_d = float(model.Ad[0, 1]), float(model.Bd[0, 0]), float(model.Ed[0, 1])
    t_i = float(model.Ad[0, 2]) if lag else 0.0
    kappa, l_i = own["kappa"], own["lag"]
    kappa_th = (t_i - t_w * kappa) / (1.0 - l_i)
    r = (t_u + kappa_th * (1.0 - l_i)) / own["g_u"]
    k_th = (1.0 - lams[0]) * (1.0 - lams[1]) / (t_w + r * (1.0 - a))
    return {
        "lam_w": lams[0] + lams[1] - 1.0 + r * k_th,
        "k_th": k_th,
        "th_w": t_w,
        "th_i": t_i,
        "th_u": t_u,
        "th_d": t_d,
        "kappa_th": kappa_th,
        "rho_th": kappa_th / kappa if kappa else 0.0,
    }


@jit
def locate(p: Any, s: Any, theta: float) -> float:
    """Take a measured angle [rad]; return what it moved by that neither speed nor whole turns tell [rad].

    ``s``: the law's state, its speed that of the measurement; ``unseen`` ticks since the angle before.
    """
    w, jump = s["x"][0], 0.0
    if s["located"]:
        moved = theta - s["theta_seen"] - 0.5 * (s["w_seen"] + w) * s["unseen"] * p["T_s"]
        turns, rounds = np.rint(moved / TURN), 0.0
        jump = moved - turns * TURN
        if p["theta_span"] > 0.0:
            rounds = np.rint(moved / p["theta_span"])
            left = moved - rounds * p["theta_span"]
            if abs(left) < abs(jump):
                jump, turns = left, 0.0
            else:
                rounds = 0.0
        s["turns"] -= int(turns)
        s["rounds"] -= int(rounds)
    s["theta_seen"], s["w_seen"], s["unseen"], s["located"] = theta, w, 0, 1
    s["turned"] = theta + s["turns"] * TURN + s["rounds"] * p["theta_span"]
    return float(jump)


@jit
def angle_error(p: Any, s: Any, theta_ref: float, held: float) -> float:
    """phi - phi* [rad] at the tick that :func:`hil.control.speed.look_ahead_speed` reaches.

    ``theta_ref``: the reference then; ``held``: kappa times the current that the reference has then.
    """
    return float(s["x_p"][2] - theta_ref + p["kappa_th"] * s["x_p"][1] - p["rho_th"] * held)
