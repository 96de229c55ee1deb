"""Verdict rows for the points where the paper is wrong or says less than it seems to, each by numbers."""

from __future__ import annotations

import math

import numpy as np

from hil.paper.continuous import channel_theta, initial_h, lag
from hil.paper.examples import (
    I_Q_REF,
    PHI,
    RECONSTRUCTION,
    W_REF,
    case_1,
    feedforward,
    reference_terms,
    section_5,
    section_6,
)
from hil.paper.items import CANNOT, CORRECTED, Item, judged, numbers
from hil.paper.printed import ROUNDING, case_3_errors, zero
from hil.paper.study import Study, noise_gain

V_DC = 540.0
"""DC link that the bench has [V]; the voltage circle is V_DC / sqrt(3)."""


def steady_voltage(electrical: bool) -> float:
    """u_q [V] that holds w* and i_q*: R i_q* + n psi w*, or psi w* if w were the electrical speed."""
    m = RECONSTRUCTION
    return m.R_s * I_Q_REF + (1 if electrical else m.n_p) * m.psi_f * W_REF


def _window_items(study: Study) -> list[Item]:
    run = study.runs["case 3"]
    e = run.case.example
    (ours, _), _ = case_3_errors(run.continuous, run.case)
    bound = (0.01 * 0.05 + 0.02) * float(lag(e.gamma, e.D)[0])
    small = float(lag(np.array([[1e-3], [2e-3]]), e.D)[0])
    return [
        Item(
            "theta = 0 for all t > t0 + D", "errata 1: Theorem 1, (17), (18)", "0 for any d",
            f"case 3, ch 1: {ours:.1e}, bound sup|d'| int phi = {bound:.1e}",
            judged(ours < ROUNDING), "holds for a constant d only; d_hat is a moving average of d over D",
        ),
        Item(
            "error on a ramp over its slope [s], Sect. 5, ch 1 to 3", "errata 1: Theorem 1", "0",
            f"{numbers(lag(e.gamma, e.D))}; {small:.4f} for small g D", judged(small < ROUNDING),
            "int phi: the estimate is that much late, D/2 = 0.25 s for small g D",
        ),
    ]  # fmt: skip


def _noise_item() -> Item:
    long, short = noise_gain((0.3, 0.7), 0.5) / 0.5, noise_gain((6e-5, 1.4e-4), 1e-4) / 1e-4
    gains = [noise_gain(g) for g in ((0.003, 0.007), (0.3, 0.7), (1.0, 3.0))]
    return Item(
        "D can be taken arbitrarily small: noise gain times D for g D small; (.3, .7); (1, 3)",
        "errata 2: Remarks 3, 5", "no price", numbers(gains, 2),
        judged(short <= long),
        f"sigma(d_hat) / sigma(x) grows as 1/D: D = 0.1 ms makes {short:.0f} times the noise of x",
    )  # fmt: skip


def _sign_items(study: Study) -> list[Item]:
    wrong, right = section_6(), section_6(torque_sign=1.0)
    printed, motor = np.linalg.eigvals(wrong.A), np.linalg.eigvals(right.A)
    misled = np.abs(study.misled.x).max(axis=0)
    return [
        Item(
            "A_12 = a1 b1", "errata 3: (34)", f"{wrong.A[0, 1]:.1f}", f"{right.A[0, 1]:+.1f}",
            judged(wrong.A[0, 1] == -right.A[0, 1], CANNOT, CORRECTED),
            "torque accelerates: +3 n psi_f / (2 J), b1 belongs to T_L alone",
        ),
        Item(
            "open-loop poles of the PMSM [rad/s]", "errata 3: (34)",
            numbers(sorted(printed.real, reverse=True), 1),
            f"{motor[0].real:.1f} +- {abs(motor[0].imag):.0f}j", judged(np.allclose(printed, motor)),
            "the printed A is unstable, the motor is damped",
        ),
        Item(
            "Pi_12", "errata 3: Sect. 6", "-3.6", f"{right.Pi[0, 1]:+.1f}",
            judged(abs(right.Pi[0, 1] - 3.6) < 1e-9, CANNOT, CORRECTED), "the sign of a1 b1 again",
        ),
        Item(
            "the controller as printed on the real motor: largest |w - w*| [rad/s], |i_q - i_q*| [A]",
            "errata 3: Fig. 15", "well controlled", f"{misled[0]:.1e}, {misled[1]:.1e}",
            judged(bool((misled < (W_REF, 100.0)).all())),
            "sampled form at 1 kHz; the observer takes 2 a1 b1 x_2 for a disturbance and cancels it late",
        ),
    ]  # fmt: skip


def _input_item() -> Item:
    m = RECONSTRUCTION
    pole = m.B_f / m.J
    return Item(
        "T_L as an input: speed pole with u_q alone [rad/s]; offset per N m of load [rad/s]",
        "errata 4: u = [T_L, u_q]", "-0.3; 0", f"-{pole:.3f}; {1 / m.B_f:.0f}", judged(pole >= 0.3),
        "true only on a bench with a commanded load machine; without it i_q holds i_q* and w drifts",
    )  # fmt: skip


