"""The embedded bus: frames between processes, none leaves the machine, loopback alone is enough."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import can
import pytest

from drivers.bus import BusSettings, open_link
from drivers.errors import LinkError
from drivers.local import address_of

pytestmark = pytest.mark.process
CROSSING = """
import sys, can
with can.Bus(interface="hil-local", channel="ns") as a, can.Bus(interface="hil-local", channel="ns") as b:
    a.send(can.Message(arbitration_id=0x123, data=[1, 2, 3], is_extended_id=False))
    m = b.recv(2.0)
    assert m is not None and bytes(m.data) == b"\\x01\\x02\\x03", m
print("crossed")
"""
LEAK = """
import socket, can, time
from drivers.local import address_of
LOOPBACK_AND_GROUP = socket.inet_aton("127.0.0.1") + socket.inet_aton(address_of("ns")[0])
sniffer = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
sniffer.settimeout(0.3)
with can.Bus(interface="hil-local", channel="ns") as a:
    for k in range(50):
        a.send(can.Message(arbitration_id=k, data=[k], is_extended_id=False))
end, here, away = time.monotonic() + 1.0, 0, 0
while time.monotonic() < end:
    try:
        data, address = sniffer.recvfrom(2048)
    except TimeoutError:
        break
    if data[23:24] == b"\\x11" and data[26:34] == LOOPBACK_AND_GROUP:
        here, away = here + (address[0] == "lo"), away + (address[0] != "lo")
print(here, away)
"""


@pytest.fixture
def pair(channel: str) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    with (
        can.Bus(interface="hil-local", channel=channel) as a,
        can.Bus(interface="hil-local", channel=channel) as b,
    ):
        yield a, b


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x181, data=bytes(range(8)), is_extended_id=False),
        can.Message(arbitration_id=0x1ABCDEF0, data=b"", is_extended_id=True),
        can.Message(arbitration_id=0x80, data=b"\x01", is_extended_id=False),
        can.Message(arbitration_id=0x33, is_remote_frame=True, dlc=4, is_extended_id=False),
        can.Message(
            arbitration_id=0x201, data=bytes(64), is_fd=True, bitrate_switch=True, is_extended_id=False
        ),
    ],
    ids=["classic", "extended", "sync", "remote", "fd"],
)
def test_what_is_sent_is_received(pair: tuple[can.BusABC, can.BusABC], message: can.Message) -> None:
    a, b = pair
    a.send(message)
    got = b.recv(1.0)
    assert got is not None and got.equals(
        message, timestamp_delta=None, check_channel=False, check_direction=False
    )
    assert a.recv(0.02) is None, "its own message comes back only when asked for"


def test_own_messages_when_asked_for(channel: str) -> None:
    with can.Bus(interface="hil-local", channel=channel, receive_own_messages=True) as bus:
        bus.send(can.Message(arbitration_id=1, data=b"x", is_extended_id=False))
        assert bus.recv(1.0) is not None


def test_channels_do_not_meet(channel: str) -> None:
    assert address_of("a") != address_of("b")
    with (
        can.Bus(interface="hil-local", channel=channel) as a,
        can.Bus(interface="hil-local", channel="x") as b,
    ):
        a.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert b.recv(0.05) is None


def test_a_link_and_python_can_see_the_same_frames(channel: str) -> None:
    link = open_link(BusSettings("hil-local", channel))
    with can.Bus(interface="hil-local", channel=channel) as bus:
        link.send(0x201, b"\x01\x02")
        got = bus.recv(1.0)
        assert got is not None and (got.arbitration_id, bytes(got.data)) == (0x201, b"\x01\x02")
        bus.send(can.Message(arbitration_id=0x181, data=b"\x09" * 8, is_extended_id=False))
        frame = link.receive(1_000_000_000)
        assert frame is not None and (frame.can_id, frame.data) == (0x181, b"\x09" * 8)
        assert link.receive(0) is None and link.receive(5_000_000) is None
        for _ in range(5):
            bus.send(can.Message(arbitration_id=1, is_extended_id=False))
        time.sleep(0.05)
        assert link.discard() == 5
    link.close()


def test_an_interface_that_does_not_exist_is_one_clear_error() -> None:
    with pytest.raises(LinkError, match="can't open bus socketcan:can99"):
        open_link(BusSettings("socketcan", "can99"))


def in_namespace(script: str, *setup: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a network namespace of its own, after ``setup`` commands."""
    commands = "; ".join((*setup, f'exec "{sys.executable}" -c "$SCRIPT"'))
    return subprocess.run(
        ["unshare", "-rn", "sh", "-c", commands],
        env=os.environ | {"SCRIPT": script}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


needs_namespaces = pytest.mark.skipif(
    shutil.which("unshare") is None
    or shutil.which("ip") is None
    or subprocess.run(["unshare", "-rn", "true"], capture_output=True, check=False).returncode != 0,
    reason="this host gives no network namespaces (or has no ip command)",
)


@needs_namespaces
def test_it_works_where_only_loopback_is_up() -> None:
    done = in_namespace(CROSSING, "ip link set lo up")
    assert done.stdout.strip() == "crossed", done.stderr


@needs_namespaces
def test_without_loopback_it_says_so() -> None:
    done = in_namespace(CROSSING)
    assert done.returncode != 0 and "ip link set lo up" in done.stderr


@needs_namespaces
def test_no_frame_leaves_the_machine() -> None:
    """A default route for multicast over another interface is there; nothing may take it."""
    setup = (
        "ip link set lo up", "ip link add v0 type veth peer name v1", "ip addr add 10.9.8.1/24 dev v0",
        "ip link set v0 up", "ip link set v1 up",
        "ip route add 224.0.0.0/4 dev v0", "ip route add default dev v0",
    )  # fmt: skip
    done = in_namespace(LEAK, *setup)
    here, away = map(int, done.stdout.split())
    assert here >= 50 and away == 0, done.stderr


def test_the_viewer_of_python_can_shows_frames(channel: str) -> None:
    pid, fd = pty.fork()
    if pid == 0:
        os.environ["TERM"] = "xterm"
        os.execv(sys.executable, [sys.executable, "-m", "can.viewer", "-i", "hil-local", "-c", channel])
    seen = b""
    try:
        with can.Bus(interface="hil-local", channel=channel) as bus:
            end = time.monotonic() + 20
            while b"0x2A5" not in seen and time.monotonic() < end:
                bus.send(can.Message(arbitration_id=0x2A5, data=[0xBE, 0xEF], is_extended_id=False))
                if select.select([fd], [], [], 0.1)[0]:
                    seen += os.read(fd, 65536)
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(fd)
    assert b"0x2A5" in seen
