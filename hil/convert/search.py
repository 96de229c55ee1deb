"""The ticks of a recording, found with a way back: a wrong guess may show many ticks after it was made.

How many periods a tick comes after the last one, what it has read and what was asked are not on the wire.
:meth:`hil.convert.rerun.Run.take` guesses by the stamps, and the command proves the guess; but where the last
command is held it proves nothing, and where it is rounded it may fit by chance. So when a tick fits in no
way, one of the choices before it is made another way, and what follows is gone through again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from hil.convert.periods import Period, with_ahead
from hil.convert.rerun import Before, Run
from hil.errors import HilError
from hil.loop import COUNTER_JUMP
from hil.signals import Request, RxFlag, TickArray, ticks_from

WINDOW: Final = 300
"""Ticks that may still be taken back: as many periods as the longest wait with a held command, and more."""
TRIES: Final = 15_000
"""Runs of a tick that the search for one way on may take; about 1 s."""


class NotOursError(HilError):
    """The recorded commands are not what this controller gives."""


class Taken(NamedTuple):
    """A tick, where it began, and which of the ways that :meth:`hil.convert.rerun.Run.take` finds it is."""

    before: Before
    period: Period
    ahead: list[int]
    way: int
    tick: bytes

    @property
    def ticks(self) -> TickArray:
        """The tick."""
        return ticks_from(self.tick)

    @property
    def sure(self) -> bool:
        """Whether its choice is an everyday one: a measurement in time, a period after the last."""
        tick = self.ticks[0]
        good = int(tick["rx_flags"]) & (RxFlag.FRESH | COUNTER_JUMP) == RxFlag.FRESH
        return good and tick["gap"] == 1 and tick["request"] == Request.ARM


class Search:
    """The ticks of a run over a recording, the last few of which can be taken back."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._taken: deque[Taken] = deque()

    def ticks(self, found: Iterable[Period]) -> Iterator[TickArray]:
        """Each tick once it is certain; one that the recording's end cuts off is left out.

        Raises NotOursError.
        """
        for period, ahead in with_ahead(found, self._run.period_ns):
            if not (period.closed or period.commands):
                break
            self._take(period, ahead)
            if len(self._taken) > WINDOW:
                yield self._taken.popleft().ticks
            if self._run.over:
                break
        while self._taken:
            yield self._taken.popleft().ticks

    def _take(self, period: Period, ahead: list[int]) -> None:
        taken = self._first(period, ahead) or self._go_back(period, ahead)
        if not taken:
            raise NotOursError(f"at {period.t_ns * 1e-9:.6f} s this controller sends something else")
        self._taken.append(taken)

    def _first(self, period: Period, ahead: list[int]) -> Taken | None:
        """The likeliest way to take a period, from where the run stands."""
        before = self._run.before()
        for _ in self._run.take(before, period, ahead):
            return Taken(before, period, ahead, 0, self._run.ticks.tobytes())
        return None

    def _go_back(self, period: Period, ahead: list[int]) -> Taken | None:
        """Take a period that fits in no way after another choice before it; those between are taken anew."""
        most = self._run.tries + TRIES
        newest_first = range(len(self._taken) - 1, -1, -1)
        for at in sorted(newest_first, key=lambda at: self._taken[at].sure):
            for other in self._otherwise(self._taken[at]):
                later = self._go_on(at, period, ahead)
                if later:
                    while len(self._taken) > at:
                        self._taken.pop()
                    self._taken += [other, *later[:-1]]
                    return later[-1]
            if self._run.tries > most:
                break
        return None

    def _otherwise(self, taken: Taken) -> Iterator[Taken]:
        """The other ways to take a tick; the run stands after each."""
        before, period, ahead, own, _ = taken
        self._run.restore(before)
        for way, _ in enumerate(self._run.take(before, period, ahead)):
            if way != own:
                yield Taken(before, period, ahead, way, self._run.ticks.tobytes())

    def _go_on(self, at: int, period: Period, ahead: list[int]) -> list[Taken]:
        """The ticks after place ``at`` up to a period, by first choices; none when one fits in no way."""
        later: list[Taken] = []
        between = [(self._taken[i].period, self._taken[i].ahead) for i in range(at + 1, len(self._taken))]
        for one in [*between, (period, ahead)]:
            taken = self._first(*one)
            if taken is None:
                return []
            later.append(taken)
        return later
