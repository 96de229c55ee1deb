"""From a configuration file to all that a run needs before anything opens: database, binding, design."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drivers.binding import Binding, bind
from drivers.codec import Database
from drivers.drive import DriveKind, DriveKindError, drive_kind
from drivers.jit import COMPILED
from drivers.mapping import MEASURED, RECEIVED, DriveMap, map_of
from drivers.signal import Signal
from hil.config.design import Machine, SlowMessage, WireFacts, build
from hil.config.filtered import refuse_shaking, refuse_unstable
from hil.config.reachable import out_of_reach
from hil.config.showable import check_limits
from hil.config.tables import RunConfig, load_toml
from hil.control.registry import laws
from hil.errors import ConfigError


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
    """What it asks for and can't get (:mod:`hil.config.reachable`)."""


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
        theta_span=angle_span(binding.signal("angle")),
    )


def angle_span(angle: Signal | None) -> float:
    """What the angle's counter counts until it begins anew [rad]; 0 for whole turns, and for a float."""
    if angle is None or angle.is_float:
        return 0.0
    span = angle.raw_count * angle.step
    turns = span / (2.0 * math.pi)
    return 0.0 if abs(turns - round(turns)) < 0.01 and round(turns) else span


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
    config = load_toml(path, RunConfig, overrides.as_settings())
    if config.paired:
        raise ConfigError(
            str(path),
            [
                f"controller.kind {config.controller.kind}: half of one law over two nodes, and this takes "
                "one drive; hil run, check and demo take both, without --set node"
            ],
        )
    return setup_of(path, config)


def setup_of(path: Path, config: RunConfig, read: Callable[..., Database] = Database) -> Setup:
    """:func:`load_setup` for a configuration that is loaded; ``read`` makes a file's database."""
    database = read(path.parent / config.drive.dbc, config.drive.node_id, config.drive.node_rule)
    load = config.commands_load
    parts = drive_map(config, database, str(path))
    asked = parts.sync or parts.poll  # then it answers as often as that
    period_ms = None if asked else config.feedback_every * config.loop.period_ns * 1e-6
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
    _check_angle(path, config, wire)
    machine = build(config, wire)
    if config.drive.takes != "voltage":
        refuse_unstable(str(path), config, machine, wire.x_lsb[0])
    else:
        refuse_shaking(str(path), config, machine)
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


def _check_angle(path: Path, config: RunConfig, wire: WireFacts) -> None:
    """An angle that is to be followed is one of the shaft, over a turn at least. Raises ConfigError."""
    if config.follows_angle and 0.0 < wire.theta_span < 2.0 * math.pi:
        raise ConfigError(
            str(path),
            [
                f"drive.signals.angle: its frames show {wire.theta_span:.4g} rad, less than a turn; name the "
                "shaft's mechanical angle, or correct its unit in drive.signals.units"
            ],
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
    if (binding.map.poll or kind.asked) and config.feedback_every > 1:
        what = "the drive answers each command" if binding.map.poll else "the drive answers each request"
        raise ConfigError(str(path), [f"feedback.period_ms: {what} (in each tick); remove it"])
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
