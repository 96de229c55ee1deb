"""Composition root: the only place that wires configuration, drivers, clock, recorder and loop together."""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from drivers.bcm import KernelSync, kernel_sync
from drivers.binding import Binding, bind
from drivers.bus import BusSettings, Link, open_link
from drivers.busload import frame_seconds, message_rates, message_shares
from drivers.client import precompile
from drivers.codec import Database
from drivers.drive import Drive as BusDrive
from drivers.drive import DriveKind, DriveKindError, OnFrames, drive_kind
from drivers.errors import DriverError, LinkError
from drivers.jit import COMPILED
from drivers.kernel import interface_facts
from drivers.lockstep import LockstepLink
from drivers.mapping import MEASURED, RECEIVED, DriveMap, map_of
from drivers.signal import Signal
from drivers.watch import CommandWatch
from hil import fused, realtime
from hil.claim import ClaimedError, claimed
from hil.clock import LockstepClock, RealClock
from hil.config import RunConfig, load_toml
from hil.control.registry import laws
from hil.design import Machine, SlowMessage, WireFacts, build
from hil.errorcodes import words
from hil.errors import ArmingError, ConfigError, HilError
from hil.filtered import refuse_unstable
from hil.guardian import GuardedDrive, Rights, Words, guardian
from hil.inbox import Inbox, ranges
from hil.log.origin import origin, package_version
from hil.log.recorder import BYTES_PER_TICK, Recorder, check_folder
from hil.log.split import part_path
from hil.loop import Loop, Outcome, Plan, StopRequest, no_whole
from hil.ports import Drive
from hil.progress import say, watching
from hil.reachable import out_of_reach
from hil.reasons import End, explain
from hil.shadow import ShadowDrive
from hil.shipped import log_base
from hil.showable import check_limits
from hil.signals import Reason, new_ticks
from hil.watch.registry import announced, own_entry, who_asked

MAX_LOAD = 0.7
LOAD_REMEDY = f"keep it under {100 * MAX_LOAD:.0f} %: a lower loop.rate_hz, a higher bitrate, or CAN FD"
LISTEN_PERIODS, LISTEN_S = 5, 0.05
"""How long a run listens for another controller: so many of its own periods, and at least that long."""
ANOTHER_REMEDY = "stop it, take another bus.channel, or only look: loop.shadow, hil watch"
EMULATED_INTERFACES = ("hil-local", "virtual")


@dataclass(frozen=True, slots=True)
class Overrides:
    """What the command line puts on top of the config; python-can's own flags."""

    interface: str | None = None
    channel: str | None = None
    bitrate: int | None = None
    fd: bool = False
    settings: tuple[str, ...] = ()

    def as_settings(self) -> list[str]:
        """The same as ``table.key=value`` settings."""
        out = list(self.settings)
        out += [f"bus.interface={json.dumps(self.interface)}"] if self.interface else []
        out += [f"bus.channel={json.dumps(self.channel)}"] if self.channel else []
        out += [f"bus.bitrate={self.bitrate}"] if self.bitrate else []
        out += ["bus.fd=true"] if self.fd else []
        return out


@dataclass(frozen=True, slots=True)
class Setup:
    """A configuration with everything that belongs to it loaded and designed; nothing is open yet."""

    path: Path
    config: RunConfig
    database: Database
    binding: Binding
    wire: WireFacts
    machine: Machine
    warnings: tuple[str, ...] = ()
    """What it asks for and can't get (:mod:`hil.reachable`)."""


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
        }


def drive_map(config: RunConfig, database: Database, where: str) -> DriveMap:
    """The configured map of the drive's signals, else the house protocol's. Raises DatabaseError."""
    return map_of(config.drive.signals, database, f"{where}: drive.signals", **config.map_facts)


