"""From a drive's own states to CiA 402's 3-bit codes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from drivers.frames import ENABLE_OPERATION
from drivers.mapping import OFF, STATES

FAULT_RESET: Final = 0x80
CONTROLWORDS: Final = (0x00, 0x02, 0x06, 0x07, ENABLE_OPERATION, FAULT_RESET)
"""Every controlword that is sent."""
NOT_READY: Final = 0
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
_LEADS_TO: Final = {0x06: 2, 0x07: 3, ENABLE_OPERATION: 3}


def of_statusword(word: int) -> int:
    """State in a CiA 402 statusword; what fits none is not ready."""
    return next((state for mask, value, state in _STATUSWORD if word & mask == value), NOT_READY)


def of_controlword(controlword: int) -> int:
    """State that a controlword leads a drive to, short of operation, which a drive must say itself."""
    return _LEADS_TO.get(controlword, 1)


def translator(
    states: Mapping[int, str] | str, last_controlword: Callable[[], int]
) -> Callable[[int], int] | None:
    """A function from raw value to state, or None when they are the same. Unknown values are not ready."""
    if isinstance(states, str):
        return of_statusword
    if not states:
        return None
    codes = {raw: STATES[name] for raw, name in states.items()}

    def translate(raw: int) -> int:
        code = codes.get(raw, NOT_READY)
        return of_controlword(last_controlword()) if code == OFF else code

    return translate
