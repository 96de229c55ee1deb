"""Disturbance observers: FTDOB (Theorem 1) and the conventional DOB (31), in exact sampled form.

Both share the innovation v_k = Ed^-1 (x_k - Ad x_{k-1} - Bd ua_{k-1}), which equals d_{k-1} exactly, and
differ in the window that they put over it. The small interface of a window: a design that yields
:class:`Window`, its step kernels, and :func:`impulse_response` for its bounds. A conventional DOB is the
window with one pole, Theta = (1, 0) and no delayed term, so both run through one kernel. Four more forms
take its place in their channels: a third exponential, weights over past innovations, a linear filter, and a
window of variable length (:mod:`hil.control.adaptive`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from hil.control.adaptive import adaptive_fill, adaptive_step
from hil.control.errors import ControlDesignError
from hil.control.jit import jit
from hil.control.linalg import Array, Index, exp, power

SINGULAR = 1e-9
"""|lam_1^N - lam_2^N| / max lam^N at and below which Theorem 1's matrix counts as singular (Theta > 1e9)."""

MAX_RESPONSE = 1 << 20
"""Longest impulse response that is summed for a bound [ticks]."""


FIR_MAX: Final = 256
"""Longest finite impulse response [ticks] that the record has room for."""

PAIR, THIRD, FIR, FILTER, ADAPTIVE = range(5)
"""Forms of a channel: two exponentials (also the DOB), three, weights, a filter, variable length."""


def _none() -> Array:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class Window:
    """Weights of a window, one entry (or pair) per channel; n channels.

    ``lam`` (2, n): lam_i = e^{-gamma_i T_s}; ``lam_N`` (2, n): lam_i^N, 0 for a filter without a window;
    ``theta`` (2, n); ``N`` (n,) window length in ticks (for a conventional DOB: 1).
    Empty where no channel needs them: ``form`` (n,), one of PAIR, THIRD, FIR, FILTER; ``third`` (3, n): lam,
    lam^N and Theta of a third exponential; ``g`` (FIR_MAX, n): d_hat_k = sum_j g_j v_{k-j}; ``M``, ``W``,
    ``S`` (n, n): rho_k = M rho_{k-1} + v_k - d_hat_{k-1}, d_hat_k = d_hat_{k-1} + W rho_k, x_hat = x - S rho.
    Of an adaptive one ``N`` is the longest, ``short`` and ``first`` (n,) the lengths after a change, and
    ``g`` the bounds h sigma_n of the estimates by 1 to N ticks.
    """

    lam: Array
    lam_N: Array
    theta: Array
    N: Index
    form: Array = field(default_factory=_none)
    third: Array = field(default_factory=_none)
    g: Array = field(default_factory=_none)
    M: Array = field(default_factory=_none)
    W: Array = field(default_factory=_none)
    S: Array = field(default_factory=_none)
    short: Array = field(default_factory=_none)
    first: Array = field(default_factory=_none)

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.lam.shape[1])


