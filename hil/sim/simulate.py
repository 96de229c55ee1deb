"""`hil simulate`: controller and emulated motor in one compiled loop, through the same wire resolution.

It calls the very kernels that the loop and the emulator process call, in the order in which a lockstep bus
delivers their frames, so its outputs equal those of a lockstep run to the bit.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from drivers.codec import Database
from firmware_model.config import PlantConfig, Wire, build_params, new_sample, new_state
from firmware_model.drive import advance, on_command, on_load_command, on_sync
from firmware_model.node import wire_of
from firmware_model.plant import PARAMS, SAMPLE, STATE
from hil.config.design import Machine
from hil.control.jit import entry, jit
from hil.control.law import FAC, LAW_PARAMS, LAW_STATE, exact_after
from hil.control.references import REFERENCE
from hil.errors import ConfigError
from hil.log.mcapfile import RunFile
from hil.log.recorder import check_folder
from hil.log.split import SplitFile, open_run
from hil.replay.snapshot import StateFollower
from hil.report.segments import Responses
from hil.report.statistics import Totals
from hil.runtime.header import header_of, log_path
from hil.runtime.loop import RAMP_EVENT, transition_event
from hil.runtime.refusals import needed_bytes
from hil.runtime.session import plan_of
from hil.runtime.setup import Setup
from hil.signals import ALL_MISSING, DriveState, Reason, Request, RxFlag, TickArray, new_ticks
from hil.sim.columns import APART, Columns, gather
from hil.sim.emulate import load_plant
from hil.tick.guard import NO_ANGLE, NO_I_D, NO_I_Q, SAFETY_PARAMS, SAFETY_STATE
from hil.tick.kernel import step
from hil.tick.reasons import explain
from hil.tick.setpoint import SETPOINT_PARAMS, SETPOINT_STATE, prepare

Record = npt.NDArray[np.void]
BLOCK: Final = 1024
NO_COLUMNS: Final = Columns(0)


@jit
def receive(pp: Any, ps: Any, out: Any, t: Any, absent: int, messages: int, fresh: bool) -> None:
    """SYNC to the drive, its answer into the tick's inputs, as codec and client do it.

    ``messages``: slow ones that the map reads; they come together. ``fresh``: it measures in this tick.
    """
    o = out[0]
    on_sync(pp[0], ps[0], o)
    t["rx_flags"], t["missing"] = 0, ALL_MISSING
    if absent & NO_I_Q:
        t["i_q"] = math.nan
    if absent & NO_I_D:
        t["i_d"] = math.nan
    if absent & NO_ANGLE:
        t["theta"] = math.nan
    if fresh:
        t["rx_flags"] = RxFlag.FRESH.value
        t["w"] = o["w"]
        t["i_q"] = math.nan if absent & NO_I_Q else o["i_q"]
        t["i_d"] = math.nan if absent & NO_I_D else o["i_d"]
        t["theta"] = math.nan if absent & NO_ANGLE else o["theta"]
        t["echo"], t["drive_state"], t["limited"] = o["echo"], o["state"], o["limited"]
    t["T_L_true"] = o["T_L_true"]
    if o["emcy_due"]:
        t["rx_flags"] |= RxFlag.EMERGENCY.value
        t["drive_error"] = o["error"]
    if o["status_due"]:
        t["rx_flags"] |= RxFlag.STATUS.value
        t["missing"] = ALL_MISSING & (ALL_MISSING << messages)
        t["v_dc"], t["drive_error"] = o["v_dc"], o["error"]
        t["temperature_motor"], t["temperature_inverter"] = o["temperature_motor"], o["temperature_inverter"]


@jit
def deliver(lp: Any, ps: Any, t: Any) -> None:
    """The tick's command to the drive, as codec and node do it."""
    if not t["send"]:
        return
    if lp[0]["kind"] == FAC:
        on_load_command(ps[0], t["T_L"])
    on_command(ps[0], t["counter"], t["controlword"], t["u_q"], t["u_d"])


def is_over(t: Any) -> bool:
    """Whether the run ended with a tick, as the loop decides it."""
    done = t["state"] == DriveState.SWITCH_ON_DISABLED or t["state"] == DriveState.FAULT
    return bool(done and t["reason"] != Reason.NONE)


ended = jit(is_over)


