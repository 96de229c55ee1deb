"""The guard's and the supervisor's records, for tests that call their functions one by one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hil.signals import DriveState, RxFlag, new_ticks
from hil.tick.guard import SAFETY_PARAMS, guard_command
from hil.tick.kernel import new_safety_state

VALUES: dict[str, float] = {
    "T_s": 1e-3, "w_max": 150.0, "i_trip": 22.0, "u_max": 300.0, "du_max": 50.0, "T_L_max": 10.0,
    "v_dc_min": 0.0, "v_dc_max": 1e4, "temperature_max": 110.0, "i_continuous": 8.0, "i2t_max": math.inf,
    "power_window": 1.0, "energy_max": math.inf, "deviation_max": math.inf, "soft_start_ticks": 0,
    "trip_ticks": 3, "guard_trip_ticks": 5, "hold_ticks": 3, "quick_stop_ticks": 20, "error_budget": 8,
    "enable_ticks": 100, "max_gap": 20, "counter_modulus": 16, "u_lsb": 0.01, "T_L_lsb": 0.01, "J": 0.011,
    "frozen_ticks": 5, "repeat_ticks": 2**62, "frozen_du": 0.66, "w_error_max": math.inf, "w_error_ticks": 1,
    "i_d_max": math.inf, "open_phase_min": math.inf, "rules": 1,
}  # fmt: skip


class Guard:
    """The guard with its records; operation enabled unless said otherwise."""

    def __init__(self, **changed: float) -> None:
        self.p, self.s, self.ticks = np.zeros(1, SAFETY_PARAMS), new_safety_state(), new_ticks()
        for name, value in {**VALUES, **changed}.items():
            self.p[name] = value
        self.t: Any = self.ticks[0]
        self.t["state"] = int(DriveState.OPERATION_ENABLED)
        self.s["state"] = int(DriveState.OPERATION_ENABLED)
        self.s["run_ticks"] = 10_000
        self.t["rx_flags"] = int(RxFlag.FRESH)

    def ask(self, u_q: float, u_d: float = 0.0, T_L: float = 0.0) -> tuple[float, float, float, int, int]:
        reason = guard_command(self.p[0], self.s[0], self.t, u_q, u_d, T_L)
        t = self.t
        return float(t["u_q"]), float(t["u_d"]), float(t["T_L"]), int(t["guard_flags"]), int(reason)
