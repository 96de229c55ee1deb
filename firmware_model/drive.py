"""The drive's firmware: CiA 402 states, latching on SYNC, watchdog and trips, as kernels over two records.

Order of a SYNC: :func:`advance` to now, then :func:`on_sync` (latch the newest command, sample). Voltage is
applied in OPERATION_ENABLED alone; in every other state the gates are off, no current flows and the
commanded load machine is released too. The diodes really need about L i / v_dc (0.3 ms at 5 A, 33 mH,
540 V) to stop the current, and would rectify above sqrt(3) n_p |w| psi_f = v_dc; the model does neither.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from firmware_model.coupling import load_speed
from firmware_model.current import refer, regulate
from firmware_model.jit import jit
from firmware_model.link import link_voltage
from firmware_model.load import edge_after, load_torque
from firmware_model.motor import move
from firmware_model.plant import ANGLE, LOAD_SPEED, PROTOCOL_VERSION, TWIST, ErrorCode, State
from firmware_model.rub import friction_torque, rub
from firmware_model.sensors import measure, to_angle, whole_degrees
from firmware_model.speedfilter import track


@jit
def trip(s: Any, error: int) -> None:
    """Latch a fault: gates off, error code, an emergency message due."""
    if s["state"] != State.FAULT:
        s["state"] = State.FAULT.value
        s["error"] = error
        s["emcy"] = 1
        gates_off(s)


@jit
def gates_off(s: Any) -> None:
    """No voltage, no current, no commanded load."""
    s["u_q"], s["u_d"], s["T_commanded"] = 0.0, 0.0, 0.0
    s["x"][1], s["x"][2] = 0.0, 0.0
    s["limited"] = 0
    s["q_ref"], s["d_ref"], s["q_total"], s["d_total"] = 0.0, 0.0, 0.0, 0.0


@jit
def protect(p: Any, s: Any) -> None:
    """Over-current, over-speed, over-temperature: checked at every substep."""
    x = s["x"]
    if not (math.isfinite(x[0]) and math.isfinite(x[1]) and math.isfinite(x[2])):
        x[0] = 0.0
        s["series"][LOAD_SPEED, 0], s["series"][TWIST, 0] = 0.0, 0.0
        trip(s, ErrorCode.OVER_SPEED.value)
    if x[1] * x[1] + x[2] * x[2] > p["i_trip"] * p["i_trip"]:
        trip(s, ErrorCode.OVER_CURRENT.value)
    if abs(x[0]) > p["w_trip"]:
        trip(s, ErrorCode.OVER_SPEED.value)
    if s["v_dc"] > p["v_trip"]:
        trip(s, ErrorCode.DC_LINK_OVER_VOLTAGE.value)
    if s["temperature"] > p["temperature_trip"]:
        trip(s, ErrorCode.OVER_TEMPERATURE_MOTOR.value)


@jit
def watch(p: Any, s: Any) -> None:
    """Watchdog: fed by fresh valid commands alone, armed by the first, latches."""
    if s["watching"] and p["watchdog_ns"] > 0 and s["t_ns"] - s["fed_ns"] > p["watchdog_ns"]:
        s["watching"] = 0
        trip(s, ErrorCode.COMMUNICATION_TIMEOUT.value)


@jit
def heat(p: Any, s: Any, h: float) -> None:
    """First-order thermal model: C dT/dt = 1.5 R i^2 - (T - T_ambient) / R_th."""
    loss = 1.5 * p["R_s"] * (s["x"][1] * s["x"][1] + s["x"][2] * s["x"][2])
    final = p["ambient"] + loss * p["thermal_resistance"]
    s["temperature"] += (final - s["temperature"]) * h / p["thermal_time"]


@jit
def advance(p: Any, s: Any, dt_ns: int) -> None:
    """Move plant time on by dt_ns in substeps of at most substep_ns that end at the edges of step loads."""
    left = dt_ns
    edge = edge_after(p, s["t_ns"])
    while left > 0:
        step = min(left, p["substep_ns"])
        if edge < s["t_ns"] + step:
            step = max(int(np.rint(edge)) - s["t_ns"], 1)
            edge = edge_after(p, s["t_ns"] + step)
        on = s["state"] == State.OPERATION_ENABLED
        if p["takes"] > 0:
            step = min(step, p["current_ns"] - s["t_ns"] % p["current_ns"])
            if on and s["t_ns"] % p["current_ns"] == 0:
                regulate(p, s)
        if p["slot_ns"] > 0:
            step = min(step, p["slot_ns"] - s["t_ns"] % p["slot_ns"])
        h = step * 1e-9
        before = s["x"][0]
        if p["rubs"] or p["capacitance"] > 0.0:
            rub(p, s, s["t_ns"] * 1e-9, h, on)
        else:
            move(p, s["x"], s["series"], s["t_ns"] * 1e-9, h, s["u_q"], s["u_d"], s["T_commanded"], on)
        s["t_ns"] += step
        if p["filter"] > 0:
            track(p, s, before, s["x"][0], h)
        left -= step
        protect(p, s)  # first, so that no absurd current heats the motor
        heat(p, s, h)
        watch(p, s)


@jit
def on_command(s: Any, counter: int, controlword: int, u_q: float, u_d: float) -> None:
    """Take a fresh valid command: it waits for the next SYNC and feeds the watchdog."""
    s["pending"] = 1
    s["next_counter"], s["next_controlword"] = counter, controlword
    s["next_q"], s["next_d"] = u_q, u_d
    s["fed_ns"], s["watching"] = s["t_ns"], 1


@jit
def on_load_command(s: Any, T_L: float) -> None:
    """Take a fresh valid load torque: it waits for the next SYNC."""
    s["next_T"] = T_L


@jit
def transition(s: Any, controlword: int) -> None:
    """CiA 402 state machine driven by one controlword."""
    state = s["state"]
    rising_reset = (controlword & 0x80) != 0 and (s["controlword"] & 0x80) == 0
    s["controlword"] = controlword
    if state == State.FAULT:
        if rising_reset:
            s["state"], s["error"] = State.SWITCH_ON_DISABLED.value, 0
        return
    if state == State.NOT_READY_TO_SWITCH_ON:
        return
    if (controlword & 0x02) == 0:
        s["state"] = State.SWITCH_ON_DISABLED.value
    elif (controlword & 0x04) == 0:
        enabled = state == State.OPERATION_ENABLED or state == State.QUICK_STOP_ACTIVE
        s["state"] = State.QUICK_STOP_ACTIVE.value if enabled else State.SWITCH_ON_DISABLED.value
    elif state == State.QUICK_STOP_ACTIVE:
        return
    elif (controlword & 0x01) == 0:
        s["state"] = State.READY_TO_SWITCH_ON.value
    elif (controlword & 0x08) == 0:
        s["state"] = State.SWITCHED_ON.value if state >= State.READY_TO_SWITCH_ON else state
    elif state == State.SWITCHED_ON or state == State.OPERATION_ENABLED:
        s["state"] = State.OPERATION_ENABLED.value
    elif state == State.READY_TO_SWITCH_ON:
        s["state"] = State.SWITCHED_ON.value


@jit
def latch(p: Any, s: Any) -> None:
    """Apply the newest command: state machine, then the inverter's circle v_dc / sqrt(3) and its rounding.

    A drive with a current loop takes it as the loop's reference.
    """
    if s["pending"]:
        s["pending"] = 0
        s["echo"] = s["next_counter"]
        transition(s, s["next_controlword"])
        s["T_commanded"] = s["next_T"]  # together with the voltage of the same tick
    if s["state"] == State.SWITCH_ON_DISABLED:
        s["watching"] = 0  # a drive that was switched off properly may be left alone
    if s["state"] != State.OPERATION_ENABLED:
        gates_off(s)
        return
    if p["takes"] > 0:
        refer(p, s)
        return
    u_q, u_d = s["next_q"], s["next_d"]
    if p["u_lsb"] > 0.0:
        u_q, u_d = np.rint(u_q / p["u_lsb"]) * p["u_lsb"], np.rint(u_d / p["u_lsb"]) * p["u_lsb"]
    limit = link_voltage(p, s) / math.sqrt(3.0)
    norm = math.sqrt(u_q * u_q + u_d * u_d)
    s["limited"] = 1 if norm > limit else 0
    scale = limit / norm if norm > limit else 1.0
    s["u_q"], s["u_d"] = u_q * scale, u_d * scale


@jit
def on_sync(p: Any, s: Any, out: Any) -> None:
    """Latch, sample, and fill ``out`` (SAMPLE) with what goes on the wire."""
    if not s["started"]:
        s["started"] = 1
        s["t_ns"] = 0
        s["fed_ns"] = 0
    latch(p, s)
    x = s["x"]
    out["w"] = measure(s, s["seen_w"] if p["filter"] > 0 else x[0], p["w_noise"], p["w_lsb"], p["w_top"])
    out["i_q"] = measure(s, x[1], p["i_noise"], p["i_q_lsb"], p["i_q_top"])
    out["i_d"] = measure(s, x[2], p["i_noise"], p["i_d_lsb"], p["i_d_top"])
    out["theta"] = to_angle(s["series"][ANGLE, 0], p["theta_lsb"], p["theta_counts"])
    out["echo"], out["state"], out["limited"] = s["echo"], s["state"], s["limited"]
    out["protocol_version"] = PROTOCOL_VERSION
    out["v_dc"] = min(np.rint(link_voltage(p, s) / 0.1), 65535.0) * 0.1
    out["temperature_motor"] = whole_degrees(s["temperature"])
    out["temperature_inverter"] = whole_degrees(p["ambient"])
    out["error"] = s["error"]
    out["status_due"] = 1 if s["syncs"] % p["status_every"] == 0 else 0
    out["emcy_due"] = s["emcy"]
    s["emcy"] = 0
    s["syncs"] += 1
    t = s["t_ns"] * 1e-9
    out["T_L_true"] = np.float64(
        np.float32(
            load_torque(p, t, load_speed(p, s), s["series"][ANGLE, 0])
            + s["T_commanded"]
            + friction_torque(p, s, t)
        )
    )
    out["w_true"] = np.float64(np.float32(x[0]))
