"""Limits that the drive's frames cannot show would never trip: they are refused before anything opens."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

from hil.config.limits import LimitsTable
from hil.errors import ConfigError

Spans = Mapping[str, tuple[float, float]]

EITHER_SIGN: Final = (
    ("w_max_rad_s", "speed"),
    ("i_trip_a", "i_q"),
    ("i_trip_a", "i_d"),
    ("i_d_max_a", "i_d"),
    ("open_phase_min_a", "i_d"),
)
ABOVE: Final = (
    ("v_dc_max_v", "v_dc"),
    ("v_dc_regen_max_v", "v_dc"),
    ("temperature_max_c", "temperature_motor"),
    ("temperature_max_c", "temperature_inverter"),
)
NEEDED: Final = (
    ("v_dc_min_v", ("v_dc",)),
    ("v_dc_max_v", ("v_dc",)),
    ("v_dc_regen_max_v", ("v_dc",)),
    ("temperature_max_c", ("temperature_motor", "temperature_inverter")),
)
"""Limits that need one of these signals; only what the configuration itself sets is judged."""


def check_limits(
    where: str, limits: LimitsTable, spans: Spans, carried: Mapping[str, float] | None = None
) -> None:
    """Raise ConfigError with every limit that no frame of this drive can show to be passed, or can carry.

    ``spans``: smallest and largest value of each part that the drive sends; ``carried``: largest command of
    either sign that fits its signal, by the limit's key.
    """
    problems = list(_problems(limits, spans))
    for key, top in (carried or {}).items():
        if key in limits.model_fields_set and getattr(limits, key) > top:
            problems.append(
                f"limits.{key}: a command carries no more than {top:g}; take less, or correct the DBC"
            )
    if problems:
        raise ConfigError(where, problems)


def _problems(limits: LimitsTable, spans: Spans) -> Iterator[str]:
    given = limits.model_fields_set
    for key, parts in NEEDED:
        if key in given and not any(part in spans for part in parts):
            what = " or ".join(parts)
            yield f"limits.{key}: the drive has no {what} to judge by; map it or remove the limit"
    for pairs, both in ((EITHER_SIGN, True), (ABOVE, False)):
        for key, part in pairs:
            limit = getattr(limits, key)
            if key in given and limit is not None and part in spans:
                low, high = spans[part]
                yield from _too_high(key, limit, part, min(high, -low) if both else high)
    low = spans.get("v_dc", (0.0, 0.0))[0]
    if 0.0 < limits.v_dc_min_v <= low:
        yield f"limits.v_dc_min_v: v_dc shows no less than {low:g}; {limits.v_dc_min_v:g} would never trip"


def _too_high(key: str, limit: float, part: str, top: float) -> Iterator[str]:
    """A limit must be below what the signal can show, or nothing can be seen to pass it."""
    if math.isfinite(top) and limit >= top:
        yield f"limits.{key}: {part} shows no more than {top:g}; {limit:g} would never trip, take less"
