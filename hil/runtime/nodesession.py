"""A run of several nodes on one bus: alone on it, guarded, recorded, armed; every way out without torque.

What :mod:`hil.runtime.session` is for one drive, of its parts.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from drivers.client import DriveClient
from drivers.hub import links_of
from hil.config.design import Machine
from hil.errors import ArmingError
from hil.log.recorder import Recorder, check_folder
from hil.runtime import fused, fusednodes
from hil.runtime.bus import deaf, opened_link
from hil.runtime.clock import LockstepClock, RealClock
from hil.runtime.guardian import Words
from hil.runtime.header import header_of, log_path
from hil.runtime.inbox import Inbox, Place, Takes
from hil.runtime.loop import Outcome, StopRequest
from hil.runtime.noderules import COUNTERS
from hil.runtime.nodes import Axis, NodesLoop
from hil.runtime.nodesetup import Nodes, check_nodes_load
from hil.runtime.progress import say
from hil.runtime.refusals import check_arming, check_reachable, check_set_up, needed_bytes
from hil.runtime.session import (
    Ended,
    RunResult,
    alone,
    await_drive,
    end_of,
    guarding,
    hear_others,
    plan_of,
    run_armed,
    set_by_others,
    writing,
)
from hil.signals import Reason
from hil.tick.reasons import End

Clock = LockstepClock | RealClock


def run_nodes(setups: Nodes, *, arm: bool = False, request: StopRequest | None = None) -> RunResult:
    """Arm and run all nodes; returns after a safe stop of all. Raises HilError before anything is sent."""
    first = next(iter(setups.values()))
    for setup in setups.values():
        check_arming(setup, arm)
        check_reachable(setup)
    check_nodes_load(setups)
    config, path = first.config, log_path(first, "run")
    check_folder(path, len(setups) * needed_bytes(config))
    clock = LockstepClock() if config.loop.clock == "lockstep" else RealClock()
    with alone(*setups.values()), writing(Recorder(path, None, config.loop.rate_hz, len(setups))) as recorder:
        for name, setup in setups.items():
            setup.machine.looped()
            with _said_of(name):
                check_set_up(setup)
        fusednodes.load()
        shared = Words()
        stopper = partial(_stopper, setups, shared)
        with guarding(config, recorder, stopper, shared) as words:
            return _recorded(setups, request or StopRequest(), recorder, clock, words)


@contextlib.contextmanager
def _said_of(name: str) -> Iterator[None]:
    """A refusal says which node it is of."""
    try:
        yield
    except ArmingError as error:
        raise ArmingError(f"node {name}: {error}") from error


def _clients(
    setups: Nodes, recorder: Recorder | None = None, clock: Clock | None = None
) -> list[DriveClient]:
    """A client for each node; without a clock they only send."""
    first = next(iter(setups.values()))
    links = links_of(partial(opened_link, first), [setup.binding for setup in setups.values()])
    on_frames = recorder.frames if recorder and first.config.log.frames else None
    now = clock.now_ns if clock else time.monotonic_ns
    links = links if clock else [deaf(link) for link in links]
    return [
        DriveClient(port, one.database, on_frames=on_frames, now=now, drive_map=one.binding.map)
        for port, one in zip(links, setups.values(), strict=True)
    ]


class Stopper:
    """The guardian's way to stop all nodes, in the configuration's order."""

    def __init__(self, clients: Sequence[DriveClient], cells: Any) -> None:
        self._clients, self._cells = clients, cells

    def stop_from(self, counter: int) -> None:
        """Each node's stop frames, with counters after its own last; never raises."""
        for place, client in enumerate(self._clients, COUNTERS):
            client.stop_from(self._cells[place])


def _stopper(setups: Nodes, words: Words) -> Stopper:
    """With clients of its own."""
    return Stopper(_clients(setups), words.cells)


