"""A run from start to end: alone on its bus, guarded, recorded, armed; every way out without torque."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

from drivers.client import precompile
from drivers.drive import Drive as BusDrive
from drivers.drive import drive_kind
from drivers.errors import DriverError, LinkError
from hil.config.design import Machine
from hil.config.tables import RunConfig
from hil.errors import ArmingError, HilError
from hil.log.recorder import Recorder, check_folder
from hil.ports import Drive
from hil.runtime import fused, realtime
from hil.runtime.bus import is_emulated_bus, new_client, note_interface, opened_client
from hil.runtime.claim import ClaimedError, claimed
from hil.runtime.clock import LockstepClock, RealClock
from hil.runtime.guardian import GuardedDrive, Rights, Stopper, Words, guardian
from hil.runtime.header import header_of, log_path
from hil.runtime.inbox import Inbox, Place, Takes, ranges
from hil.runtime.loop import Loop, Outcome, Plan, StopRequest
from hil.runtime.progress import say, watching
from hil.runtime.refusals import check_arming, check_load, check_reachable, check_set_up, needed_bytes
from hil.runtime.registry import announced, own_entry, who_asked
from hil.runtime.setup import Setup
from hil.runtime.shadow import ShadowDrive
from hil.signals import Reason, TickArray, new_ticks
from hil.tick.errorcodes import words
from hil.tick.reasons import End, explain

LISTEN_PERIODS, LISTEN_S = 5, 0.05
"""How long a run listens for another controller: so many of its own periods, and at least that long."""
ANOTHER_REMEDY = "stop it, take another bus.channel, or only look: loop.shadow, hil watch"


@dataclass(slots=True)
class RunResult:
    """What a run was, for people and for ``--json``."""

    log: str
    outcome: Outcome
    complete: bool
    dropped: int
    grants: list[realtime.Grant] = field(default_factory=list)
    processor_us: float = 0.0
    """Processor time of the loop's thread, per tick [us]."""
    end: End | None = None
    """Why it ended; None when it did not get so far."""
    nodes: dict[str, Any] = field(default_factory=dict)
    """Of a run with several nodes how each ended, by name; ``outcome`` and ``end`` are then its cause's."""

    @property
    def ok(self) -> bool:
        """True when the run ended by request and lost nothing."""
        asked = self.outcome.reason in (Reason.STOP_REQUESTED, Reason.QUICK_STOP_REQUESTED)
        return asked and self.complete and self.dropped == 0

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "log": self.log,
            "ticks": self.outcome.ticks,
            "skipped": self.outcome.skipped,
            "ended": Reason(self.outcome.reason).name.lower(),
            "end": self.end.as_dict() if self.end else None,
            "dropped": self.dropped,
            "log_complete": self.complete,
            "processor_us": self.processor_us,
            "grants": [asdict(grant) for grant in self.grants],
            "ok": self.ok,
        } | ({"nodes": self.nodes} if self.nodes else {})


def compile_kernels(setup: Setup) -> None:
    """Compile, or load, what a run needs: that takes longer than anything later waits for."""
    setup.machine.looped()
    fac = setup.config.commands_load
    opens = drive_kind(setup.config.drive.kind).open
    precompile(setup.database, setup.binding.map, fac, new_ticks()[0], opens)
    fused.load()


def run(setup: Setup, *, arm: bool = False, request: StopRequest | None = None) -> RunResult:
    """Arm and run a configuration; returns after a safe stop. Raises HilError before anything is sent."""
    check_arming(setup, arm)
    check_reachable(setup)
    check_load(setup)
    request = request or StopRequest()
    config = setup.config
    path = log_path(setup, "run")
    check_folder(path, needed_bytes(config))
    clock = LockstepClock() if config.loop.clock == "lockstep" else RealClock()
    with alone(setup), writing(Recorder(path, None, config.loop.rate_hz)) as recorder:
        compile_kernels(setup)  # while the writer starts
        check_set_up(setup)
        with guarding(config, recorder, partial(new_client, setup, hears=False)) as words:
            return _recorded(setup, request, recorder, clock, words)


@contextlib.contextmanager
def writing(recorder: Recorder) -> Iterator[Recorder]:
    """A log that says of a run that was refused why."""
    try:
        yield recorder
    except (LinkError, DriverError, HilError) as error:
        recorder.close({"ended": f"refused: {error}"})
        raise


@contextlib.contextmanager
def alone(*setups: Setup) -> Iterator[None]:
    """No other process of this machine may send what these send. Raises ArmingError."""
    bus, sent = setups[0].config.bus, []
    for binding in (setup.binding for setup in setups if not setup.config.loop.shadow):
        sent += [bound.message for bound in binding.outgoing] + ([binding.sync] if binding.sync else [])
    try:
        with claimed(bus.interface, bus.channel, [f"0x{message.send_id:X}" for message in sent]):
            yield
    except ClaimedError as error:
        look = "hil watch, --shadow" if len(setups) == 1 else "hil watch"
        raise ArmingError(f"nothing was sent: {error}; to look on: {look}") from error


