"""One viewer's look at a run: new ticks and events since the last look, and numbers of the newest ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hil.log.errors import LogError
from hil.log.info import info
from hil.log.records import EVENT, EVENT_BYTES
from hil.log.ring import RingError, attach
from hil.runtime.clock import RealClock
from hil.runtime.inbox import SetpointError, ask, outside, shown
from hil.runtime.registry import Entry, WatchError, ask_stop, is_alive, no_node
from hil.signals import TICK, DriveState, Reason, Request, TickArray, ticks_from

SILENT_S, SILENT_PERIODS = 0.3, 3
"""Age from which a tick is no longer news, and at least so many periods."""
Event = tuple[int, int, str, str]
"""t_ns, tick, kind, text."""


def unpack_events(raw: bytes) -> list[Event]:
    """Events from the records of their ring."""
    found = []
    for at in range(0, len(raw), EVENT_BYTES):
        t_ns, k, kind_size, size = EVENT.unpack_from(raw, at)
        start = at + EVENT.size
        middle, end = start + kind_size, start + kind_size + size
        kind, text = raw[start:middle], raw[middle:end]
        found.append((t_ns, k, kind.decode(errors="replace"), text.decode(errors="replace")))
    return found


def ring_of(entry: Entry, node: str) -> str:
    """What the ring of a node's ticks is called."""
    place = entry.place_of(node)
    return f"ticks-{place}" if place else "ticks"


class Look:
    """A viewer's end of a run's rings, opened read-only. Raises WatchError when they can't be opened.

    ``node``: of a run with several nodes the one whose ticks are seen; empty: the first.
    """

    def __init__(self, entry: Entry, node: str = "") -> None:
        self.entry = entry
        self.node = node or next(iter(entry.nodes), "")
        if why := no_node(entry, node):
            raise WatchError(why)
        try:
            self._ticks = attach(entry.pid, ring_of(entry, self.node), TICK.itemsize)
            try:
                self._events = attach(entry.pid, "events", EVENT_BYTES)
            except RingError:
                self._ticks.close()
                raise
        except RingError as error:
            raise WatchError(str(error)) from error
        self._seen = self._events_seen = 0
        self._published, self._changed_ns = -1, 0

    def new_ticks(self) -> TickArray:
        """The ticks since the last look, at most what the ring holds."""
        raw, self._seen = self._ticks.since(self._seen)
        return ticks_from(raw)

    def age_s(self, ticks: TickArray) -> float:
        """Age of the newest of ``ticks``; in lockstep, since this viewer saw it come."""
        now_ns = RealClock().now_ns()
        if self.entry.clock == RealClock.name:
            return max(now_ns - int(ticks["t_ns"][-1]) - int(ticks["lateness_ns"][-1]), 0) * 1e-9
        if self._ticks.published != self._published:
            self._published, self._changed_ns = self._ticks.published, now_ns
        return (now_ns - self._changed_ns) * 1e-9

    def is_silent(self, age_s: float) -> bool:
        """True when the newest tick is too old for a loop that runs: it hangs, or was stopped."""
        return age_s > max(SILENT_S, SILENT_PERIODS / self.entry.rate_hz)

    def new_events(self) -> list[Event]:
        """The events since the last look."""
        raw, self._events_seen = self._events.since(self._events_seen)
        return unpack_events(raw)

    def latest(self, count: int) -> TickArray:
        """The newest ticks."""
        return ticks_from(self._ticks.latest(count))

    def events(self, count: int) -> list[Event]:
        """The newest events, oldest first."""
        return unpack_events(self._events.latest(count))

    @property
    def dropped(self) -> int:
        """Records that the log's ring had no room for."""
        return self._ticks.dropped

    @property
    def alive(self) -> bool:
        """True while the run's process is there."""
        return is_alive(self.entry)

    def stop(self, who: str) -> str:
        """Ask for an orderly stop; say in a few words what came of it."""
        newest = self.latest(1)
        if len(newest) and int(newest["request"][-1]) >= Request.RAMP_DOWN:
            return "stopping already"
        t_ns, k = (int(newest[name][-1]) for name in ("t_ns", "k")) if len(newest) else (0, 0)
        return "stop asked" if ask_stop(self.entry, who, t_ns, k) else "asked already, or ended"

    @property
    def takes(self) -> dict[str, tuple[float, float, float]]:
        """What may be set of what is seen."""
        return self.entry.takes_of(self.node)

    def set(self, values: dict[str, float], who: str) -> str:
        """Ask for other references; say in a few words what came of it."""
        if why := outside(values, self.takes):
            return f"refused: {why}"
        try:
            ask(self.entry.pid, values, who, timeout_s=0.5, node=self.entry.place_of(self.node))
        except SetpointError as error:
            return f"refused: {error}"
        return f"set: {shown(values)}"

    def close(self) -> None:
        """Let go of the rings."""
        self._ticks.close()
        self._events.close()


def figures(look: Look, ticks: TickArray) -> dict[str, Any]:
    """Numbers of the newest ticks: SI units, lateness in us, rate in Hz (None before two ticks).

    ``age_s`` is that of the newest; the rate of a loop that is silent is over the time until now.
    """
    if not len(ticks):
        return {"k": 0, "state": "arming", "reason": "", "dropped": look.dropped}
    t = ticks[-1]
    late = np.percentile(ticks["lateness_ns"] * 1e-3, (50, 99, 100))
    age_s = look.age_s(ticks)
    silent = look.is_silent(age_s)
    span_s = (int(t["t_ns"]) - int(ticks["t_ns"][0])) * 1e-9 + (age_s if silent else 0.0)
    names = ("w", "w_ref", "i_q", "i_d", "u_q", "u_d", "T_L_hat", "v_dc")
    return {
        "k": int(t["k"]),
        "state": DriveState(int(t["state"])).name.lower(),
        "reason": Reason(int(t["reason"])).name.lower() if t["reason"] else "",
        **{name: float(t[name]) for name in names},
        "lateness_us": {
            name: round(float(v), 1) for name, v in zip(("p50", "p99", "max"), late, strict=True)
        },
        "rate_hz": round((len(ticks) - 1) / span_s, 1) if span_s > 0 else None,
        "age_s": round(age_s, 3),
        "silent": silent,
        "skipped": int(ticks["skipped"].sum()),
        "dropped": look.dropped,
    }


def outcome(log: str) -> str:
    """How a run ended, by its log."""
    try:
        found = json.loads(info(Path(log)).metadata.get("result", {}).get("result", "{}"))
    except (LogError, OSError, ValueError) as error:
        return f"its log can't be read: {error}"
    ended = found.get("ended") if isinstance(found, dict) else None
    return str(ended or "its log has no result")
