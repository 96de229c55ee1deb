"""Curves of a log of any length in bounded memory, such that no spike is lost.

:class:`Envelope` keeps the smallest and the largest value of each curve in bins of equally many ticks; when
there are too many bins, neighbours are joined. :class:`CloseUps` keeps every tick around what matters most.
:func:`merged` puts them together: coarse over the whole run, to the tick where something happened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from hil.report.curves import F4, F8

MOST_BINS: Final = 12_000  # even; 8 bytes a bin and curve end up in the page
BEFORE, LENGTH = 200, 2200  # ticks of a close-up before what happened, and in all
MOST_CLOSE_UPS: Final = 8


class Envelope:
    """Minimum and maximum of ``curves`` curves over bins of ``width`` ticks, a power of two.

    ``t`` [s] is a bin's first tick; a bin without any number is NaN. The last ticks, less than a bin, are one
    bin more in :meth:`bins`.
    """

    def __init__(self, curves: int, most: int = MOST_BINS) -> None:
        self.width = 1
        self._count, self._most = 0, most
        self._t = np.empty(most)
        self._low = np.empty((curves, most), np.float32)
        self._high = np.empty((curves, most), np.float32)
        self._rest_t = np.empty(0)
        self._rest = np.empty((curves, 0), np.float32)

    def feed(self, t: F8, values: F4) -> None:
        """Take the next ticks: their times [s] and values (curves, ticks)."""
        t = np.concatenate([self._rest_t, t])
        values = np.concatenate([self._rest, values], axis=1)
        while len(t) >= self.width:
            if self._count == self._most:
                self._halve()
                continue
            n = min(len(t) // self.width, self._most - self._count)
            self._add(t[: n * self.width], values[:, : n * self.width], n)
            t, values = t[n * self.width :], values[:, n * self.width :]
        self._rest_t, self._rest = t.copy(), values.copy()

    def _add(self, t: F8, values: F4, n: int) -> None:
        new = slice(self._count, self._count + n)
        binned = values.reshape(len(values), n, self.width)
        self._t[new] = t[:: self.width]
        self._low[:, new] = np.fmin.reduce(binned, axis=2)
        self._high[:, new] = np.fmax.reduce(binned, axis=2)
        self._count += n

    def _halve(self) -> None:
        """Join neighbouring bins."""
        half = self._most // 2
        self._t[:half] = self._t[::2]
        self._low[:, :half] = np.fmin(self._low[:, ::2], self._low[:, 1::2])
        self._high[:, :half] = np.fmax(self._high[:, ::2], self._high[:, 1::2])
        self._count, self.width = half, self.width * 2

    def bins(self) -> tuple[F8, F4, F4]:
        """Times [s], minima and maxima of all bins."""
        t, low, high = self._t[: self._count], self._low[:, : self._count], self._high[:, : self._count]
        if not len(self._rest_t):
            return t, low, high
        return (
            np.append(t, self._rest_t[0]),
            np.append(low, np.fmin.reduce(self._rest, axis=1)[:, None], axis=1),
            np.append(high, np.fmax.reduce(self._rest, axis=1)[:, None], axis=1),
        )


@dataclass(slots=True)
class CloseUp:
    """Every tick from row ``first`` on, until there are LENGTH of them."""

    first: int
    weight: float
    t: list[F8] = field(default_factory=list)
    values: list[F4] = field(default_factory=list)
    rows: int = 0

    def feed(self, t: F8, values: F4) -> None:
        """Take ticks that follow those held."""
        room = LENGTH - self.rows
        if room > 0:
            self.t.append(t[:room].copy())
            self.values.append(values[:, :room].copy())
            self.rows += min(room, len(t))


class CloseUps:
    """The close-ups of the greatest weight; of equal ones the earlier."""

    def __init__(self) -> None:
        self.kept: list[CloseUp] = []
        self._row = 0
        self._t, self._values = np.empty(0), np.empty((0, 0), np.float32)

    def feed(self, t: F8, values: F4, wanted: list[tuple[int, float]]) -> None:
        """Take the next ticks; ``wanted`` are (row in this block, weight) of what happened in them."""
        for one in self.kept:
            one.feed(t, values)
        if self._t.size:
            t, values = np.concatenate([self._t, t]), np.concatenate([self._values, values], axis=1)
        before = len(self._t)
        for row, weight in wanted:
            self._begin(self._row - before, row + before, weight, t, values)
        self._row += len(t) - before
        self._t, self._values = t[-BEFORE:].copy(), values[:, -BEFORE:].copy()

    def _begin(self, offset: int, at: int, weight: float, t: F8, values: F4) -> None:
        """Open a close-up unless one covers that row; the least one makes room."""
        row = offset + at
        if any(one.first <= row < one.first + LENGTH - BEFORE for one in self.kept):
            return
        if len(self.kept) == MOST_CLOSE_UPS:
            least = min(self.kept, key=lambda one: (one.weight, -one.first))
            if least.weight >= weight:
                return
            self.kept.remove(least)
        start = max(0, at - BEFORE)
        one = CloseUp(offset + start, weight)
        one.feed(t[start:], values[:, start:])
        self.kept.append(one)


def merged(envelope: Envelope, close_ups: CloseUps) -> tuple[F8, F4, F4]:
    """Times, minima and maxima: the envelope's bins, replaced by single ticks where a close-up has them."""
    t, low, high = envelope.bins()
    if envelope.width == 1:
        return t, low, high
    end, parts = 0, []
    for one in sorted(close_ups.kept, key=lambda one: one.first):
        first_bin = max(-(-one.first // envelope.width), end)
        last_bin = (one.first + one.rows) // envelope.width
        if last_bin <= first_bin:
            continue
        parts.append((t[end:first_bin], low[:, end:first_bin], high[:, end:first_bin]))
        rows = slice(first_bin * envelope.width - one.first, last_bin * envelope.width - one.first)
        values = np.concatenate(one.values, axis=1)[:, rows]
        parts.append((np.concatenate(one.t)[rows], values, values))
        end = last_bin
    parts.append((t[end:], low[:, end:], high[:, end:]))
    times, lows, highs = zip(*parts, strict=True)
    return np.concatenate(times), np.concatenate(lows, axis=1), np.concatenate(highs, axis=1)