def wire_facts(binding: Binding) -> WireFacts:
    """What the kernel needs of the frames, in SI units."""
    load = binding.signal("load_torque")
    speed, i_q, i_d = (binding.signal(part) for part in ("speed", "i_q", "i_d"))
    i_q = i_q or binding.signal("torque")
    return WireFacts(
        u_lsb=binding.u_step,
        T_L_lsb=load.step if load else 0.01,
        counter_modulus=binding.counter_modulus,
        x_lsb=(_step(speed), _step(i_q), _step(i_d)),
        u_top=binding.u_top,
        T_L_top=load.top if load else math.inf,
        slow=slow_messages(binding),
        measured=tuple(
            "i_q" if part == "torque" else part
            for bound in binding.incoming
            if bound.has(MEASURED)
            for part, _ in bound.parts
        ),
    )


def _step(signal: Signal | None) -> float:
    """Resolution of a measurement; of one that there is not, any."""
    return 1.0 if signal is None else signal.step


def slow_messages(binding: Binding) -> tuple[SlowMessage, ...]:
    """What the drive sends besides its measurements; with SYNC the cycle counts in SYNCs.

    The pages of a multiplexer take turns, so that each comes once in as many cycles as there are.
    """
    sync = binding.sync.cycle_ms if binding.sync else 0
    out = []
    for bound in binding.slow:
        cycle, parts = bound.message.cycle_ms, tuple(part for part, _ in bound.parts)
        pages = sum(other.message.name == bound.message.name for other in binding.incoming)
        cycle *= max(pages, len(bound.wanted), 1)
        syncs = cycle / sync if sync else 0.0
        out.append(SlowMessage(bound.message.name, parts, cycle * 1e-3, syncs))
    return tuple(out)


def load_setup(path: Path, overrides: Overrides) -> Setup:
    """Load and check everything of a run without opening or sending anything."""
    return setup_of(path, load_toml(path, RunConfig, overrides.as_settings()))


def setup_of(path: Path, config: RunConfig, read: Callable[..., Database] = Database) -> Setup:
    """:func:`load_setup` for a configuration that is loaded; ``read`` makes a file's database."""
    database = read(path.parent / config.drive.dbc, config.drive.node_id, config.drive.node_rule)
    load = config.controller.kind == "fac"
    parts = drive_map(config, database, str(path))
    asked = parts.sync or parts.poll  # then it answers as often as that
    period_ms = None if asked else config.loop.period_ns * 1e-6
    if parts.sync and parts.sync == parts.step:  # lockstep: it paces the loop
        loop = config.loop.model_copy(update={"pacing": "sync"})
        config = config.model_copy(update={"loop": loop})
    binding = bind(parts, database, load=load, period_ms=period_ms)
    kind = _kind(path, config)
    _check_pacing(path, config, binding, kind)
    _check_sync(path, config, binding, kind)
    shown = {part: signal.span for part in RECEIVED if (signal := binding.signal(part))}
    wire = wire_facts(binding)
    _check_command(path, config)
    carried = {config.command.keys[0]: wire.u_top} | ({"T_L_max_n_m": wire.T_L_top} if load else {})
    check_limits(str(path), config.limits, shown, carried)
    machine = build(config, wire)
    if config.drive.takes != "voltage":
        refuse_unstable(str(path), config, machine, wire.x_lsb[0])
    return Setup(path, config, database, binding, wire, machine, out_of_reach(config, wire))


def _kind(path: Path, config: RunConfig) -> DriveKind:
    """What speaks with the drive. Raises ConfigError."""
    try:
        return drive_kind(config.drive.kind)
    except DriveKindError as error:
        raise ConfigError(str(path), [f"drive.kind: {error}"]) from error


def _check_command(path: Path, config: RunConfig) -> None:
    """The controller asks for what the drive takes. Raises ConfigError."""
    kind, takes = config.controller.kind, config.drive.takes
    if takes not in laws()[kind].takes:
        fit = ", ".join(name for name, law in laws().items() if takes in law.takes)
        asked = " or ".join(laws()[kind].takes)
        raise ConfigError(
            str(path), [f"controller.kind: {kind} asks for a {asked}, the drive takes a {takes}; take {fit}"]
        )


