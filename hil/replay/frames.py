"""Logged frames against the ticks: decoded with the logged DBC they must give what the ticks measured.

They are read again by the kernels that read the bus. A tick's frames are those that passed before it was
computed; a log that lost frames, or whose map is of another version, is not compared, and a note says so.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from drivers.binding import Binding, bind
from drivers.codec import Database
from drivers.errors import DriverError
from drivers.mapping import RECEIVED, map_of
from drivers.refeed import refeed
from drivers.tables import incoming_tables
from drivers.wire import FRAME, STATE
from hil.config.tables import RunConfig, validate
from hil.errors import HilError
from hil.log.reader import Log
from hil.log.schema import Records
from hil.replay.fold import earliest, ulp_between
from hil.replay.sent import SentCheck
from hil.replay.verdict import Difference
from hil.signals import FIELDS, TICK, RxFlag, TickArray, new_ticks

COMPARED_FLAGS = (
    RxFlag.FRESH | RxFlag.CRC_ERROR | RxFlag.COUNTER_REPEATED | RxFlag.COUNTER_JUMP | RxFlag.LENGTH_ERROR
)
_KINDS = {field.name: field.kind for field in FIELDS}
BOUND_NS = 2**31 - 1
"""What a time of a tick is cut to."""
END_NS = 2**63 - 1
"""No frame comes later."""


def binding_of(log: Log) -> tuple[Binding, RunConfig]:
    """The map and the DBC of a log, bound. Raises HilError or DriverError."""
    try:
        config = validate(json.loads(log.attachments["config.json"]), RunConfig, "config.json", None)
        text = log.attachments["drive.dbc"]
    except (KeyError, ValueError, TypeError, RecursionError) as error:
        raise HilError(f"{error}") from error
    database = Database(Path("drive.dbc"), config.drive.node_id, config.drive.node_rule, text)
    parts = map_of(config.drive.signals, database, "drive.signals", **config.map_facts)
    return bind(parts, database, load=config.commands_load), config


class FrameCheck:
    """Ticks and frames as they come; ``difference`` is the first tick that its frames contradict."""

    def __init__(self, log: Log) -> None:
        self.difference: Difference | None = None
        self.note = ""
        self._ticks: list[TickArray] = []
        self._frames: list[Records] = []
        self._begun = False
        self.done_k = -1
        self._lockstep = log.metadata.get("run", {}).get("clock") == "lockstep"
        if log.metadata.get("run", {}).get("kind") != "run":
            self.note = "frames not compared: no run on a bus wrote the log"
            return
        try:
            binding, config = binding_of(log)
        except (HilError, DriverError) as error:
            self.note = f"frames not compared: {error}"
            return
        self._tick = new_ticks()
        messages, signals, needed = incoming_tables(binding, TICK)
        state, fields = np.zeros(1, STATE), TICK.fields
        assert fields is not None  # noqa: S101 - a record has fields
        state["needed"] = needed
        state["echo_at"] = -1 if binding.map.echo else fields["echo"][1]
        sync = binding.opener if config.loop.pacing == "sync" and not config.loop.shadow else None
        sent = (sync, binding.command.message, binding.emergency)
        ids = np.array([-1 if message is None else message.send_id for message in sent], np.int64)
        self._kernel: Any = (
            ids, messages, signals, np.full(max(len(messages), 1), -1, np.int64), state,
            np.zeros(2, np.uint32), np.zeros(128, np.uint8), self._tick.view(np.uint8), np.zeros(0, FRAME),
            fields["drive_error"][1],
        )  # fmt: skip
        names = {RECEIVED[part].field for bound in binding.incoming for part, _ in bound.parts}
        names |= {"echo"} | ({"drive_error"} if binding.emergency else set())
        if binding.map.states:
            names -= {"drive_state"}  # translated step by step from states of its own
        self._sent = SentCheck(binding)
        self._names = sorted(names & (set(_KINDS) - log.absent))

    def feed(self, kind: str, records: Records) -> None:
        """Take a block; compare what is complete: its frames are all there once a later one is."""
        if self.note or self.difference is not None:
            return
        (self._ticks if kind == "ticks" else self._frames).append(records)
        if self._frames and self._ticks:
            self._compare(int(self._frames[-1]["t_ns"][-1]))

    def over(self, difference: Difference | None) -> bool:
        """True when nothing earlier than ``difference`` is left to be found."""
        past = difference is None or self.done_k >= difference.tick
        return bool(self.note) or self.difference is not None or past

    def finish(self) -> None:
        """Compare what is left: no more frames will come."""
        if self.note or self.difference is not None:
            return
        if self._frames and self._ticks:
            self._compare(END_NS)
        if self.difference is None and self._frames:
            self.difference = self._sent.compare(np.empty(0, TICK), np.concatenate(self._frames), last=True)

    def _compare(self, until_ns: int) -> None:
        ticks = np.concatenate(self._ticks) if len(self._ticks) > 1 else self._ticks[0]
        if (np.abs(ticks["computed_ns"].astype(np.int64)) >= BOUND_NS).any():
            self.note = "frames not compared: a tick took longer than its record can say"
            return
        limits = ticks["t_ns"].astype(np.int64) + ticks["computed_ns"]
        count = int(np.argmax(limits >= until_ns)) if (limits >= until_ns).any() else len(ticks)
        if not count:
            self._ticks = [ticks]
            return
        frames = np.concatenate(self._frames)
        rows = np.empty((count, TICK.itemsize), np.uint8)
        flags = np.zeros(count, np.int64)
        if not self._begun:  # what came before the first tick is not known
            self._tick[:] = ticks[:1]
        before = self._sent.last if self._begun else ticks[:1]
        counters = np.concatenate((before["counter"], ticks["counter"][:count])).astype(np.int64)
        listens = (ticks["rx_flags"][:count] & RxFlag.GUARDIAN) != 0
        given: Any = (frames, limits[:count], counters, listens, *self._kernel, rows, flags)
        used = refeed(*given)
        self._judge(ticks[:count], rows.view(TICK)[:, 0], flags)
        sent = self._sent.compare(ticks[:count], frames[:used], last=until_ns == END_NS)
        self.difference = earliest(self.difference, sent)
        self.done_k = int(ticks["k"][count - 1])
        self._begun, self._ticks, self._frames = True, [ticks[count:]], [frames[used:]]
        self._frames = [part for part in self._frames if len(part)]
        self._ticks = [part for part in self._ticks if len(part)]

    def _judge(self, ticks: TickArray, again: TickArray, flags: Any) -> None:
        """The first tick that differs, and the field."""
        first: tuple[int, str, float, float] | None = None
        known = slice(0 if self._begun else 1, None)
        expected = ticks["rx_flags"].astype(np.int64) & COMPARED_FLAGS
        odd = np.nonzero((expected != flags & COMPARED_FLAGS)[known])[0] if self._lockstep else np.empty(0)
        if len(odd):
            row = int(odd[0]) + (known.start or 0)
            first = (row, "rx_flags", float(expected[row]), float(flags[row] & COMPARED_FLAGS))
        for name in self._names:
            a, b = np.ascontiguousarray(ticks[name]), np.ascontiguousarray(again[name])
            unequal = np.nonzero((a.view(f"u{a.itemsize}") != b.view(f"u{b.itemsize}"))[known])[0]
            row = int(unequal[0]) + (known.start or 0) if len(unequal) else len(ticks)
            if row < len(ticks) and (
                first is None or row < first[0] or (first[1] == "rx_flags" and row == first[0])
            ):
                first = (row, name, float(a[row]), float(b[row]))
        if first is not None:
            row, name, logged, found = first
            ulp = ulp_between(logged, found, _KINDS[name])
            self.difference = Difference(int(ticks["k"][row]), name, logged, found, ulp)
