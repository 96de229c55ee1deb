"""Step responses, found and judged while a log streams by: moves of the reference and steps of the load.

A response lasts from its step to the next one, to the end of operation, or ten thousand ticks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from hil.report.curves import F8, since
from hil.report.metrics import RECOVERED_RAD_S
from hil.signals import DriveState, TickArray

MOST_TICKS: Final = 10_000
MOST_KEPT: Final = 200
REST_TICKS: Final = 5  # a reference that holds still for so long has stopped moving
LOAD_STEP_N_M: Final = 0.5
SETTLED_SHARE: Final = 0.02
_COLUMNS: Final = ("t", "w", "w_ref", "i_q", "T_L_true", "T_L_hat")
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Response:
    """How one step was answered. Times from the step on [s]; None where it has no meaning or never came.

    ``size``: of the load [N m] or of the reference [rad/s]; ``dip`` [rad/s]: largest |w - w*|;
    ``recovery_s``: until |w - w*| stays below 0.5 rad/s; ``rise_s``: from 10 to 90 % of the move;
    ``overshoot_percent`` of the move; ``settling_s``: until w stays within 2 % of the move (at least
    0.5 rad/s) around its end; ``iae`` [rad]: integral of |w - w*|; ``ripple`` [rad/s] and ``ripple_i`` [A]:
    standard deviation over the last half, when recovered by then; ``estimate_error`` [N m]:
    |T_L_hat - T_L| N ticks after a load step.
    """

    kind: Literal["load", "reference"]
    t: float
    size: float
    dip: float
    recovery_s: float | None
    rise_s: float | None
    overshoot_percent: float | None
    settling_s: float | None
    iae: float
    ripple: float | None
    ripple_i: float | None
    estimate_error: float | None


def last_outside(t: F8, deviation: F8, band: float) -> float | None:
    """Time from ``t[0]`` until |deviation| stays inside ``band``; None when it ends outside."""
    inside = np.abs(deviation) <= band
    if inside.all():
        return 0.0
    row = len(inside) - int(inside[::-1].argmin())
    return float(t[row] - t[0]) if row < len(t) else None


def judge(kind: Literal["load", "reference"], size: float, c: dict[str, F8], N: int) -> Response:
    """Judge the columns ``c`` of one response; N is the speed observer's window [ticks]."""
    t, error = c["t"], c["w"] - c["w_ref"]
    recovery = last_outside(t, error, RECOVERED_RAD_S)
    half = len(t) // 2
    calm = half > 10 and recovery is not None and recovery <= t[half] - t[0]
    move = _move(c) if kind == "reference" else (None, None, None, size)
    estimate = None
    if kind == "load" and len(t) > N + 1:
        estimate = _finite(abs(c["T_L_hat"][N] - c["T_L_true"][N]))
    return Response(
        kind, float(t[0]), move[3], largest(np.abs(error)), recovery,
        *move[:3],
        _total(np.abs(error[:-1]) * (t[1:] - t[:-1])),
        deviation(error[half:]) if calm else None,
        deviation(c["i_q"][half:]) if calm else None,
        estimate,
    )  # fmt: skip


def largest(sizes: F8) -> float:
    """Largest of numbers from 0 on, those that are none left out; 0 for none."""
    most = float(sizes.max(initial=0.0))
    return most if most == most else float(np.fmax.reduce(sizes, initial=0.0))


def _total(values: F8) -> float:
    """Sum of the values, those that are no number left out."""
    total = float(values.sum())
    return total if total == total else float(np.nansum(values))


def deviation(values: F8) -> float:
    """Standard deviation: numpy's, which takes longer to find its way than for a second of ticks."""
    apart = values - values.sum() / len(values)
    return math.sqrt((apart * apart).sum() / len(values))


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _move(c: dict[str, F8]) -> tuple[float | None, float | None, float | None, float]:
    """Rise, overshoot, settling and size of a move of the reference that has come to rest."""
    t, w, w_ref = c["t"], c["w"], c["w_ref"]
    start, end = float(w_ref[0]), float(w_ref[-1])
    size = end - start
    rests = len(t) > REST_TICKS and bool((w_ref[-REST_TICKS:] == end).all())
    if not rests or abs(size) < RECOVERED_RAD_S or not np.isfinite(w).any():
        return None, None, None, size
    share = (w - start) / size
    beyond = float(np.fmax.reduce(share)) - 1.0
    low, high = int((share >= 0.1).argmax()), int((share >= 0.9).argmax())
    rise = float(t[high] - t[low]) if share[high] >= 0.9 else None
    band = max(SETTLED_SHARE * abs(size), RECOVERED_RAD_S)
    return rise, 100.0 * max(beyond, 0.0), last_outside(t, w - end, band), size


