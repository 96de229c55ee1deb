"""`hil emulate`: the emulated drive as a process of its own on the configured bus."""

from __future__ import annotations

import signal
from collections import Counter
from pathlib import Path
from typing import Any, TypeVar

from drivers.binding import bind
from drivers.bus import Link, open_link
from drivers.codec import Database
from drivers.mapping import MEASURED
from firmware_model.bench import Bench, Coupled, Tap
from firmware_model.config import PlantConfig, build_params, new_state
from firmware_model.faulty_link import FaultyLink
from firmware_model.faulty_plant import PlantFaults
from firmware_model.node import Node, compile_kernels, frames_of, wire_of
from firmware_model.shaft import Shaft, refuse_uncoupled
from hil.config.nodefile import load_nodes
from hil.config.tables import RunConfig, load_toml
from hil.errors import ConfigError
from hil.runtime import realtime
from hil.runtime.bus import bus_settings
from hil.runtime.claim import claimed
from hil.runtime.setup import Overrides, drive_map

N = TypeVar("N", bound=Node)


def load_plant(path: Path, config: RunConfig, settings: list[str] | None = None) -> tuple[PlantConfig, Path]:
    """The plant that a run configuration names, and the folder of its file."""
    if config.emulator is None:
        raise ConfigError(str(path), ['emulator: missing; add [emulator] with plant = "plants/demo.toml"'])
    plant_path = path.parent / config.emulator.plant
    return load_toml(plant_path, PlantConfig, settings or []), plant_path.parent


class Emulated:
    """What a plant's file describes; ``frames``: what it speaks."""

    def __init__(self, plant: PlantConfig, folder: Path, node_rule: str) -> None:
        self._plant, self._database = plant, Database(folder / plant.dbc, plant.node_id, node_rule)
        self._params = build_params(plant, wire_of(self._database, plant.protocol))
        self._eds, self._acted = folder / plant.eds if plant.eds else None, Counter[int]()
        self.frames = frames_of(self._database, plant.protocol, eds=(self._eds, {}) if self._eds else None)

    def faulty(self, link: Link, lockstep: bool) -> FaultyLink:
        """A link with the faults of its frames."""
        faults, opener = self._plant.fault, self.frames.sync_id
        return FaultyLink(link, self._database, faults, lockstep=lockstep, acted=self._acted, sync_id=opener)

    def on(self, kind: type[N], link: Link, faulty: FaultyLink | None, config: RunConfig, **more: Any) -> N:
        """A node of it on a link, through its faults."""
        plant, faults = self._plant, None
        if plant.fault or plant.black_box:
            faults = PlantFaults(plant.fault, self._params, self.frames.counter_modulus - 1, self._acted)
        node = kind(
            faulty or link,
            self._database,
            self._params,
            clock=config.loop.clock,
            period_ns=config.loop.period_ns,
            truth=plant.truth,
            protocol=plant.protocol,
            eds=self._eds,
            faults=faults,
            **more,
        )
        if faulty is not None:
            faulty.now_ns, faulty.lost_sync = lambda: node.now_ns, node.pass_time
        return node


def make_node(path: Path, config: RunConfig, plant_settings: list[str]) -> tuple[Node, Link, str]:
    """Load everything, open the bus; return the node and a line that says what it is."""
    plant, folder = load_plants(path, {"": config}, plant_settings)[""]
    drive = Emulated(plant, folder, config.drive.node_rule)
    if drive.frames.spoken is not None:
        check_spoken(path, config, drive.frames.spoken)
    link: Link = open_link(bus_settings(config))
    lockstep, every = config.loop.clock == "lockstep", plant.feedback_every
    faulty = drive.faulty(link, lockstep) if plant.fault else None
    ends = lockstep and config.feedback_every > 1 and faulty is None
    node = drive.on(Node, link, faulty, config, pacing=plant.pacing, every=every, ends_ticks=ends)
    bus = config.bus
    motor = plant.motor.name or "inline"
    what = f"{bus.interface}:{bus.channel} node {plant.node_id}, motor {motor}, {config.loop.clock}"
    return node, faulty or link, what


def make_bench(path: Path, nodes: dict[str, RunConfig], plant_settings: list[str]) -> tuple[Bench, Link, str]:
    """:func:`make_node` for two drives on one shaft; the settings of a plant are for both."""
    plants = load_plants(path, nodes, plant_settings)
    refuse_uncoupled({name: plant for name, (plant, _) in plants.items()})
    config = next(iter(nodes.values()))
    made, bus, link = [], config.bus, open_link(bus_settings(config))
    for name, (plant, folder) in plants.items():
        own = nodes[name].drive
        if plant.node_id != own.node_id:
            link.close()
            raise ConfigError(
                f"{path}: node {name}",
                [f"emulator.plant: node {plant.node_id} is emulated, drive.node_id is {own.node_id}"],
            )
        made.append(_coupled(plant, folder, link, config, own.node_rule))
    shown = " and ".join(f"{name} (node {plant.node_id})" for name, (plant, _) in plants.items())
    what = f"{bus.interface}:{bus.channel}, {shown} on one shaft, {config.loop.clock}"
    return Bench(link, made), link, what


