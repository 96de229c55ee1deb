"""CANopen nodes for tests on hil-local: the emulated drive in a thread, and nodes of the canopen library."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen

from drivers.bus import BusSettings, Link, open_link
from drivers.codec import Database
from firmware_model.config import PlantConfig, build_params
from firmware_model.node import Node, wire_of
from hil.config.tables import RunConfig, load_toml
from hil.runtime.configure import Job, job_of
from tests.conftest import CONFIGS, ROOT
from tests.durand402 import config_of

NODE = 5
PATIENT = "canopen.answer_timeout_s=5.0"
"""A busy machine lets a thread wait."""
EDS = CONFIGS / "drives" / "cia402.eds"
E35 = ROOT / "tests" / "data" / "e35.eds"
"""Of a servo's maker, with values of its node 32: examples/eds of canopen's source package."""


def bus_of(channel: str) -> BusSettings:
    return BusSettings("hil-local", channel)


def run_config(configs: Path) -> Path:
    """The shipped configuration, every object by the mode alone."""
    path = configs / "canopen.toml"
    if not path.exists():
        shipped = (configs / "cia402.toml").read_text(encoding="utf-8")
        path.write_text(config_of(shipped), encoding="utf-8")
    return path


def job(configs: Path, channel: str, *settings: str) -> Job:
    """The job of that config on a bus of its own."""
    path = run_config(configs)
    return job_of(path, load_toml(path, RunConfig, [PATIENT, *settings]), bus_of(channel))


@contextlib.contextmanager
def emulated(configs: Path, channel: str, *settings: str) -> Iterator[Node]:
    """The shipped emulated CiA 402 drive, served by a thread."""
    path = configs / "plants" / "cia402.toml"
    config = load_toml(path, PlantConfig, settings)
    database = Database(path.parent / config.dbc, config.node_id)
    link = open_link(bus_of(channel))
    node = Node(
        link, database, build_params(config, wire_of(database, "cia402")), clock="lockstep", pacing="sync",
        period_ns=1_000_000, truth=False, protocol="cia402", eds=path.parent / config.eds,
    )  # fmt: skip
    with serving(node.run, link):
        yield node


@contextlib.contextmanager
def serving(run: Callable[[Callable[[], bool]], None], link: Link) -> Iterator[None]:
    over = threading.Event()
    thread = threading.Thread(target=run, args=(over.is_set,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(5)
        link.close()


@contextlib.contextmanager
def stranger(channel: str, node_id: int = NODE, eds: Path = EDS) -> Iterator[Any]:
    """A node of the canopen library: SDO server and object dictionary by strangers."""
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02  # leaving takes as long
    network.connect(interface="hil-local", channel=channel)
    try:
        yield network.add_node(canopen.LocalNode(node_id, str(eds)))
    finally:
        network.disconnect()


@contextlib.contextmanager
def recorded(channel: str) -> Iterator[list[can.Message]]:
    """Every frame on a bus."""
    frames: list[can.Message] = []
    bus = can.Bus(channel, "hil-local")
    notifier = can.Notifier(bus, [frames.append], timeout=0.02)
    try:
        yield frames
        time.sleep(0.05)
    finally:
        notifier.stop()
        bus.shutdown()


@contextlib.contextmanager
def durand_drive(channel: str, eds: Path) -> Iterator[None]:
    """A drive on durand, a stack of strangers, as a process of its own; its EDS goes to a file."""
    words = [sys.executable, "-m", "tests.durand402", channel, str(eds)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield
        finally:
            process.terminate()