def ftdob(gamma_1: Array, gamma_2: Array, delay_s: Array | float, T_s: float) -> Window:
    """FTDOB of Theorem 1: Theta = [I 0] [G, Lam^N G]^-1, N = round(D / T_s), per channel.

    gamma_1, gamma_2 [rad/s] (n,), delay D [s] scalar or (n,). With diagonal Gamma the inverse is per channel
    theta_1 = -lam_2^N / (lam_1^N - lam_2^N), theta_2 = lam_1^N / (lam_1^N - lam_2^N).
    Raises ControlDesignError that names the violated condition.
    """
    first, second, delay = (np.atleast_1d(np.asarray(a, float)) for a in (gamma_1, gamma_2, delay_s))
    if first.ndim != 1 or second.shape != first.shape or delay.shape not in ((1,), first.shape):
        raise ControlDesignError(
            "gamma_1, gamma_2 and D need one entry per channel, "
            f"not {first.shape}, {second.shape}, {delay.shape}"
        )
    gamma, delay = np.array([first, second]), np.broadcast_to(delay, first.shape)
    if not (np.isfinite(gamma).all() and (gamma > 0).all()):
        raise ControlDesignError(
            f"Gamma must be a positive diagonal matrix (Theorem 1, 1), not {gamma.ravel()}"
        )
    _check_tick(T_s)
    if not np.isfinite(delay).all():
        raise ControlDesignError(f"D must be finite (Theorem 1), not {delay}")
    if (delay < T_s * 0.999999).any():
        raise ControlDesignError(f"D = {delay.min()} s is shorter than a tick, T_s = {T_s} s; lengthen D")
    if (gamma[0] == gamma[1]).any():
        channel = int(np.argmax(gamma[0] == gamma[1]))
        raise ControlDesignError(
            f"equal poles in channel {channel}: gamma_1 = gamma_2 = {gamma[0, channel]} rad/s makes "
            "[G, Lam^N G] singular (Theorem 1, 2); move one of them"
        )
    N: Index = np.rint(delay / T_s).astype(np.int64)
    lam = _decay(gamma, T_s)
    lam_N: Array = np.array([[power(x, n) for x, n in zip(row, N, strict=True)] for row in lam])
    determinant = lam_N[1] - lam_N[0]
    singular = np.abs(determinant) <= SINGULAR * lam_N.max(axis=0)  # relative: both lam^N may be tiny
    if singular.any():
        channel = int(np.argmax(singular))
        raise ControlDesignError(
            f"[G, Lam^N G] is singular in channel {channel} to working precision: lam_1^N = "
            f"{lam_N[0, channel]:.6g}, lam_2^N = {lam_N[1, channel]:.6g} (Theorem 1, 2); "
            "move the poles apart or change D"
        )
    return Window(lam, lam_N, np.array([lam_N[1] / determinant, -lam_N[0] / determinant]), N)


def _decay(gamma: Array, T_s: float) -> Array:
    """e^{-gamma T_s}, entry by entry, the same to the bit on every machine."""
    return np.array([exp(float(-g * T_s)) for g in gamma.ravel()]).reshape(gamma.shape)


def _check_tick(T_s: float) -> None:
    """Refuse a sample time [s] that is none."""
    if not 0 < T_s < np.inf:
        raise ControlDesignError(f"T_s must be positive and finite, not {T_s}")


def conventional_dob(gamma_c: Array, T_s: float) -> Window:
    """Conventional DOB (31): d_hat = h, h_k = lam h_{k-1} + (1 - lam) v_k; gamma_c [rad/s] (n,)."""
    gamma = np.atleast_1d(np.asarray(gamma_c, float))
    if not (np.isfinite(gamma).all() and (gamma > 0).all()):
        raise ControlDesignError(f"Gamma_c must be positive, not {gamma}")
    _check_tick(T_s)
    lam = _decay(gamma, T_s)
    zero = np.zeros_like(lam)
    return Window(
        np.array([lam, lam]),
        np.array([zero, zero]),
        np.array([np.ones_like(lam), zero]),
        np.ones(lam.shape[0], np.int64),
    )


def exponentials(lam: Array, theta: Array, N: int) -> Window:
    """One channel of one to three exponentials; lam, theta (k,)."""
    lam, theta = (np.r_[a, np.zeros(3 - len(a))] for a in (lam, theta))
    lam_N = np.array([power(x, N) if weight else 0.0 for x, weight in zip(lam, theta, strict=True)])
    length = np.array([N], np.int64)
    first, first_N, weights = (np.reshape(a[:2], (2, 1)) for a in (lam, lam_N, theta))
    if theta[2] == 0:
        return Window(first, first_N, weights, length)
    return Window(
        first, first_N, weights, length, np.array([THIRD]), np.array([[lam[2]], [lam_N[2]], [theta[2]]])
    )