@jit
def simulate_block(
    sp: Any,
    ss: Any,
    lp: Any,
    ls: Any,
    rp: Any,
    gp: Any,
    gs: Any,
    pp: Any,
    ps: Any,
    out: Any,
    tick: Any,
    ticks: Any,
    floats: Any,
    integers: Any,
    stop: Any,
    k: int,
    period_ns: int,
    stop_at: int,
    every: int,
) -> int:
    """Run ticks k, k + 1, ... into ``ticks``; return how many, fewer than its length when the run ended.

    ``tick`` is the one before the first: what a tick does not write it has from the one before. Where
    ``floats`` and ``integers`` have columns (:mod:`hil.sim.columns`), it is as many as these have room for:
    the records are written in turn then, their fields gathered; the first with a reason goes to ``stop``.
    """
    before, size, columns = tick, ticks.shape[0], floats.shape[1] - APART
    for i in range(max(size, columns)):
        j = i % size
        if k + i > 0:
            advance(pp[0], ps[0], period_ns)
        ticks[j] = before[0]  # now, and not right after they were written: a copy would wait for the writes
        now = ticks[j : j + 1]
        t = now[0]
        t["k"] = k + i
        t["t_ns"] = (k + i) * period_ns
        t["gap"] = 1
        t["request"] = Request.STOP.value if k + i >= stop_at else Request.ARM.value
        receive(pp, ps, out, t, sp[0]["absent"], sp[0]["messages"], (k + i) % every == 0)
        prepare(rp, gp, gs, ss, lp, now)
        step(sp, ss, lp, ls, now)
        deliver(lp, ps, t)
        before = now
        done = ended(t)
        if columns > 0:
            if t["reason"] != 0 and stop[0]["reason"] == 0:
                stop[0] = t
            if done or j + 1 == size or i + 1 == columns:
                gather(ticks[: j + 1], floats, integers, i - j)
        if done:
            return i + 1
    tick[0] = before[0]
    return int(max(size, columns))


@dataclass(slots=True)
class Simulation:
    """A simulated run; :meth:`blocks` yields its ticks."""

    setup: Setup
    plant: Record
    plant_state: Record
    stop_at: int
    machine: Machine
    every: int = 1
    """Ticks from one measurement of the plant to the next."""

    def blocks(self) -> Any:
        """Yield tick arrays of up to BLOCK ticks until the run has ended; each is overwritten by the next."""
        ticks = new_ticks(BLOCK)  # one for all: fresh pages would cost more than the control law
        advance_into = self._into()
        k = 0
        while True:
            count = advance_into(ticks, k)
            yield ticks[:count]
            k += count
            if count < BLOCK or is_over(ticks[count - 1]):
                return

    def columns(self, room: Columns) -> Iterator[Columns]:
        """Fill ``room`` again and again until the run has ended, without a record kept but its stop."""
        room.stop["reason"] = Reason.NONE
        advance_into = self._into(room)
        k = 0
        while True:
            room.count = advance_into(room.ring, k)
            yield room
            k += room.count
            if room.count < room.rows or is_over(room.last()):
                return

    def warm_up(self) -> None:
        """Compile everything: a block of no ticks changes nothing."""
        self._into()(new_ticks(0), 0)

    def _into(self, room: Columns = NO_COLUMNS) -> Callable[[TickArray, int], int]:
        machine, tick, out = self.machine, new_ticks(), new_sample()
        period_ns, run = self.setup.config.loop.period_ns, compiled_block()

        def into(ticks: TickArray, k: int) -> int:
            return run(
                machine.safety, machine.safety_state, machine.law, machine.law_state, machine.reference,
                machine.setpoint, machine.setpoint_state,
                self.plant, self.plant_state, out, tick, ticks,
                room.floats, room.integers, room.stop, k, period_ns, self.stop_at, self.every,
            )  # fmt: skip

        return into


@cache
def compiled_block() -> Callable[..., int]:
    """:func:`simulate_block` without the look at its arguments, which takes as long as twenty ticks."""
    controller = (SAFETY_PARAMS, SAFETY_STATE, LAW_PARAMS, LAW_STATE, REFERENCE)
    kinds = (*controller, SETPOINT_PARAMS, SETPOINT_STATE, PARAMS, STATE, SAMPLE)
    records = [np.zeros(1, kind) for kind in kinds]
    room = NO_COLUMNS.floats, NO_COLUMNS.integers, NO_COLUMNS.stop
    return entry(simulate_block, *records, new_ticks(), new_ticks(0), *room, 0, 1, 0, 1)


def make_simulation(setup: Setup, plant_settings: list[str]) -> Simulation:
    """Load the plant of a setup. Raises ConfigError, also when the run has no length."""
    plant, folder = load_plant(setup.path, setup.config, plant_settings)
    database = Database(folder / plant.dbc, plant.node_id)
    return simulation_of(setup, plant, wire_of(database, plant.protocol))


def simulation_of(setup: Setup, plant: PlantConfig, wire: Wire) -> Simulation:
    """The simulation of a setup with a plant that is loaded. Raises ConfigError."""
    ticks = plan_of(setup.config).ticks
    if ticks is None:
        raise ConfigError(str(setup.path), ["loop.duration_s: missing; a simulation must end"])
    if plant.fault:
        raise ConfigError(str(setup.path), ["fault: a fault script needs the bus; use hil run or hil faults"])
    every = plant.feedback_every
    if plant.protocol == "cia402":  # it measures, and rounds its torque, as it is set
        every, wire = setup.config.feedback_every, replace(wire, i_q_lsb=setup.wire.x_lsb[1])
    params = build_params(plant, wire)
    state = new_state(params, setup.wire.counter_modulus - 1)
    return Simulation(setup, params, state, ticks, setup.machine.fresh(), every)


