"""One pass over a log: everything that a report shows of it, in memory that does not grow with its length."""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import numpy as np

from hil.config.design import Machine
from hil.config.tables import RunConfig, validate
from hil.control.law import exact_after
from hil.errors import ConfigError, HilError
from hil.log.ahead import ahead
from hil.log.reader import Block, Log, Source, new_log, read_blocks
from hil.replay import Replay, Verdict, machine_of
from hil.report.angles import Angles
from hil.report.curves import CURVES, F4, F8, limit_lines, values_of
from hil.report.envelope import CloseUps, Envelope, merged
from hil.report.excursions import Excursions
from hil.report.frames import Frames, FrameTime
from hil.report.segments import Responses
from hil.report.statistics import Phases, Spectrum, Totals
from hil.runtime.bus import frame_time, message_names
from hil.signals import DriveState, TickArray
from hil.tick.reasons import explain

T = TypeVar("T")
STOP_WEIGHT: Final = 1e6  # a close-up of an end outweighs that of any load step


@dataclass(slots=True)
class Run:
    """All that a report knows of one log. Times are seconds from the first tick."""

    log: Log
    name: str
    config: RunConfig | None = None
    config_problem: str = ""
    N: tuple[int, int] = (1, 1)
    frame_time: FrameTime | None = None
    totals: Totals = field(default_factory=Totals)
    phases: Phases = field(default_factory=Phases)
    spectrum: Spectrum = field(default_factory=Spectrum)
    responses: Responses = field(default_factory=Responses)
    excursions: Excursions = field(default_factory=Excursions)
    angles: Angles = field(default_factory=Angles)
    frames: Frames = field(default_factory=Frames)
    envelope: Envelope = field(default_factory=lambda: Envelope(len(CURVES)))
    close_ups: CloseUps = field(default_factory=CloseUps)
    verdict: Verdict = field(default_factory=lambda: Verdict("cannot", 0, why="not asked for"))
    first_ns: int | None = None
    stop: Any = None
    """The first tick with a reason."""
    _safety: Any = None
    _state: int = int(DriveState.SWITCH_ON_DISABLED)

    def take(self, blocks: Generator[Block, None, T]) -> T:
        """Take all blocks of the log; return what their generator returns."""
        while True:
            try:
                kind, records = next(blocks)
            except StopIteration as end:
                found: T = end.value
                return found
            if len(records):
                (self.feed if kind == "ticks" else self.frames.feed)(records)

    def feed(self, ticks: TickArray) -> None:
        """Take the next ticks; what is no number in them is shown as that, not warned of."""
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            self._feed(ticks)

    def _feed(self, ticks: TickArray) -> None:
        if self.first_ns is None:
            self.begin(ticks)
        t: F8 = (ticks["t_ns"].astype(np.int64) - (self.first_ns or 0)).astype(np.float64) * 1e-9
        values = values_of(ticks)
        steps = self.responses.feed(t, ticks)
        ends = self._transitions(ticks)
        self.envelope.feed(t, values)
        self.close_ups.feed(t, values, sorted(steps + ends))
        self.totals.feed(t, ticks)
        self.excursions.feed(t, ticks)
        self.angles.feed(t, ticks)
        if self.stop is None and ticks["reason"].any():
            self.stop = ticks[int(np.argmax(ticks["reason"] != 0))].copy()
        self.phases.feed(ticks)
        self.spectrum.feed(ticks)

    def begin(self, ticks: TickArray) -> None:
        """At the first tick: its time, and the config, which stands before it in the file."""
        self.first_ns = int(ticks["t_ns"][0])
        self.read_config()

    def read_config(self) -> None:
        """The log's own config and design; what is unusable is said in the report."""
        try:
            data = json.loads(self.log.attachments["config.json"])
            self.config = validate(data, RunConfig, "config.json", None)
            machine: Machine = machine_of(self.log)
        except (KeyError, ValueError, TypeError, RecursionError) as error:
            self.config_problem = f"the log has no usable config ({error!r})"
        except (ConfigError, HilError) as error:
            self.config_problem = str(error)
        else:
            self._safety = machine.safety
            self.frame_time = frame_time(self.config)
            self.N = exact_after(machine.law)
            self.responses.N = self.N[0]

    def _transitions(self, ticks: TickArray) -> list[tuple[int, float]]:
        """Rows where the supervisor's state changes for a reason."""
        states = ticks["state"].astype(np.int64)
        changed = (np.diff(states, prepend=self._state) != 0) & (ticks["reason"] != 0)
        self._state = int(states[-1])
        return [(int(row), STOP_WEIGHT) for row in np.nonzero(changed)[0]]

    @property
    def node(self) -> str:
        """Which of several nodes on a bus it is; empty for a run of one drive."""
        return self.log.node

    @property
    def follows(self) -> bool:
        """False for a commanded torque: its speed reference means nothing, so there is no error to show."""
        return self.config is None or self.config.follows_speed

    @property
    def rate_hz(self) -> float:
        """Ticks a second, by the config or else by the ticks."""
        if self.config is not None:
            return float(self.config.loop.rate_hz)
        t, _, _ = self.envelope.bins()
        return self.envelope.width / float(np.median(np.diff(t))) if len(t) > 1 and t[-1] > t[0] else 1000.0

    @property
    def span_s(self) -> float:
        """Length of the run [s]."""
        if self.first_ns is None or self.log.last_t_ns is None:
            return 0.0
        return (self.log.last_t_ns - self.first_ns) * 1e-9

    @property
    def ended(self) -> str:
        """How the run says that it ended."""
        return str(self.log.result.get("ended", "unknown: the log has no result"))

    @property
    def end(self) -> dict[str, Any] | None:
        """Why it ended: as the log says, else from the first tick with a reason; None when neither tells."""
        said = self.log.result.get("end")
        if isinstance(said, dict) and {"reason", "text", "remedy"} <= said.keys():
            return said
        if self.stop is None or self._safety is None:
            return None
        found = explain(self._safety, None, self.stop)
        return found.as_dict() if found else None

    def curves(self) -> tuple[F8, F4, F4]:
        """Times [s], minima and maxima of all curves."""
        return merged(self.envelope, self.close_ups)

    def lines(self) -> dict[str, list[tuple[float, str]]]:
        """Limits a plot shows."""
        return limit_lines(self.config, self.N)

    def message_names(self) -> dict[int, str]:
        """Names of CAN identifiers by the log's own DBC."""
        return message_names(self.config, self.log.attachments.get("drive.dbc", ""))

    def bus_load(self) -> tuple[float, float] | None:
        """Mean and busiest second [%]."""
        return self.frames.load(self.frame_time) if self.frame_time else None

    def events(self, most: int) -> list[dict[str, Any]]:
        """The first events of the log with times on the report's axis."""
        first_ns = self.first_ns or 0
        return [
            {"t": (e["t_ns"] - first_ns) * 1e-9, "kind": e["kind"], "text": e["text"], "k": e["k"]}
            for e in self.log.events[:most]
        ]