def fir(g: Array) -> Window:
    """One channel that weighs the past N innovations; g (N,), N at most FIR_MAX.

    Its pair has lam = 0: h = v, so that the pair's memory is that of v.
    """
    zero, padded = np.zeros((2, 1)), np.zeros((FIR_MAX, 1))
    padded[: len(g), 0] = g
    return Window(zero, zero, zero, np.array([len(g)], np.int64), np.array([FIR]), g=padded)


def adaptive(N: int, short: int, first: int, bounds: Array, e: float) -> Window:
    """One channel of variable length, ``first`` <= ``short`` <= N; bounds (N,), e = Ed of the channel."""
    one = fir(bounds)
    lengths = {"short": np.array([short]), "first": np.array([first])}
    return replace(one, form=np.array([ADAPTIVE]), S=np.array([[e]]), **lengths)


def linear_filter(M: Array, W: Array, S: Array | None = None) -> Window:
    """n channels of the filter rho_k = M rho_{k-1} + v_k - d_hat_{k-1}, d_hat_k = d_hat_{k-1} + W rho_k."""
    n = len(M)
    zero, one = np.zeros((2, n)), np.ones(n, np.int64)
    return Window(zero, zero, zero, one, np.full(n, FILTER), M=M, W=W, S=_none() if S is None else S)


def side_by_side(*windows: Window) -> Window:
    """One window whose channels are those of ``windows`` in turn."""
    every = ("lam", "lam_N", "theta", "N")
    own = {name: np.concatenate([getattr(w, name) for w in windows], axis=-1) for name in every}
    if not any(len(w.form) for w in windows):
        return Window(**own)
    rows = {"form": (), "third": (3,), "g": (FIR_MAX,), "short": (), "first": ()}
    for name, shape in rows.items():
        own[name] = np.concatenate([_part(w, name, (*shape, w.n)) for w in windows], axis=-1)
    square: dict[str, Any] = {name: np.zeros((own["N"].size, own["N"].size)) for name in ("M", "W", "S")}
    first = 0
    for w in windows:
        for name, whole in square.items():
            whole[first : first + w.n, first : first + w.n] = _part(w, name, (w.n, w.n))
        first += w.n
    return Window(**own, **square)


def _part(window: Window, name: str, shape: tuple[int, ...]) -> Array:
    """A part that may be empty, as zeros then."""
    part: Array = getattr(window, name)
    return part if part.size else np.zeros(shape)


@jit
def window_step(
    lam: Array,
    lam_N: Array,
    theta: Array,
    N: Index,
    v: Array,
    h: Array,
    past: Array,
    head: int,
    d_hat: Array,
) -> int:
    """Advance h by one tick with innovation v (n,) and write d_hat (n,); return the new head.

    h_i <- lam_i h_i + (1 - lam_i) v;  d_hat = sum_i theta_i (h_{i,k} - lam_i^N h_{i,k-N})
    ``h`` (2, n) is h_{k-1}; ``past`` (size, 2, n) is a ring of its past values, head points at h_{k-1}.
    """
    size = past.shape[0]
    new_head = (head + 1) % size
    for c in range(v.shape[0]):
        back = (new_head - N[c]) % size
        total = 0.0
        for i in range(2):
            value = lam[i, c] * h[i, c] + (1.0 - lam[i, c]) * v[c]
            total += theta[i, c] * (value - lam_N[i, c] * past[back, i, c])
            h[i, c] = value
        d_hat[c] = total
    for c in range(v.shape[0]):
        for i in range(2):
            past[new_head, i, c] = h[i, c]
    return int(new_head)


@jit
def fill(v: Array, h: Array, past: Array) -> None:
    """Fill the memory with the steady state of a disturbance v: h_i = v now and in the past."""
    for c in range(v.shape[0]):
        for i in range(2):
            h[i, c] = v[c]
            for j in range(past.shape[0]):
                past[j, i, c] = v[c]


