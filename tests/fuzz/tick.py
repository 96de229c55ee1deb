"""The whole tick with every input scrambled: what leaves is finite, limited, and zero outside operation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hil.config.design import WireFacts, build
from hil.config.tables import RunConfig, load_toml
from hil.signals import DriveState, Request, RxFlag, new_ticks
from tests.fuzz.draw import Draw
from tests.fuzz.files import Take

CONFIG = load_toml(Path(__file__).resolve().parents[2] / "configs" / "demo.toml", RunConfig)
WIRE = WireFacts(0.01, 0.01, 16, (0.01, 0.001, 0.01), 327.67)
LIMITS = CONFIG.limits
FIELDS = (
    "w",
    "i_q",
    "i_d",
    "w_ref",
    "dw_ref",
    "i_q_ref_in",
    "v_dc",
    "temperature_motor",
    "temperature_inverter",
)
STATES = (DriveState.SWITCH_ON_DISABLED, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED)


def whole_tick() -> Take:
    """A target that enables the drive, then gives the inputs of each tick drawn values."""
    machine = build(CONFIG, WIRE)

    def take(data: bytes) -> None:
        draw, fresh, ticks = Draw(data), machine.fresh(), new_ticks()
        t: Any = ticks[0]
        t["v_dc"], t["temperature_motor"], t["temperature_inverter"] = 540.0, 25.0, 25.0
        for state in STATES:
            t["gap"], t["rx_flags"], t["request"] = 1, int(RxFlag.FRESH), int(Request.ARM)
            t["drive_state"] = int(state)
            fresh.step(ticks)
        before, stopped = (0.0, 0.0), False
        for _ in range(30):
            scramble(t, draw)
            fresh.step(ticks)
            before = check_command(t, before)
            assert not (stopped and t["state"] == DriveState.OPERATION_ENABLED), "a stop is for good"
            stopped = t["reason"] != 0
            if not draw.rest():
                return

    return take


def scramble(t: Any, draw: Draw) -> None:
    """Set the inputs of one tick; most ticks stay in operation, so that the law is met too."""
    t["gap"] = draw.pick((1, 1, 1, 2, 30)) if not draw.one_in(8) else 1 + draw.below(1 << 16)
    t["rx_flags"] = int(RxFlag.FRESH) if not draw.one_in(4) else draw.below(1 << 13)
    t["drive_state"] = int(DriveState.OPERATION_ENABLED) if not draw.one_in(6) else draw.below(8)
    t["request"] = int(Request.ARM) if not draw.one_in(12) else draw.below(6)
    t["echo"] = t["counter"] if not draw.one_in(4) else draw.below(256)
    for _ in range(draw.below(5)):
        t[draw.pick(FIELDS)] = draw.number(1.0, 10.0, LIMITS.w_max_rad_s, LIMITS.i_trip_a)


def check_command(t: Any, before: tuple[float, float]) -> tuple[float, float]:
    """Check one tick's command: finite, within circle and step, zero outside operation."""
    u_q, u_d, T_L = float(t["u_q"]), float(t["u_d"]), float(t["T_L"])
    assert np.isfinite([u_q, u_d, T_L]).all(), (u_q, u_d, T_L)
    assert np.hypot(u_q, u_d) <= LIMITS.u_max_v + 0.0071 and abs(T_L) <= LIMITS.T_L_max_n_m + 0.0051
    if t["state"] != DriveState.OPERATION_ENABLED:
        assert (u_q, u_d, T_L) == (0.0, 0.0, 0.0), DriveState(int(t["state"]))
    else:
        step = LIMITS.du_max_v + 0.0051
        assert abs(u_q - before[0]) <= step and abs(u_d - before[1]) <= step, (before, u_q, u_d)
    return u_q, u_d
