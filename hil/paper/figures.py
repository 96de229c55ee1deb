"""Figs. 1 to 15 of the paper, and the four that it lacks (fixed time, corrected motor, price of D, bench)."""

from __future__ import annotations

import numpy as np

from hil.control.linalg import Array
from hil.paper.continuous import Trace, lag
from hil.paper.examples import PHI
from hil.paper.plots import CHANNELS, CONVENTIONAL, DISTURBANCE, FTDOB, SAMPLED, Curve, Figure, Line, Panel
from hil.paper.study import Run, Study, noise_gain

UNITS_6 = ("rad/s²", "A/s")


def _labelled(look: Line, label: str) -> Line:
    return {**look, "label": label}


def _part(trace: Trace, end: float, start: float = 0.0) -> slice:
    low, high = np.searchsorted(trace.t, [start - 1e-9, end + 1e-9])
    return slice(int(low), int(high))


def _sampled_points(run: Run, y: Array, end: float, start: float, count: int = 26) -> Curve:
    """A few points of the sampled form, so that the lines below stay visible."""
    rows = np.linspace(run.at(start), run.at(end), count).astype(int)
    return Curve(run.sampled.t[rows], y[rows], SAMPLED)


def estimates(run: Run, name: str, start: float, end: float, units: tuple[str, ...]) -> Figure:
    """d_i with both estimates; one panel a channel."""
    trace, part = run.continuous, _part(run.continuous, end, start)
    panels = [
        Panel(
            [
                Curve(trace.t[part], trace.d[part, c], DISTURBANCE),
                Curve(trace.t[part], trace.d_hat_c[part, c], CONVENTIONAL),
                Curve(trace.t[part], trace.d_hat[part, c], FTDOB),
                _sampled_points(run, run.sampled.d_hat[:, c], end, start),
            ],
            f"$d_{c + 1}$, $\\hat{{d}}_{c + 1}$" + (f" [{units[c]}]" if units else " [1/s]"),
        )
        for c in range(trace.d.shape[1])
    ]
    return Figure(name, f"Disturbance estimation results, {run.case.name}.", panels)


def errors(
    run: Run,
    name: str,
    start: float,
    end: float,
    units: tuple[str, ...],
    inset: tuple[float, float] | None = None,
) -> Figure:
    """Estimation errors; one panel a channel; ``inset``: times that are enlarged."""
    trace, part = run.continuous, _part(run.continuous, end, start)
    panels = [
        Panel(
            [
                Curve(trace.t[part], trace.error_c[part, c], CONVENTIONAL),
                Curve(trace.t[part], trace.error[part, c], FTDOB),
                _sampled_points(run, run.sampled.error[:, c], end, start),
            ],
            f"$\\vartheta_{c + 1}$" + (f" [{units[c]}]" if units else " [1/s]"),
            inset=inset if c != 1 else None,  # channel 2 is piecewise constant: nothing to enlarge
        )
        for c in range(trace.d.shape[1])
    ]
    return Figure(name, f"Estimation errors of the FTDOB and the conventional DOB, {run.case.name}.", panels)


def together(
    run: Run, name: str, quantity: str, caption: str, inset: tuple[float, float] | None = None
) -> Figure:
    """All channels of x or u in one panel; ``inset``: times that are enlarged."""
    trace = run.continuous
    y = trace.x if quantity == "x" else trace.u
    curves = [
        Curve(trace.t, y[:, c], _labelled(CHANNELS[c], f"${quantity}_{c + 1}$")) for c in range(y.shape[1])
    ]
    unit = "1" if quantity == "x" else "1/s"
    return Figure(
        name, f"{caption}, {run.case.name}.", [Panel(curves, f"${quantity}$ [{unit}]", inset=inset)]
    )


def _states_6(run: Run) -> Figure:
    trace = run.continuous
    labels = ("$x_1 = \\omega - \\omega^*$ [rad/s]", "$x_2 = i_q - i_q^*$ [A]")
    panels = [Panel([Curve(trace.t, trace.x[:, c], CHANNELS[0])], labels[c]) for c in range(2)]
    return Figure("fig15", "State trajectory of the system, PMSM as printed (sign error included).", panels)


def _case_figures(
    run: Run,
    first: int,
    window: tuple[float, float],
    error_inset: tuple[float, float] | None = None,
    inset: tuple[float, float] | None = None,
) -> list[Figure]:
    """The four figures that the paper gives to each case of Sect. 5."""
    names = [f"fig{first + i:02d}" for i in range(4)]
    return [
        estimates(run, names[0], *window, ()),
        errors(run, names[1], *window, (), error_inset),
        together(run, names[2], "x", "State trajectory of the system", inset),
        together(run, names[3], "u", "Control input for three channels", inset),
    ]


def paper_figures(study: Study) -> list[Figure]:
    """Figs. 1 to 15 in the paper's order."""
    pmsm = study.runs["PMSM as printed"]
    return [
        *_case_figures(study.runs["case 1"], 1, (0.0, 10.0)),
        *_case_figures(study.runs["case 2"], 5, (38.0, 68.0), None, (38.0, 68.0)),
        *_case_figures(study.runs["case 3"], 9, (0.0, 200.0), (31.0, 200.0)),
        estimates(pmsm, "fig13", 0.0, 10.0, UNITS_6),
        errors(pmsm, "fig14", 0.0, 10.0, UNITS_6),
        _states_6(pmsm),
    ]


