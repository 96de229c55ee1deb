"""Parts of the compiled tick as kernels of their own, since nothing can be read from a clock inside one."""

from __future__ import annotations

import time
from typing import Any

from hil.config.design import Machine
from hil.control.jit import jit
from hil.signals import DriveState, new_ticks
from hil.tick.guard import guard_command

BATCHES = 8
"""The quickest counts: what else the machine does only ever adds."""


@jit
def guard_often(sp: Any, ss: Any, ticks: Any, count: int) -> None:
    """The guard over ``count`` commands of the law."""
    for _ in range(count):
        guard_command(sp[0], ss[0], ticks[0], 1.0, 1.0, 0.0)


def guard_ns(machine: Machine, count: int = 2000) -> float:
    """Processor time [ns] of the guard, which is part of the tick's step: many in a call."""
    machine, ticks = machine.fresh(), new_ticks()
    ticks["state"] = machine.safety_state["state"] = DriveState.OPERATION_ENABLED

    def batch(commands: int) -> int:
        begin = time.thread_time_ns()
        guard_often(machine.safety, machine.safety_state, ticks, commands)
        return time.thread_time_ns() - begin

    batch(1)
    with_guard, without = (min(batch(commands) for _ in range(BATCHES)) for commands in (count, 0))
    return (with_guard - without) / count
