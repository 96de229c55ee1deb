"""Figures of a whole run, gathered block by block: tracking, counts, phases of the tick, spectrum."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hil.report.curves import F8, STATE_NAMES, since
from hil.signals import DriveState, GuardFlag, RxFlag, TickArray

PER_DECADE: Final = 50
LOWEST_US: Final = 0.01
DECADES: Final = 9
SPECTRUM_TICKS: Final = 2048
SPECTRUM_FIELDS: Final = ("speed error", "i_q")
FLAG_NAMES: Final = {
    where: [(int(flag), f"{where}: {str(flag.name).lower().replace('_', ' ')}") for flag in kind]
    for where, kind in (("bus", RxFlag), ("guard", GuardFlag))
}


class Histogram:
    """Durations [us] in bins of equal ratio, 50 a decade: a percentile is good to 5 %, the maximum exact."""

    def __init__(self) -> None:
        self.counts = np.zeros(PER_DECADE * DECADES, np.int64)
        self.count, self.max, self.sum = 0, 0.0, 0.0

    def feed(self, values: F8) -> None:
        """Take values [us]; what is below 0.01 us counts there."""
        if len(values):
            place = PER_DECADE * np.log10(np.maximum(values, LOWEST_US) / LOWEST_US)
            index = np.minimum(place.astype(np.int64), len(self.counts) - 1)
            self.counts += np.bincount(index, minlength=len(self.counts))
            self.count, self.max = self.count + len(values), max(self.max, float(values.max()))
            self.sum += float(values.sum())

    def edges(self) -> F8:
        """Lower edge of each bin, and the upper of the last [us]."""
        out: F8 = LOWEST_US * 10.0 ** (np.arange(len(self.counts) + 1) / PER_DECADE)
        return out

    def percentile(self, share: float) -> float:
        """Upper edge of the bin that ``share`` of all values do not exceed [us], at most the maximum."""
        if self.count == 0 or self.max <= 0.0:
            return 0.0
        row = int(np.searchsorted(np.cumsum(self.counts), math.ceil(share * self.count)))
        return min(float(self.edges()[row + 1]), self.max)

    def as_dict(self) -> dict[str, float]:
        """Mean, percentiles and maximum [us]."""
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        mean = self.sum / self.count if self.count else 0.0
        return {"mean": mean} | {n: self.percentile(s) for n, s in shares.items()} | {"max": self.max}


class Phases:
    """What the parts of a tick cost [us]."""

    def __init__(self) -> None:
        names = ("woken late", "feedback", "control", "send", "record")
        self.parts = {name: Histogram() for name in names}

    def feed(self, ticks: TickArray) -> None:
        """Take ticks; the record's cost stands in the tick after."""
        at = {n: ticks[n] * 1e-3 for n in ("lateness_ns", "received_ns", "computed_ns", "sent_ns")}
        old = at["received_ns"] < at["lateness_ns"]  # paced by the timer: feedback of an earlier tick
        at["received_ns"][old] = at["lateness_ns"][old]
        self.parts["woken late"].feed(at["lateness_ns"])
        self.parts["feedback"].feed(at["received_ns"] - at["lateness_ns"])
        self.parts["control"].feed(at["computed_ns"] - at["received_ns"])
        self.parts["send"].feed(at["sent_ns"] - at["computed_ns"])
        recorded = ticks["recorded_ns"][1:] * 1e-3
        self.parts["record"].feed((recorded - at["sent_ns"][:-1])[recorded > 0])

    @property
    def lateness(self) -> Histogram:
        """Wake-up after the deadline."""
        return self.parts["woken late"]