@jit
def weigh_past(p: Any, s: Any) -> None:
    """work = sum_j g_j v_{k-j} over the longest FIR; the weights of a shorter one are 0 after its N.

    The channels side by side: one sum waits for its last addition, three do not wait for each other.
    """
    head, size, longest = s["head"], s["past"].shape[0], 0
    for c in range(3):
        if p["form"][c] == FIR:
            longest = max(longest, p["N"][c])
    w, q, d = 0.0, 0.0, 0.0
    for j in range(longest):
        at = (head - j) % size
        w += p["g"][j, 0] * s["past"][at, 0, 0]
        q += p["g"][j, 1] * s["past"][at, 0, 1]
        d += p["g"][j, 2] * s["past"][at, 0, 2]
    s["work"][0], s["work"][1], s["work"][2] = w, q, d


@jit
def shape_step(p: Any, s: Any) -> None:
    """Write d_hat of the channels of another form than PAIR, after :func:`window_step`; p, s: the records.

    FIR: d_hat = sum_j g_j v_{k-j}.  THIRD: d_hat += theta_3 (h_3,k - lam_3^N h_3,k-N).  FILTER: see Window.
    ADAPTIVE: see :mod:`hil.control.adaptive`.
    """
    v, head, size = s["v"], s["head"], s["past"].shape[0]
    weigh_past(p, s)
    for c in range(3):
        if p["form"][c] == FIR:
            s["d_hat"][c] = s["work"][c]
        elif p["form"][c] == THIRD:
            value = p["third"][0, c] * s["h_3"][c] + (1.0 - p["third"][0, c]) * v[c]
            s["h_3"][c] = value
            s["past_3"][head, c] = value
            back = (head - p["N"][c]) % size
            s["d_hat"][c] += p["third"][2, c] * (value - p["third"][1, c] * s["past_3"][back, c])
        elif p["form"][c] == FILTER:
            total = 0.0
            for j in range(3):
                total += p["M"][c, j] * s["rho"][j]
            s["work"][c] = total + v[c] - s["d_filter"][c]
        elif p["form"][c] == ADAPTIVE:
            adaptive_step(p, s, c)
    for c in range(3):
        if p["form"][c] == FILTER:
            s["rho"][c] = s["work"][c]
    for c in range(3):
        if p["form"][c] == FILTER:
            for j in range(3):
                s["d_filter"][c] += p["W"][c, j] * s["rho"][j]
            s["d_hat"][c] = s["d_filter"][c]


@jit
def shape_fill(p: Any, s: Any) -> None:
    """Fill the memory of the forms of :func:`shape_step` with the steady state of the disturbance s['v']."""
    for c in range(3):
        s["h_3"][c], s["d_filter"][c], s["rho"][c] = s["v"][c], s["v"][c], 0.0
        for j in range(s["past_3"].shape[0]):
            s["past_3"][j, c] = s["v"][c]
        if p["form"][c] == ADAPTIVE:
            adaptive_fill(p, s, c)


def impulse_response(window: Window, length: int) -> Array:
    """Response of d_hat to a unit impulse of v, per channel; shape (length, n).

    w_j = sum_i theta_i (1 - lam_i) lam_i^j for j < N, 0 from N on (a conventional DOB goes on). Of a filter
    that couples channels it is each channel's response to its own; of an adaptive window that of its longest.
    """
    weights = _pair_response(window, length)
    for c, form in enumerate(window.form):
        if form == FIR:
            weights[:, c] = np.r_[window.g[:length, c], np.zeros(max(0, length - FIR_MAX))]
        elif form == ADAPTIVE:
            weights[:, c] = parabola_weights(int(window.N[c]), length)
        elif form == THIRD:
            lam, lam_N, theta = window.third[:, c : c + 1]
            lam, lam_N, theta = (np.array([a, [0.0]]) for a in (lam, lam_N, theta))
            one = Window(lam, lam_N, theta, window.N[c : c + 1])
            weights[:, c] += _pair_response(one, length)[:, 0]
        elif form == FILTER:
            weights[:, c] = _filter_response(window, c, length)
    return weights


