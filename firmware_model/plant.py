"""Records of the emulated drive: everything its kernels read (parameters) and change (state).

One-element structured arrays of fixed shape, so that one compiled cache serves every configuration.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np

MAX_LOADS: Final = 8
ORDER: Final = 8
"""Order of the motor's Taylor series."""
SLIDE: Final = 3 + MAX_LOADS
"""Row of the series' room that holds which way the shaft slides: -1, 1, or 0 while it sticks."""
DRIVE, STRIBECK, LINK, INVERSE, POWER = range(SLIDE + 1, SLIDE + 6)
"""Rows: torque that drives the shaft without friction; e^{-|w| / w_s}; DC link, its inverse, motor power."""
ROWS: Final = POWER + 1
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


class LoadKind(IntEnum):
    """Kinds of load torque; several add up."""

    NONE = 0
    CONSTANT = 1
    STEP = 2
    SINE = 3
    FAN = 4
    COUPLER = 5
    BRAKE = 6


PARAMS: Final = np.dtype(
    [
        ("R_s", "f8"),
        ("L_d", "f8"),
        ("L_q", "f8"),
        ("psi_f", "f8"),
        ("n_p", "f8"),
        ("J", "f8"),
        ("B_f", "f8"),
        ("phi_w", "f8"),
        ("phi_q", "f8"),
        ("substep_ns", "i8"),
        ("v_dc", "f8"),
        ("u_lsb", "f8"),
        ("w_lsb", "f8"),
        ("i_q_lsb", "f8"),
        ("i_d_lsb", "f8"),
        ("w_top", "f8"),
        ("i_q_top", "f8"),
        ("i_d_top", "f8"),
        ("w_noise", "f8"),
        ("i_noise", "f8"),
        ("watchdog_ns", "i8"),
        ("i_trip", "f8"),
        ("w_trip", "f8"),
        ("temperature_trip", "f8"),
        ("ambient", "f8"),
        ("thermal_resistance", "f8"),
        ("thermal_time", "f8"),
        ("status_every", "i8"),
        ("seed", "i8"),
        ("loads", "i8"),
        ("varying", "i8"),
        ("load_kind", "i8", MAX_LOADS),
        ("load_a", "f8", MAX_LOADS),
        ("load_b", "f8", MAX_LOADS),
        ("load_c", "f8", MAX_LOADS),
        ("load_d", "f8", MAX_LOADS),
        ("rubs", "i8"),
        ("coulomb", "f8"),
        ("static", "f8"),
        ("stribeck", "f8"),
        ("capacitance", "f8"),
        ("rectifier", "f8"),
        ("brake_resistance", "f8"),
        ("brake_on", "f8"),
        ("brake_off", "f8"),
        ("v_trip", "f8"),
        ("takes", "i8"),
        ("drive_k_t", "f8"),
        ("i_limit", "f8"),
        ("current_ns", "i8"),
        ("gain_q", "f8"),
        ("gain_d", "f8"),
        ("reset_q", "f8"),
        ("reset_d", "f8"),
        ("pll", "f8"),
    ],
    align=True,
)
"""Motor, inverter, sensors, firmware and loads. SI units; ``*_lsb`` 0 means no rounding.

Loads use a..d as: constant (T); step (T, from, until); sine (T, frequency, phase); fan (k);
coupler (T_max, slip at T_max, speed of the other side); brake (T, from, until). ``rubs`` 0: no friction, no
brake; ``capacitance`` 0: the DC link stays at v_dc, which else is the rectifier's no-load voltage. ``takes``:
what a command is (:class:`Takes`); gains [V/A] and shares of reset of the sampled current loop.
"""

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
        ("pll_w", "f8"),
        ("pll_rate", "f8"),
    ],
    align=True,
)
"""x = (w, i_q, i_d), room for its series and those of the loads; plant time from the first SYNC;
latched and pending command; CiA 402 state; references [A] and integrators [V] of the current loop;
speed and its rate by the PLL.
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
    ],
    align=True,
)
"""What the drive sends after a SYNC, as it stands on the wire: raw * scale + offset."""
