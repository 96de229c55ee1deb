"""Records of the emulated drive: everything its kernels read (parameters) and change (state).

One-element structured arrays of fixed shape, so that one compiled cache serves every configuration. A
parameter is one row of ``PARAMETERS``, a load one file of :mod:`firmware_model.loads`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np

from firmware_model.gains import gains
from firmware_model.registry import loads
from firmware_model.series import ORDER

MAX_LOADS: Final = 8
SLIDE: Final = 3 + MAX_LOADS
"""Row of the series' room that holds which way the shaft slides: -1, 1, or 0 while it sticks."""
DRIVE, STRIBECK, LINK, INVERSE, POWER, ANGLE = range(SLIDE + 1, SLIDE + 7)
"""Rows: torque that drives the shaft without friction; e^{-|w| / w_s}; DC link, its inverse, motor power; the
shaft's angle, whose coefficient 0 is the state itself."""
QUADRATURE: Final = ANGLE + 1
"""First of the rows, one a load, for the quarter turn ahead of a load that goes by the angle."""
FLUX, SQUARE, EXCESS = range(QUADRATURE + MAX_LOADS, QUADRATURE + MAX_LOADS + 3)
"""Rows of a saturated q axis: phi = psi_q / L_q, its square, i_q - phi (:mod:`firmware_model.saturation`)."""
LOAD_SPEED, TWIST = EXCESS + 1, EXCESS + 2
"""Rows of a soft coupling, whose coefficients 0 are the states themselves: speed of the load, twist [rad]."""
ROWS: Final = TWIST + 1
PROTOCOL_VERSION: Final = 1


class State(IntEnum):
    """CiA 402 states of the drive."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


class ErrorCode(IntEnum):
    """Error codes of CiA 301 and CiA 402 that the drive reports."""

    NONE = 0x0000
    OVER_CURRENT = 0x2310
    DC_LINK_OVER_VOLTAGE = 0x3210
    DC_LINK_UNDER_VOLTAGE = 0x3220
    OVER_TEMPERATURE_DRIVE = 0x4210
    OVER_TEMPERATURE_MOTOR = 0x7120
    OVER_SPEED = 0x8400
    COMMUNICATION_TIMEOUT = 0x8130


class Takes(IntEnum):
    """What the drive takes as a command."""

    VOLTAGE = 0
    CURRENT = 1
    TORQUE = 2


class Filter(IntEnum):
    """What the reported speed comes through."""

    NONE = 0
    FIRST_ORDER = 1
    PLL = 2
    MEAN = 3


MOST_SLOTS: Final = 1024
"""Samples of the longest moving average."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A field of ``PARAMS``: what it is of a PlantConfig and a Wire, its type, its unit."""

    of: Callable[[Any, Any], float | None]
    """None: there is none, which is as good as infinite."""
    unit: str = ""
    type: str = "f8"


def _loop(of: Callable[[Any], float | None]) -> Callable[[Any, Any], float | None]:
    """A number of the drive's own current loop; 0 for a drive that takes a voltage and has none."""
    return lambda config, wire: 0.0 if config.firmware.takes == "voltage" else of(config)


def _gains(config: Any, L: float) -> tuple[float, float]:
    """Gain [V/A] and share of reset of one axis."""
    firmware = config.firmware
    T = firmware.current_period_us * 1e-6
    return gains(config.motor.R_s_ohm, L, firmware.current_loop_rad_s, T)


def _filter(name: str) -> Callable[[Any, Any], float | None]:
    """A number of what the speed comes through; 0 where that has none such."""
    return lambda config, wire: _speed_filter(config.firmware).get(name, 0)


def _speed_filter(firmware: Any) -> dict[str, float]:
    """Kind and numbers of what the speed comes through."""
    given, period = firmware.filtered_by, firmware.current_period_us
    if given.kind == "first-order":
        return {"filter": Filter.FIRST_ORDER, "pole_1": given.pole_rad_s}
    if given.kind == "pll":
        slow, fast = sorted((given.pole_1_rad_s, given.pole_2_rad_s))
        return {"filter": Filter.PLL, "pole_1": slow, "pole_2": fast}
    if given.kind == "moving-average":
        slots = round(given.window_ms * 1e3 / period)
        return {"filter": Filter.MEAN, "slot_ns": period * 1000, "slots": slots}
    return {}


def _varies(config: Any) -> bool:
    """True for what the series without rows of its own has no room for."""
    rows = config.motor.L_q_saturation_a is not None or config.coupling is not None
    return rows or has(config, "coefficient") or has(config, "angular")


