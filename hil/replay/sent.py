"""Sent frames against the ticks: a tick's command, laid out again with the logged map, must give the frame.

A command belongs to the tick that was computed last before it; one that the drive answers goes out at the
begin of the next, and says off where there is none. After the last tick stop frames follow.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.binding import MOST_COUNTS, Binding
from drivers.errors import DriverError
from drivers.refeed import resend
from drivers.tables import command_values, outgoing_tables, sent_offsets
from drivers.wire import DATA_AT, FRAME, STATE
from hil.log.schema import Records
from hil.replay.fold import ulp_between
from hil.replay.verdict import Difference
from hil.signals import FIELDS, TICK, TickArray, new_ticks

_KINDS = {field.name: field.kind for field in FIELDS}
_FIELD_OF = {
    "load_torque": "T_L",
    "enable": "controlword",
    "reset": "controlword",
    "i_q_ref": "u_q",
    "i_d_ref": "u_d",
    "torque_ref": "u_q",
}


class SentCheck:
    """Compares a run's commands tick by tick; the next block's first frames follow the tick ``last``."""

    def __init__(self, binding: Binding) -> None:
        self._binding, self._polls = binding, binding.map.poll != ""
        self.last: TickArray = np.empty(0, TICK)
        messages, signals = outgoing_tables(binding)
        self._ids, self._raw = messages["id"], np.zeros(128, np.uint8)
        self._given: Any = (
            sent_offsets(TICK), command_values(), messages, signals, np.zeros(1, STATE),
            np.zeros(2, np.uint32), self._raw, np.zeros(0, FRAME),
        )  # fmt: skip
        self._stops = new_ticks(MOST_COUNTS)
        self._stops["counter"] = np.arange(MOST_COUNTS)

    def compare(self, ticks: TickArray, frames: Records, last: bool) -> Difference | None:
        """The first of these ``ticks`` whose frames say something else; ``last``: no tick follows them."""
        ticks = np.concatenate((self.last, ticks))
        if not len(ticks):
            return None
        frames = frames[(frames["received"] == 0) & np.isin(frames["can_id"], self._ids)]
        computed = ticks["t_ns"].astype(np.int64) + ticks["computed_ns"]
        sent = frames["t_ns"].astype(np.int64)
        owners = np.searchsorted(computed, sent, "left" if self._polls else "right") - 1
        off = (last & (sent >= computed[-1])) | (self._polls & (ticks["send"][owners] == 0))
        for at in np.nonzero(self._wrong(frames, owners, ticks))[0]:
            if not (off[at] and self._is_stop(frames[at : at + 1])):
                return self._difference(ticks[owners[at] : owners[at] + 1], frames[at : at + 1])
        self.last = ticks[-1:].copy()
        return None

    def _wrong(self, frames: Records, owners: Any, ticks: TickArray) -> Any:
        """Which frames are not what their ticks make."""
        wrong = np.zeros(len(frames), np.uint8)
        rows = np.ascontiguousarray(ticks).view(np.uint8).reshape(len(ticks), TICK.itemsize)
        given: Any = (frames, owners.astype(np.int64), rows, *self._given, wrong)
        resend(*given)
        return wrong

    def _is_stop(self, frame: Records) -> bool:
        """Is it a stop frame: nothing but zero and off, with any counter?"""
        frames = np.repeat(frame, MOST_COUNTS)
        return not self._wrong(frames, np.arange(MOST_COUNTS), self._stops).all()

    def _difference(self, tick: TickArray, frame: Records) -> Difference:
        """The first value that is not the tick's; the counter where the frame can't be read."""
        can_id, size = int(frame["can_id"][0]), int(frame["size"][0])
        bound = next(one for one in self._binding.outgoing if one.message.send_id == can_id)
        self._wrong(frame, np.zeros(1, np.int64), tick)  # lays the tick's own command out
        own = bound.message.decode(self._raw[DATA_AT : DATA_AT + bound.message.length].tobytes())
        name, found = "counter", np.nan
        try:
            sent = bound.message.decode(frame["data"][0, :size].tobytes())
            name, found = next((part, sent[at]) for part, at in bound.parts if sent[at] != own[at])
        except (DriverError, StopIteration):
            pass
        name = _FIELD_OF.get(name, name)
        logged = float(tick[name][0])
        ulp = ulp_between(logged, found, _KINDS[name]) if np.isfinite(found) else 0
        return Difference(int(tick["k"][0]), name, logged, float(found), ulp)
