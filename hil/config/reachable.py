"""What a configuration asks for and can't get: said before the run, and refused on a bus that may be real.

The speed that a reference reaches and the voltage that it needs there (with the field
weakened, where the law does that), poles that the sampling can't follow,
times that are no whole number of periods. The check is of the steady state without load: what fails here
never works; what passes may still saturate under load, and the record flags that (``GuardFlag.SATURATED``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from hil.config.design import WireFacts, motor_model
from hil.config.reference import ReferenceTable
from hil.config.tables import RunConfig
from hil.control.law import LAW_PARAMS
from hil.control.mtpa import operating_point


def out_of_reach(config: RunConfig, wire: WireFacts) -> tuple[str, ...]:
    """One line for each thing that can't be had: key, what is wrong, what to do."""
    rest = (*_voltage(config), *_drive_limit(config), *_poles(config), *_delays(config))
    return (*_speed(config, wire), *rest)


def peak(reference: ReferenceTable) -> float:
    """Largest |w*| [rad/s] of a reference."""
    if reference.kind == "table":
        return max(abs(w) for w in reference.w_rad_s)
    if reference.kind == "sine":
        return abs(reference.offset_rad_s) + abs(reference.amplitude_rad_s)
    return abs(reference.w_rad_s)


def voltage_at(config: RunConfig, w: float) -> float:
    """|u| [V] that holds a speed [rad/s] in steady state without load, by the controller's motor.

    i_q = B_f w / k_t, i_d = 0;  u_q = R_s i_q + n_p w psi_f,  u_d = -n_p w L_q i_q
    """
    m = config.motor
    i_q = m.B_f_n_m_s * w / (1.5 * m.n_p * m.psi_f_wb)
    return math.hypot(m.R_s_ohm * i_q + m.n_p * w * m.psi_f_wb, m.n_p * w * m.L_q_h * i_q)


def is_held(config: RunConfig, w: float, u_most: float) -> bool:
    """Whether the law mtpa holds a speed [rad/s] without load on a circle of u_most [V]: i_d within i_max."""
    m, p = motor_model(config.motor), np.zeros(1, LAW_PARAMS)
    own = {"k_t": m.k_t, "n_p": m.n_p, "R_s": m.R_s, "L_d": m.L_d, "L_q": m.L_q}
    for name, value in (own | {"i_max": config.limits.i_max_a}).items():
        p[name] = value
    tau, u = m.B_f * w / (1.5 * m.n_p), config.controller.voltage_share * u_most
    return not operating_point(p[0], tau, m.n_p * w, u)[2]


def _weakened(config: RunConfig, w: float, most: float) -> Iterator[str]:
    """Past base speed: what the current can't hold, and what the magnets do to the link without it."""
    limits, m = config.limits, config.motor
    if not is_held(config, w, most):
        yield (
            f"reference: {w:g} rad/s can't be held with {most:g} V even by a weakened field of "
            f"{limits.i_max_a:g} A (limits.u_max_v and what the frames carry, controller.voltage_share, "
            "limits.i_max_a); take a lower speed"
        )
    emf = math.sqrt(3.0) * m.n_p * m.psi_f_wb * w
    if emf > limits.v_dc_max_v:
        yield (
            f"reference: at {w:g} rad/s the magnets give {emf:.4g} V between phases, and charge the DC link "
            f"past limits.v_dc_max_v = {limits.v_dc_max_v:g} once the drive lets go; take a lower speed"
        )


def _speed(config: RunConfig, wire: WireFacts) -> Iterator[str]:
    limits, w = config.limits, peak(config.reference)
    if w > limits.w_max_rad_s:
        w_max = f"limits.w_max_rad_s = {limits.w_max_rad_s:g}"
        yield f"reference: reaches {w:g} rad/s, {w_max} stops it; take less"
    if limits.u_max_v is None:
        return
    most, needs = min(limits.u_max_v, wire.u_top), voltage_at(config, w)
    if config.controller.kind == "mtpa":
        yield from _weakened(config, w, most)
        return
    if config.controller.kind != "fac" and needs > most:
        yield (
            f"reference: {w:g} rad/s takes {needs:.4g} V without load, there are {most:g} V "
            "(limits.u_max_v, and what the frames carry); take a lower speed"
        )


def _voltage(config: RunConfig) -> Iterator[str]:
    limits = config.limits
    circle = limits.v_dc_max_v / math.sqrt(3.0)
    if limits.u_max_v is None:
        return
    if "v_dc_max_v" in limits.model_fields_set and limits.u_max_v > circle:
        yield (
            f"limits.u_max_v = {limits.u_max_v:g}: a DC link of v_dc_max_v = {limits.v_dc_max_v:g} V gives "
            f"{circle:.4g} V (v_dc / sqrt 3); take less"
        )


def _drive_limit(config: RunConfig) -> Iterator[str]:
    """What the drive cuts off would read as load."""
    limit, asked = config.drive.current_limit_a, config.limits.i_max_a
    if config.drive.takes == "torque":
        asked = config.command.most / config.drive_k_t
    if limit is not None and asked > limit:
        yield (
            f"limits: up to {asked:g} A are asked for, the drive's own limit is drive.current_limit_a = "
            f"{limit:g} A, and what it cuts off would read as load; lower limits.{config.command.keys[0]}"
        )


def _tables(config: RunConfig) -> Iterator[tuple[str, dict[str, Any]]]:
    yield "controller", config.controller.model_dump()
    yield "observer.speed", config.observer.speed.model_dump()
    if config.observer.current is not None:
        yield "observer.current", config.observer.current.model_dump()


def _poles(config: RunConfig) -> Iterator[str]:
    """A pole past half the sampling frequency is none that a sampled law can have."""
    most = math.pi * config.loop.rate_hz
    for where, table in _tables(config):
        for key, value in table.items():
            if not key.endswith("_rad_s") or "noise" in key:
                continue
            for pole in value if isinstance(value, list) else [value]:
                if pole is not None and pole > most:
                    yield (
                        f"{where}.{key} = {pole:g}: faster than half of loop.rate_hz = {config.loop.rate_hz} "
                        f"({most:.4g} rad/s); take less, or a higher rate"
                    )


def _delays(config: RunConfig) -> Iterator[str]:
    """A window is a whole number of periods."""
    lengths = [
        (f"{where}.{key}", table[key])
        for where, table in _tables(config)
        for key in ("delay_ms", "short_ms", "first_ms")
        if table.get(key) is not None and table.get("kind") != "dob"
    ]
    for key, length in lengths:
        periods = length * 1e-3 * config.loop.rate_hz
        whole = max(1, round(periods))
        if abs(periods - whole) > 1e-6 * whole:
            yield (
                f"{key} = {length:g}: no whole number of periods at {config.loop.rate_hz} Hz; "
                f"{whole * 1e3 / config.loop.rate_hz:g} ms is taken"
            )
