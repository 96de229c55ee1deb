"""What a run achieved, from its ticks: tracking, dip and recovery, estimate error, lateness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.control.law import MotorModel
from hil.signals import DriveState, Request, TickArray

RECOVERED_RAD_S = 0.5
CHANGED_N_M = 0.5
"""A load torque that changes by more from one tick to the next changes again."""
SETTLED = 0.1
"""A step goes on while the torque changes by more than this part of its first tick's jump."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """Percentiles of the wake-up after the deadline [us]."""

    p50: float
    p99: float
    p999: float
    max: float

    @classmethod
    def of(cls, ticks: TickArray) -> Lateness:
        """Of all ticks; zeros for none."""
        if len(ticks) == 0:
            return cls(0.0, 0.0, 0.0, 0.0)
        late = ticks["lateness_ns"] * 1e-3
        p50, p99, p999 = np.percentile(late, [50, 99, 99.9])
        return cls(float(p50), float(p99), float(p999), float(late.max()))


@dataclass(frozen=True, slots=True)
class LoadStep:
    """Response to a step of the true load torque; of another machine's it takes some ticks to settle.

    ``dip`` [rad/s]: largest speed error after it; ``recovery_ms``: from the step until the error stays below
    0.5 rad/s; ``estimate_error`` [rad/s2]: |d_hat_w - d_w| N ticks after it has settled, d_w the true one of
    the period that the newest innovation covers; ``step`` [rad/s2]: what the load alone adds to d_w.
    """

    k: int
    dip: float
    recovery_ms: float
    estimate_error: float
    step: float


def operating(ticks: TickArray) -> TickArray:
    """Ticks in which operation is enabled."""
    own: TickArray = ticks[ticks["state"] == int(DriveState.OPERATION_ENABLED)]
    return own


def tracking_rms(ticks: TickArray) -> float:
    """RMS of w - w* over the ticks in operation [rad/s]."""
    own = operating(ticks)
    if len(own) == 0:
        return float("nan")
    error: Any = own["w"] - own["w_ref"]
    return float(np.sqrt(np.mean(error * error)))


def find_step(ticks: TickArray, at_least: float = 0.5) -> int | None:
    """Row of the largest jump of the true load torque [N m] between two ticks, None for none.

    None counts once a stop was asked for: friction and brakes let go as the shaft comes to rest.
    """
    if len(ticks) < 2:
        return None
    jump = np.where(ticks["request"][1:] < Request.RAMP_DOWN, np.abs(np.diff(untold(ticks))), np.nan)
    if not np.isfinite(jump).any():
        return None
    row = int(np.nanargmax(jump)) + 1
    return row if jump[row - 1] >= at_least else None


def untold(ticks: TickArray) -> npt.NDArray[np.float64]:
    """The true load torque [N m] less what the controller is told of a load machine that it commands."""
    out: npt.NDArray[np.float64] = ticks["T_L_true"] - ticks["T_L_in"]
    return out


def torque(motor: MotorModel, i_q: Any, i_d: Any) -> Any:
    """1.5 n_p (psi_f i_q + (L_d - L_q) i_d i_q) [N m] of currents [A]."""
    return 1.5 * motor.n_p * (motor.psi_f + (motor.L_d - motor.L_q) * i_d) * i_q


def true_disturbance(ticks: TickArray, believed: MotorModel, true: MotorModel) -> npt.NDArray[np.float64]:
    """d_w [rad/s2] by definition: what the true motor's dw/dt has over the believed model's with c(x)."""
    w, i_q, i_d = ticks["w"], ticks["i_q"], np.nan_to_num(ticks["i_d"])  # not reported: held at zero
    real = (torque(true, i_q, i_d) - ticks["T_L_true"] - true.B_f * w) / true.J
    told = torque(believed, i_q, i_d) - ticks["T_L_in"] - believed.B_f * w
    out: npt.NDArray[np.float64] = real - told / believed.J
    return out


def load_step(ticks: TickArray, N: int, believed: MotorModel, true: MotorModel) -> LoadStep | None:
    """Judge the response to the largest load step; N is the window of the speed channel [ticks]."""
    row = find_step(ticks)
    if row is None or row < 50:
        return None
    load = untold(ticks)
    settled = row + _moving(load[row - 1 :])
    if settled + N + 1 >= len(ticks):
        return None
    end = _until(ticks, settled)
    error = ticks["w"][row:end] - ticks["w_ref"][row:end]
    outside = np.nonzero(np.abs(error) > RECOVERED_RAD_S)[0]
    period_ms = float(np.median(np.diff(ticks["t_ns"][row - 1 : end]))) * 1e-6
    recovery = (int(outside[-1]) + 1) * period_ms if len(outside) else 0.0
    true_step = -float(load[settled] - load[row - 1]) / true.J
    d_w = true_disturbance(ticks[settled + N - 1 : settled + N + 1], believed, true)
    estimate_error = abs(float(ticks["d_hat_w"][settled + N]) - float(d_w[0]))
    return LoadStep(int(ticks["k"][row]), float(np.abs(error).max()), recovery, estimate_error, true_step)


def _moving(torque_n_m: npt.NDArray[np.float64]) -> int:
    """For how many ticks after its first the step at the beginning goes on; NaN does not."""
    jumps = np.abs(np.diff(torque_n_m))
    still = ~(jumps[1:] > SETTLED * jumps[0])
    return int(np.argmax(still)) if still.any() else len(still)


def _until(ticks: TickArray, row: int) -> int:
    """First row after ``row`` at which the load or the reference changes again."""
    load = np.abs(np.diff(untold(ticks[row:]))) > CHANGED_N_M
    moving = np.abs(ticks["dw_ref"][row + 1 :]) > 0
    changed = np.nonzero(load | moving | (ticks["state"][row + 1 :] != ticks["state"][row]))[0]
    return row + 1 + int(changed[0]) if len(changed) else len(ticks)
