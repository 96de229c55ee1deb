"""What the windows of a design reach: length, noise, bound of the resolution, lag, peak of |H|."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hil.control.law import LawSpec, design_law, exact_after, law_window, sampled_model
from hil.control.linalg import Array
from hil.control.observer import Window, bounds, impulse_response, parabola_weights, response_length
from hil.tuning.loop import LOAD, PULSE_I, PULSE_W, Record
from hil.tuning.measure import Bench, responses


def own_loop_figures(law: Record, bench: Bench, lsb: Array) -> dict[str, dict[str, float]]:
    """Figures of the speed channel of a drive with its own current loop, through what filters its speed.

    By the observer's own kernels, which no command answers here: d_hat after a step of d, and after one LSB.
    """
    kinds, believed = np.array([LOAD, PULSE_W, PULSE_I]), replace(bench, regulator=None)
    d = responses(law, [believed.plant(bench.motor)], kinds, bench.ticks, closed=False)[0, :, 3]
    step, by_w, by_i = -bench.motor.J * d[0], d[1], d[2] * law["u_i"][0]
    energy, size = ((by_w**2).sum(), (by_i**2).sum()), (np.abs(by_w).sum(), np.abs(by_i).sum())
    sigma = np.array([bench.w_noise, bench.i_noise])
    peak, N = float(np.abs(np.fft.rfft(np.diff(step, prepend=0.0))).max()), exact_after(law)[0]
    own = {
        "N": N,
        "D_ms": N * bench.T_s * 1e3,
        "sigma_d": float(np.sqrt((sigma**2 * energy).sum() / bench.every)),
        "lag_ms": float((1.0 - step).sum() - 0.5) * bench.T_s * 1e3,
        "peak_H": peak,
        "mismatch_allowed": 1.0 / peak,
        "lsb_bound": float((0.5 * lsb[:2] * size).sum()),
    }
    return {"speed": own}


def figures(spec: LawSpec, bench: Bench, lsb: Array) -> dict[str, dict[str, float]]:
    """Of the speed and the current channel; ``mismatch_allowed`` is 1 / peak |H| (small gain), the share by
    which k_t / J may be off while any loop around the estimate stays stable."""
    window, model = law_window(spec, bench.T_s), sampled_model(spec.motor, bench.T_s)
    weights = impulse_response(window, response_length(window))
    limits = bounds(window, model.Ad, model.Ed, bench.T_s, lsb)
    noises = np.array([bench.w_noise, bench.i_noise, bench.i_noise])
    found = {
        name: _channel(weights[:, c], model, bench, noises, c) | {"lsb_bound": float(limits.resolution[c])}
        for c, name in enumerate(("speed", "current"))
    }
    if spec.shaft is not None:
        found["speed"] = _beside_shaft(weights[:, 0], design_law(spec, bench.T_s), bench, lsb)
    for c, own in enumerate(found.values()):
        if window.short.size and window.short[c]:
            own |= _after_a_change(window, model, bench, noises, c)
    return found


def _beside_shaft(g: Array, law: Record, bench: Bench, lsb: Array) -> dict[str, float]:
    """Figures of the speed channel whose innovations rest on the shaft's states as well."""
    v_y, v_u, v_s = (law[name][0, :4] for name in ("v_y", "v_u", "v_s"))
    d = np.convolve(v_y, np.diff(law["gap_y"][0, :4], prepend=0.0))[:3]  # weights of d in an innovation
    by_w, h = np.convolve(g, v_y), np.convolve(g, d)
    by_i = np.convolve(g, np.convolve(v_u[:3], [0.5, 0.5]) + np.convolve(v_s[:3], [1.0, -1.0]))
    peak, N = float(np.abs(np.fft.rfft(h, max(4096, len(h)))).max()), exact_after(law)[0]
    return {
        "N": N,
        "D_ms": N * bench.T_s * 1e3,
        "sigma_d": math.hypot(
            bench.w_noise * np.linalg.norm(by_w).item(), bench.i_noise * np.linalg.norm(by_i).item()
        ),
        "lag_ms": float((h * (np.arange(len(h)) + 0.5)).sum() * bench.T_s * 1e3),
        "peak_H": peak,
        "mismatch_allowed": 1.0 / peak,
        "lsb_bound": float(0.5 * (lsb[0] * np.abs(by_w).sum() + lsb[1] * np.abs(by_i).sum())),
    }


def _after_a_change(window: Window, model: Any, bench: Bench, noises: Array, c: int) -> dict[str, float]:
    """Figures of an adaptive channel's short window, and the first length in ticks."""
    N = int(window.short[c])
    short = _channel(parabola_weights(N, N), model, bench, noises, c)
    return {f"short_{key}": short[key] for key in ("N", "D_ms", "sigma_d", "lag_ms")} | {
        "first_N": int(window.first[c])
    }


def _channel(g: Array, model: Any, bench: Bench, noises: Array, c: int) -> dict[str, float]:
    """Figures of one channel's weights."""
    inverse = model.gap_inverse[0]
    rows = np.r_[g, 0.0][:, None] * inverse[c] - np.r_[0.0, g][:, None] * (inverse @ model.Ad)[c]
    peak = float(np.abs(np.fft.rfft(g, max(4096, len(g)))).max())
    N = int(np.nonzero(np.abs(g) > 1e-12)[0][-1]) + 1
    return {
        "N": N,
        "D_ms": N * bench.T_s * 1e3,
        "sigma_d": float(np.sqrt(((rows * noises) ** 2).sum())),
        "lag_ms": float((g * (np.arange(len(g)) + 0.5)).sum() * bench.T_s * 1e3),
        "peak_H": peak,
        "mismatch_allowed": 1.0 / peak,
    }
