"""Units of config keys: the end of a key's name says its unit, and this table says how it is written."""

from __future__ import annotations

from typing import Final

UNITS: Final = {
    "_rad_s3": "rad/s^3",
    "_rad_s2": "rad/s^2",
    "_n_m_s_rad": "N m s/rad",
    "_n_m_rad": "N m/rad",
    "_n_m_s2": "N m s^2",
    "_n_m_s": "N m s",
    "_n_m_a": "N m/A",
    "_arms": "A rms",
    "_kg_m2": "kg m^2",
    "_rad_s": "rad/s",
    "_n_m": "N m",
    "_a2s": "A^2 s",
    "_a_rad": "A/rad",
    "_as_rad": "A s/rad",
    "_v_as": "V/(A s)",
    "_v_a": "V/A",
    "_a_s": "A/s",
    "_k_w": "K/W",
    "_k_s": "K/s",
    "_percent": "%",
    "_ticks": "ticks",
    "_budget": "frames",
    "_every": "SYNCs",
    "_turns": "turns",
    "bitrate": "bit/s",
    "_ohm": "ohm",
    "_deg": "deg",
    "_rad": "rad",
    "_wb": "Wb",
    "_hz": "Hz",
    "_ms": "ms",
    "_us": "us",
    "_mm": "mm",
    "_mb": "MB",
    "_s": "s",
    "_h": "H",
    "_f": "F",
    "_a": "A",
    "_v": "V",
    "_c": "degC",
    "_j": "J",
    "_w": "W",
}
"""Ends of names, each before those that it ends in itself."""

COUNTS: Final = (
    "skipped_max",
    "dropped_max",
    "lost_feedback_max",
    "crc_errors_max",
    "samples",
    "bits",
    "passes",
    "laps",
)
NUMBERS: Final = (
    "on_value",
    "off_value",
    "n_p",
    "order",
    "orders",
    "fifo_priority",
    "cpu",
    "node_id",
    "seed",
    "damping",
    "damping_ratio",
    "resonance_damping",
    "inertia_ratio",
    "share",
    "voltage_share",
)
PURE: Final = frozenset((*COUNTS, *NUMBERS, "covariance", "mean"))
"""What has no unit of its own: counts, numbers of things, ratios, and what has those of other keys."""


def unit_of(name: str) -> str:
    """The unit that a key's name ends in; empty for none."""
    for end, unit in UNITS.items():
        if name.endswith(end) and name not in PURE:
            return unit
    return ""