@contextlib.contextmanager
def guarding(
    config: RunConfig, recorder: Recorder, opened: Callable[[], Stopper], words: Words | None = None
) -> Iterator[Words | None]:
    """A guardian for the run, unless time stands still, nothing is sent, or the bus is this process's own.

    ``opened`` makes, in the guardian, what can stop the drives.
    """

    def stopper() -> Stopper:
        recorder.leave()
        return opened()

    loop, own = config.loop, config.bus.interface == "virtual"
    if own or loop.clock == "lockstep" or loop.shadow or not config.guardian.enabled:
        yield None
    else:
        timeout_ns, asked = config.guardian.timeout_ns(loop), config.realtime
        rights = Rights(asked.fifo_priority, asked.lock_memory, asked.cpu)
        with guardian(timeout_ns, rights, stopper, words) as shared:
            yield shared


def _recorded(
    setup: Setup,
    request: StopRequest,
    recorder: Recorder,
    clock: RealClock | LockstepClock,
    words: Words | None,
) -> RunResult:
    """Open the drive and the log, arm, run."""
    config = setup.config
    shadow = config.loop.shadow
    with opened_client(setup, recorder, clock) as client:
        seen = client.overhear() if shadow else None
        recorder.begin(header_of(setup, "run", clock.name))  # meanwhile the drive may be heard
        asked = not shadow and drive_kind(config.drive.kind).asked
        if asked:  # who asks has listened
            hear_others(setup, client)
        if shadow or not setup.binding.map.poll:
            say(f"waiting for the drive on {config.bus.interface}:{config.bus.channel}")
            await_drive(setup, client, asked)
        if not (shadow or asked):
            hear_others(setup, client)
        recorder.await_open()
        say(f"{'listening only' if shadow else 'arming'}; log {recorder.path}")
        drive: Drive = client if seen is None else ShadowDrive(client, seen)
        if words:
            drive = GuardedDrive(client, words, clock.now_ns, client.timed)
        if shadow:
            recorder.event(clock.now_ns(), 0, "shadow", "reads and computes, sends nothing")
        machine, plan = setup.machine.fresh(), plan_of(config)
        plan = replace(plan, together=fused.together(plan.period_ns, request))
        machine = machine if request.ramps else machine.at_once()
        takes = set_by_others(setup)
        with contextlib.closing(Inbox(Place(machine, takes))) as inbox, _started(None if shadow else client):
            compiled = partial(fused.whole_tick, client, words, machine, recorder, plan, request)
            whole = partial(compiled, number=inbox.number, clock=clock.cell, seen=seen)
            parts = drive, clock, recorder, machine.looped(), recorder.record, plan, request, whole
            loop = Loop(*parts, inbox if takes else None, client.timed)
            client.discard()

            def ended(outcome: Outcome, k: int) -> Ended:
                end = end_of(machine, client, outcome.stop, recorder, clock.now_ns(), k)
                result: dict[str, Any] = {"ended": Reason(outcome.reason).name.lower()}
                result |= {"ticks": outcome.ticks, "skipped": outcome.skipped}
                return Ended(result | ({"end": end.as_dict()} if end else {}), outcome, end, {})

            return run_armed(config, loop, recorder, clock, request, ended, takes)


@contextlib.contextmanager
def _started(client: BusDrive | None) -> Iterator[None]:
    """The drive's CANopen node in operation, where it has one; every way out leaves it. None: a shadow."""
    if client is None:
        yield
        return
    client.start()
    client.flush()  # into the log before the loop makes its tick ready in the same room
    try:
        yield
    finally:
        client.leave()


def set_by_others(setup: Setup) -> Takes:
    """What ``hil set`` may ask of this run: nothing when the config says so, or when it sends nothing."""
    config = setup.config
    if config.loop.shadow or not config.setpoint.enabled:
        return {}
    return ranges(setup.machine, config.controller.kind)


def await_drive(setup: Setup, client: BusDrive, ask: bool = False) -> None:
    """Listen for the drive before anything is sent; ``ask``: for what it measures, which commands nothing."""
    timeout_s = setup.config.drive.heartbeat_timeout_s
    if not client.wait_for_drive(timeout_s, ask):
        bus = setup.config.bus
        hint = (
            f"start it: hil emulate {setup.path}"
            if is_emulated_bus(setup.config)
            else "is it powered and wired?"
        )
        sent = "no command" if ask else "nothing"
        raise ArmingError(
            f"no drive heard on {bus.interface}:{bus.channel} for {timeout_s:g} s, {sent} was sent; {hint}"
        )
    if odd := client.odd_length():
        raise ArmingError(f"{odd}; correct the DBC, or the drive's mapping; nothing was sent")


def hear_others(setup: Setup, client: BusDrive) -> None:
    """Listen for another controller, on this machine or not, before anything is sent. Raises ArmingError."""
    heard = client.other_master(max(LISTEN_PERIODS * setup.config.loop.period_ns * 1e-9, LISTEN_S))
    if heard is not None:
        bus = setup.config.bus
        raise ArmingError(
            f"another controller sends 0x{heard:X} on {bus.interface}:{bus.channel}: nothing was sent; "
            f"{ANOTHER_REMEDY}"
        )


