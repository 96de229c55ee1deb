"""Runs for scripts: simulated, on a bus, beside an emulated drive; each gives a log."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hil.api.setups import File, Settings, overrides, setup_of, texts
from hil.log.check import seal
from hil.log.reader import Log, open_log
from hil.log.schema import meanings, units
from hil.replay import Verdict, replay_log
from hil.runtime.header import header_of
from hil.runtime.session import run as run_setup
from hil.runtime.setup import Setup
from hil.runtime.setup import setup_of as setup_from
from hil.signals import Reason
from hil.sim.demo import emulator_process, own_channel
from hil.sim.simulate import make_simulation
from hil.sim.simulate import simulate as simulated
from hil.tick.reasons import explain


def simulate(
    config: Setup | File, settings: Settings = (), *, plant: Settings = (), log: bool = False
) -> Log:
    """Controller and emulated motor in one process, without a bus, as fast as the machine goes.

    ``plant`` sets keys of the emulated drive. The result has the ticks (``ticks``, ``to_pandas()``), how it
    ended (``result``) and what ``hil.metrics``, ``hil.plot`` and ``hil.replay`` need; it is a
    file only with ``log``. Raises ``hil.HilError`` for what can't be simulated.
    """
    setup = setup_of(config, settings)
    if log:
        return open_log(Path(simulated(setup, list(texts(plant)))["log"]))
    simulation = make_simulation(setup, list(texts(plant)))
    ticks = np.concatenate([block.copy() for block in simulation.blocks()])
    seal(ticks)
    machine, stops = simulation.machine, np.nonzero(ticks["reason"])[0]
    end = explain(machine.safety, machine.safety_state, ticks[stops[0]]) if len(stops) else None
    result = {
        "ended": Reason(int(ticks["reason"][-1])).name.lower(),
        "ticks": len(ticks),
        "end": end.as_dict() if end else None,
    }
    return _in_memory(setup, ticks, result)


def _in_memory(setup: Setup, ticks: Any, result: dict[str, Any]) -> Log:
    """The log that the run would have written, without a file."""
    header = header_of(setup, "simulate", "lockstep")
    run = {str(key): str(value) for key, value in header["metadata"].items()}
    about = {"run": run, "units": units(), "meanings": meanings(), "result": {"result": json.dumps(result)}}
    path, kept, last = setup.path.with_suffix(".mcap"), header["attachments"], int(ticks["t_ns"][-1])
    return Log(path, ticks, metadata=about, attachments=kept, tick_count=len(ticks), last_t_ns=last)


def run(config: Setup | File, settings: Settings = (), *, arm: bool = False, emulated: bool = False) -> Log:
    """The controller on the bus that the configuration names, until ``loop.duration_s`` or Ctrl-C.

    ``emulated``: beside an emulated drive of its own, on a channel that nobody else has. ``arm`` allows
    voltage on a bus that may be real, and asks nothing more: it is ``--arm --yes`` of ``hil run``.
    Returns the log as it was written. Raises ``hil.HilError`` before anything is sent.
    """
    setup = setup_of(config, settings)
    if not emulated:
        return open_log(Path(run_setup(setup, arm=arm).log))
    setup = _apart(setup)
    with emulator(setup):
        return open_log(Path(run_setup(setup).log))


def _apart(setup: Setup) -> Setup:
    """The same on a channel of the embedded bus that nobody else has."""
    bus = setup.config.bus.model_copy(update={"interface": "hil-local", "channel": own_channel("hil")})
    return setup_from(setup.path, setup.config.model_copy(update={"bus": bus}))


@contextlib.contextmanager
def emulator(config: Setup | File, settings: Settings = (), *, plant: Settings = ()) -> Iterator[int]:
    """The emulated drive of a configuration as a process of its own, while the block lasts; yields its pid.

    Raises ``hil.HilError`` when it can't start.
    """
    setup = setup_of(config, settings)
    with emulator_process(setup.path, overrides(_differing(setup)), texts(plant)) as pid:
        yield pid


def _differing(setup: Setup) -> dict[str, Any]:
    """The keys that a drive goes by, as they are in a setup."""
    tables = setup.config.model_dump(include={"bus", "loop", "drive", "emulator"}, exclude_none=True)
    return {f"{table}.{key}": value for table, keys in tables.items() for key, value in keys.items()}


def replay(log: Log | File) -> Verdict:
    """Re-run the controller over a log and compare every output by bits.

    The verdict's ``verdict`` is ``same``, ``differs`` (with the first difference) or ``cannot`` (with
    ``why``). Raises ``hil.HilError`` for what is no log.
    """
    return replay_log(log if isinstance(log, Log) else open_log(str(log)))