def _recorded(
    setups: Nodes, request: StopRequest, recorder: Recorder, clock: Clock, words: Words | None
) -> RunResult:
    """Open the drives and the log, arm, run."""
    first = next(iter(setups.values()))
    with contextlib.ExitStack() as held:
        clients = _clients(setups, recorder, clock)
        for client in clients:  # the first, which closes the bus, last
            held.callback(client.close)
        recorder.begin(nodes_header(setups, clock.name))
        bus = first.config.bus
        say(f"waiting for {' and '.join(setups)} on {bus.interface}:{bus.channel}")
        for ask in (await_drive, hear_others):
            for (name, setup), client in zip(setups.items(), clients, strict=True):
                with _said_of(name):
                    ask(setup, client)
        recorder.await_open()
        say(f"arming; log {recorder.path}")
        machines = [setup.machine.fresh() for setup in setups.values()]
        machines = machines if request.ramps else [machine.at_once() for machine in machines]
        records = [recorder.record, *recorder.more_records]
        axes = [Axis(*parts) for parts in zip(setups, clients, machines, records, strict=True)]
        takes = {name: set_by_others(setup) for name, setup in setups.items()}
        inbox = held.enter_context(contextlib.closing(Inbox(*_places(machines, takes))))
        for client in clients:  # in operation after arming; every way out leaves it
            held.callback(client.leave)
            client.start()
            client.flush()
        box = inbox if any(takes.values()) else None
        plan = plan_of(first.config)
        plan = replace(plan, together=fused.together(plan.period_ns, request))
        compiled = partial(fusednodes.whole_nodes, axes, words, recorder, plan, request)
        whole = partial(compiled, number=inbox.number, clock=clock.cell)
        loop = NodesLoop(axes, clock, recorder, plan, request, words, whole, box)
        for client in clients:
            client.discard()
        ended = partial(_ended, axes, recorder, clock)
        return run_armed(first.config, loop, recorder, clock, request, ended, takes[axes[0].name], takes)


def _places(machines: Sequence[Machine], takes: Mapping[str, Takes]) -> list[Place]:
    """What set-points may be set of; events of all but the first begin with the node's name."""
    first = next(iter(takes))
    return [
        Place(machine, one, "" if name == first else name)
        for machine, (name, one) in zip(machines, takes.items(), strict=True)
    ]


def nodes_header(setups: Nodes, clock: str) -> dict[str, Any]:
    """The header of the first node's log, and beside it what is another node's own."""
    (_, first), *more = setups.items()
    header = header_of(first, "run", clock)
    header["nodes"] = [name for name, _ in more]
    header["more"] = {"nodes": {"names": ",".join(setups)}}
    for name, setup in more:
        own = header_of(setup, "run", clock)
        header["more"][f"run of {name}"] = own["metadata"]
        header["attachments"] |= {
            f"{what} of {name}": text for what, text in own["attachments"].items() if what != "config.toml"
        }
    return header


def _ended(axes: Sequence[Axis], recorder: Recorder, clock: Clock, outcome: Outcome, k: int) -> Ended:
    """Why each node's run ended; the run's is that of the node for whose sake it did."""
    now_ns = clock.now_ns()
    ends = {
        axis.name: end_of(axis.machine, axis.client, axis.outcome.stop, recorder, now_ns, k, f"{axis.name}: ")
        for axis in axes
    }
    cause = cause_of(axes)
    result, own = _result(outcome, axes, ends, cause), cause.outcome
    why = Outcome(outcome.ticks, outcome.skipped, own.reason, own.state, own.stop)
    return Ended(result, why, ends[cause.name], result["nodes"])


def cause_of(axes: Sequence[Axis]) -> Axis:
    """The node for whose sake the run ended: the first with a reason that is not another node's."""
    own = [axis for axis in axes if axis.outcome.reason not in (Reason.NODE_STOPPED, Reason.STOP_REQUESTED)]
    return (own or list(axes))[0]


def _result(
    outcome: Outcome, axes: Sequence[Axis], ends: dict[str, End | None], cause: Axis
) -> dict[str, Any]:
    """The run's result as the log keeps it: of the node for whose sake it ended, and each node's."""
    nodes: dict[str, dict[str, Any]] = {}
    for axis in axes:
        end = ends[axis.name]
        nodes[axis.name] = {"ended": Reason(axis.outcome.reason).name.lower()}
        nodes[axis.name] |= {"end": end.as_dict()} if end else {}
    shared = {"ticks": outcome.ticks, "skipped": outcome.skipped, "node": cause.name}
    return nodes[cause.name] | shared | {"nodes": nodes}
