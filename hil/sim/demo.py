"""`hil demo`: emulator process, armed loop, load step, stop, replay, and a table of what happened."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import uuid
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_model.config import PlantMotor
from hil.config.design import law_spec, motor_model
from hil.config.nodefile import load_nodes
from hil.config.shipped import find_config
from hil.config.tables import RunConfig
from hil.control.law import MotorModel, exact_after, law_window, sampled_model
from hil.control.observer import Window, bounds, impulse_response, response_length
from hil.errors import HilError
from hil.log.reader import Log, open_log
from hil.replay import Verdict, replay, replay_log
from hil.report.metrics import Lateness, LoadStep, load_step, tracking_rms
from hil.runtime.bus import bus_settings
from hil.runtime.nodesession import run_nodes
from hil.runtime.nodesetup import Nodes, load_node_setups
from hil.runtime.progress import say
from hil.runtime.session import RunResult, run
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import Reason, TickArray
from hil.sim.emulate import load_plant

BY_THE_HOST = (
    Reason.GUARDIAN, Reason.GUARDIAN_LOST, Reason.LOOP_OVERRUN, Reason.STALE_FEEDBACK, Reason.COMMAND_LOST,
    Reason.COUNTER_ERRORS, Reason.ENABLE_TIMEOUT,
)  # fmt: skip
"""What ends a run on a sound emulated bus only because nobody was scheduled in time."""
COMMUNICATION_TIMEOUT = 0x8130
"""The drive's watchdog (CiA 301)."""
__all__ = ["closed_loop", "demo", "emulator_process", "resolution_bound"]