def one_log(runs: Sequence[Run]) -> bool:
    """True for the nodes of one run: they share time, frames and events."""
    nodes = {run.node for run in runs}
    return len(runs) == len(nodes) > 1 and "" not in nodes and len({run.log.path for run in runs}) == 1


def collect_nodes(source: Source, *, verify: bool = True) -> list[Run]:
    """:func:`collect` of a run of one drive, or of each node of a run with several."""
    first = collect(source, verify=verify)
    return [first, *(collect(source, verify=verify, node=node) for node in first.log.nodes[1:])]


def named(runs: list[Run], *, alone: bool) -> list[Run]:
    """Nodes get their names; ``alone``: no other log is beside theirs."""
    for run in runs:
        run.name = f"{'' if alone else run.name + ' '}{run.node}" if run.node else run.name
    return runs


def collect(source: Source, *, verify: bool = True, node: str = "") -> Run:
    """Read a log, and replay it when ``verify``; ``node``: one after the first. Raises LogError."""
    log = new_log(source, node)
    run = Run(log, log.path.stem)
    verdict = run.take(ahead(log, _replaying if verify else read_blocks))
    with np.errstate(invalid="ignore", over="ignore"):
        run.responses.finish()
    if run.config is None and not run.config_problem:  # there was no tick
        run.read_config()
    log.node = node or next(iter(log.nodes), "")
    run.verdict = verdict or run.verdict
    return run


def _replaying(log: Log) -> Generator[Block, None, Verdict]:
    """The blocks of a log; returns what a replay of its ticks says."""
    again, more = Replay(log), True
    for block in read_blocks(log):
        if block.kind == "ticks":
            more = more and again.feed(block.records)
        yield block
    return again.verdict()
