"""The bus of a run: how it is opened, whether it may be real, and the drive's client on it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from drivers.bcm import KernelSync, kernel_sync
from drivers.bus import BusSettings, Link, SocketLink, open_link
from drivers.busload import frame_seconds
from drivers.codec import Database
from drivers.drive import Drive as BusDrive
from drivers.drive import OnFrames, drive_kind
from drivers.errors import DriverError
from drivers.kernel import interface_facts
from drivers.lockstep import LockstepLink
from hil.config.tables import RunConfig
from hil.errors import ArmingError
from hil.log.recorder import Recorder
from hil.runtime.clock import LockstepClock, RealClock
from hil.runtime.setup import Setup

EMULATED_INTERFACES = ("hil-local", "virtual")


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


@contextlib.contextmanager
def opened_client(
    setup: Setup, recorder: Recorder | None, clock: RealClock | LockstepClock
) -> Iterator[BusDrive]:
    """A drive client on the configured bus, closed in the end."""
    on_frames = recorder.frames if recorder and setup.config.log.frames else None
    client = new_client(setup, on_frames, clock.now_ns, controls=True)
    try:
        yield client
    finally:
        client.close()


def new_client(
    setup: Setup,
    on_frames: OnFrames | None = None,
    now: Callable[[], int] = time.monotonic_ns,
    controls: bool = False,
    hears: bool = True,
) -> BusDrive:
    """A drive client on a link of its own; one that ``controls`` may have SYNC by the kernel."""
    load = setup.config.commands_load
    return drive_kind(setup.config.drive.kind).open(
        opened_link(setup) if hears else deaf(opened_link(setup)),
        setup.database,
        load=load,
        drive_map=setup.binding.map,
        on_frames=on_frames,
        now=now,
        timed=sync_by_kernel(setup) if controls else None,
    )


def opened_link(setup: Setup) -> Link:
    """The configured bus, opened; in lockstep it knows the end of a tick."""
    link: Link = open_link(bus_settings(setup.config))
    if setup.config.loop.clock == "lockstep":
        sync = setup.binding.opener
        link = LockstepLink(link, sync.send_id if sync else None)
    return link


def deaf(link: Link) -> Link:
    """A link that only sends: where it has a socket it hears nothing from now on."""
    if isinstance(link, SocketLink):
        link.hear(())
    return link


def sync_by_kernel(setup: Setup) -> KernelSync | None:
    """What sends SYNC in the loop's place, where the config asks for it. Raises LinkError."""
    bus, sync = setup.config.bus, setup.binding.sync
    if bus.sync == "loop" or sync is None:
        return None
    return kernel_sync(bus.channel, sync.send_id, sync.length > 0, setup.config.loop.period_ns)