def _check_pacing(path: Path, config: RunConfig, binding: Binding, kind: DriveKind) -> None:
    """A drive without SYNC is not paced by it, one that is asked by nothing else. Raises ConfigError."""
    if kind.asked and binding.sync is None:
        missing = f"drive.signals.sync: missing; name the message that asks a {config.drive.kind} drive"
        raise ConfigError(str(path), [missing])
    if kind.asked and config.loop.pacing != "sync":
        raise ConfigError(
            str(path), [f'loop.pacing: a {config.drive.kind} drive speaks when it is asked; take "sync"']
        )
    if binding.map.poll and config.loop.pacing != "sync":
        raise ConfigError(
            str(path), ['loop.pacing: the drive answers each command (drive.signals.poll); take "sync"']
        )
    if binding.opener is None and config.loop.clock == "lockstep":
        raise ConfigError(str(path), ['loop.clock: a drive without SYNC keeps its own time; take "realtime"'])
    if binding.opener is None and config.loop.pacing == "sync":
        raise ConfigError(
            str(path), ['loop.pacing: the drive takes no SYNC (drive.signals has no sync); take "feedback"']
        )


def _check_sync(path: Path, config: RunConfig, binding: Binding, kind: DriveKind) -> None:
    """Where the kernel can send SYNC in the loop's place. Raises ConfigError."""
    loop = config.loop
    if config.bus.sync == "loop":
        return
    needs = {
        'bus.interface = "socketcan"': config.bus.interface == "socketcan",
        'loop.pacing = "sync", and a drive that takes it': loop.pacing == "sync" and binding.sync is not None,
        'loop.clock = "realtime"': loop.clock == "realtime",
        "a run that sends: no loop.shadow": not loop.shadow,
        "a SYNC of at most one byte": binding.sync is None or binding.sync.length <= 1,
        "a drive that takes SYNC and is not asked": not kind.asked,
        "compiled kernels: no NUMBA_DISABLE_JIT": COMPILED,
    }
    lacking = [need for need, there in needs.items() if not there]
    if lacking:
        raise ConfigError(str(path), [f'bus.sync: "kernel" needs {lacking[0]}; else take "loop"'])


def bus_settings(config: RunConfig) -> BusSettings:
    """The bus table in the drivers' terms."""
    bus = config.bus
    return BusSettings(bus.interface, bus.channel, bus.bitrate, bus.data_bitrate, bus.fd)


def frame_time(config: RunConfig) -> Callable[[int, bool], float]:
    """Longest time on the bus [s] of a frame of so many bytes (True: extended identifier)."""
    bus = config.bus

    def seconds(length: int, extended: bool) -> float:
        fd = bus.fd or length > 8
        return frame_seconds(
            length, fd=fd, extended=extended, bitrate=bus.bitrate, data_bitrate=bus.data_bitrate
        )

    return seconds


def message_names(config: RunConfig | None, dbc: str) -> dict[int, str]:
    """Message names by identifier as it stands in a frame, from a DBC's text; empty where it is none."""
    node, rule = (config.drive.node_id, config.drive.node_rule) if config else (1, "")
    try:
        return dict(Database(Path("drive.dbc"), node, rule, dbc).by_id)
    except DriverError:
        return {}


def is_emulated_bus(config: RunConfig) -> bool:
    """True for buses that no real drive hangs on: hil-local, python-can's virtual, vcan by the kernel's word.

    An interface that is not there is taken by its name; nothing can be armed on it anyway.
    """
    return _is_emulated(config.bus.interface, config.bus.channel)


def _is_emulated(interface: str, channel: str) -> bool:
    if interface != "socketcan":
        return interface in EMULATED_INTERFACES
    try:
        facts = interface_facts(channel)
    except DriverError:
        return False  # nobody can say, so it may be real
    return facts.kind == "vcan" if facts else channel.startswith("vcan")


