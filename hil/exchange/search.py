"""The ticks of a recording, found with a way back: a wrong guess may show many ticks after it was made.

How many periods a tick comes after the last one, what it has read and what was asked are not on the wire.
:meth:`hil.exchange.rerun.Run.take` guesses by the stamps, and the command proves the guess; but where
the last command is held it proves nothing, and where it is rounded it may fit by chance. So when a tick
fits in no way, one of the choices before it is made another way, and what follows is gone through again.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from hil.errors import HilError
from hil.exchange.periods import Period, with_ahead
from hil.exchange.rerun import Before, Run
from hil.runtime.rules import COUNTER_JUMP
from hil.signals import Request, RxFlag, TickArray, ticks_from

WINDOW: Final = 300
"""Ticks that may still be taken back: as many periods as the longest wait with a held command, and more."""
CONFIRM: Final = 10
"""Ticks that another choice should lead through, from the one that did not fit."""
NEAR: Final = 5
TRIES: Final = 7_000
"""Runs of a tick that the search for one way on may take with one choice made another way;"""
DEEP, DEEP_TRIES = 4, 3_000
"""and with any choices of the last ticks. Both together take 1 to 2 s."""


class NotOursError(HilError):
    """The recorded commands are not what this controller gives."""


class Taken(NamedTuple):
    """A tick, where it began, and which of the ways that :meth:`hil.exchange.rerun.Run.take` finds it is."""

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
        return bool(good and tick["gap"] == 1 and tick["request"] == Request.ARM)


class Search:
    """The ticks of a run over a recording, the last few of which can be taken back."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._taken: deque[Taken] = deque()
        self._coming: deque[tuple[Period, list[int]]] = deque()

    def ticks(self, found: Iterable[Period]) -> Iterator[TickArray]:
        """Each tick once it is certain; one that the recording's end cuts off is left out.

        A drive that sends by its own clock was there before this controller: what came before the first
        command is not of its run. Raises NotOursError.
        """
        if not self._run.shadow:
            found = itertools.dropwhile(lambda period: not period.commands, found)
        whole = (one for one in with_ahead(found, self._run.period_ns) if one[0].closed or one[0].commands)
        self._coming.extend(itertools.islice(whole, CONFIRM))
        if not self._coming and not self._run.shadow:
            raise NotOursError("there is no command")
        while self._coming and not self._run.over:
            self._take()
            self._coming.extend(itertools.islice(whole, CONFIRM - len(self._coming)))
            while len(self._taken) > WINDOW:
                yield self._taken.popleft().ticks
        while self._taken:
            yield self._taken.popleft().ticks

    def _take(self) -> None:
        """Take the period that comes; where it fits in no way, make another choice before it."""
        if taken := self._first(*self._coming[0]):
            self._taken.append(taken)
            self._coming.popleft()
            return
        at, others = self._another_way()
        if not others:
            t_ns = self._coming[0][0].t_ns
            raise NotOursError(f"at {t_ns * 1e-9:.6f} s this controller sends something else")
        for _ in range(at + len(others) - len(self._taken)):
            self._coming.popleft()
        while len(self._taken) > at:
            self._taken.pop()
        self._taken += others
        self._again(others[-1])

    def _first(self, period: Period, ahead: list[int]) -> Taken | None:
        """The likeliest way to take a period, from where the run stands."""
        before = self._run.before()
        for _ in self._run.take(before, period, ahead):
            return Taken(before, period, ahead, 0, self._run.ticks.tobytes())
        return None

    def _another_way(self) -> tuple[int, list[Taken]]:
        """The place of a choice that is made another way, and the ticks from there on that then fit.

        Of those that lead past the period that comes the first that leads on to the end of what is known, or
        else the one that leads furthest; no ticks when there is none. The last few choices come first, then
        those that stamps leave open, then the others; of each the newest first.
        """
        most, best = self._run.tries + TRIES, (0, list[Taken]())
        reached, end = len(self._taken), len(self._taken) + len(self._coming)
        newest_first = range(reached - 1, -1, -1)
        for at in sorted(newest_first, key=lambda at: at < reached - NEAR and self._taken[at].sure):
            for other in self._others(self._taken[at]):
                ticks = [other, *self._go_on(at + 1)]
                if at + len(ticks) > reached:
                    reached, best = at + len(ticks), (at, ticks)
                    if reached == end or self._run.over:
                        return best
            if self._run.tries > most:
                break
        return best if best[1] else self._any_way(max(0, reached - DEEP))

    def _any_way(self, at: int) -> tuple[int, list[Taken]]:
        """As :meth:`_another_way`, with any choices from a place on: two hold-ups in a row take two."""
        best, most = (at, list[Taken]()), self._run.tries + DEEP_TRIES
        if at < len(self._taken):
            self._run.restore(self._taken[at].before)
            for ticks in self._ways_from(at, most):
                best = max(best, (at, ticks), key=lambda one: len(one[1]))
                if at + len(best[1]) == len(self._taken) + len(self._coming) or self._run.over:
                    break
        return best

    def _ways_from(self, place: int, most: int) -> Iterator[list[Taken]]:
        """The ways from a place on that lead past the period that comes, the last choices varied first."""
        if place > len(self._taken):
            yield list(self._go_on(place))
            return
        one = self._taken[place] if place < len(self._taken) else None
        period, ahead = (one.period, one.ahead) if one else self._coming[0]
        before = self._run.before()
        for way, _ in enumerate(self._run.take(before, period, ahead)):
            taken = Taken(before, period, ahead, way, self._run.ticks.tobytes())
            for later in self._ways_from(place + 1, most):
                yield [taken, *later]
            if self._run.tries > most:
                return

    def _others(self, taken: Taken) -> Iterator[Taken]:
        """The other ways to take a tick; the run stands after each."""
        before, period, ahead, own, _ = taken
        self._run.restore(before)
        for way, _ in enumerate(self._run.take(before, period, ahead)):
            if way != own:
                yield Taken(before, period, ahead, way, self._run.ticks.tobytes())

    def _go_on(self, place: int) -> Iterator[Taken]:
        """The ticks from a place on by first choices, up to one that does not fit or ends the run."""
        taken_before = ((taken.period, taken.ahead) for taken in self._taken)
        for period, ahead in itertools.islice(itertools.chain(taken_before, self._coming), place, None):
            taken = None if self._run.over else self._first(period, ahead)
            if taken is None:
                return
            yield taken

    def _again(self, taken: Taken) -> None:
        """Let the run stand after a tick that was taken."""
        self._run.restore(taken.before)
        ways = self._run.take(taken.before, taken.period, taken.ahead)
        next(itertools.islice(ways, taken.way, None))