class Spectrum:
    """Welch's mean power spectral density over windows of 2048 ticks in operation, Hann, mean removed."""

    def __init__(self) -> None:
        self._window = np.hanning(SPECTRUM_TICKS)
        self._power = np.zeros((len(SPECTRUM_FIELDS), SPECTRUM_TICKS // 2 + 1))
        self._rest = np.empty((len(SPECTRUM_FIELDS), 0))
        self.windows = 0

    def feed(self, ticks: TickArray) -> None:
        """Take ticks; a window never reaches over a gap or a tick out of operation."""
        x = np.stack([ticks["w"] - ticks["w_ref"], ticks["i_q"]])
        good = (ticks["state"] == int(DriveState.OPERATION_ENABLED)) & (ticks["gap"] == 1)
        good &= np.isfinite(x).all(axis=0)
        if not good.all():
            tail = int(np.nonzero(~good)[0][-1]) + 1
            self._rest, x = np.empty((len(x), 0)), x[:, tail:]
        self._rest = np.concatenate([self._rest, x], axis=1)
        while self._rest.shape[1] >= SPECTRUM_TICKS:
            part = self._rest[:, :SPECTRUM_TICKS]
            part = (part - part.mean(axis=1, keepdims=True)) * self._window
            self._power += np.abs(np.fft.rfft(part, axis=1)) ** 2
            self.windows += 1
            self._rest = self._rest[:, SPECTRUM_TICKS // 2 :]

    def density(self, rate_hz: float) -> tuple[F8, F8]:
        """Frequencies [Hz] from the first line on, and amplitude spectral densities [unit/sqrt(Hz)]."""
        scale = 2.0 / (rate_hz * float(np.sum(self._window**2)) * max(self.windows, 1))
        frequencies: F8 = np.arange(1.0, SPECTRUM_TICKS // 2 + 1) * (rate_hz / SPECTRUM_TICKS)
        density: F8 = np.sqrt(self._power * scale)[:, 1:]
        return frequencies, density


@dataclass(slots=True)
class Totals:
    """Sums and counts over a run; ``lost`` are ticks in operation without fresh feedback."""

    ticks: int = 0
    skipped: int = 0
    missing: int = 0
    operating: int = 0
    lost: int = 0
    not_a_number: int = 0
    squared_error: float = 0.0
    iae: float = 0.0
    peaks: dict[str, float] = field(default_factory=dict)
    flags: dict[str, int] = field(default_factory=dict)
    states: dict[str, int] = field(default_factory=dict)
    _k: int | None = None

    def feed(self, t: F8, ticks: TickArray, step: float | None = None) -> None:
        """Take the next ticks, at times ``t`` [s]; ``step``: their :func:`usual_step`, where it is known."""
        on = ticks["state"] == int(DriveState.OPERATION_ENABLED)
        fresh = (ticks["rx_flags"] & int(RxFlag.FRESH)) != 0
        error = np.abs(ticks["w"] - ticks["w_ref"])[on]
        good = error[np.isfinite(error)]
        self.ticks += len(ticks)
        self.skipped += int(ticks["skipped"].sum(dtype=np.int64))
        self.operating += len(error)
        self.lost += int(np.count_nonzero(on & ~fresh))
        self.not_a_number += len(ticks) - int(np.count_nonzero(np.isfinite(ticks["w"])))
        self.squared_error += float(np.sum(good**2))
        self.iae += float(np.sum(good)) * (usual_step(t) if step is None else step)
        self._gaps(ticks)
        self._count(ticks)
        for name in ("w", "i_q", "i_d", "u_q"):
            self.peaks[name] = max(self.peaks.get(name, 0.0), _peak(ticks[name]))

    def _gaps(self, ticks: TickArray) -> None:
        k = ticks["k"].astype(np.int64, copy=False)
        first = k[0] - ticks["gap"][0] if self._k is None else self._k
        self.missing += int(np.maximum(since(k, first) - ticks["gap"], 0).sum())
        self._k = int(k[-1])

    def _count(self, ticks: TickArray) -> None:
        if not self.flags:
            self.flags = dict.fromkeys((name for names in FLAG_NAMES.values() for _, name in names), 0)
        for where, column in (("bus", "rx_flags"), ("guard", "guard_flags")):
            for word, count in _tally(ticks[column]):
                for flag, name in FLAG_NAMES[where]:
                    self.flags[name] += count if word & flag else 0
        counts = np.bincount(np.minimum(ticks["state"], len(STATE_NAMES) - 1), minlength=len(STATE_NAMES))
        for name, count in zip(STATE_NAMES, counts.tolist(), strict=True):
            self.states[name] = self.states.get(name, 0) + count

    @property
    def tracking_rms(self) -> float | None:
        """RMS of w - w* in operation [rad/s]."""
        return math.sqrt(self.squared_error / self.operating) if self.operating else None


def usual_step(t: F8) -> float:
    """Median of the steps from one time to the next; 0 for a single one."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def _tally(words: npt.NDArray[Any]) -> list[tuple[int, int]]:
    """The words that are there, and how often; without sorting, where a table of them is small."""
    if words.max() >= 1 << 16:
        found, counts = np.unique(words, return_counts=True)
        return list(zip(found.tolist(), counts.tolist(), strict=True))
    counts = np.bincount(words)
    found = np.nonzero(counts)[0]
    return list(zip(found.tolist(), counts[found].tolist(), strict=True))


def _peak(values: npt.NDArray[Any]) -> float:
    """Largest finite |value|; 0 for none."""
    sizes = np.abs(values)
    most = float(sizes.max(initial=0.0))
    return most if math.isfinite(most) else float(sizes.max(initial=0.0, where=np.isfinite(sizes)))
