"""Verdict rows for what the paper prints and claims: gains, identities, Figs. 1 to 15."""

from __future__ import annotations

import numpy as np

from hil.paper.continuous import Trace, channel_theta, theta
from hil.paper.examples import I_Q_REF, PHI, RECONSTRUCTION, W_REF, Case, section_5, section_6
from hil.paper.items import CANNOT, CORRECTED, Item, judged, numbers, same_digits
from hil.paper.study import Run, Study, after, after_levels

PI_5 = ((0.7, -1.0, -1.6), (0.0, 2.8, -2.0), (0.0, 0.0, 5.7))
PI_6 = ((0.0031, -3.6), (2.4, 2.8618))
THETA_5 = (-2.0332, 3.0332)
THETA_6 = (-2.8583, 5.5167, 3.8583, -4.5167)
ROUNDING = 1e-12
"""What counts as zero, relative to the initial error."""


def _gain_items() -> list[Item]:
    five, six = section_5(), section_6()
    th5, th6 = channel_theta(five.gamma, five.D), channel_theta(six.gamma, six.D)
    flat5, flat6 = five.Pi.ravel(), six.Pi.ravel()
    poles5 = np.linalg.eigvals(five.A + five.B @ five.Pi).real
    poles6 = np.linalg.eigvals(six.A + six.B @ six.Pi).real
    flat_theta5, shape = th5.T.ravel(), theta(five.gamma, five.D).shape
    return [
        Item(
            "Theta, each channel, D = 0.5 s",
            "Sect. 5, Theorem 1",
            numbers(THETA_5),
            numbers(th5[:, 0]),
            judged(same_digits(THETA_5 * 3, flat_theta5, 4)),
            "gamma_2 - gamma_1 = 0.8 rad/s in every channel, so all three channels are alike",
        ),
        Item(
            "shape of Theta",
            "Sect. 5",
            "6 x 3",
            f"{shape[0]} x {shape[1]}",
            judged(shape == (6, 3), CORRECTED),
            "Theorem 1 gives n x 2n; the transpose is printed",
        ),
        Item(
            "Pi", "Sect. 5, (24)", numbers(np.ravel(PI_5), 1), numbers(flat5, 1),
            judged(same_digits(np.ravel(PI_5), flat5, 4)), "B^-1 (Z Upsilon - A Z) Z^-1",
        ),
        Item(
            "closed-loop poles [rad/s]", "Sect. 5, (23)", "-0.1, -0.2, -0.3",
            numbers(sorted(poles5, reverse=True), 1),
            judged(np.allclose(sorted(poles5), [-0.3, -0.2, -0.1], atol=1e-12)), "eigenvalues of A + B Pi",
        ),
        Item(
            "Theta, channels 1 and 2, D = 0.5 s", "Sect. 6, Theorem 1", numbers(THETA_6),
            numbers(th6.ravel()),
            judged(same_digits(THETA_6, th6.ravel(), 4)), "order: both entries of Theta_1, then of Theta_2",
        ),
        Item(
            "Pi", "Sect. 6, (24)", numbers(np.ravel(PI_6)), numbers(flat6),
            judged(same_digits(np.ravel(PI_6), flat6, 4)),
            "with A as printed and the reconstructed motor; the sign of Pi_12 is judged under errata 3",
        ),
        Item(
            "closed-loop poles [rad/s]", "Sect. 6, (23)", "-0.3, -0.4",
            numbers(sorted(poles6, reverse=True), 1),
            judged(np.allclose(sorted(poles6), [-0.4, -0.3], atol=1e-9)), "eigenvalues of A + B Pi",
        ),
    ]  # fmt: skip


def identities() -> dict[str, tuple[float, float]]:
    """The four identities of the printed Pi that a motor must satisfy: (printed, with the reconstruction)."""
    m = RECONSTRUCTION
    return {
        "0.3 J - B_f": (0.0031, 0.3 * m.J - m.B_f),
        "3 n psi_f / 2 [N m/A]": (3.6, m.k_t),
        "n psi_f [V s]": (2.4, m.n_p * m.psi_f),
        "R - 0.4 L [ohm]": (2.8618, m.R_s - 0.4 * m.L_q),
    }