def note_interface(config: RunConfig, recorder: Recorder, t_ns: int, k: int) -> None:
    """Log what the kernel says of the interface now: its state, error counters, bitrate, restart, queue.

    Asked before the loop and after it, never in a tick. A bus that the kernel does not know is left out.
    """
    if config.bus.interface != "socketcan":
        return
    try:
        facts = interface_facts(config.bus.channel)
        text = facts.text() if facts else f"there is no interface {config.bus.channel}"
    except DriverError as error:
        text = str(error)
    recorder.event(t_ns, k, "interface", text)


@contextlib.contextmanager
def sending_bus(
    interface: str, channel: str, bitrate: int, fd: bool, *, real_allowed: bool
) -> Iterator[Callable[[int, bytes, bool], None]]:
    """A way to send raw frames. Raises ArmingError for a bus that may be real, unless that is allowed."""
    if not (real_allowed or _is_emulated(interface, channel)):
        raise ArmingError(
            f"{interface}:{channel} is no emulated bus and the frames may command a drive; "
            "nothing was sent. --transmit-commands allows it"
        )
    link = open_link(BusSettings(interface, channel, bitrate, None, fd))
    try:
        yield link.send
    finally:
        link.close()


def log_path(setup: Setup, kind: str) -> Path:
    """Where the run's log goes: the configured name, or config name, kind and UTC time."""
    log = setup.config.log
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    name = log.name or f"{setup.path.stem}-{kind}-{stamp}"
    path = (log_base(setup.path) / log.folder / f"{name}.mcap").resolve()
    return path if log.split_s is None and log.split_mb is None else part_path(path, 0)


def plant_of(path: Path) -> dict[str, str]:
    """The plant's file as an attachment: what is one, and nothing else that the path may lead to."""
    from firmware_model.config import PlantConfig

    try:
        if not path.is_file():
            raise ConfigError(str(path), ["no such file"])
        load_toml(path, PlantConfig)
        return {"plant.toml": path.read_text(encoding="utf-8")}
    except (ConfigError, OSError, ValueError) as error:
        say(f"no plant is kept in the log: {str(error).splitlines()[0]}")
        return {}


def header_of(setup: Setup, kind: str, clock: str) -> dict[str, Any]:
    """Metadata and attachments that make a log self-contained."""
    packages = ("numpy", "scipy", "numba", "python-can", "mcap")
    attachments = {
        "config.toml": setup.path.read_text(encoding="utf-8"),
        "config.json": setup.config.model_dump_json(),
        "controller.json": setup.machine.to_json(),
        "drive.dbc": setup.database.text,
    }
    if setup.config.emulator is not None:
        attachments |= plant_of(setup.path.parent / setup.config.emulator.plant)
    return {
        "metadata": {
            "kind": kind,
            "clock": clock,
            "started": datetime.now(UTC).isoformat(),
            "python": sys.version.split()[0],
            "machine": platform.machine(),
            "kernel": platform.release(),
            "wire": json.dumps(
                {
                    "u_lsb": setup.wire.u_lsb,
                    "T_L_lsb": setup.wire.T_L_lsb,
                    "counter_modulus": setup.wire.counter_modulus,
                    "x_lsb": setup.wire.x_lsb,
                    "u_top": setup.wire.u_top,
                    **({"T_L_top": setup.wire.T_L_top} if math.isfinite(setup.wire.T_L_top) else {}),
                    "slow": [asdict(message) for message in setup.wire.slow],
                    "measured": setup.wire.measured,
                }
            ),
            **origin(),
            **{f"version {name}": package_version(name) for name in packages},
        },
        "attachments": attachments,
        "compression": setup.config.log.compression,
        "split": {"s": setup.config.log.split_s, "mb": setup.config.log.split_mb},
    }


@contextlib.contextmanager
def opened_client(
    setup: Setup,
    recorder: Recorder | None,
    clock: RealClock | LockstepClock,
    watch: CommandWatch | None = None,
) -> Iterator[BusDrive]:
    """A drive client on the configured bus, closed in the end; ``watch`` sees each frame, too."""
    on_frames = recorder.frames if recorder and setup.config.log.frames else None
    client = _client(setup, watch.chained(on_frames) if watch else on_frames, clock.now_ns, controls=True)
    try:
        yield client
    finally:
        client.close()