PARAMETERS: Final = {
    "R_s": Parameter(lambda c, w: c.motor.R_s_ohm, "ohm"),
    "L_d": Parameter(lambda c, w: c.motor.L_d_h, "H"),
    "L_q": Parameter(lambda c, w: c.motor.L_q_h, "H"),
    "L_q_saturation": Parameter(lambda c, w: c.motor.L_q_saturation_a or 0.0, "A"),
    "psi_f": Parameter(lambda c, w: c.motor.psi_f_wb, "Wb"),
    "n_p": Parameter(lambda c, w: c.motor.n_p),
    "J": Parameter(lambda c, w: c.masses.J_m, "kg m2"),
    "B_f": Parameter(lambda c, w: c.motor.B_f_n_m_s, "N m s"),
    "phi_w": Parameter(lambda c, w: c.disturbance.phi_w_rad_s2, "rad/s2"),
    "phi_q": Parameter(lambda c, w: c.disturbance.phi_q_a_s, "A/s"),
    "substep_ns": Parameter(lambda c, w: min(c.substep_us * 1000, c.masses.substep_ns), "ns", "i8"),
    "v_dc": Parameter(lambda c, w: c.inverter.v_dc_v, "V"),
    "u_lsb": Parameter(lambda c, w: c.inverter.resolution_v, "V"),
    "w_lsb": Parameter(lambda c, w: w.w_lsb, "rad/s"),
    "i_q_lsb": Parameter(lambda c, w: w.i_q_lsb, "A"),
    "i_d_lsb": Parameter(lambda c, w: w.i_d_lsb, "A"),
    "theta_lsb": Parameter(lambda c, w: w.theta_lsb, "rad"),
    "theta_counts": Parameter(lambda c, w: w.theta_counts),
    "w_top": Parameter(lambda c, w: w.w_top, "rad/s"),
    "i_q_top": Parameter(lambda c, w: w.i_q_top, "A"),
    "i_d_top": Parameter(lambda c, w: w.i_d_top, "A"),
    "w_noise": Parameter(lambda c, w: c.sensors.w_noise_rad_s, "rad/s"),
    "i_noise": Parameter(lambda c, w: c.sensors.i_noise_a, "A"),
    "watchdog_ns": Parameter(lambda c, w: round(c.firmware.watchdog_ms * 1e6), "ns", "i8"),
    "i_trip": Parameter(lambda c, w: c.firmware.i_trip_a, "A"),
    "w_trip": Parameter(lambda c, w: c.firmware.w_trip_rad_s, "rad/s"),
    "temperature_trip": Parameter(lambda c, w: c.firmware.temperature_trip_c, "degC"),
    "ambient": Parameter(lambda c, w: c.firmware.ambient_c, "degC"),
    "thermal_resistance": Parameter(lambda c, w: c.firmware.thermal_resistance_k_w, "K/W"),
    "thermal_time": Parameter(lambda c, w: c.firmware.thermal_time_s, "s"),
    "status_every": Parameter(lambda c, w: c.firmware.status_every, "", "i8"),
    "seed": Parameter(lambda c, w: c.seed, "", "i8"),
    "loads": Parameter(lambda c, w: len(c.all_loads), "", "i8"),
    "varying": Parameter(lambda c, w: _varies(c), "", "i8"),
    "turns": Parameter(lambda c, w: has(c, "angular") or w.theta_lsb > 0.0, "", "i8"),
    "rubs": Parameter(lambda c, w: c.friction.most_n_m > 0.0 or has(c, "level"), "", "i8"),
    "coulomb": Parameter(lambda c, w: c.friction.coulomb_n_m, "N m"),
    "static": Parameter(lambda c, w: c.friction.most_n_m, "N m"),
    "stribeck": Parameter(lambda c, w: c.friction.stribeck_rad_s, "rad/s"),
    "capacitance": Parameter(lambda c, w: c.inverter.capacitance_f or 0.0, "F"),
    "rectifier": Parameter(lambda c, w: c.inverter.rectifier_ohm, "ohm"),
    "brake_resistance": Parameter(lambda c, w: c.inverter.brake_ohm, "ohm"),
    "brake_on": Parameter(lambda c, w: c.inverter.brake_on_v, "V"),
    "brake_off": Parameter(lambda c, w: c.inverter.brake_off_v or 0.0, "V"),
    "v_trip": Parameter(lambda c, w: c.inverter.v_dc_trip_v, "V"),
    "J_load": Parameter(lambda c, w: c.masses.J_l, "kg m2"),
    "stiffness": Parameter(lambda c, w: c.masses.c, "N m/rad"),
    "damping": Parameter(lambda c, w: c.masses.d, "N m s/rad"),
    "takes": Parameter(lambda c, w: Takes[c.firmware.takes.upper()], "", "i8"),
    "drive_k_t": Parameter(_loop(lambda c: c.firmware.torque_constant_n_m_a or c.motor.k_t_n_m_a), "N m/A"),
    "i_limit": Parameter(_loop(lambda c: c.firmware.i_limit_a), "A"),
    "current_ns": Parameter(_loop(lambda c: c.firmware.current_period_us * 1000), "ns", "i8"),
    "gain_q": Parameter(_loop(lambda c: _gains(c, c.motor.L_q_h)[0]), "V/A"),
    "gain_d": Parameter(_loop(lambda c: _gains(c, c.motor.L_d_h)[0]), "V/A"),
    "reset_q": Parameter(_loop(lambda c: _gains(c, c.motor.L_q_h)[1])),
    "reset_d": Parameter(_loop(lambda c: _gains(c, c.motor.L_d_h)[1])),
    "filter": Parameter(_filter("filter"), "", "i8"),
    "pole_1": Parameter(_filter("pole_1"), "rad/s"),
    "pole_2": Parameter(_filter("pole_2"), "rad/s"),
    "slot_ns": Parameter(_filter("slot_ns"), "ns", "i8"),
    "slots": Parameter(_filter("slots"), "", "i8"),
}
"""Motor, inverter, sensors and firmware, by the name that kernels use; no order means anything.

``*_lsb`` 0: no rounding, of ``theta_lsb`` no angle is reported; ``theta_counts`` 0: within a turn.
``turns``: the angle is kept. ``varying``: a load changes within a substep, the q axis saturates
(``L_q_saturation`` 0: not) or the coupling is soft (``J_load`` 0: not, and ``J`` is all of the inertia);
``rubs`` 0: no friction, no brake; ``capacitance`` 0: the DC link stays at v_dc, else that is the no-load
voltage. ``takes``: what a command is (:class:`Takes`);
gains and shares of reset are those of the sampled current loop; ``filter`` is of the speed
(:class:`Filter`), with its poles, or the samples of a mean and their period.
"""
_NUMBERS: Final = sorted({name for member in loads().values() for name in member.numbers})
LOAD: Final = np.dtype([("kind", "i8"), *((name, "f8") for name in _NUMBERS)], align=True)
"""One load: its code and, by name, every number that any load of the registry has."""
PARAMS: Final = np.dtype(
    [*((name, row.type) for name, row in PARAMETERS.items()), ("load", LOAD, (MAX_LOADS,))], align=True
)
"""``PARAMETERS``, and the loads, of which the first ``loads`` are there. SI units."""