def _motor_items() -> list[Item]:
    return [
        Item(
            name, "Table 1 (missing), by Pi", f"{printed:.4f}", f"{computed:.4f}",
            judged(same_digits([printed], [computed], 4)),
            "the motor is a reconstruction from the printed Pi, not a citation",
        )
        for name, (printed, computed) in identities().items()
    ]  # fmt: skip


def zero(error: float, scale: float = 1.0) -> str:
    """An error as text; rounding is called 0."""
    return "0 (rounding)" if abs(error) <= ROUNDING * scale else f"{abs(error):.3g}"


def _error_at(run: Run, t: float) -> tuple[float, ...]:
    """Largest |error| of FTDOB in continuous and sampled form at t, over the channels."""
    k = run.at(t)
    return tuple(float(np.abs(trace.error[k]).max()) for trace in (run.continuous, run.sampled))


def _case_1_items(run: Run) -> list[Item]:
    trace, items = run.continuous, []
    for t, name in ((0.5, "start"), (3.5, "step at 3 s"), (6.5, "step at 6 s")):
        both = _error_at(run, t)
        item = Item(
            f"case 1: error of the FTDOB D after the {name}, continuous / sampled", "Figs. 1, 2",
            "0", " / ".join(zero(e) for e in both), judged(max(both) < ROUNDING),
            "constant d: exact from D on, in both forms",
        )  # fmt: skip
        items.append(item)
    e = np.abs(trace.error_c)
    at = [(3, 0.5, 2), (2, 3.5, 1), (3, 3.5, 2)]
    dob = [float(e[run.at(t), c]) for _, t, c in at]
    half = run.at(3.25)
    ours, theirs = (np.abs(x[half, 1:]) / (0.4, 0.5) for x in (trace.error, trace.error_c))
    return [
        *items,
        Item(
            "case 1: error of the conventional DOB at ch 3, 0.5 s; ch 2, 3.5 s; ch 3, 3.5 s", "Figs. 1, 2",
            "not 0", numbers(dob, 3), judged(min(dob) > 0.1), "exponential: e^{-gamma_c D} is left after D",
        ),
        Item(
            "case 1: error at D/2 after the step, ch 2 and 3, FTDOB / conventional [% of the step]",
            "Figs. 1, 2", "FTDOB faster", f"{numbers(100 * ours, 0)} / {numbers(100 * theirs, 0)}",
            judged(bool((ours < theirs).all())),
            "the estimate is a moving average over D: a ramp, not a jump",
        ),
    ]  # fmt: skip


def _end_state(run: Run, figures: str) -> Item:
    x = np.abs(run.continuous.x[-1]).max()
    share = x / np.abs(run.continuous.x[0]).max()
    return Item(
        f"{run.case.name}: largest state at the end, {run.case.end:.0f} s, over the largest at the start",
        figures, "close to zero", f"{share:.1e}", judged(share < 0.05),
        "slowest pole 0.1 rad/s; what is left is its decay and, in case 3, the lag of the estimate",
    )  # fmt: skip


def _case_2_item(run: Run) -> Item:
    rows = after_levels(run)
    ftdob = float(max(np.abs(t.error[rows]).max() for t in (run.continuous, run.sampled)))
    dob = float(np.abs(run.continuous.error_c[rows]).max())
    return Item(
        "case 2: largest error D after each level, FTDOB / conventional", "Figs. 5, 6", "0 / not 0",
        f"{zero(ftdob)} / {dob:.3f}", judged(ftdob < ROUNDING and dob > 1e-3, CANNOT),
        "the signal is not defined in the text: levels of +-0.1 held 1 s, seeded, assumed",
    )  # fmt: skip


def case_3_errors(trace: Trace, case: Case) -> tuple[tuple[float, float], tuple[float, float]]:
    """Largest |error| of ch 1 and 3: FTDOB from D on, conventional DOB once its start has decayed (15 s)."""
    ours = np.abs(trace.error[after(trace, case.example.D)]).max(axis=0)
    theirs = np.abs(trace.error_c[after(trace, 15.0)]).max(axis=0)
    return (float(ours[0]), float(ours[2])), (float(theirs[0]), float(theirs[2]))