def fixed_time(study: Study) -> Figure:
    """Error against time for ten initial errors, by three observers."""
    c = study.convergence
    end = ((c.t[c.N], "D"),)
    looks = (FTDOB, {**CONVENTIONAL, "color": "#7a4fa3", "ls": "-."}, CONVENTIONAL)
    names = ("FTDOB, exact sampled form", "FTDOB, Euler", "conventional DOB")
    panels = []
    for curves, look, name in zip((c.ftdob, c.euler, c.dob), looks, names, strict=True):
        lines = [Curve(c.t, np.maximum(y, 1e-17), {**look, "lw": 1.2, "label": "_"}) for y in curves]
        panels.append(Panel(lines, "|error| [1/s]", log_y=True, title=name, vertical=end))
    caption = (
        "Fixed time: largest error of a channel for ten initial errors from 1e-3 to 1e3, constant d. "
        "From tick N = D/T_s on the exact form is at rounding whatever the start; the others are not."
    )
    return Figure("fixed_time", caption, panels)


def corrected(study: Study) -> Figure:
    """The design as printed beside the corrected one, same poles, and the printed one on the real motor."""
    printed, ours = study.runs["PMSM as printed"].continuous, study.runs["PMSM corrected"].continuous
    misled = study.misled
    looks = (
        _labelled(CONVENTIONAL, "as printed, on its own model"),
        _labelled({**CHANNELS[2], "lw": 1.6}, "as printed, on the real motor"),
        _labelled(FTDOB, "corrected"),
    )
    panels = [
        Panel(
            [
                Curve(trace.t, np.maximum(np.abs(trace.x[:, c]), 1e-6), look)
                for trace, look in zip((printed, misled, ours), looks, strict=True)
            ],
            label,
            log_y=True,
        )
        for c, label in enumerate(("$|\\omega - \\omega^*|$ [rad/s]", "$|i_q - i_q^*|$ [A]"))
    ]
    caption = (
        "The PMSM with the design as printed and with the corrected one (right sign of a1 b1, known terms in "
        "the model, so that d = phi), same poles of 0.3 and 0.4 rad/s, same start."
    )
    return Figure("corrected", caption, panels)


def price(study: Study) -> Figure:
    """What D costs: lag and noise against D, for the poles of Sect. 5, channel 1."""
    gamma = study.runs["case 1"].case.example.gamma[:, :1]
    D = np.logspace(-2, 1, 31)
    late = np.array([float(lag(gamma, d)[0]) for d in D])
    noise = np.array([noise_gain((gamma[0, 0] * d, gamma[1, 0] * d), d) / d for d in D])
    grey = {"color": "#777777", "lw": 1.0, "ls": ":"}
    panels = [
        Panel(
            [
                Curve(D, late, _labelled(FTDOB, "Sect. 5, channel 1")),
                Curve(D, D / 2, _labelled(grey, "D/2, 1.41/D")),
            ],
            "lag on a ramp [s]",
            log_y=True,
            log_x=True,
        ),
        Panel(
            [Curve(D, noise, {**FTDOB, "label": "_"}), Curve(D, np.sqrt(2) / D, grey)],
            "noise gain [1/s]",
            log_y=True,
            log_x=True,
        ),
    ]
    caption = (
        "What D buys and costs: the estimate lags by up to D/2 and amplifies noise of x by 1.41/D or more."
    )
    return Figure("price", caption, panels, xlabel="D [s]")


def bench(study: Study) -> list[Figure]:
    """phi as estimated on the bench with the commanded load machine; nothing when it was not run."""
    if study.bench is None:
        return []
    ticks = study.bench[:-50:4]
    t = ticks["t_ns"] * 1e-9
    panels = [
        Panel(
            [
                Curve(t, np.full_like(t, PHI[c]), _labelled(DISTURBANCE, "true $\\varphi$")),
                Curve(t, ticks[name].astype(float), _labelled(FTDOB, "estimate")),
            ],
            f"$\\varphi_{c + 1}$ [{UNITS_6[c]}]",
        )
        for c, name in enumerate(("d_hat_w", "d_hat_q"))
    ]
    speed = [
        Curve(t, ticks["w_ref"].astype(float), {**DISTURBANCE, "label": "_"}),
        Curve(t, ticks["w"].astype(float), {**FTDOB, "label": "_"}),
    ]
    caption = (
        "The corrected design on the bench (configs/paper.toml): load machine and voltage commanded over the "
        "bus, the paper's windows and poles, full dq motor, resolution of the FD frames. (c): speed, its "
        "reference yellow."
    )
    return [Figure("bench", caption, [*panels, Panel(speed, "$\\omega$ [rad/s]")])]


def all_figures(study: Study) -> list[Figure]:
    """The paper's figures, then ours."""
    return [*paper_figures(study), fixed_time(study), corrected(study), price(study), *bench(study)]