def plan_of(config: RunConfig) -> Plan:
    """Timing of the run."""
    loop = config.loop
    ticks = None if loop.duration_s is None else round(loop.duration_s * loop.rate_hz)
    follows = loop.pacing == "sync" and (loop.shadow or config.bus.sync == "kernel")
    pacing = "feedback" if follows else loop.pacing
    return Plan(loop.period_ns, loop.timeout_ns, pacing, ticks, config.feedback_every)


class Tells(Protocol):
    """What a drive's client says once the run is over."""

    def odd_length(self) -> str:
        """Which message came with another length than it should, in words."""

    def flush(self) -> None:
        """Hand on the frames that came and went."""


class Ended(NamedTuple):
    """Why a run ended: as the log keeps it, in ticks and skips, and of several nodes each one's."""

    result: dict[str, Any]
    outcome: Outcome
    end: End | None
    nodes: dict[str, Any]


def run_armed(
    config: RunConfig,
    loop: Loop,
    recorder: Recorder,
    clock: RealClock | LockstepClock,
    request: StopRequest,
    ended: Callable[[Outcome, int], Ended],
    takes: Takes,
    nodes: Mapping[str, Takes] | None = None,
) -> RunResult:
    """Run the loop and close the log. ``ended`` finds out why it ended, and with which tick."""
    grants: list[realtime.Grant] = []
    outcome, failure, processor_ns = Outcome(), "", 0
    try:
        with driving(config, recorder, clock, request, takes, nodes) as grants:
            begin_ns = time.thread_time_ns()
            outcome = loop.run()
            processor_ns = time.thread_time_ns() - begin_ns
    except BaseException as error:
        failure = f"{type(error).__name__}: {error}"
        raise
    finally:
        last_k = outcome.ticks + outcome.skipped
        released(config, recorder, clock, last_k)
        why, dropped = ended(outcome, last_k), recorder.dropped
        complete = recorder.close(why.result | ({"ended": failure} if failure else {}))
        if not complete:
            kept = "" if recorder.path.exists() else ": it was deleted or moved during the run"
            say(f"log {recorder.path} is not complete{kept}")
    processor_us = processor_ns * 1e-3 / max(outcome.ticks, 1)
    path = str(recorder.path)
    return RunResult(path, why.outcome, complete, dropped, grants, processor_us, why.end, why.nodes)


def end_of(
    machine: Machine,
    client: Tells,
    stop: TickArray | None,
    recorder: Recorder,
    now_ns: int,
    k: int,
    of: str = "",
) -> End | None:
    """Why a drive's run ended, in the tick ``stop``; what it said of itself is logged after ``of``."""
    if odd := client.odd_length():
        recorder.event(now_ns, k, "length", of + odd)
        say(f"{of}{odd}; no frame of another length is taken: correct the DBC, or the drive's mapping")
    with contextlib.suppress(Exception):  # after the guardian's stop nothing else hands them on
        client.flush()
    if stop is None:
        return None
    if code := int(stop[0]["drive_error"]):
        recorder.event(now_ns, int(stop[0]["k"]), "drive-error", of + words(code))
    return explain(machine.safety, machine.safety_state, stop[0])


@contextlib.contextmanager
def driving(
    config: RunConfig,
    recorder: Recorder,
    clock: RealClock | LockstepClock,
    request: StopRequest,
    takes: Takes,
    nodes: Mapping[str, Takes] | None = None,
) -> Iterator[list[realtime.Grant]]:
    """While the loop runs: signals stop it, the rights asked for are granted, others see it.

    ``nodes``: of a run with several nodes what may be set of each, by name.
    """
    ticks, where = plan_of(config).ticks, f"{config.bus.interface}:{config.bus.channel}"
    with stopping_on_signals(request):
        note_interface(config, recorder, clock.now_ns(), 0)
        grants: list[realtime.Grant] = []
        if clock.name == "monotonic":
            realtime.keep_off(recorder.writer_pid, config.realtime.cpu)
            grants = realtime.acquire(config.realtime)
        entry = own_entry(recorder.path, where, config.loop.rate_hz, ticks, clock.name, takes, nodes or {})
        with announced(entry), watching(os.getpid(), ticks):
            yield grants


def released(config: RunConfig, recorder: Recorder, clock: RealClock | LockstepClock, last_k: int) -> None:
    """The rights given back after the loop; the interface's state and who asked for the stop in the log."""
    realtime.release()
    note_interface(config, recorder, clock.now_ns(), last_k)
    if asked := who_asked(os.getpid()):
        t_ns, k, who = asked
        recorder.event(t_ns, k, "stop-asked", who)


@contextlib.contextmanager
def stopping_on_signals(request: StopRequest) -> Iterator[None]:
    """Ctrl-C, SIGTERM and SIGHUP ask for a safe stop; the old handlers come back afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, request.stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
