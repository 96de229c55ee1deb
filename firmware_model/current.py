"""The drive's own current loop: a sampled PI whose zero cancels the winding's pole.

    u = k (i* - i) + I + decoupling,  I+ = I + k (1 - a) (i* - i),  a = e^{-R T / L},  k = (1 - l) R / (1 - a)
so i+ = l i + (1 - l) i*, l = e^{-b T}: at its own samples the first-order lag of bandwidth b, exactly. It is
limited to the inverter's circle; the integrators take the error that the limited voltage stands for.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from firmware_model.jit import jit
from firmware_model.link import link_voltage
from firmware_model.plant import Takes


@jit
def refer(p: Any, s: Any) -> None:
    """The references [A] of the newest command, within the drive's own limit."""
    q, d = s["next_q"], s["next_d"]
    if p["takes"] == Takes.TORQUE:
        q, d = q / p["drive_k_t"], 0.0
    limit = p["i_limit"]
    s["q_ref"], s["d_ref"] = min(max(q, -limit), limit), min(max(d, -limit), limit)
    s["limited"] = 1 if s["q_ref"] != q or s["d_ref"] != d else 0


@jit
def regulate(p: Any, s: Any) -> None:
    """One sample of the loop: the voltage that holds until the next."""
    w, i_q, i_d = s["x"]
    e_q, e_d = s["q_ref"] - i_q, s["d_ref"] - i_d
    u_q = p["gain_q"] * e_q + s["q_total"] + p["n_p"] * w * (p["L_d"] * i_d + p["psi_f"])
    u_d = p["gain_d"] * e_d + s["d_total"] - p["n_p"] * w * p["L_q"] * i_q
    limit = link_voltage(p, s) / math.sqrt(3.0)
    norm = math.sqrt(u_q * u_q + u_d * u_d)
    scale = limit / norm if norm > limit else 1.0
    s["u_q"], s["u_d"] = u_q * scale, u_d * scale
    if p["u_lsb"] > 0.0:
        s["u_q"] = np.rint(s["u_q"] / p["u_lsb"]) * p["u_lsb"]
        s["u_d"] = np.rint(s["u_d"] / p["u_lsb"]) * p["u_lsb"]
    s["q_total"] += p["reset_q"] * (p["gain_q"] * e_q + s["u_q"] - u_q)
    s["d_total"] += p["reset_d"] * (p["gain_d"] * e_d + s["u_d"] - u_d)