def _reference_items(study: Study) -> list[Item]:
    d = reference_terms(section_6()) + PHI
    run, corrected = study.runs["PMSM as printed"], study.runs["PMSM corrected"]
    peak = float(np.abs(run.continuous.x[:, 1]).max())
    ours = float(np.abs(corrected.continuous.x[:, 1]).max())
    return [
        Item(
            "d of (34) with its reference terms", "errata 5: (34)", "phi = (0.1, 0.2)", numbers(d, 1),
            judged(np.allclose(d, PHI), CORRECTED),
            "known terms belong in the model; only phi is left to the observer",
        ),
        Item(
            "largest |i_q - i_q*| from d_hat(0) = 0, as printed / corrected [A]", "errata 5: Fig. 15",
            "well controlled", f"{peak:.0f} / {ours:.3f}", judged(peak < 100.0),
            "until D has passed the loop carries all of d; same poles in both",
        ),
    ]  # fmt: skip


def _voltage_item() -> Item:
    mechanical, electrical = steady_voltage(False), steady_voltage(True)
    circle = V_DC / math.sqrt(3)
    u = feedforward()
    return Item(
        "u_q that holds w* = 500 rad/s, i_q* = 1.5 A, w mechanical / electrical [V]", "errata 6: Sect. 6.3",
        "not said", f"{mechanical:.0f} / {electrical:.0f}", judged(mechanical <= circle),
        f"the voltage circle of a {V_DC:.0f} V link is {circle:.0f} V; T_L* would be {u[0]:.1f} N m",
    )  # fmt: skip


def _speed_item() -> Item:
    m = RECONSTRUCTION
    return Item(
        "w is the electrical angular velocity: back-EMF per w [V s]", "errata 7: (32)",
        f"{m.psi_f:.1f} (if electrical)", f"{m.n_p * m.psi_f:.1f} (as used)", judged(m.n_p == 1, CORRECTED),
        "(32) multiplies w by n, so w is mechanical and n the number of pole pairs",
    )  # fmt: skip


def _start_item(study: Study) -> Item:
    case, run = case_1(), study.runs["case 1"]
    h = initial_h(case).reshape(2, 3)
    difference = np.abs(study.zero_fill.d_hat - run.continuous.d_hat[: study.zero_fill.t.size]).max(axis=1)
    late = float(difference[run.at(0.5) :].max())
    return Item(
        "z0: h_1(0) - h_2(0), ch 1 to 3", "errata 8: case 1, (10)", "0, 0, 0", numbers(h[0] - h[1], 2),
        judged(late < ROUNDING, CANNOT, CORRECTED),
        f"(10) is violated, harmless after D: h before t0 held or 0 changes d_hat by {difference.max():.2f} "
        f"before D and by {zero(late)} after",
    )  # fmt: skip


def _notation_items() -> list[Item]:
    e = section_5()
    th = channel_theta(e.gamma, e.D)[:, 0]
    left = [float((th * np.exp(-e.gamma[:, 0] * t)).sum()) for t in (0.5, 1.5)]
    m = RECONSTRUCTION
    b2 = -m.B_f / m.J
    return [
        Item(
            "(15) at t0 + D with t0 = 1 s: error over the initial error", "errata 9: (11) to (15)",
            f"{left[1]:.3f}", zero(left[0]),
            judged(abs(left[1]) < ROUNDING, CORRECTED), "e^{-Gamma t} should read e^{-Gamma (t - t0)}",
        ),
        Item(
            "observer on a constant d = 1, d_hat(0) = 0, at gamma t = 1", "errata 9: (2)",
            "nothing: d' = 0 for every d", f"d_hat = {1 - math.exp(-1):.3f}", CORRECTED,
            "a hat is missing: d_hat' = -Gamma d_hat + Gamma (x' - A x - B u)",
        ),
        Item(
            "term of i_q* in d_2 for a constant i_q* = 1.5 A [A/s]", "errata 9: (34)", "-1.5", "0", CORRECTED,
            "\"- i_q*\" means \"- d i_q*/dt\"",
        ),
        Item(
            "b2 = -B/J with B the matrix", "errata 9: (34)", "not defined", f"{b2:.4f} 1/s", CORRECTED,
            "B means the friction coefficient B_f",
        ),
    ]  # fmt: skip


def _poles_item() -> Item:
    settle = math.log(50) / 0.3
    return Item(
        "poles of 0.3 and 0.4 rad/s: time to 2 % [s]", "errata 10: Sect. 6", "favorable",
        f"{settle:.0f}", judged(settle < 1.0),
        "a worked example, no tuning: the demo's speed pole is 30 rad/s, 0.13 s",
    )  # fmt: skip


def errata_items(study: Study) -> list[Item]:
    """All rows of the ten points, in their order."""
    return [
        *_window_items(study),
        _noise_item(),
        *_sign_items(study),
        _input_item(),
        *_reference_items(study),
        _voltage_item(),
        _speed_item(),
        _start_item(study),
        *_notation_items(),
        _poles_item(),
    ]
