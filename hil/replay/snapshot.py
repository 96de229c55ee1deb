"""The controller's state at a tick, as it is kept in each part of a split log.

The state is a function of the ticks before. So the writer process computes it by following them, and the loop
does nothing for it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hil.config.design import Machine
from hil.log.reader import Log
from hil.replay import machine_of, state_text
from hil.signals import TickArray, new_ticks


class StateFollower:
    """Implements :class:`hil.log.split.Follower`. A missing tick leaves the state unknown for good."""

    def __init__(self, header: dict[str, Any]) -> None:
        log = Log(Path("header"), new_ticks(0))
        log.metadata["run"] = {key: str(value) for key, value in header.get("metadata", {}).items()}
        log.attachments.update(header.get("attachments", {}))
        self._machine: Machine | None = machine_of(log).fresh()
        self._machine.warm_up()
        self._last_k = -1

    def feed(self, ticks: TickArray) -> None:
        """Compute the ticks anew, which leaves the state behind them."""
        k = ticks["k"].astype(np.int64)
        if (np.diff(k, prepend=self._last_k) != ticks["gap"]).any():
            self._machine = None
        self._last_k = int(k[-1])
        if self._machine is not None:
            again = ticks.copy()
            for row in range(len(again)):
                self._machine.step(again[row : row + 1])

    def state(self) -> str:
        """JSON: the last tick, and the bytes of both states unless they are not known."""
        return (
            json.dumps({"k": self._last_k})
            if self._machine is None
            else state_text(self._machine, self._last_k)
        )
