"""SYNC by the kernel: the job's bytes, and the steering of a timer that starts anew after each expiry."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.bcm import STEER_EVERY, TX_DELETE, KernelSync, Steering, kernel_sync
from drivers.bus import SocketLink
from drivers.client import DriveClient
from drivers.errors import LinkError
from hil.errors import ConfigError
from hil.runtime.setup import Overrides, load_setup
from hil.signals import RxFlag, new_ticks
from tests.conftest import CONFIGS

PERIOD_NS = 1_000_000


@pytest.fixture
def ends() -> Iterator[tuple[KernelSync, socket.socket, socket.socket]]:
    """A job over ordinary sockets, and their other ends."""
    job, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ear, mouth = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    theirs.setblocking(False)
    sync = KernelSync(job, ear, 0x80, True, PERIOD_NS)
    with theirs, mouth:
        yield sync, theirs, mouth
        sync.close()


def test_the_jobs_bytes(ends: tuple[KernelSync, socket.socket, socket.socket]) -> None:
    """linux/can/bcm.h: TX_SETUP with SETTIMER and STARTTIMER, 1 ms as the second interval, 240 frames."""
    sync, theirs, _ = ends
    sync.start()
    sent = theirs.recv(8192)
    asked, first, second = (
        "01000000 03000000 00000000 00000000",
        16 * "00",
        "0000000000000000 e803000000000000",
    )
    assert sent[:56] == bytes.fromhex(f"{asked} {first} {second} 80000000 f0000000")
    frames = [sent[56 + 16 * n :][:16] for n in range(240)]
    assert len(sent) == 56 + 240 * 16
    assert frames == [struct.pack("=IB3x8s", 0x80, 1, bytes((count,))) for count in range(1, 241)]


def test_nothing_is_sent_before_the_start_and_the_job_is_deleted_once(
    ends: tuple[KernelSync, socket.socket, socket.socket],
) -> None:
    sync, theirs, _ = ends
    sync.steer(64, 0)
    sync.stop()
    with pytest.raises(BlockingIOError):
        theirs.recv(8192)
    sync.start()
    theirs.recv(8192)
    sync.stop()
    assert theirs.recv(8192) == bytes.fromhex("02000000" + 44 * "00" + "80000000" + "00000000")
    sync.stop()
    with pytest.raises(ConnectionError):  # the socket is closed: what it had asked for ends with it
        theirs.send(b"")
    with pytest.raises(LinkError):
        sync.start()


def test_what_was_heard_before_the_start_is_not_its_own(
    ends: tuple[KernelSync, socket.socket, socket.socket],
) -> None:
    sync, _, mouth = ends
    mouth.send(struct.pack("=IB3x8s", 0x80, 1, b"\x63"))
    sync.start()
    with pytest.raises(BlockingIOError):
        sync._ear.recv(72, socket.MSG_DONTWAIT)


@pytest.mark.parametrize("period_ns", [125_000, 1_000_000, 10_000_000])
@pytest.mark.parametrize("over_ns", [0.0, 3160.0, 5500.0])
def test_a_timer_that_starts_anew_is_kept_on_its_grid(period_ns: int, over_ns: float) -> None:
    """Each period is the interval and what the kernel takes: unsteered 3 us a period are 3 ms in a second."""
    rng = np.random.default_rng(17)
    steering, at, stamps = Steering(period_ns), 40_000.0, []
    for k in range(1, 64 * 200):
        at += 1000 * steering.interval_us + over_ns + rng.exponential(200.0)
        stamps.append(at - k * period_ns)
        if k % STEER_EVERY == 0:
            steering.steer(k, round(at), k * period_ns)
    phase = np.array(stamps[STEER_EVERY * 20 :])
    assert np.abs(phase).max() < STEER_EVERY * 1000
    assert abs(phase[-64 * 100 :].mean() - phase[: 64 * 90].mean()) < 5000.0


def test_without_the_broadcast_manager_a_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> socket.socket:
        raise OSError(93, "Protocol not supported")

    monkeypatch.setattr("drivers.bcm.socket.socket", none)
    with pytest.raises(LinkError, match=r"vcan0: Protocol not supported; modprobe can_bcm, or set bus.sync"):
        kernel_sync("vcan0", 0x80, True, PERIOD_NS)


@pytest.mark.compiled
def test_once_the_bus_was_down_the_job_is_deleted(
    ends: tuple[KernelSync, socket.socket, socket.socket],
) -> None:
    """The kernel would go on with it by itself when the interface comes up again."""
    sync, theirs, _ = ends
    setup, record = load_setup(CONFIGS / "demo.toml", Overrides()), new_ticks()
    ours, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, bus:
        client = DriveClient(SocketLink(None, ours, ours), setup.database, timed=sync)
        client.prepare(record[0])
        sync.start()
        theirs.recv(8192)
        bus.send(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))  # bus-off
        client.receive(record[0], 1)
        assert theirs.recv(8192)[0] == TX_DELETE
        assert int(record[0]["rx_flags"]) & int(RxFlag.BUS_DOWN)


LACKING = {
    'bus.interface = "socketcan"': ('bus.interface="hil-local"',),
    'loop.pacing = "sync"': ('loop.pacing="timer"',),
    'loop.clock = "realtime"': ('loop.clock="lockstep"',),
    "no loop.shadow": ("loop.shadow=true",),
}


@pytest.mark.compiled
@pytest.mark.parametrize("need", LACKING)
def test_what_sync_by_the_kernel_needs_is_said(need: str) -> None:
    """One line: the key, what it needs, what else to take."""
    path, own = CONFIGS / "vcan0.toml", ('bus.sync="kernel"',)
    assert load_setup(path, Overrides(settings=own)).config.bus.sync == "kernel"
    with pytest.raises(ConfigError) as refused:
        load_setup(path, Overrides(settings=(*own, *LACKING[need])))
    line = str(refused.value).splitlines()[-1]
    assert "bus.sync" in line and need in line and 'else take "loop"' in line


def test_a_drive_that_takes_no_sync_gets_none_by_the_kernel_either() -> None:
    own = ('bus.sync="kernel"', 'bus.interface="socketcan"', 'bus.channel="vcan0"')
    with pytest.raises(ConfigError, match="a drive that takes it"):
        load_setup(CONFIGS / "inverter.toml", Overrides(settings=own))