def _client(
    setup: Setup,
    on_frames: OnFrames | None = None,
    now: Callable[[], int] = time.monotonic_ns,
    controls: bool = False,
) -> BusDrive:
    """A drive client on a link of its own; one that ``controls`` may have SYNC by the kernel."""
    load = setup.config.controller.kind == "fac"
    link: Link = open_link(bus_settings(setup.config))
    if setup.config.loop.clock == "lockstep":
        sync = setup.binding.opener
        link = LockstepLink(link, sync.send_id if sync else None)
    return drive_kind(setup.config.drive.kind).open(
        link,
        setup.database,
        load=load,
        drive_map=setup.binding.map,
        on_frames=on_frames,
        now=now,
        timed=sync_by_kernel(setup) if controls else None,
    )


def sync_by_kernel(setup: Setup) -> KernelSync | None:
    """What sends SYNC in the loop's place, where the config asks for it. Raises LinkError."""
    bus, sync = setup.config.bus, setup.binding.sync
    if bus.sync == "loop" or sync is None:
        return None
    return kernel_sync(bus.channel, sync.send_id, sync.length > 0, setup.config.loop.period_ns)


def check_arming(setup: Setup, arm: bool) -> None:
    """Refuse a real bus without an explicit ``--arm``; a shadow run sends nothing and needs none.

    Lockstep is refused there in any case: a real drive's time does not stand still.
    """
    bus, loop = setup.config.bus, setup.config.loop
    if is_emulated_bus(setup.config):
        return
    if loop.clock == "lockstep":
        raise ArmingError(
            f"{bus.interface}:{bus.channel} may carry a real drive, which keeps its own time: nothing was "
            'sent; leave --lockstep out, or set loop.clock = "realtime"'
        )
    if arm or loop.shadow:
        return
    raise ArmingError(
        f"{bus.interface}:{bus.channel} may carry a real drive: nothing was sent; "
        "check with 'hil check', then arm with --arm"
    )


def check_reachable(setup: Setup) -> None:
    """Say what can't be had; refuse it on a bus that may be real. Raises ArmingError."""
    if why := setup.binding.command.message.unwatched:
        say(f"warning: drive.signals.unwatched: {why}")
    for line in setup.warnings:
        say(f"warning: {line}")
    if setup.warnings and not (setup.config.loop.shadow or is_emulated_bus(setup.config)):
        raise ArmingError(f"{setup.warnings[0]}; nothing was sent")


def load_found(setup: Setup) -> tuple[str, bool]:
    """Worst-case bus load of this run in words, with the frames that make it, and whether it is allowed."""
    bus = setup.config.bus
    rates = message_rates(setup.binding, float(setup.config.loop.rate_hz))
    shares = message_shares(rates, bus.bitrate, bus.data_bitrate)
    load = sum(shares.values())
    frames = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
    words = f"{100 * load:.0f} % at {bus.bitrate} bit/s with every stuff bit, without other nodes: {frames}"
    return words, load <= MAX_LOAD


def check_load(setup: Setup) -> None:
    """Refuse to overload a real bus; an emulated one has no bitrate. Raises ArmingError."""
    if setup.config.loop.shadow or is_emulated_bus(setup.config):
        return
    found, good = load_found(setup)
    if not good:
        raise ArmingError(f"bus load {found}; nothing was sent; {LOAD_REMEDY}")


def check_set_up(setup: Setup) -> None:
    """Refuse a CANopen drive that lost what hil configure has set; asks it by SDO. Raises ArmingError."""
    config = setup.config
    if config.canopen is None or config.loop.shadow:
        return
    from hil.configure import lost

    problems = lost(setup.path, config, bus_settings(config), config.drive.heartbeat_timeout_s)
    if problems:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise ArmingError(
            f"the drive is not as hil configure sets it: {problems[0]}{more}; set it: hil configure "
            f"{setup.path}; no SYNC and no command was sent"
        )


