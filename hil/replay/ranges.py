"""Numbers of a log that kernels index by, loop to or divide by: none out of its range reaches a kernel."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from hil.control.cogging import ORDERS
from hil.control.fac import MAX_GAP
from hil.control.law import MTPA, N_MAX, ROWS
from hil.control.mtpa import POINTS
from hil.control.observer import ADAPTIVE, FIR, FIR_MAX
from hil.control.references import TABLE, TABLE_MAX
from hil.control.speed import FOLLOWS, MOST_DELAY
from hil.control.speedfilter import MOST_AVERAGE, PAST, ROOM
from hil.log.named import Record
from hil.signals import DriveState
from hil.tick.guard import MOST_MESSAGES, MOST_PERIODS

COUNTERS: Final = 256
"""Commands that the supervisor remembers: the range of a counter on the wire."""
RANGES: Final[dict[str, dict[str, tuple[int, int]]]] = {
    "safety": {"counter_modulus": (1, COUNTERS), "messages": (0, MOST_MESSAGES)},
    "law": {
        "kind": (0, MTPA),
        "max_gap": (1, MAX_GAP),
        "N": (0, N_MAX - 1),
        "form": (0, ADAPTIVE),
        "rows": (0, ROWS),
        "delay": (0, MOST_DELAY),
        "order": (0, MOST_AVERAGE),
        "short": (0, FIR_MAX),
        "first": (0, FIR_MAX),
        "every": (0, MAX_GAP),
        "span": (0, ROOM),
        "cogs": (0, ORDERS),
        "points": (0, POINTS),
        "pair": (0, FOLLOWS),
    },
    "reference": {"kind": (0, TABLE), "count": (0, TABLE_MAX)},
    "safety_state": {
        "counter": (0, COUNTERS - 1),
        "state": (0, max(DriveState)),
        "elapsed": (0, MOST_PERIODS),
        "gap": (0, MOST_PERIODS),
    },
    "law_state": {
        "head": (0, N_MAX - 1),
        "gap": (0, MAX_GAP),
        "started": (0, 1),
        "filled": (0, N_MAX),
        "row": (0, ROWS),
        "place": (0, PAST - 1),
        "heard": (0, PAST),
        "length": (0, FIR_MAX),
        "hold": (0, FIR_MAX),
        "still": (0, FIR_MAX),
        "doubt": (0, 1),
    },
}


def check_ranges(kind: str, record: Record) -> None:
    """Refuse a record whose numbers would lead a kernel out of its arrays. Raises ValueError."""
    for name, (low, high) in RANGES[kind].items():
        value: Any = record[name]
        if np.any(value < low) or np.any(value > high):
            raise ValueError(f"{kind}.{name} is {value[0]}, not within {low} to {high}")
    if kind != "law":
        return
    form, N = record["form"], record["N"]
    if np.any(((form == FIR) | (form == ADAPTIVE)) & (N > FIR_MAX)):
        raise ValueError(f"law.N is {N[0]}, where weights have room for {FIR_MAX}")
    short, first = record["short"], record["first"]
    if np.any((form == ADAPTIVE) & ~((first >= 1) & (first <= short) & (short <= N))):
        raise ValueError(f"law.first, short, N are {first[0]}, {short[0]}, {N[0]}: they do not grow from 1")
    if np.any(record["order"]) and not (record["v_y"][0, 0] and record["gap_y"][0].all()):
        raise ValueError("law.v_y or law.gap_y is 0, by which a kernel divides")
    if np.any((record["every"] > 1) & (record["order"] > 0) & (record["span"] < record["every"])):
        raise ValueError(f"law.span is {record['span'][0]}, shorter than law.every = {record['every'][0]}")
