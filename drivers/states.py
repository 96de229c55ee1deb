"""From a drive's own states to CiA 402's 3-bit codes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.frames import ENABLE_OPERATION
from drivers.jit import jit
from drivers.mapping import OFF, STATES

FAULT_RESET: Final = 0x80
CONTROLWORDS: Final = (0x00, 0x02, 0x06, 0x07, ENABLE_OPERATION, FAULT_RESET)
"""Every controlword that is sent."""
NOT_READY: Final = 0
ENABLED: Final = 4
# CiA 402-2, statusword 6041h: (mask, value) of each state
_STATUSWORD: Final = (
    (0x4F, 0x40, 1),
    (0x6F, 0x21, 2),
    (0x6F, 0x23, 3),
    (0x6F, 0x27, 4),
    (0x6F, 0x07, 5),
    (0x4F, 0x0F, 6),
    (0x4F, 0x08, 7),
)
SWITCH_ON: Final = 0x07
ALL_BITS: Final = -1


def of_statusword(word: int) -> int:
    """State in a CiA 402 statusword; what fits none is not ready."""
    return int(state_of(codes_of("statusword"), word, 0))


@jit
def of_controlword(controlword: int) -> int:
    """State that a controlword leads a drive to, short of operation, which a drive must say itself."""
    if controlword in (SWITCH_ON, ENABLE_OPERATION):
        return 3
    return 2 if controlword == 0x06 else 1


def codes_of(states: Mapping[int, str] | str) -> npt.NDArray[np.int64]:
    """Rows of (mask, value, state) for :func:`state_of`, one after the other; none for states as they are."""
    rows = _STATUSWORD if isinstance(states, str) else [(ALL_BITS, v, STATES[n]) for v, n in states.items()]
    return np.array(rows, np.int64).reshape(-1)


@jit
def state_of(codes: Any, raw: int, controlword: int) -> Any:
    """State of a raw value after the last ``controlword``; what is in no row of ``codes`` is not ready."""
    for row in range(0, len(codes), 3):
        if raw & codes[row] == codes[row + 1]:
            code = codes[row + 2]
            return of_controlword(controlword) if code == OFF else code
    return NOT_READY


def translator(
    states: Mapping[int, str] | str, last_controlword: Callable[[], int]
) -> Callable[[int], int] | None:
    """A function from raw value to state, or None when they are the same. Unknown values are not ready."""
    codes = codes_of(states)
    return (lambda raw: int(state_of(codes, raw, last_controlword()))) if len(codes) else None