def load_plants(
    path: Path, nodes: dict[str, RunConfig], settings: list[str] | None = None
) -> dict[str, tuple[PlantConfig, Path]]:
    """:func:`load_plant` for each node, with the faults that happen to it; one drive alone has no name.

    Raises ConfigError.
    """
    plants = {}
    for name, config in nodes.items():
        plant, folder = load_plant(path, config, settings)
        for fault in plant.fault:
            if fault.node is not None and fault.node not in nodes:
                known = " and ".join(nodes)
                why = f"there are {known}" if known else "the bus has one drive; leave the node out"
                raise ConfigError(str(path), [f"fault: node {fault.node!r}: {why}"])
        own = [fault for fault in plant.fault if fault.node in (None, name)]
        plants[name] = plant.model_copy(update={"fault": own}), folder
    return plants


def _coupled(plant: PlantConfig, folder: Path, link: Link, config: RunConfig, node_rule: str) -> Coupled:
    """One node of a bench, with its faults."""
    drive, tap = Emulated(plant, folder, node_rule), Tap(link)
    faulty = drive.faulty(tap, False) if plant.fault or plant.black_box else None
    node = drive.on(Coupled, link, faulty, config, pacing="sync")
    if faulty is not None:
        node.faulty, node.tap = faulty, tap
    return node


def check_spoken(path: Path, config: RunConfig, spoken: dict[int, int]) -> None:
    """Refuse an emulated drive that does not speak what the run maps. Raises ConfigError.

    ``spoken``: length of each message that it sends or takes, by identifier.
    """
    drive = config.drive
    database = Database(path.parent / drive.dbc, drive.node_id, drive.node_rule)
    made = bind(drive_map(config, database, str(path)), database, load=config.commands_load)
    needed = [b.message for b in made.incoming if {part for part, _ in b.parts} & set(MEASURED)]
    strange = [
        f"{message.name} (0x{message.can_id:X}, {message.length} bytes)"
        for message in (*needed, *(bound.message for bound in made.outgoing))
        if spoken.get(message.send_id) != message.length
    ]
    if strange:
        raise ConfigError(
            str(path),
            [
                f"emulator.plant: the emulated drive knows no {', '.join(dict.fromkeys(strange))} as "
                f"{drive.dbc} has it for node {drive.node_id}; emulate what speaks it, or take another DBC"
            ],
        )


def warm_up(path: Path, *configs: RunConfig) -> None:
    """Compile the plants' kernels and those of their faults, for the processes forked from this one."""
    records = []
    for config in configs:
        plant, folder = load_plant(path, config)
        params = build_params(plant, wire_of(Database(folder / plant.dbc, plant.node_id), plant.protocol))
        records += [params, new_state(params, 0)]
    compile_kernels(*records[:2])
    if len(configs) == 2:
        Shaft(*records)


def serve(path: Path, overrides: Overrides, plant_settings: list[str]) -> None:
    """Run the emulator until SIGINT or SIGTERM. Prints one line when it listens and one at the end."""
    if nodes := load_nodes(path, overrides.as_settings()):
        config = next(iter(nodes.values()))
        names = [f"node {one.drive.node_id}" for one in nodes.values()]
        with claimed(config.bus.interface, config.bus.channel, names):
            _serve(config, *make_bench(path, nodes, plant_settings))
        return
    config = load_toml(path, RunConfig, overrides.as_settings())
    plant, _ = load_plant(path, config, plant_settings)
    node_name, bus = f"node {plant.node_id}", config.bus
    with claimed(bus.interface, bus.channel, [node_name]):
        _serve(config, *make_node(path, config, plant_settings))


def _serve(config: RunConfig, node: Node | Bench, link: Link, what: str) -> None:
    node.warm_up()
    if config.loop.clock == "realtime":
        below = config.realtime.model_copy(
            update={"fifo_priority": max(0, config.realtime.fifo_priority - 1)}
        )
        realtime.acquire(below.model_copy(update={"cpu": None}))
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    print(f"emulator ready on {what}", flush=True)  # noqa: T201 - the line that callers wait for
    try:
        node.run(lambda: stopped)
    finally:
        realtime.release()  # to give so much locked memory back takes tens of milliseconds
        link.close()
    print(node.summary(), flush=True)  # noqa: T201