@contextlib.contextmanager
def emulator_process(path: Path, overrides: Overrides, plant_settings: tuple[str, ...] = ()) -> Iterator[int]:
    """The emulator of a config as a process; yields its pid once it listens, ends it afterwards.

    It ends with the thread that started it, too, whatever ends that.
    """
    command = [sys.executable, "-m", "hil.cli", "emulate", str(path), "--parent", str(os.getpid())]
    for setting in overrides.as_settings():
        command += ["--set", setting]
    for setting in plant_settings:
        command += ["--plant-set", setting]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None  # noqa: S101 - PIPE was asked for
    try:
        line = process.stdout.readline()
        if not line.startswith("emulator ready"):
            raise HilError(f"the emulator can't start: {line.strip() or 'see its message above'}")
        yield process.pid
    finally:
        process.terminate()
        try:
            process.communicate(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def resolution_bound(setup: Setup) -> float:
    """Largest error of d_hat_w [rad/s2] that the resolution of the frames alone can cause."""
    spec = law_spec(setup.config)
    T_s = 1.0 / setup.config.loop.rate_hz
    model = sampled_model(motor_model(setup.config.motor), T_s)
    if order := int(setup.machine.law["order"][0]):
        return filtered_bound(setup, law_window(spec, T_s), order)
    limits = bounds(law_window(spec, T_s), model.Ad, model.Ed, T_s, np.array(setup.wire.x_lsb))
    return float(limits.resolution[0])


def filtered_bound(setup: Setup, window: Window, order: int) -> float:
    """:func:`resolution_bound` of a speed through a filter: |window * weights of samples| lsb / 2."""
    weights = impulse_response(window, response_length(window))[:, 0]
    every = np.convolve(weights, setup.machine.law["v_y"][0, : order + 2])
    return float(np.abs(every).sum() * setup.wire.x_lsb[0] / 2)


def summary(
    setup: Setup, ticks: TickArray, result: RunResult, verdict: Verdict, true: MotorModel
) -> dict[str, Any]:
    """The demo's result, as ``--json`` prints it."""
    N = exact_after(setup.machine.law)[0]
    step: LoadStep | None = load_step(ticks, N, motor_model(setup.config.motor), true)
    return {
        "log": result.log,
        "ticks": result.outcome.ticks,
        "skipped": result.outcome.skipped,
        "dropped": result.dropped,
        "ended": result.as_dict()["ended"],
        "end": result.as_dict()["end"],
        "lateness_us": asdict(Lateness.of(ticks)),
        "tracking_rms_rad_s": tracking_rms(ticks),
        "dip_rad_s": step.dip if step else None,
        "recovery_ms": step.recovery_ms if step else None,
        "estimate_error_after_n": step.estimate_error if step else None,
        "estimate_step_rad_s2": step.step if step else None,
        "estimate_bound_rad_s2": resolution_bound(setup),
        "n": N,
        "grants": [asdict(grant) for grant in result.grants],
        "replay": verdict.as_dict(),
    }


def true_motor(motor: PlantMotor) -> MotorModel:
    """The emulator's motor in the controller's terms."""
    return MotorModel(
        motor.R_s_ohm, motor.L_d_h, motor.L_q_h, motor.psi_f_wb, motor.n_p, motor.J_kg_m2, motor.B_f_n_m_s
    )


def own_channel(what: str) -> str:
    """A channel of the embedded bus that nobody else has."""
    return f"{what}-{os.getpid()}-{uuid.uuid4().hex[:6]}"


def closed_loop(
    path: Path, overrides: Overrides, plant: tuple[str, ...] = ()
) -> tuple[Setup, RunResult, Log]:
    """Emulator as a process, controller here, on a bus of their own; the log is read back.

    ``plant``: settings of the plant, KEY=VALUE.
    """
    if overrides.channel is None:
        overrides = replace(overrides, channel=own_channel("demo"))
    setup = load_setup(path, overrides)
    with emulator_process(path, overrides, plant):
        if setup.config.canopen is not None:
            set_up(path, setup.config)
        result = run(setup)
    return setup, result, open_log(Path(result.log))


def set_up(path: Path, config: RunConfig) -> None:
    """What `hil configure` does before a run: the emulated drive has just been switched on."""
    from hil.runtime.configure import configure, job_of

    configure(job_of(path, config, bus_settings(config)), store=False, dbc=None)


def too_slow(setup: Setup, result: RunResult, log: Log) -> str:
    """Why this host can't hold the rate, in words; empty for a run that ended for another reason, or well."""
    loop, reason = setup.config.loop, Reason(result.outcome.reason)
    starved = reason == Reason.DRIVE_FAULT and COMMUNICATION_TIMEOUT in log.ticks["drive_error"]
    if loop.clock == "lockstep" or not (reason in BY_THE_HOST or starved):
        return ""
    late_ms = max(log.ticks["lateness_ns"], default=0) * 1e-6
    ended = reason.name.lower().replace("_", " ")
    return (
        f"this host can't hold {loop.rate_hz} Hz ({ended}; {result.outcome.skipped} periods skipped, "
        f"up to {late_ms:.1f} ms late)"
    )


def in_lockstep(overrides: Overrides, setup: Setup) -> Overrides:
    """The same without real time, with a log of its own."""
    own = ['loop.clock="lockstep"']
    own += [f'log.name="{setup.config.log.name}-lockstep"'] if setup.config.log.name else []
    return replace(overrides, settings=(*overrides.settings, *own))


def nodes_loop(path: Path, overrides: Overrides) -> tuple[Nodes, RunResult, Log]:
    """:func:`closed_loop` for several nodes on one emulated shaft."""
    if overrides.channel is None:
        overrides = replace(overrides, channel=own_channel("demo"))
    setups = load_node_setups(path, overrides)
    assert setups is not None  # noqa: S101 - asked for by who knows that there are several
    with emulator_process(path, overrides):
        for setup in setups.values():
            if setup.config.canopen is not None:
                set_up(path, setup.config)
        result = run_nodes(setups)
    return setups, result, open_log(Path(result.log))


def demo_nodes(path: Path, overrides: Overrides) -> dict[str, Any]:
    """:func:`demo` of several nodes: what the first one did, how each ended, and whether all replay."""
    setups, result, log = nodes_loop(path, overrides)
    setup = next(iter(setups.values()))
    if slow := too_slow(setup, result, log):
        say(f"{slow}; going on in lockstep: the same loop and drives, without real time")
        setups, result, log = nodes_loop(path, in_lockstep(overrides, setup))
        setup = next(iter(setups.values()))
    plants = [load_plant(path, one.config)[0].motor for one in setups.values()]
    true = replace(true_motor(plants[0]), J=sum(motor.J_kg_m2 for motor in plants))
    shown = summary(setup, log.ticks, result, replay(Path(result.log)), true)
    return shown | {"clock": setup.config.loop.clock, "too_slow": slow, "nodes": result.nodes}


def demo(path: Path | None, overrides: Overrides, plant: tuple[str, ...] = ()) -> dict[str, Any]:
    """Run the demo, in lockstep where the host can't hold its rate; raises HilError with one clear line.

    ``plant``: settings of the plant, KEY=VALUE.
    """
    path = path or find_config("demo.toml")
    if load_nodes(path, overrides.as_settings()):
        if plant:
            raise HilError(f"{path}: --plant-set: each of several nodes has its own plant; change that file")
        return demo_nodes(path, overrides)
    setup, result, log = closed_loop(path, overrides, plant)
    slow = too_slow(setup, result, log) if setup.binding.opener else ""
    if slow:
        say(f"{slow}; going on in lockstep: the same loop and drive, without real time")
        setup, result, log = closed_loop(path, in_lockstep(overrides, setup), plant)
    motor = load_plant(path, setup.config, list(plant))[0].motor
    shown = summary(setup, log.ticks, result, replay_log(log), true_motor(motor))
    return shown | {"clock": setup.config.loop.clock, "too_slow": slow}
