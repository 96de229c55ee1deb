"""Kernels of the law for a drive with a current loop of its own: state w, input the torque asked for.

The command u is a current [A] or a torque [N m], k_u its torque per unit. The drive makes of it
    tau di/dt = u(t - delay) - i,   J dw/dt = k_u i - B_f w + J d
Sampled exactly, with what flows at the tick (i) and the command that acts from then on (u):
    w+ = a w + b (alpha i + (1 - alpha) u) + e d,   i+ = l i + (1 - l) u,   l = e^{-T_s / tau}
so alpha i + (1 - alpha) u is the constant that has the same effect on w: with d it is what the observer is
told. A drive that reports i_q tells it by itself: the mean of the samples at both ends of the tick.
"""

from __future__ import annotations

from typing import Any, Final

from hil.control.cogging import loaded, ripple
from hil.control.jit import jit
from hil.control.position import angle_error
from hil.control.regen import braked
from hil.control.speedfilter import enter

MOST_DELAY: Final = 8
"""Ticks by which a command may act later than with the next latch."""
COMMANDS: Final = MOST_DELAY + 1
LEADS: Final = 1
"""``pair`` of the law fac over two nodes, which commands the load machine, too."""
FOLLOWS: Final = 2
"""``pair`` of that load machine."""


@jit
def flowed(p: Any, s: Any, i: float, sampled: bool, periods: int) -> float:
    """End the past ``periods``: return the constant command that had their effect on w; i [unit of u].

    ``sampled``: the drive has said what flows now. Else the model of its inner loop goes on.
    """
    total = 0.0
    for period in range(periods):
        u, before = s["commands"][p["delay"]], s["inner"]
        s["inner"] = p["lag"] * before + (1.0 - p["lag"]) * u
        if sampled and period == periods - 1:
            s["inner"] = i
            mean = 0.5 * (before + i)
        else:
            mean = p["share"] * before + (1.0 - p["share"]) * u
        total += mean
        if p["order"]:
            enter(s, mean, s["inner"] - before)
        for age in range(p["delay"], 0, -1):
            s["commands"][age] = s["commands"][age - 1]
    if periods < 1 and sampled:
        s["inner"] = i
    return float(total / max(periods, 1))


@jit
def latched(p: Any, s: Any, u: float, on: bool) -> None:
    """Tell what the drive has latched now; with its gates off nothing flows, and nothing is on its way."""
    s["commands"][0] = u
    if not on:
        s["inner"] = 0.0
        for age in range(p["delay"] + 1):
            s["commands"][age] = 0.0


@jit
def look_ahead_speed(p: Any, s: Any) -> None:
    """x_p = (w, i, theta) at the tick from which the next command will act: all that act before are known."""
    w, i, d, theta = s["x"][0], s["inner"], s["d_hat"][0], s["turned"] - s["origin"]
    for age in range(p["delay"], -1, -1):
        u = s["commands"][age]
        if loaded(p):
            d = s["d_hat"][0] + ripple(p, s, (p["delay"] - age + 0.5) * p["T_s"])
        if p["k_th"] != 0.0:
            theta += p["th_w"] * w + p["th_i"] * i + p["th_u"] * u + p["th_d"] * d
        w = p["Ad"][0, 0] * w + p["Bd"][0, 0] * (p["share"] * i + (1.0 - p["share"]) * u)
        w += p["Ed"][0, 0] * d
        i = p["lag"] * i + (1.0 - p["lag"]) * u
    s["x_p"][0], s["x_p"][1], s["x_p"][2] = w, i, theta


@jit
def slope_change(p: Any, s: Any, dw_ref: float) -> float:
    """T_s w*'' [rad/s2], how the reference's slope changed over the last tick; 0 where it is not fed forward.

    It is taken for how it goes on. A law asks once a tick.
    """
    if p["jerk"] == 0:
        return 0.0
    change = dw_ref - s["slope"]
    s["slope"] = dw_ref
    return float(change)


@jit
def ask_speed(p: Any, s: Any, w_ref: float, dw_ref: float) -> None:
    """The command that moves the speed error by e^{-pole T_s} a tick and leaves the inner loop its own pole.

    sigma = w + kappa i, kappa = alpha b / (a - l), is the mode of (w, i) with the eigenvalue a:
        sigma+ = a sigma + e d + g u,   g = (1 - alpha) b + kappa (1 - l)
    With u* = (w*+ - a w* - e d) / b, what holds the reference, sigma* = w* + kappa u*, and
        u = (sigma*+ + lam (sigma - sigma*) - a sigma - e d) / g
    Without a lag (kappa = 0) it is the cascade's speed law. A load over the angle is known at each of these
    moments: at both ends of the tick what holds against it, between them its effect. Of the law ``position``
    the error of the angle goes into sigma+, too (:mod:`hil.control.position`).
    """
    look_ahead_speed(p, s)
    a, b, kappa, T_s = p["Ad"][0, 0], p["Bd"][0, 0], p["kappa"], p["T_s"]
    drift = p["Ed"][0, 0] * s["d_hat"][0]
    change, ahead = slope_change(p, s, dw_ref), 1.0 + p["delay"]
    target = w_ref + ahead * T_s * (dw_ref + 0.5 * ahead * change)
    after = target + T_s * (dw_ref + (ahead + 0.5) * change)
    holds = kappa * (after - a * target - drift) / b
    held = holds
    if change != 0.0:  # what flows grows by D a tick, and is behind by what the command's own share is ahead
        D = T_s * change / b
        held -= kappa * (1.0 - p["share"]) / (1.0 - p["lag"]) * D
        holds = held + kappa * D
    if loaded(p):
        share, lead = kappa * p["Ed"][0, 0] / b, p["cog_lead"]
        held -= share * ripple(p, s, lead)
        holds -= share * ripple(p, s, lead + T_s)
        drift += p["Ed"][0, 0] * ripple(p, s, lead + 0.5 * T_s)
    sigma = s["x_p"][0] + kappa * s["x_p"][1]
    wanted = after + holds + p["lam_w"] * (sigma - target - held)
    if p["k_th"] != 0.0:
        h = ahead * T_s
        theta_ref = s["theta_ref"] + h * (w_ref + h * (dw_ref / 2.0 + ahead * change / 6.0))
        wanted -= p["k_th"] * angle_error(p, s, theta_ref, held)
    u = (wanted - a * sigma - drift) / p["g_u"]
    s["i_q_ref"] = min(max(u / p["u_i"], -p["i_max"]), p["i_max"])
    if p["regen"] and p["pair"] == 0:
        s["capped"] = 0
        s["i_q_ref"] = braked(p, s, p["n_p"] * s["x_p"][0], 0.0, s["i_q_ref"])
        u = s["i_q_ref"] * p["u_i"] if s["capped"] else u
    s["u"][0], s["u"][1], s["u"][2] = 0.0, u, 0.0


@jit
def share(p: Any, s: Any, i_q: float) -> None:
    """The net command of :func:`ask_speed` as (T_L, i_q*): u_net = u - T_L / k_u, T_L = k_u (u - u_net)."""
    u, net = i_q * p["u_i"], s["u"][1]
    s["i_q_ref"] = i_q
    s["u"][0] = min(max(p["k_u"] * (u - net), -p["T_L_max"]), p["T_L_max"])
    s["u"][1] = u
