"""Sensitivity and margins from one response: what acts, after a unit pulse was added to it unannounced.

S = 1 / (1 + L) is its transform,  Ms = max |S|,  L = 1 / S - 1
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from hil.control.linalg import Array

POINTS: Final = 1 << 11


def peak_of(pulse: Array) -> float:
    """Ms, the largest |S|, from the response of what acts to a unit pulse added to it."""
    return float(np.abs(np.fft.rfft(pulse, max(POINTS, len(pulse)))).max())


@dataclass(frozen=True, slots=True)
class Margins:
    """Gain margin, phase margin [deg], delay margin [ms]."""

    gain: float
    phase_deg: float
    delay_ms: float


def margins_of(pulse: Array, T_s: float) -> Margins:
    """Margins from the response of what acts to a unit pulse added to it: S, and L = 1 / S - 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        L = 1 / np.fft.rfft(pulse, 1 << 16) - 1
    w = np.linspace(0, np.pi / T_s, len(L))[1:-1]
    L = L[1:-1]
    cross = np.nonzero((np.abs(L[:-1]) - 1) * (np.abs(L[1:]) - 1) <= 0)[0]
    real = np.nonzero((L[:-1].imag * L[1:].imag <= 0) & (L[:-1].real < 0) & (np.abs(L[:-1]) < 1))[0]
    gains, phases = 1 / np.abs(L[real]), np.angle(-L[cross])
    delays = phases % (2 * np.pi) / w[cross] * 1e3
    return Margins(
        float(gains.min(initial=math.inf)),
        float(np.degrees(np.abs(phases)).min(initial=math.inf)),
        float(delays.min(initial=math.inf)),
    )