def code_of(kind: str) -> int:
    """What a load's record has for its kind, in this process."""
    return list(loads()).index(kind)


def has(config: Any, kernel: str) -> bool:
    """True when one of the plant's loads has that kernel."""
    return any(getattr(loads()[load.kind], kernel) is not None for load in config.all_loads)


STATE: Final = np.dtype(
    [
        ("x", "f8", 3),
        ("series", "f8", (ROWS, ORDER + 1)),
        ("t_ns", "i8"),
        ("started", "i8"),
        ("u_q", "f8"),
        ("u_d", "f8"),
        ("T_commanded", "f8"),
        ("limited", "i8"),
        ("state", "i8"),
        ("error", "i8"),
        ("emcy", "i8"),
        ("controlword", "i8"),
        ("pending", "i8"),
        ("next_counter", "i8"),
        ("next_controlword", "i8"),
        ("next_q", "f8"),
        ("next_d", "f8"),
        ("next_T", "f8"),
        ("echo", "i8"),
        ("fed_ns", "i8"),
        ("watching", "i8"),
        ("temperature", "f8"),
        ("syncs", "i8"),
        ("random", "i8"),
        ("v_dc", "f8"),
        ("braking", "i8"),
        ("q_ref", "f8"),
        ("d_ref", "f8"),
        ("q_total", "f8"),
        ("d_total", "f8"),
        ("seen_w", "f8"),
        ("seen_rate", "f8"),
        ("angle", "f8"),
        ("angles", "f8", MOST_SLOTS),
        ("slot", "i8"),
    ],
    align=True,
)
"""x = (w, i_q, i_d), room for its series and those of the loads; plant time from the first SYNC;
latched and pending command; CiA 402 state; references [A] and integrators [V] of the current loop;
speed and its rate by the filter, the shaft's angle and a ring of its past.
"""

SAMPLE: Final = np.dtype(
    [
        ("w", "f8"),
        ("i_q", "f8"),
        ("i_d", "f8"),
        ("echo", "i8"),
        ("state", "i8"),
        ("limited", "i8"),
        ("protocol_version", "i8"),
        ("v_dc", "f8"),
        ("temperature_motor", "f8"),
        ("temperature_inverter", "f8"),
        ("error", "i8"),
        ("status_due", "i8"),
        ("emcy_due", "i8"),
        ("T_L_true", "f8"),
        ("w_true", "f8"),
        ("theta", "f8"),
    ],
    align=True,
)
"""What the drive sends after a SYNC, as it stands on the wire: raw * scale + offset."""