def parabola_weights(N: int, length: int) -> Array:
    """g of the parabola of N ticks, and zeros; shape (length,)."""
    j = np.arange(length)
    g: Array = 6.0 * (j + 1) * np.maximum(N - j, 0) / (N * (N + 1.0) * (N + 2))
    return g


def _filter_response(window: Window, c: int, length: int) -> Array:
    """Response of channel c of a linear filter to its own unit impulse."""
    rho, d, out = np.zeros(window.n), np.zeros(window.n), np.zeros(length)
    for k in range(length):
        rho = window.M @ rho - d + (np.arange(window.n) == c) * (k == 0)
        d = d + window.W @ rho
        out[k] = d[c]
    return out


def _pair_response(window: Window, length: int) -> Array:
    """:func:`impulse_response` of two exponentials a channel."""
    j = np.arange(length)[:, None]
    weights = np.zeros((length, window.n))
    for i in range(2):
        infinite = (1 - window.lam[i]) * window.lam[i] ** j
        shifted = np.where(j >= window.N, window.lam_N[i] * (1 - window.lam[i]), 0.0)
        weights += window.theta[i] * (infinite - shifted * window.lam[i] ** np.maximum(j - window.N, 0))
    return weights


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a window's estimate can reach, per channel (n,).

    ``ramp``: error per unit slope of d [s] (sup|d'| times it bounds the error; int phi of the errata);
    ``noise``: sigma(d_hat) / sigma(x) for white noise on x [1/s];
    ``resolution``: largest error for one LSB q of each state, rounding errors +-q/2 of the worst signs.
    """

    ramp: Array
    noise: Array
    resolution: Array


def response_length(window: Window) -> int:
    """Ticks after which a unit impulse has left every channel: N + 1; without a window, 1e-16 is left."""
    form = window.form if len(window.form) else np.full(window.n, PAIR)
    endless = (window.lam_N == 0).all(axis=0) & (form == PAIR)
    ticks = window.N.astype(float) + 1
    if (form == FILTER).any():
        of = np.block([[window.M, -np.eye(window.n)], [window.W @ window.M, np.eye(window.n) - window.W]])
        rest = np.abs(np.linalg.eigvals(of[np.ix_(np.tile(form == FILTER, 2), np.tile(form == FILTER, 2))]))
        ticks[form == FILTER] = np.ceil(np.log(1e-16) / np.log(np.clip(rest.max(), 1e-300, 1 - 1e-16))) + 1
    ticks[endless] = np.ceil(np.log(1e-16) / np.log(np.clip(window.lam[0, endless], 1e-300, 1 - 1e-16))) + 1
    return int(min(ticks.max(), MAX_RESPONSE))


def bounds(window: Window, Ad: Array, Ed: Array, T_s: float, lsb: Array) -> Bounds:
    """Bounds of a window on the sampled model; lsb (n,) is the resolution of x on the wire.

    x with error e_k gives v the error Ed^-1 (e_k - Ad e_{k-1}); through the window w the error of d_hat is
    sum_j (w_j Ed^-1 - w_{j-1} Ed^-1 Ad) e_{k-j}, whose worst case over |e| <= lsb/2 is its absolute sum.
    """
    weights = impulse_response(window, response_length(window))
    inverse = np.linalg.inv(Ed)
    shifted = np.vstack([np.zeros((1, window.n)), weights[:-1]])
    response = weights[:, :, None] * inverse[None] - shifted[:, :, None] * (inverse @ Ad)[None]
    remaining = np.abs(1.0 - np.cumsum(weights, axis=0))  # the weights of an estimator sum to 1
    return Bounds(
        ramp=(remaining.sum(axis=0) + 0.5) * T_s,
        noise=np.sqrt((response**2).sum(axis=(0, 2))),
        resolution=(np.abs(response) * (np.asarray(lsb, float) / 2)[None, None, :]).sum(axis=(0, 2)),
    )


def rule_of_thumb(lsb: float, delay_s: float) -> float:
    """One LSB q in x is about 1.4 q / D in d_hat."""
    return 1.4 * lsb / delay_s
