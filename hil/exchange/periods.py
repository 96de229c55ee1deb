"""How the frames of a recording make up ticks: which belong to which, and when each tick was."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

FOLLOW_TICKS: Final = 1000
EARLY_SHARE: Final = 10
"""No stamp is taken to be earlier than its deadline by more than this part of a period,"""
TIGHT_SHARE: Final = 50
"""and none that the grid has been set back to by more than this."""
HELD_SHARE: Final = 4
"""Part of a period that a loop takes at most between waking and SYNC, unless it is held up."""
AHEAD: Final = 4
BURST: Final = 3
MERGE_PERIODS: Final = 5
"""So long after a command a measurement without one counts as skipped by the controller."""
HELD_PERIODS: Final = 1000
"""The same where the controller is this one: it comes back from being stopped, or its run is over."""
GAPS_MOST: Final = 100
"""So many gaps are tried between those that the stamps leave open; over 64 periods none is like another."""
MOST_NS: Final = 2**31 - 1
JUMP_NS: Final = 60_000_000_000
"""A drive, its controller or its recorder is long stopped when nothing of a run came for so long."""


class Heard(NamedTuple):
    """One recorded frame. ``t_ns`` from the first on; ``can_id`` carries SocketCAN's flag bits."""

    t_ns: int
    can_id: int
    received: bool
    fd: bool
    data: bytes


class Roles(NamedTuple):
    """Which identifiers play which part: ``sync`` is None where the drive sends by its own clock.

    ``measuring``: the messages of a measurement, all of which make one; ``commands``: the controller's;
    ``slow``: what else the drive is judged by, as its status.
    """

    sync: int | None
    measuring: frozenset[int]
    commands: Collection[int]
    slow: frozenset[int] = frozenset()


@dataclass(slots=True)
class Period:
    """The frames of one tick: ``late`` came before its SYNC, ``answers`` to it, then ``commands``.

    ``after``: what a listener heard between a measurement and its command, read with this tick or the next.
    ``t_ns``: when SYNC passed, or the measurement was complete; ``answered_ns``, ``sent_ns``: the last of
    each, -1 for none. ``closed`` is False for the last one, which may be cut off.
    """

    t_ns: int
    late: list[Heard] = field(default_factory=list)
    answers: list[Heard] = field(default_factory=list)
    commands: list[Heard] = field(default_factory=list)
    after: list[Heard] = field(default_factory=list)
    answered_ns: int = -1
    sent_ns: int = -1
    closed: bool = True

    def answer(self, frame: Heard) -> None:
        """Take a frame of the drive."""
        self.answers.append(frame)
        self.answered_ns = frame.t_ns

    def cut(self, timeout_ns: int) -> list[Heard]:
        """Without a command: keep what came in time, return the rest."""
        in_time = [frame for frame in self.answers if self.commands or frame.t_ns <= self.t_ns + timeout_ns]
        rest, self.answers = self.answers[len(in_time) :], in_time
        if rest:
            self.answered_ns = in_time[-1].t_ns if in_time else -1
        return rest

    def command(self, frame: Heard) -> None:
        """Take a frame of the controller."""
        self.commands.append(frame)
        self.sent_ns = frame.t_ns


@dataclass(slots=True)
class Steady:
    """Periods up to a jump of the recorder's clock: none of a run comes a minute after another.

    ``jump``: the stamps before and after it [ns]; None when there was none among what was asked for.
    """

    found: Iterable[Period]
    jump: tuple[int, int] | None = None

    def periods(self) -> Iterator[Period]:
        """The periods."""
        last_ns: int | None = None
        for period in self.found:
            if last_ns is not None and period.t_ns - last_ns > JUMP_NS:
                self.jump = last_ns, period.t_ns
                return
            yield period
            last_ns = period.t_ns


class Whose(NamedTuple):
    """A frame, whether the controller sent it, and whether its own side recorded it, as read."""

    frame: Heard
    own: bool
    as_read: bool


def periods(
    frames: Iterable[Heard], roles: Roles, timeout_ns: int, period_ns: int, merge: int = MERGE_PERIODS
) -> Iterator[Period]:
    """The ticks that the frames make up. ``merge``: periods, of :data:`MERGE_PERIODS`."""
    if roles.sync is None:
        return _by_feedback(_with_foreign(frames, roles), roles, period_ns, merge * period_ns)
    return _by_sync(_with_foreign(frames, roles), roles, timeout_ns)


def _with_foreign(frames: Iterable[Heard], roles: Roles) -> Iterator[Whose]:
    """Each frame and whether the controller sent it.

    A recording made by the controller's own side says so of its frames; a command that it *received* is then
    somebody else's. One made by a listener received them all.
    """
    ours = {*roles.commands, roles.sync}
    own_side: bool | None = None
    for frame in frames:
        own = frame.can_id in ours
        if own and own_side is None:
            own_side = not frame.received
        yield Whose(frame, own and not (own_side and frame.received), bool(own_side))


def _by_sync(frames: Iterable[Whose], roles: Roles, timeout_ns: int) -> Iterator[Period]:
    """A tick begins with SYNC; what the drive says after the tick's command is late for it.

    Where no command was sent, it is late after the timeout. What came before the first SYNC is not the run's.
    """
    period: Period | None = None
    late: list[Heard] = []
    for frame, own, _ in frames:
        if own and frame.can_id == roles.sync:
            if period is not None:
                late = period.cut(timeout_ns) + late
                yield period
            period, late = Period(frame.t_ns, late if period is not None else []), []
        elif period is None:
            continue
        elif own:
            period.command(frame)
        elif period.commands:
            late.append(frame)
        else:
            period.answer(frame)
    if period is not None:
        period.cut(timeout_ns)
        period.closed = False
        yield period


