"""The response to a load step, on ticks made here: of a step, of one that takes ticks to settle, of none."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from hil.control.law import MotorModel
from hil.report.metrics import load_step
from hil.signals import DriveState, TickArray, new_ticks

MOTOR = MotorModel(R_s=2.875, L_d=0.033, L_q=0.033, psi_f=0.8, n_p=3, J=0.02, B_f=0.0)
ROW, N, COUNT = 100, 12, 400


def pushed(*torque_n_m: float, dip: float = 2.0) -> TickArray:
    """At rest until ``ROW``; then these torques, the last for good, and a speed error that decays."""
    ticks = new_ticks(COUNT)
    ticks["k"], ticks["t_ns"], ticks["gap"] = range(COUNT), np.arange(COUNT) * 1_000_000, 1
    ticks["state"] = int(DriveState.OPERATION_ENABLED)
    torque = np.zeros(COUNT)
    torque[ROW : ROW + len(torque_n_m)] = torque_n_m
    torque[ROW + len(torque_n_m) :] = torque_n_m[-1]
    ticks["T_L_true"] = torque
    after = np.arange(COUNT - ROW)
    ticks["w"][ROW:] = -dip * np.e * after / 10.0 * np.exp(-after / 10.0)
    ticks["d_hat_w"] = np.concatenate((np.zeros(N), -torque[:-N] / MOTOR.J))
    return ticks


@pytest.mark.parametrize(
    ("torques", "step"), [((5.0,), -250.0), ((3.2, 4.4, 5.0), -250.0), ((-1.9, -3.0, -4.0), 200.0)]
)
def test_a_load_that_takes_ticks_to_settle_is_one_step(torques: tuple[float, ...], step: float) -> None:
    """Another machine's torque comes through its current loop: the dip is that of all of it."""
    found = load_step(pushed(*torques), N, MOTOR, MOTOR)
    assert found is not None
    assert found.k == ROW and found.dip == pytest.approx(2.0) and found.step == pytest.approx(step)
    assert found.recovery_ms == pytest.approx(38.0, abs=1.0) and found.estimate_error == pytest.approx(0.0)


def test_a_load_that_does_not_settle_is_no_step_and_warns_of_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_step(pushed(*np.arange(1.0, 295.0)), N, MOTOR, MOTOR) is None
        assert load_step(pushed(5.0)[: ROW + 2], N, MOTOR, MOTOR) is None
        assert load_step(pushed(5.0, -2.0, 4.0, -3.0), N, MOTOR, MOTOR) is not None
        assert load_step(pushed(0.0), N, MOTOR, MOTOR) is None
