"""Limits that the drive's frames cannot show would never trip: they are refused before anything opens."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from drivers.binding import Binding
from drivers.signal import Signal
from hil.config import LimitsTable
from hil.errors import ConfigError

EITHER_SIGN: Final = (
    ("w_max_rad_s", "speed"),
    ("i_trip_a", "i_q"),
    ("i_trip_a", "i_d"),
    ("i_d_max_a", "i_d"),
    ("open_phase_min_a", "i_d"),
)
ABOVE: Final = (
    ("v_dc_max_v", "v_dc"),
    ("temperature_max_c", "temperature_motor"),
    ("temperature_max_c", "temperature_inverter"),
)
NEEDED: Final = (
    ("v_dc_min_v", ("v_dc",)),
    ("v_dc_max_v", ("v_dc",)),
    ("temperature_max_c", ("temperature_motor", "temperature_inverter")),
)
"""Limits that need one of these signals; only what the configuration itself sets is judged."""


def span(signal: Signal) -> tuple[float, float]:
    """Smallest and largest value that the signal can show, in SI units."""
    if signal.is_float:
        return signal.minimum, signal.maximum
    low, high = signal.raw_range()
    ends = sorted((low * signal.scale + signal.offset, high * signal.scale + signal.offset))
    return ends[0], ends[1]


def check_limits(where: str, limits: LimitsTable, binding: Binding) -> None:
    """Raise ConfigError with every limit that no frame of this drive can show to be passed."""
    if problems := list(_problems(limits, binding)):
        raise ConfigError(where, problems)


def _problems(limits: LimitsTable, binding: Binding) -> Iterator[str]:
    given = limits.model_fields_set
    for key, parts in NEEDED:
        if key in given and all(binding.signal(part) is None for part in parts):
            what = " or ".join(parts)
            yield f"limits.{key}: the drive has no {what} to judge by; map it or remove the limit"
    for pairs, both in ((EITHER_SIGN, True), (ABOVE, False)):
        for key, part in pairs:
            signal, limit = binding.signal(part), getattr(limits, key)
            if key in given and limit is not None and signal is not None:
                low, high = span(signal)
                yield from _too_high(key, limit, part, min(high, -low) if both else high)
    signal = binding.signal("v_dc")
    if "v_dc_min_v" in given and signal is not None and 0.0 < limits.v_dc_min_v <= span(signal)[0]:
        low = span(signal)[0]
        yield f"limits.v_dc_min_v: {signal.name} shows no less than {low:g}; take more than that"


def _too_high(key: str, limit: float, part: str, top: float) -> Iterator[str]:
    """A limit must be below what the signal can show, or nothing can be seen to pass it."""
    if math.isfinite(top) and limit >= top:
        yield f"limits.{key}: {part} shows no more than {top:g}; {limit:g} would never trip, take less"