def _changes(columns: F8, before: F8, name: str) -> F8:
    """What a column adds from tick to tick, to the one ``before`` in the first."""
    row = _COLUMNS.index(name)
    return since(columns[row], before[row, 0])


class Responses:
    """Finds and judges every response; keeps the first 200 and the worst figure of all."""

    def __init__(self) -> None:
        self.N = 1
        self.kept: list[Response] = []
        self.count = 0
        self.worst: dict[str, float] = {}
        self.unfinished: set[str] = set()
        self._open: tuple[Literal["load", "reference"], float, list[F8]] | None = None
        self._rows = 0
        self._last: F8 | None = None
        self._moved = -(10**9)
        self._row = 0

    def feed(self, t: F8, ticks: TickArray) -> list[tuple[int, float]]:
        """Take the next ticks; return (row, weight) of the steps that begin in them."""
        columns = np.empty((len(_COLUMNS), len(t)))
        columns[0] = t
        for place, name in enumerate(_COLUMNS[1:], 1):
            columns[place] = ticks[name]
        on = ticks["state"] == int(DriveState.OPERATION_ENABLED)
        before = columns[:, :1] if self._last is None else self._last[:, None]
        moved, stepped = (_changes(columns, before, name) for name in ("w_ref", "T_L_true"))
        found, at = [], 0
        for row, kind in self._steps(moved, stepped, on):
            self._extend(columns[:, at:row])
            self._close()
            at = row
            if kind is not None:
                size = float(stepped[row])
                start = [before] if kind == "reference" and row == 0 else []
                at -= 1 if kind == "reference" and row > 0 else 0  # it begins at the tick before
                self._open, self._rows = (kind, size, start), len(start)
                found.append((row, abs(size) if kind == "load" else 0.1))
        self._extend(columns[:, at:])
        self._last, self._row = columns[:, -1].copy(), self._row + len(t)
        return found

    def _steps(
        self, moved: F8, stepped: F8, on: npt.NDArray[np.bool_]
    ) -> Iterator[tuple[int, Literal["load", "reference"] | None]]:
        """Rows at which a response begins, or where operation ends (None)."""
        moving = np.nonzero(moved)[0]
        still = since(moving + self._row, self._moved) if len(moving) else moving
        self._moved = int(moving[-1]) + self._row if len(moving) else self._moved
        load = np.nonzero(np.abs(stepped) >= LOAD_STEP_N_M)[0]
        ends = np.nonzero(~on & np.concatenate([[True], on[:-1]]))[0]
        rows: dict[int, Literal["load", "reference"] | None] = dict.fromkeys(ends.tolist())
        rows |= {row: "reference" for row in moving[still > REST_TICKS].tolist() if on[row]}
        rows |= {row: "load" for row in load.tolist() if on[row]}
        yield from sorted(rows.items())

    def _extend(self, columns: F8) -> None:
        if self._open is not None and self._rows < MOST_TICKS:
            self._open[2].append(columns[:, : MOST_TICKS - self._rows])
            self._rows += min(columns.shape[1], MOST_TICKS - self._rows)

    def _close(self) -> None:
        """Judge the open response."""
        if self._open is None:
            return
        kind, size, parts = self._open
        self._open = None
        if self._rows < 3:
            return
        columns = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        response = judge(kind, size, dict(zip(_COLUMNS, columns, strict=True)), self.N)
        self.count += 1
        if len(self.kept) < MOST_KEPT:
            self.kept.append(response)
        self._remember(response)

    def _remember(self, response: Response) -> None:
        """Worst figures; a recovery or a settling that never came is worse than any."""
        for name in ("dip", "recovery_s", "estimate_error", "ripple"):
            if response.kind == "load" or name == "ripple":
                self._worse(name, getattr(response, name))
        for name in ("rise_s", "overshoot_percent", "settling_s"):
            if response.kind == "reference":
                self._worse(name, getattr(response, name))
        if response.kind == "load" and response.recovery_s is None:
            self.unfinished.add("recovery_s")
        if response.overshoot_percent is not None and response.settling_s is None:
            self.unfinished.add("settling_s")

    def _worse(self, name: str, value: float | None) -> None:
        if value is not None:
            self.worst[name] = max(self.worst.get(name, 0.0), value)

    def finish(self) -> None:
        """Judge what is open at the end of the log."""
        self._close()
