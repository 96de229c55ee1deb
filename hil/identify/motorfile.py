"""The motor that was identified: as a table for the next step, and as a TOML file with its intervals."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Final

from hil.config.motor import MotorTable
from hil.config.tables import RunConfig
from hil.identify.estimate import Estimate

KEYS: Final = {
    "R_s": "R_s_ohm",
    "L_d": "L_d_h",
    "L_q": "L_q_h",
    "psi_f": "psi_f_wb",
    "J": "J_kg_m2",
    "B_f": "B_f_n_m_s",
}
"""Parameters and their keys in the motor's table."""
FACTS: Final = {
    "w_noise": ("w_noise_rad_s", 1.0),
    "i_q_noise": ("i_q_noise_a", 1.0),
    "i_d_noise": ("i_d_noise_a", 1.0),
    "w_lsb": ("w_lsb_rad_s", 1.0),
    "i_q_lsb": ("i_q_lsb_a", 1.0),
    "i_d_lsb": ("i_d_lsb_a", 1.0),
    "arrival": ("arrival_ms", 1e3),
    "arrival_jitter": ("arrival_jitter_ms", 1e3),
    "L_q_saturation": ("L_q_saturation_a", 1.0),
    "resonance": ("resonance_hz", 1.0),
    "resonance_damping": ("resonance_damping", 1.0),
    "inertia_ratio": ("inertia_ratio", 1.0),
}
"""What else is told, its key in the table ``identified`` and by what it is multiplied there."""
SHAFT_KEYS: Final = {name: FACTS[name][0] for name in ("resonance", "resonance_damping", "inertia_ratio")}
"""Those of a soft coupling: they have intervals, too."""


def motor_of(found: Estimate, before: MotorTable) -> MotorTable:
    """The motor with what the data tell; the rest as it was believed before."""
    told = {name: p.value for name, p in found.parameters.items() if name in KEYS and p.told}
    changes = {KEYS[name]: value for name, value in told.items() if value > 0.0}
    if "B_f" in told:
        changes[KEYS["B_f"]] = max(told["B_f"], 0.0)
    return before.model_copy(update={**changes, "identified": None})


def number(value: float) -> str:
    """Six digits in TOML's form of a float."""
    text = f"{value:.6g}"
    return text if any(mark in text for mark in ".en") else f"{text}.0"


def _interval_lines(found: Estimate, end: str) -> list[str]:
    lines = [f"[identified.{end}]"]
    for name, key in (KEYS | SHAFT_KEYS).items():
        p = found.parameters.get(name)
        if p is not None and p.told:
            value = getattr(p, end)
            if name == "L_q" and end == "low":  # a saturating one is between both
                value = min([value, *(row["low"] for row in found.saturation)])
            lines.append(f"{key} = {number(value)}")
    return lines


def _motor_lines(found: Estimate, motor: MotorTable) -> list[str]:
    lines = [f'name = "{motor.name}"' if motor.name else 'name = "identified"']
    for name, key in KEYS.items():
        p = found.parameters.get(name)
        note = f"+- {p.half:.2g}" if p is not None and p.told else "not identified: as it was configured"
        lines.append(f"{key} = {number(getattr(motor, key))} # {note}")
        if name == "psi_f":
            lines.append(f"n_p = {motor.n_p}")
    return lines


def _extra(found: Estimate) -> dict[str, Any]:
    """Facts for the design that are no motor's."""
    p = {name: value for name, value in found.parameters.items() if value.told}
    out: dict[str, Any] = {}
    if "coulomb" in p:
        out["coulomb_n_m"] = number(max(p["coulomb"].value, 0.0))
    out |= {key: number(p[name].value * unit) for name, (key, unit) in FACTS.items() if name in p}
    out |= {f"{name}_ticks": round(p[name].value) for name in ("delay", "echo_lag") if name in p}
    return out


def quoted(text: str) -> str:
    """A TOML string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{"".join(c if c.isprintable() else " " for c in escaped)}"'


def toml_of(found: Estimate, motor: MotorTable, config: RunConfig, logs: Sequence[str]) -> str:
    """The file: a motor's table that a run configuration can name."""
    drive = (
        f"node {config.drive.node_id} of {config.drive.dbc} on {config.bus.interface}:{config.bus.channel}"
    )
    lines = ["# Identified by hil identify; intervals of 95 %. A configuration takes it by its name.", ""]
    lines += [*_motor_lines(found, motor), "", "[identified]"]
    lines += [f"date = {quoted(datetime.now(UTC).isoformat(timespec='seconds'))}", f"drive = {quoted(drive)}"]
    lines += [f"logs = [{', '.join(quoted(log) for log in logs)}]"]
    lines += [f"{key} = {value}" for key, value in _extra(found).items()]
    lines += ["", *_interval_lines(found, "low"), "", *_interval_lines(found, "high"), ""]
    return "\n".join(lines)
