"""Ticks as one plain array a field: what a figure reads of a record is a few of its bytes.

Filled in compiled code while the records are still near; the same arrays serve one run after the other.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from hil.control.jit import jit
from hil.signals import new_ticks

ROWS: Final = 8192
APART: Final = 8
"""Rows that stay unused: columns a power of two apart share few places of the processor's nearest memory."""
RING: Final = 128
"""Records that are written in turn: few, so that they stay in the processor's nearest memory."""
FLOATS: Final = ("w", "w_ref", "dw_ref", "i_q", "i_d", "u_q", "u_d", "T_L_true", "T_L_hat", "theta_error")
INTEGERS: Final = ("k", "state", "reason", "rx_flags", "guard_flags", "skipped", "gap")


@jit
def gather(ticks: Any, floats: Any, integers: Any, at: int) -> None:
    """Write ticks from row ``at`` on: the fields :data:`FLOATS` and :data:`INTEGERS`, in their order."""
    for j in range(len(ticks)):
        t, i = ticks[j], at + j
        floats[0, i], floats[1, i], floats[2, i] = t["w"], t["w_ref"], t["dw_ref"]
        floats[3, i], floats[4, i] = t["i_q"], t["i_d"]
        floats[5, i], floats[6, i] = t["u_q"], t["u_d"]
        floats[7, i], floats[8, i], floats[9, i] = t["T_L_true"], t["T_L_hat"], t["theta_error"]
        integers[0, i], integers[1, i], integers[2, i] = t["k"], t["state"], t["reason"]
        integers[3, i], integers[4, i] = t["rx_flags"], t["guard_flags"]
        integers[5, i], integers[6, i] = t["skipped"], t["gap"]


class Columns:
    """Some ticks' fields by name, in room for ``rows``; ``stop``: a run's first tick with a reason."""

    def __init__(self, rows: int = ROWS) -> None:
        self.ring, self.stop, self.count, self.rows = new_ticks(RING), new_ticks(), 0, rows
        self.floats = np.empty((len(FLOATS), rows + APART))
        self.integers = np.empty((len(INTEGERS), rows + APART), np.int64)
        self._of: dict[str, Any] = dict(zip(FLOATS, self.floats, strict=True))
        self._of |= dict(zip(INTEGERS, self.integers, strict=True))

    def __getitem__(self, name: str) -> Any:
        return self._of[name][: self.count]

    def __len__(self) -> int:
        return self.count

    def last(self) -> dict[str, int]:
        """The newest tick's integers."""
        return dict(zip(INTEGERS, self.integers[:, self.count - 1].tolist(), strict=True))