def needed_bytes(config: RunConfig) -> int:
    """Disk space that a run of the configured length may take, at least one minute's."""
    seconds = config.loop.duration_s or 60.0
    return round(seconds * config.loop.rate_hz * BYTES_PER_TICK) + (8 << 20)


def compile_kernels(setup: Setup) -> None:
    """Compile, or load, what a run needs: that takes longer than anything later waits for."""
    setup.machine.looped()
    fac = setup.config.controller.kind == "fac"
    opens = drive_kind(setup.config.drive.kind).open
    precompile(setup.database, setup.binding.map, fac, new_ticks()[0], opens)
    fused.load(plan_of(setup.config).pacing)


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
    with _alone(setup), _writing(Recorder(path, None, config.loop.rate_hz)) as recorder:
        compile_kernels(setup)  # while the writer starts
        check_set_up(setup)
        with _guarding(setup, recorder) as words:
            return _recorded(setup, request, recorder, clock, words)


@contextlib.contextmanager
def _writing(recorder: Recorder) -> Iterator[Recorder]:
    """A log that says of a run that was refused why."""
    try:
        yield recorder
    except (LinkError, DriverError, HilError) as error:
        recorder.close({"ended": f"refused: {error}"})
        raise


@contextlib.contextmanager
def _alone(setup: Setup) -> Iterator[None]:
    """No other process of this machine may send what this run sends. Raises ArmingError."""
    binding, bus = setup.binding, setup.config.bus
    sent = [bound.message for bound in binding.outgoing] + ([binding.sync] if binding.sync else [])
    names = [] if setup.config.loop.shadow else [f"0x{message.send_id:X}" for message in sent]
    try:
        with claimed(bus.interface, bus.channel, names):
            yield
    except ClaimedError as error:
        raise ArmingError(f"nothing was sent: {error}; to look on: hil watch, --shadow") from error


@contextlib.contextmanager
def _guarding(setup: Setup, recorder: Recorder) -> Iterator[Words | None]:
    """A guardian for the run, unless time stands still, nothing is sent, or the bus is this process's own."""

    def client() -> BusDrive:
        recorder.leave()
        return _client(setup)

    config = setup.config
    loop, alone = config.loop, config.bus.interface == "virtual"
    if alone or loop.clock == "lockstep" or loop.shadow or not config.guardian.enabled:
        yield None
    else:
        timeout_ns, asked = config.guardian.timeout_ns(loop), config.realtime
        rights = Rights(asked.fifo_priority, asked.lock_memory, asked.cpu)
        with guardian(timeout_ns, rights, client) as words:
            yield words


def _recorded(
    setup: Setup,
    request: StopRequest,
    recorder: Recorder,
    clock: RealClock | LockstepClock,
    words: Words | None,
) -> RunResult:
    """Open the drive and the log, arm, run."""
    config = setup.config
    watch = CommandWatch(setup.binding) if config.loop.shadow else None
    with opened_client(setup, recorder, clock, watch) as client:
        recorder.begin(header_of(setup, "run", clock.name))  # meanwhile the drive may be heard
        asked = not watch and drive_kind(config.drive.kind).asked
        if asked:  # who asks has listened
            _hear_others(setup, client)
        if watch or not setup.binding.map.poll:
            say(f"waiting for the drive on {config.bus.interface}:{config.bus.channel}")
            _await_drive(setup, client, asked)
        if not (watch or asked):
            _hear_others(setup, client)
        recorder.await_open()
        say(f"{'listening only' if watch else 'arming'}; log {recorder.path}")
        drive: Drive = ShadowDrive(client, watch.after(client.flush)) if watch else client
        if words:
            drive = GuardedDrive(client, words, clock.now_ns, client.timed)
        if watch:
            recorder.event(clock.now_ns(), 0, "shadow", "reads and computes, sends nothing")
        machine, plan = setup.machine.fresh(), plan_of(config)
        machine = machine if request.ramps else machine.at_once()
        alone = watch is not None or clock.name != "monotonic"
        whole = no_whole if alone else partial(fused.whole_tick, client, words, machine, recorder, plan)
        takes = set_by_others(setup)
        with contextlib.closing(Inbox(machine, takes)) as inbox, _started(None if watch else client):
            parts = drive, clock, recorder, machine.looped(), recorder.record, plan, request, whole
            loop = Loop(*parts, inbox if takes else None, client.timed)
            client.discard()
            return _run_armed(setup, machine, loop, plan, recorder, clock, request, takes, client)