def _by_feedback(frames: Iterable[Whose], roles: Roles, period_ns: int, merge_ns: int) -> Iterator[Period]:
    """A tick is a measurement that is complete, and the commands up to where the next one begins.

    Of several measurements before a command the loop takes the newest and counts the others as skipped. A
    command without a measurement is a tick whose wait was in vain. What else the drive says after it has
    measured is read with the next tick, if the controller itself has not recorded that it read it before; of
    what came before the command a listener can't know.
    """
    period, queued, missing = Period(0), list[Heard](), set(roles.measuring)
    commanded_ns = -merge_ns
    for frame, own, as_read in frames:
        measures = not own and frame.can_id in roles.measuring
        again = own and any(frame.can_id == other.can_id for other in period.commands)
        opened = not missing or bool(period.commands)
        together = not period.commands and (
            frame.t_ns - period.t_ns < period_ns // 2 or frame.t_ns - commanded_ns < merge_ns
        )
        if again or (measures and opened and not together):
            yield period
            period, queued, missing = Period(0, answers=queued), [], set(roles.measuring)
            opened = False
        if own:
            if not period.commands:  # the first of all tells whose recording it is
                period.answers += queued if as_read else []
                period.after, queued = [] if as_read else queued, []
            period.command(frame)
            commanded_ns = frame.t_ns
            period.t_ns = frame.t_ns if missing else period.t_ns
        elif opened and not measures and (period.commands or not as_read):
            queued.append(frame)
        else:
            period.answers += queued
            queued = []
            period.answer(frame)
            missing.discard(frame.can_id)
            period.t_ns = frame.t_ns
    if not missing or period.commands:
        period.closed = False
        yield period


def with_ahead(found: Iterable[Period], period_ns: int = 0) -> Iterator[tuple[Period, list[int]]]:
    """Each period with the stamps of the few that follow it, up to those that make up a burst.

    A loop has at most three ticks within ``period_ns``; more are the frames that stop the drive.
    """
    window: deque[Period] = deque()
    for period in found:
        window.append(period)
        if len(window) > AHEAD + BURST:
            yield window.popleft(), _stamps(window, period_ns)
    while window:
        yield window.popleft(), _stamps(window, period_ns)


def _stamps(window: deque[Period], period_ns: int) -> list[int]:
    stamps = [period.t_ns for period in window]
    burst = (at for at, t_ns in enumerate(stamps[BURST:]) if t_ns - stamps[at] < period_ns)
    return stamps[: min(next(burst, AHEAD), AHEAD)]


def around(first: int, least: int, most: int) -> list[int]:
    """Gaps to be tried: ``first``, the ends of what the stamps leave open, beside it, what is between."""
    between = range(least, min(most + 1, least + GAPS_MOST))
    return [gap for gap in dict.fromkeys([first, least, most, first - 1, first + 1, *between]) if gap > 0]


class Grid:
    """Deadlines for stamps: one a period from the first stamp on, whole periods skipped as the loop does.

    The recorder's clock is not the loop's: the grid is set back at once by a stamp that comes early, and
    forward each thousand ticks by the least lateness among them.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._start_ns = 0
        self._least_ns, self._left = MOST_NS, FOLLOW_TICKS
        self.k = -1

    def saved(self) -> tuple[int, int, int, int]:
        """What the ticks so far have left; :meth:`restore` goes back there."""
        return self._start_ns, self._least_ns, self._left, self.k

    def restore(self, saved: tuple[int, int, int, int]) -> None:
        """Be as one was when that was saved."""
        self._start_ns, self._least_ns, self._left, self.k = saved

    def gap(self, t_ns: int, ahead: Iterable[int]) -> int:
        """Periods from the last tick to one whose SYNC is stamped ``t_ns``, at most.

        A SYNC may come late although its tick was on time (the process was held up between the two). The
        stamps ``ahead`` tell: none of them can come before its deadline.
        """
        if self.k < 0:
            return 1
        gap = self._since(t_ns, TIGHT_SHARE)
        for later, stamp_ns in enumerate(ahead, start=1):
            gap = min(gap, self._since(stamp_ns, EARLY_SHARE) - later)
        return max(1, gap)

    def gaps(self, t_ns: int, ahead: Iterable[int], since_ns: int) -> list[int]:
        """:meth:`gap` and what else it may be, the likeliest first. ``since_ns``: the last tick's last frame.

        The loop woke between the two. Where the stamps ahead say that SYNC came much later than that, it
        was held up after it woke, and then most likely had woken on time.
        """
        most = self.gap(t_ns, ahead)
        least = min(max(1, self._since(since_ns, TIGHT_SHARE)), most) if self.k >= 0 else 1
        held = most < self._since(t_ns - self._period_ns // HELD_SHARE, TIGHT_SHARE)
        return around(least if held else most, least, most)

    def _since(self, t_ns: int, share: int) -> int:
        """Periods from the last tick's deadline to a stamp that may be early by a share of one."""
        return (t_ns + self._period_ns // share - self._start_ns) // self._period_ns - self.k

    def place(self, t_ns: int, gap: int) -> int:
        """Take the tick; return its deadline [ns]."""
        if self.k < 0:
            self._start_ns, gap = t_ns, 1
        self.k += gap
        deadline_ns = self._start_ns + self.k * self._period_ns
        self._follow(t_ns - deadline_ns)
        return self._start_ns + self.k * self._period_ns

    def _follow(self, lateness_ns: int) -> None:
        if lateness_ns < 0:
            self._start_ns += lateness_ns
        self._least_ns, self._left = min(self._least_ns, lateness_ns), self._left - 1
        if self._left == 0:
            self._start_ns += max(self._least_ns, 0)
            self._least_ns, self._left = MOST_NS, FOLLOW_TICKS