def simulate_ticks(setup: Setup, plant_settings: list[str] | None = None) -> TickArray:
    """The whole simulated run in memory, without a log."""
    return np.concatenate([ticks.copy() for ticks in make_simulation(setup, plant_settings or []).blocks()])


def simulate(
    setup: Setup, plant_settings: list[str], *, log: bool = True, seen: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Simulate, write the log if there is to be one, return the result for ``--json``.

    ``seen`` is told after each block how many ticks are done. The compiler's time does not count.
    """
    simulation = make_simulation(setup, plant_settings)
    simulation.warm_up()
    path = log_path(setup, "simulate")
    if log:
        check_folder(path, needed_bytes(setup.config))
    start = time.perf_counter()
    with contextlib.ExitStack() as stack:
        header = header_of(setup, "simulate", "lockstep") if log else {}
        file: RunFile | SplitFile | None = open_run(path, header, StateFollower) if log else None
        if file:
            stack.enter_context(file)
        figures = Figures(setup)
        last, count, stop = _through(simulation, file, figures, seen or (lambda _: None))
        reason = Reason(int(last["reason"]))
        machine = simulation.machine
        end = None if stop is None else explain(machine.safety, machine.safety_state, stop)
        why = {"end": end.as_dict()} if end else {}
        if file:
            file.finish({"ended": reason.name.lower(), "ticks": count, "skipped": 0, **why})
    wall_s = time.perf_counter() - start - figures.seconds
    simulated_s = count * setup.config.loop.period_ns * 1e-9
    return {
        "log": str(path) if log else None,
        "ticks": count,
        "ended": reason.name.lower(),
        "end": end.as_dict() if end else None,
        "ok": reason == Reason.STOP_REQUESTED,
        **figures.as_dict(),
        "simulated_s": simulated_s,
        "wall_s": wall_s,
        "x_realtime": simulated_s / wall_s,
    }


def changes(values: npt.NDArray[np.uint32], before: int) -> npt.NDArray[np.intp]:
    """Where a value is not the one before it."""
    return np.nonzero(np.diff(values.astype(np.int64), prepend=before))[0]


class Figures:
    """What a run achieved, by the report's rules, block by block; ``seconds``: what that took."""

    def __init__(self, setup: Setup) -> None:
        self._totals, self._responses = Totals(), Responses()
        self._responses.N = exact_after(setup.machine.law)[0]
        self.seconds = 0.0

    def feed(self, ticks: TickArray) -> None:
        """Take the next ticks."""
        begin = time.perf_counter()
        t = ticks["t_ns"] * 1e-9
        self._responses.feed(t, ticks)
        self._totals.feed(t, ticks)
        self.seconds += time.perf_counter() - begin

    def as_dict(self) -> dict[str, float | None]:
        """Tracking [rad/s rms], worst dip after a load step [rad/s], slowest recovery [s]; None: no data."""
        self._responses.finish()
        worst = self._responses.worst
        never = "recovery_s" in self._responses.unfinished
        return {
            "tracking_rms_rad_s": self._totals.tracking_rms,
            "dip_rad_s": worst.get("dip"),
            "recovery_s": None if never else worst.get("recovery_s"),
        }


def _through(
    simulation: Simulation, file: RunFile | SplitFile | None, figures: Figures, seen: Callable[[int], None]
) -> tuple[Any, int, Any]:
    """Run to the end, ticks and changes of state into the file.

    Returns the last tick, how many there were, and the first with a reason, None for none.
    """
    last, count, state, stop = new_ticks()[0], 0, int(DriveState.SWITCH_ON_DISABLED), None
    request = 0
    for ticks in simulation.blocks():
        if file:
            for row in changes(ticks["state"], state):
                t = ticks[row]
                event = transition_event(int(t["state"]), int(t["reason"]))
                file.add_event(int(t["t_ns"]), int(t["k"]), *event)
            for t in ticks[changes(ticks["request"], request)]:
                if t["request"] == Request.RAMP_DOWN:
                    file.add_event(int(t["t_ns"]), int(t["k"]), *RAMP_EVENT)
            file.add_ticks(ticks)
        state, request = int(ticks["state"][-1]), int(ticks["request"][-1])
        last, count = ticks[-1].copy(), count + len(ticks)
        figures.feed(ticks)
        if stop is None and last["reason"]:
            stop = ticks[int(np.argmax(ticks["reason"] != 0))].copy()
        seen(count)
    return last, count, stop
