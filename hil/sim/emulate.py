"""`hil emulate`: the emulated drive as a process of its own on the configured bus."""

from __future__ import annotations

import signal
from collections import Counter
from pathlib import Path

from drivers.binding import bind
from drivers.bus import Link, open_link
from drivers.codec import Database
from drivers.mapping import MEASURED
from firmware_model.bench import Bench, Coupled
from firmware_model.config import PlantConfig, build_params, new_state
from firmware_model.faulty_link import FaultyLink
from firmware_model.faulty_plant import PlantFaults
from firmware_model.node import Node, compile_kernels, frames_of, wire_of
from firmware_model.shaft import refuse_uncoupled
from hil.config.nodefile import load_nodes
from hil.config.tables import RunConfig, load_toml
from hil.errors import ConfigError
from hil.runtime import realtime
from hil.runtime.bus import bus_settings
from hil.runtime.claim import claimed
from hil.runtime.setup import Overrides, drive_map


def load_plant(path: Path, config: RunConfig, settings: list[str] | None = None) -> tuple[PlantConfig, Path]:
    """The plant that a run configuration names, and the folder of its file."""
    if config.emulator is None:
        raise ConfigError(str(path), ['emulator: missing; add [emulator] with plant = "plants/demo.toml"'])
    plant_path = path.parent / config.emulator.plant
    return load_toml(plant_path, PlantConfig, settings or []), plant_path.parent


def make_node(path: Path, config: RunConfig, plant_settings: list[str]) -> tuple[Node, Link, str]:
    """Load everything, open the bus; return the node and a line that says what it is."""
    plant, folder = load_plant(path, config, plant_settings)
    database = Database(folder / plant.dbc, plant.node_id, config.drive.node_rule)
    params = build_params(plant, wire_of(database, plant.protocol))
    link: Link = open_link(bus_settings(config))
    lockstep = config.loop.clock == "lockstep"
    acted = Counter[int]()
    eds = folder / plant.eds if plant.eds else None
    frames = frames_of(database, plant.protocol, eds=(eds, {}) if eds else None)
    if frames.spoken is not None:
        check_spoken(path, config, frames.spoken)
    faulty = None
    if plant.fault:
        opener = frames.sync_id
        faulty = FaultyLink(link, database, plant.fault, lockstep=lockstep, acted=acted, sync_id=opener)
    modulus = frames.counter_modulus
    watched = plant.fault or plant.black_box
    node = Node(
        faulty or link,
        database,
        params,
        clock=config.loop.clock,
        pacing=plant.pacing,
        period_ns=config.loop.period_ns,
        truth=plant.truth,
        protocol=plant.protocol,
        eds=eds,
        faults=PlantFaults(plant.fault, params, modulus - 1, acted) if watched else None,
        every=plant.feedback_every,
        ends_ticks=lockstep and config.feedback_every > 1 and faulty is None,
    )
    if faulty is not None:
        faulty.now_ns, faulty.lost_sync = lambda: node.now_ns, node.pass_time
    bus = config.bus
    motor = plant.motor.name or "inline"
    what = f"{bus.interface}:{bus.channel} node {plant.node_id}, motor {motor}, {config.loop.clock}"
    return node, faulty or link, what


def make_bench(path: Path, nodes: dict[str, RunConfig], plant_settings: list[str]) -> tuple[Bench, Link, str]:
    """:func:`make_node` for two drives on one shaft; the settings of a plant are for both."""
    plants = {name: load_plant(path, config, plant_settings) for name, config in nodes.items()}
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
        database = Database(folder / plant.dbc, plant.node_id, own.node_rule)
        made.append(
            Coupled(
                link,
                database,
                build_params(plant, wire_of(database, plant.protocol)),
                clock=config.loop.clock,
                pacing="sync",
                period_ns=config.loop.period_ns,
                truth=plant.truth,
                protocol=plant.protocol,
                eds=folder / plant.eds if plant.eds else None,
            )
        )
    shown = " and ".join(f"{name} (node {plant.node_id})" for name, (plant, _) in plants.items())
    what = f"{bus.interface}:{bus.channel}, {shown} on one shaft, {config.loop.clock}"
    return Bench(link, made), link, what


def check_spoken(path: Path, config: RunConfig, spoken: dict[int, int]) -> None:
    """Refuse an emulated drive that does not speak what the run maps. Raises ConfigError.

    ``spoken``: length of each message that it sends or takes, by identifier.
    """
    drive = config.drive
    database = Database(path.parent / drive.dbc, drive.node_id, drive.node_rule)
    made = bind(drive_map(config, database, str(path)), database, load=config.controller.kind == "fac")
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


def warm_up(path: Path, config: RunConfig) -> None:
    """Compile the plant's kernels and those of its faults, for the processes forked from this one."""
    plant, folder = load_plant(path, config)
    params = build_params(plant, wire_of(Database(folder / plant.dbc, plant.node_id), plant.protocol))
    compile_kernels(params, new_state(params, 0))


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