def _case_3_item(run: Run) -> Item:
    ours, theirs = case_3_errors(run.continuous, run.case)
    return Item(
        "case 3: largest error after D, ch 1 and ch 3, FTDOB / conventional", "Figs. 9, 10",
        "0 after D (Theorem 1)", " / ".join(f"{a:.1e}, {b:.1e}" for a, b in (ours, theirs)),
        judged(max(ours) < ROUNDING),
        "d varies, so the estimate lags: small because the sines are slow, but not 0 (errata 1)",
    )  # fmt: skip


def _pmsm_item(run: Run) -> Item:
    trace, k = run.continuous, run.at(0.5)
    d = np.abs(trace.d[k])
    ours, theirs = np.abs(trace.error[k]) / d, np.abs(trace.error_c[k]) / d
    return Item(
        "PMSM: error D after the start, ch 1 and 2, FTDOB / conventional [% of d]", "Figs. 13, 14",
        "FTDOB faster", f"{zero(float(ours.max()))} / {numbers(100 * theirs, 0)}",
        judged(float(ours.max()) < ROUNDING), "e^{-0.2 D} and e^{-0.5 D} are left of the conventional one",
    )  # fmt: skip


def _pmsm_state_item(run: Run) -> Item:
    share = np.abs(run.continuous.x[-1]) / np.abs(run.continuous.x).max(axis=0)
    return Item(
        f"PMSM as printed: |x_1|, |x_2| at {run.case.end:.0f} s over their largest", "Fig. 15",
        "well controlled",
        ", ".join(f"{s:.1e}" for s in share), judged(bool((share < 0.05).all())),
        "converges with its slow poles; on what path, and on which motor, see errata 3, 5 and 6",
    )  # fmt: skip


def _fixed_time_item(study: Study) -> Item:
    c = study.convergence
    worst = float((c.ftdob[:, c.N :].max(axis=1) / np.maximum(c.initial, 1.0)).max())
    euler, dob = (float(curve[-1, c.N :].max() / c.initial[-1]) for curve in (c.euler, c.dob))
    return Item(
        "ten initial errors 1e-3 .. 1e3: largest error from tick N on; at 1e3 Euler form, conventional DOB",
        "Theorem 1", "0", f"{zero(worst)}; {euler:.1%}, {dob:.0%} of it",
        judged(worst < ROUNDING < min(euler, dob)),
        "exact only in the sampled form with lam^N; the others keep a share of the initial error",
    )  # fmt: skip


def _bench_item(study: Study) -> list[Item]:
    if study.bench is None:
        return []
    settled = study.bench[5000:9900]  # from the end of the ramp to before the stop
    d_hat = np.array([settled["d_hat_w"], settled["d_hat_q"]])
    low = d_hat.min(axis=1, initial=np.inf)
    high = d_hat.max(axis=1, initial=-np.inf)  # a run that ended before has neither, and misses phi
    error = np.maximum(np.abs(low - PHI), np.abs(high - PHI))
    item = Item(
        "corrected design on the bench, commanded load machine: phi", "Sect. 6, configs/paper.toml",
        numbers(PHI, 1), f"{numbers(low)} to {numbers(high)}", judged(bool((error < 2e-3).all())),
        f"through the frames' resolution, T_L and u_q both commanded, w* = 80 rad/s, i_q* = {I_Q_REF} A; "
        f"{W_REF:.0f} rad/s would need 1204 V",
    )  # fmt: skip
    return [item]


def printed_items(study: Study) -> list[Item]:
    """All rows of what the paper prints and draws, in its order."""
    one, two, three = (study.runs[f"case {i}"] for i in (1, 2, 3))
    pmsm = study.runs["PMSM as printed"]
    return [
        *_gain_items(),
        *_motor_items(),
        *_case_1_items(one),
        _end_state(one, "Figs. 3, 4"),
        _case_2_item(two),
        _end_state(two, "Figs. 7, 8"),
        _case_3_item(three),
        _end_state(three, "Figs. 11, 12"),
        _pmsm_item(pmsm),
        _pmsm_state_item(pmsm),
        _fixed_time_item(study),
        *_bench_item(study),
    ]
