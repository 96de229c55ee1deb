"""Parts of the compiled tick as kernels of their own, since nothing can be read from a clock inside one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from hil.control.jit import jit
from hil.design import Machine
from hil.guard import guard_command
from hil.signals import DriveState, new_ticks

BATCHES = 8
"""The quickest counts: what else the machine does only ever adds."""


@jit
def guard_alone(sp: Any, ss: Any, ticks: Any) -> None:
    """The guard over a command of the law."""
    guard_command(sp[0], ss[0], ticks[0], 1.0, 1.0, 0.0)


@jit
def nothing(sp: Any, ss: Any, ticks: Any) -> None:
    """The call alone."""
    ticks[0]["k"] = sp[0]["counter_modulus"] + ss[0]["counter"]


def guard_ns(machine: Machine, count: int = 500) -> float:
    """Processor time [ns] of the guard, which is part of the tick's step: a call with it less one without."""
    machine, ticks = machine.fresh(), new_ticks()
    ticks["state"] = machine.safety_state["state"] = DriveState.OPERATION_ENABLED

    def batch(kernel: Callable[..., None]) -> float:
        begin = time.thread_time_ns()
        for _ in range(count):
            kernel(machine.safety, machine.safety_state, ticks)
        return (time.thread_time_ns() - begin) / count

    kernels = (guard_alone, nothing)
    with_guard, without = (min(batch(kernel) for _ in range(BATCHES)) for kernel in kernels)
    return max(0.0, with_guard - without)
