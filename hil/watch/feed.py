"""What viewers over the network get: the running run, found again when it ends, as small messages.

A message of data holds bins of a few ticks, each with its smallest and largest value, so that a spike of one
tick is always sent. Messages are JSON without NaN.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from hil.runtime.registry import WatchError, is_alive, matching, no_node
from hil.signals import FIELDS, Field, TickArray
from hil.watch.look import Look, figures, outcome

BINS_PER_S: Final = 100
CURVES: Final = tuple(field for field in FIELDS if field.shown.live)
LIVE: Final = ("speed", "current", "command", "load torque", "lateness")
"""Order of the page's plots; those of other names come behind."""
COMMAND_UNIT: Final = "V, or what the drive takes"
EVENTS: Final = 8


def finite(value: Any) -> Any:
    """JSON has no NaN: null."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def binned(ticks: TickArray, rate_hz: int) -> dict[str, list[float]]:
    """Time [s since the first tick] and curves of ``ticks``: two points a bin, minimum and maximum."""
    width = max(1, rate_hz // BINS_PER_S)
    starts = np.flatnonzero(np.diff(ticks["k"] // width, prepend=np.uint64(2**63)))
    t = ticks["k"][starts].astype(np.float64) / rate_hz
    out = {"t": np.repeat(t, 2).round(6).tolist()}
    for field in CURVES:
        values = ticks[field.name].astype(np.float64) * field.scale
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        out[field.name] = np.column_stack((low, high)).ravel().round(4).tolist()
    return out


def live_names(fields: Sequence[Field] = CURVES) -> list[str]:
    """Names of the page's plots, in their order."""
    found = dict.fromkeys(field.shown.live for field in fields if field.shown.live)
    return sorted(found, key=(*LIVE, *found).index)


def live_plots(fields: Sequence[Field] = CURVES) -> list[tuple[str, list[tuple[str, str]]]]:
    """Title with the unit, and the curves as (key, label), for each plot of the page."""
    plots: dict[str, list[tuple[str, str]]] = {}
    names = live_names(fields)
    for field in sorted(fields, key=lambda field: names.index(field.shown.live)):
        unit = COMMAND_UNIT if field.shown.live == "command" else field.drawn_unit
        title = f"{field.shown.live} [{unit}]"
        plots.setdefault(title, []).append((field.name, field.name.removesuffix("_ns")))
    return list(plots.items())


class Feed:
    """Follows one run after the other; :meth:`next` gives the messages that are new."""

    def __init__(self, wanted: str | None, node: str = "") -> None:
        self._wanted, self._node = wanted, node
        self._look: Look | None = None
        self._said = ""
        self.opening: list[str] = []
        """What a viewer who comes now must get first."""

    @property
    def look(self) -> Look | None:
        """The run that is watched."""
        return self._look

    def next(self) -> list[str]:
        """New messages since the last call."""
        if self._look is None:
            return self._find()
        ticks = self._look.new_ticks()
        if not self._look.alive:
            return self._lost(self._look)
        return [self._data(self._look, ticks)] if len(ticks) else self._silence(self._look)

    def _silence(self, look: Look) -> list[str]:
        """The figures of a loop that is silent, with their growing age."""
        newest = figures(look, look.latest(look.entry.rate_hz))
        if not newest.get("silent"):
            return []
        return [json.dumps(finite({"now": newest}), separators=(",", ":"), allow_nan=False)]

    def _find(self) -> list[str]:
        found = matching(self._wanted)
        if len(found) != 1:
            wait = (
                "waiting for a run" if not found else f"{len(found)} runs: name one, by PID, channel or log"
            )
            return self._status(wait) if not self._said.startswith("ended") or found else []
        if why := no_node(found[0], self._node):
            return self._status(why)
        try:
            self._look = Look(found[0], self._node)
        except WatchError as error:  # it ended between the two, or is of another version
            return self._status(str(error)) if is_alive(found[0]) else []
        entry = found[0]
        run = {"pid": entry.pid, "bus": entry.bus, "log": entry.log, "rate_hz": entry.rate_hz}
        run |= {"node": self._look.node} if entry.nodes else {}
        self._said = ""
        self.opening = [
            json.dumps(
                {"run": run | {"ticks": entry.ticks, "takes": self._look.takes, "plots": live_plots()}}
            )
        ]
        return list(self.opening)

    def _status(self, text: str) -> list[str]:
        if text == self._said:
            return []
        self._said = text
        self.opening = [json.dumps({"status": text})]
        return list(self.opening)

    def _lost(self, look: Look) -> list[str]:
        look.close()
        self._look = None
        return self._status(f"ended: {outcome(look.entry.log)}")

    def _data(self, look: Look, ticks: TickArray) -> str:
        recent = look.latest(look.entry.rate_hz)
        events = [[k, kind, text] for _, k, kind, text in look.events(EVENTS)]
        data = {"now": figures(look, recent), "curves": binned(ticks, look.entry.rate_hz), "events": events}
        return json.dumps(finite(data), separators=(",", ":"), allow_nan=False)

    def history(self) -> list[str]:
        """The opening and what the ring still holds, for a viewer who comes now."""
        if self._look is None:
            return list(self.opening)
        ticks = self._look.latest(3 * self._look.entry.rate_hz)
        return [*self.opening, *([self._data(self._look, ticks)] if len(ticks) else [])]
