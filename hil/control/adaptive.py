"""Kernels of the adaptive window: long while nothing happens, short from the tick at which d has changed on.

Every length n is a parabola, exact for a constant d and the one of least noise (Fliess and Join 2013):
    d_n = sum_{j<n} g_j v_{k-j},   g_j = 6 (j + 1)(n - j) / (n (n + 1)(n + 2))
With L the length of the tick before and d_hat its estimate, d has changed when for one of m = 1, 2, 4 .. L/2
    |d_m - d_hat| > h (sigma_m + sigma_L)
a bank of likelihood ratios on the exact innovation, as in FOAW (Janabi-Sharifi et al. 2000) and the adaptive
differentiators of Seeber and Haimovich (2023). The window is then max(m, ``short``) long, stays so until the
new level alone fills it (dwell), and grows by one a tick. Only from its full length N it goes to
max(m, ``first``), less than the margins of a lasting loop allow: once in N ticks is no lasting loop.

The law takes x_hat = x - Ed rho, the end of the least-squares line through the last F = L - ``short`` samples
and the present one, so that the short window's loop is that of the measured state:
    rho = sum_{j<F} s_j v_{k-j},   s_j = 1 - (j + 1)(4 F + 2 - 3 j) / ((F + 1)(F + 2))

A measurement that stands still says nothing of a change. Does it stand where the model says that it moves
(``doubt``), windows that are not longer than it stood say nothing of the jump that ends it either.
"""

from __future__ import annotations

from typing import Any

from hil.control.jit import jit


@jit
def parabola(s: Any, c: int, n: int) -> float:
    """Estimate by the last n innovations of channel c."""
    past, head, total = s["past"], s["head"], 0.0
    size = past.shape[0]
    for j in range(n):
        total += (j + 1.0) * (n - j) * past[(head - j) % size, 0, c]
    return float(6.0 * total / (n * (n + 1.0) * (n + 2.0)))


@jit
def line_end(s: Any, c: int, F: int) -> float:
    """rho of channel c: what takes a measurement to the end of the line through F + 1 samples."""
    past, head, total = s["past"], s["head"], 0.0
    size, scale = past.shape[0], (F + 1.0) * (F + 2.0)
    for j in range(F):
        total += (1.0 - (j + 1.0) * (4.0 * F + 2.0 - 3.0 * j) / scale) * past[(head - j) % size, 0, c]
    return float(total)


@jit
def changed(p: Any, s: Any, c: int, least: int) -> int:
    """The shortest window of more than ``least`` ticks that the present estimate can't hold with; or 0."""
    length, m = s["length"][c], 1
    while 2 * m <= length:
        if m > least:
            bound = p["g"][m - 1, c] + p["g"][length - 1, c]
            if abs(parabola(s, c, m) - s["d_filter"][c]) > bound:
                return m
        m *= 2
    return 0


@jit
def set_length(p: Any, s: Any, c: int) -> None:
    """The window's length for this tick, from what the newest innovation says."""
    length, still = s["length"][c], s["x"][c] == s["x_last"][c]
    m = changed(p, s, c, 0 if still else s["still"][c] * s["doubt"][c])
    if still and m > 0:
        s["doubt"][c], m = 1, 0
    shortest = p["first"][c] if length == p["N"][c] else p["short"][c]
    if m > 0 and max(m, shortest) <= length:
        s["length"][c] = max(m, shortest)
        s["hold"][c] = s["length"][c] - m // 2
    elif s["hold"][c] > 0:
        s["hold"][c] -= 1
    elif length < p["N"][c]:
        s["length"][c] = length + 1


@jit
def adaptive_step(p: Any, s: Any, c: int) -> None:
    """Write d_hat and rho of channel c, after the newest innovation has gone into the memory."""
    set_length(p, s, c)
    s["d_filter"][c] = parabola(s, c, max(s["length"][c], 1))  # a state from elsewhere may have 0
    s["d_hat"][c] = s["d_filter"][c]
    s["rho"][c] = line_end(s, c, max(s["length"][c] - p["short"][c], 0))


@jit
def adaptive_fill(p: Any, s: Any, c: int) -> None:
    """Begin with the short window, and with the first innovation in all of the memory."""
    s["length"][c] = s["hold"][c] = p["short"][c]
    s["still"][c] = s["doubt"][c] = 0


@jit
def remember(p: Any, s: Any, ticks: int) -> None:
    """Note for how long measurements have stood still; ``ticks`` since the one before."""
    for c in range(3):
        if p["short"][c] == 0:
            continue
        if s["x"][c] == s["x_last"][c]:
            s["still"][c] = min(s["still"][c] + ticks, p["N"][c])
        else:
            s["still"][c] = s["doubt"][c] = 0
        s["x_last"][c] = s["x"][c]
