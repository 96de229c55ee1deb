"""One pass over a log: fold, compare, judge; memory holds one block."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.config.design import Machine
from hil.errors import HilError
from hil.log.ahead import ahead
from hil.log.reader import Frame, Log, Source, new_log, read_blocks
from hil.log.schema import FRAME, Records
from hil.log.split import STATE
from hil.log.ticks import nothing
from hil.replay.fold import broken, compare, earliest, refold
from hil.replay.machine import Logged, logged_machine, restored
from hil.replay.verdict import Difference, Verdict
from hil.signals import FIELDS, Reason, TickArray

if TYPE_CHECKING:
    from hil.replay.frames import FrameCheck

NOTHING = {field.name: nothing(field) for field in FIELDS}


@dataclass(frozen=True, slots=True)
class Window:
    """The part of a run that is compared [s from its first tick]; the fold itself begins at the start."""

    start_s: float = 0.0
    end_s: float = math.inf

    def of(self, ticks: TickArray, first_ns: int) -> TickArray:
        """The ticks inside."""
        if self == Window():
            return ticks
        at = (ticks["t_ns"] - np.uint64(first_ns)) * 1e-9
        inside = (at >= self.start_s) & (at <= self.end_s)
        chosen: TickArray = ticks if inside.all() else ticks[inside]  # choosing copies field by field
        return chosen


@dataclass(slots=True)
class Replay:
    """One pass over a log's ticks, block by block; memory holds one block."""

    log: Log
    window: Window = dataclasses.field(default_factory=Window)
    machine: Machine | None = None
    first_ns: int = 0
    last_k: int = -1
    ticks: int = 0
    compared: int = 0
    why: str = ""
    impossible: str = ""
    notes: tuple[str, ...] = ()
    difference: Difference | None = None

    @property
    def whole(self) -> bool:
        """True when the whole run is compared."""
        return self.window == Window()

    def feed(self, ticks: TickArray) -> bool:
        """Take the next ticks; False when there is no more to learn."""
        try:
            return not self.impossible and (len(ticks) == 0 or self._take(ticks))
        except (HilError, ValueError) as error:
            self.impossible = str(error)
            return False

    def _begin(self, ticks: TickArray) -> bool:
        """Design the controller at the first tick; False when the run's beginning is missing."""
        self.first_ns, self.last_k = int(ticks["t_ns"][0]), int(ticks["k"][0]) - int(ticks["gap"][0])
        kept = self.log.attachments.get(STATE)
        if kept is not None:
            self.machine, self.last_k = restored(self._logged().machine, kept)
        elif int(ticks["k"][0]) != 0:
            self.why = f"the log begins at tick {int(ticks['k'][0])}; its beginning is missing"
            return False
        else:
            self.machine = self._logged().machine
        return True

    def _logged(self) -> Logged:
        """The controller of the log; what is to be said of it goes to the verdict."""
        found, log = logged_machine(self.log), self.log
        lacking = sorted(field.name for field in FIELDS if field.name in log.absent and field.role == "input")
        own = [f"the log lacks the input {name}, taken as {NOTHING[name]:g}" for name in lacking]
        own += [f"not known here and passed by: {', '.join(log.unknown)}"] if log.unknown else []
        self.notes = (*found.notes, *own)
        return found

    def _take(self, ticks: TickArray) -> bool:
        """Fold and compare a block; False when there is no more to learn."""
        if self.machine is None and not self._begin(ticks):
            return False
        assert self.machine is not None  # noqa: S101 - _begin made it
        whole = self._before_gap(ticks)
        if len(whole):
            again = refold(self.machine, whole)
            logged = self.window.of(whole, self.first_ns)
            self.difference = earliest(
                broken(logged, self.log.absent),
                compare(logged, self.window.of(again, self.first_ns), self.log.absent),
            )
            self.ticks, self.compared = self.ticks + len(whole), self.compared + len(logged)
            self.last_k = int(whole["k"][-1])
        past = len(whole) > 0 and (int(whole["t_ns"][-1]) - self.first_ns) * 1e-9 > self.window.end_s
        return len(whole) == len(ticks) and self.difference is None and not past

    def _before_gap(self, ticks: TickArray) -> TickArray:
        """The ticks before the first that the loop ran and the log lacks; skipped periods are none."""
        k = ticks["k"].astype(np.int64)
        missing = np.diff(k, prepend=self.last_k) - ticks["gap"]
        at = np.nonzero(missing)[0]
        if not len(at):
            return ticks
        row = int(at[0])
        before = int(k[row - 1]) if row else self.last_k
        self.why = (
            f"same up to tick {before}, then {int(missing[row])} records are missing before tick {k[row]}"
        )
        return ticks[:row]

    def verdict(self) -> Verdict:
        """What the pass found; ``log.damage`` is known by now."""
        damage = self.log.damage or ""
        if self.impossible:
            return Verdict("cannot", 0, why=self.impossible)
        if self.difference is not None:
            return Verdict("differs", self.compared, self.difference, damage, self.notes)
        if self.why:
            return Verdict("cannot", self.compared, None, self.why, self.notes)
        if self.compared == 0:
            empty = "the log has no ticks" if self.ticks == 0 else "the window has no ticks"
            return Verdict("cannot", 0, why=damage or empty)
        return Verdict("same", self.compared, None, damage, self.notes)