@contextlib.contextmanager
def _started(client: BusDrive | None) -> Iterator[None]:
    """The drive's CANopen node in operation, where it has one; every way out leaves it. None: a shadow."""
    if client is None:
        yield
        return
    client.start()
    try:
        yield
    finally:
        client.leave()


def set_by_others(setup: Setup) -> dict[str, tuple[float, float, float]]:
    """What ``hil set`` may ask of this run: nothing when the config says so, or when it sends nothing."""
    config = setup.config
    if config.loop.shadow or not config.setpoint.enabled:
        return {}
    return ranges(setup.machine, config.controller.kind)


def _await_drive(setup: Setup, client: BusDrive, ask: bool = False) -> None:
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


def _hear_others(setup: Setup, client: BusDrive) -> None:
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
    return Plan(loop.period_ns, loop.timeout_ns, pacing, ticks)


def _run_armed(
    setup: Setup,
    machine: Machine,
    loop: Loop,
    plan: Plan,
    recorder: Recorder,
    clock: RealClock | LockstepClock,
    request: StopRequest,
    takes: dict[str, tuple[float, float, float]],
    client: BusDrive,
) -> RunResult:
    grants: list[realtime.Grant] = []
    outcome, failure, processor_ns = Outcome(), "", 0
    try:
        with stopping_on_signals(request):
            note_interface(setup.config, recorder, clock.now_ns(), 0)
            if clock.name == "monotonic":
                realtime.keep_off(recorder.writer_pid, setup.config.realtime.cpu)
                grants = realtime.acquire(setup.config.realtime)
            bus, rate_hz = setup.config.bus, setup.config.loop.rate_hz
            where = f"{bus.interface}:{bus.channel}"
            entry = own_entry(recorder.path, where, rate_hz, plan.ticks, clock.name, takes)
            with announced(entry), watching(os.getpid(), plan.ticks):
                begin_ns = time.thread_time_ns()
                outcome = loop.run()
                processor_ns = time.thread_time_ns() - begin_ns
    except BaseException as error:
        failure = f"{type(error).__name__}: {error}"
        raise
    finally:
        realtime.release()
        note_interface(setup.config, recorder, clock.now_ns(), outcome.ticks + outcome.skipped)
        if asked := who_asked(os.getpid()):
            t_ns, k, who = asked
            recorder.event(t_ns, k, "stop-asked", who)
        if odd := client.odd_length():
            recorder.event(clock.now_ns(), outcome.ticks + outcome.skipped, "length", odd)
            say(f"{odd}; no frame of another length is taken: correct the DBC, or the drive's mapping")
        with contextlib.suppress(Exception):  # after the guardian's stop nothing else hands them on
            client.flush()
        dropped = recorder.dropped
        ended = failure or Reason(outcome.reason).name.lower()
        result: dict[str, Any] = {"ended": ended, "ticks": outcome.ticks, "skipped": outcome.skipped}
        stop = outcome.stop
        end = None if stop is None else explain(machine.safety, machine.safety_state, stop[0])
        if end is not None:
            result["end"] = end.as_dict()
        if stop is not None and (code := int(stop[0]["drive_error"])):
            recorder.event(clock.now_ns(), int(stop[0]["k"]), "drive-error", words(code))
        complete = recorder.close(result)
        if not complete:
            kept = "" if recorder.path.exists() else ": it was deleted or moved during the run"
            say(f"log {recorder.path} is not complete{kept}")
    processor_us = processor_ns * 1e-3 / max(outcome.ticks, 1)
    return RunResult(str(recorder.path), outcome, complete, dropped, grants, processor_us, end)


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