def _run(replay: Replay, blocks: Iterable[tuple[str, Records]], seen: Callable[[int], None]) -> Verdict:
    """Through the blocks of a log until there is no more to learn from ticks and frames."""
    more, frames = True, None
    for kind, records in blocks:
        if kind == "ticks" and more:
            more = replay.feed(records)
            seen(replay.ticks)
        if replay.whole and not replay.impossible and len(records):
            frames = frames or _frame_check(replay.log)
            frames.feed(kind, records)
        if not more and (frames is None or frames.over(replay.difference)):
            break
    if frames is not None and not replay.why:
        if whole_end(replay.log):
            frames.finish()
        if frames.difference is not None and complete_frames(replay.log):
            replay.difference = earliest(frames.difference, replay.difference)
    return replay.verdict()


def _frame_check(log: Log) -> FrameCheck:
    """Loaded for a log with frames alone: the wire's kernels are no part of the controller."""
    from hil.replay.frames import FrameCheck

    return FrameCheck(log)


def complete_frames(log: Log) -> bool:
    """True where no frame was lost on the way into the log."""
    return log.damage is None and log.result.get("dropped_frames", 0) == 0 and "ended" in log.result


def whole_end(log: Log) -> bool:
    """True where the frames of the last ticks are there: a kill takes some along, a next part has some."""
    return log.result.get("ended") in {reason.name.lower() for reason in Reason}


def replay_log(log: Log) -> Verdict:
    """Replay a log that has been read."""
    return _run(Replay(log), [("ticks", log.ticks), ("frames", frame_records(log.frames))], lambda _: None)


def frame_records(frames: Iterable[Frame]) -> Records:
    """Frames that were read as records of the log."""
    rows = [(f.t_ns, f.can_id, f.received, len(f.data), list(f.data.ljust(64, b"\0"))) for f in frames]
    return np.array(rows, FRAME)


def tick_blocks(log: Log) -> Iterator[TickArray]:
    """The ticks of a log file, block by block."""
    for block in read_blocks(log):
        if block.kind == "ticks":
            yield block.records


def replay(
    source: Source, window: Window | None = None, seen: Callable[[int], None] | None = None
) -> Verdict:
    """Replay a file, of a run with several nodes each; what can't be replayed is a verdict, not an exception.

    ``seen`` is told after each block how many ticks are done.
    """
    try:
        log = new_log(source)
        blocks = ahead(log, read_blocks)
        verdict = _run(Replay(log, window or Window()), blocks, seen or (lambda _: None))
        return _each(source, window or Window(), log.nodes, verdict) if log.nodes else verdict
    except (HilError, ValueError) as error:
        return Verdict("cannot", 0, why=str(error))


def _each(source: Source, window: Window, nodes: Sequence[str], first: Verdict) -> Verdict:
    """The worst verdict of all nodes, and each by its name."""
    found = {nodes[0]: first}
    for node in nodes[1:]:
        log = new_log(source, node)
        found[node] = _run(Replay(log, window), ahead(log, read_blocks), lambda _: None)
    name, worst = max(found.items(), key=lambda pair: pair[1].exit_code)
    why = f"{name}: {worst.why}" if worst.why else ""
    if worst.verdict == "differs" and not why:
        why = f"node {name}"
    return dataclasses.replace(worst, why=why, nodes=found)
