"""One contract for a link over hil-local and python-can's virtual bus, and what hil-local alone promises."""

from __future__ import annotations

import itertools
import os
import pty
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.bus import BusSettings, Frame, Link, SocketLink, open_link
from drivers.errors import LinkDown, LinkError, QueueFull
from drivers.local import EFF_FLAG, ERR_FLAG, RTR_FLAG, address_of, pack_frame
from tests.conftest import ROOT

WAIT_NS = 2_000_000_000
KINDS = ("hil-local", "virtual")


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def pair(kind: str, channel: str) -> Iterator[tuple[Link, Link]]:
    settings = BusSettings(kind, channel, fd=True)
    one, other = open_link(settings), open_link(settings)
    yield one, other
    one.close()
    other.close()


@pytest.fixture
def raw(kind: str, channel: str) -> Iterator[can.BusABC]:
    """python-can's own end of the same bus."""
    with can.Bus(interface=kind, channel=channel) as bus:
        yield bus


FRAMES = [
    (0x123, b"", False),
    (0x7FF, b"\x01\x02\x03", False),
    (0x001 | EFF_FLAG, bytes(range(8)), False),
    (0x1ABCDEF | EFF_FLAG, b"\xff" * 8, False),
    (0x181, bytes(range(64)), True),
    (0x181, bytes(12), True),
]


@pytest.mark.parametrize(("can_id", "data", "fd"), FRAMES)
def test_a_frame_arrives_as_sent(pair: tuple[Link, Link], can_id: int, data: bytes, fd: bool) -> None:
    pair[0].send(can_id, data, fd)
    assert pair[1].receive(WAIT_NS) == Frame(can_id & 0x1FFFFFFF, data, can_id & EFF_FLAG, fd)
    assert pair[1].receive(0) is None


@pytest.mark.parametrize(("can_id", "data", "fd"), FRAMES)
def test_python_can_sees_the_same(
    pair: tuple[Link, Link], raw: can.BusABC, can_id: int, data: bytes, fd: bool
) -> None:
    pair[0].send(can_id, data, fd)
    seen = raw.recv(2.0)
    assert seen is not None
    assert (seen.arbitration_id, bytes(seen.data), seen.dlc) == (can_id & 0x1FFFFFFF, data, len(data))
    assert (seen.is_extended_id, seen.is_fd) == (bool(can_id & EFF_FLAG), fd)
    assert not (seen.is_remote_frame or seen.is_error_frame)


def test_what_python_can_sends_arrives(pair: tuple[Link, Link], raw: can.BusABC) -> None:
    raw.send(can.Message(arbitration_id=0x10, data=b"\x05", is_extended_id=True))
    assert pair[0].receive(WAIT_NS) == Frame(0x10, b"\x05", EFF_FLAG, False)
    raw.send(can.Message(arbitration_id=0x11, is_remote_frame=True, dlc=4, is_extended_id=False))
    remote = pair[0].receive(WAIT_NS)
    assert remote is not None and (remote.can_id, remote.flags) == (0x11, RTR_FLAG)
    raw.send(can.Message(arbitration_id=0x04, data=bytes(8), is_error_frame=True, is_extended_id=False))
    error = pair[0].receive(WAIT_NS)
    assert error is not None and error.flags == ERR_FLAG


def test_own_frames_do_not_come_back(pair: tuple[Link, Link]) -> None:
    pair[0].send(0x100, b"\x01")
    assert pair[1].receive(WAIT_NS) is not None
    assert pair[0].receive(20_000_000) is None


def test_frames_keep_their_order(pair: tuple[Link, Link]) -> None:
    for number in range(50):
        pair[0].send(0x100 + number, bytes((number,)))
    got = [pair[1].receive(WAIT_NS) for _ in range(50)]
    assert [frame.can_id if frame else -1 for frame in got] == [0x100 + number for number in range(50)]


def test_discard_throws_away_what_is_queued(pair: tuple[Link, Link]) -> None:
    for number in range(7):
        pair[0].send(number, b"")
    assert pair[1].discard() == 7
    assert pair[1].receive(0) is None


def test_waiting_ends_at_the_timeout(pair: tuple[Link, Link]) -> None:
    start = time.monotonic_ns()
    assert pair[0].receive(30_000_000) is None
    assert time.monotonic_ns() - start >= 29_000_000
    assert pair[0].receive(-5) is None


@pytest.mark.parametrize(("size", "fd"), [(9, False), (65, True)])
def test_too_long_a_frame_is_refused(pair: tuple[Link, Link], size: int, fd: bool) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        pair[0].send(0x1, bytes(size), fd)
    assert pair[1].receive(0) is None


def test_a_closed_link_is_down(channel: str) -> None:
    link = open_link(BusSettings("hil-local", channel))
    link.close()
    reused = [os.pipe() for _ in range(4)]  # take over the descriptors that the link had
    with pytest.raises(LinkDown):
        link.send(1, b"")
    for timeout in (0, 1000):
        with pytest.raises(LinkDown):
            link.receive(timeout)
    for descriptor in itertools.chain(*reused):
        os.close(descriptor)


def test_buses_of_other_names_do_not_meet(channel: str) -> None:
    one, other = (open_link(BusSettings("hil-local", name)) for name in (channel, channel + "x"))
    try:
        one.send(1, b"")
        assert other.receive(50_000_000) is None
    finally:
        one.close()
        other.close()


def test_addresses_are_multicast_stable_and_spread() -> None:
    addresses = {address_of(f"bus {number}") for number in range(2000)}
    assert len(addresses) == 2000
    assert len({port for _, port in addresses}) > 1000
    assert all(group.startswith("239.") and 16384 <= port < 32768 for group, port in addresses)
    assert address_of("239.7.8.9")[0] == "239.7.8.9"


def test_own_frames_on_request(channel: str) -> None:
    with can.Bus(interface="hil-local", channel=channel, receive_own_messages=True) as bus:
        bus.send(can.Message(arbitration_id=5, is_extended_id=False))
        assert bus.recv(2.0) is not None


def test_fd_needs_a_bus_opened_for_it(channel: str) -> None:
    link = open_link(BusSettings("hil-local", channel, fd=False))
    with can.Bus(interface="hil-local", channel=channel, fd=False) as bus:
        with pytest.raises(LinkError, match=r"bus\.fd"):
            link.send(1, bytes(64), fd=True)
        with pytest.raises(can.CanOperationError, match="fd=False"):
            bus.send(can.Message(arbitration_id=1, data=bytes(12), is_fd=True))
    link.close()


def test_datagrams_that_are_no_frames_are_dropped(channel: str) -> None:
    bus = can.Bus(interface="hil-local", channel=channel)
    link = open_link(BusSettings("hil-local", channel))
    assert isinstance(link, SocketLink)
    bad_length = bytearray(pack_frame(1, b""))
    bad_length[4] = 9
    for datagram in (b"", b"x", bytes(15), bytes(17), bytes(200), bytes(bad_length)):
        bus.sending.send(datagram)  # type: ignore[attr-defined]
        assert link.receive(50_000_000) is None
    bus.sending.send(pack_frame(7, b"\x01"))  # type: ignore[attr-defined]
    assert link.receive(WAIT_NS) == Frame(7, b"\x01", 0, False)
    link.close()
    bus.shutdown()


def test_notifier_and_filters_work(channel: str) -> None:
    filters = [{"can_id": 0x20, "can_mask": 0x7FF}]
    with (
        can.Bus(interface="hil-local", channel=channel) as sender,
        can.Bus(interface="hil-local", channel=channel, can_filters=filters) as bus,
    ):
        reader = can.BufferedReader()
        notifier = can.Notifier(bus, [reader], timeout=0.05)
        for can_id in (0x10, 0x20, 0x30):
            sender.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        message = reader.get_message(2.0)
        assert message is not None and message.arbitration_id == 0x20
        assert reader.get_message(0.1) is None
        notifier.stop()


@pytest.mark.parametrize("interface", ["socketcan", "nonsense"])
def test_a_bus_that_is_not_there_is_one_clear_line(interface: str) -> None:
    with pytest.raises(LinkError, match="can't open bus") as caught:
        open_link(BusSettings(interface, "can77"))
    assert f"{interface}:can77" in str(caught.value)


class Adapter(can.BusABC):
    """A python-can interface that keeps what it is opened with."""

    def __init__(self, channel: str, **options: object) -> None:
        self.options = {"channel": channel} | options
        super().__init__(channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.fixture
def configured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user whose python-can is configured for another bus."""
    own = (
        "interface = virtual\nchannel = other\nbitrate = 125000\nreceive_own_messages = true\nserial = 4711\n"
    )
    (tmp_path / "can.conf").write_text(f"[default]\n{own}")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", "another")
    monkeypatch.setenv("CAN_BITRATE", "250000")


@pytest.mark.usefixtures("configured")
def test_python_cans_configuration_never_says_which_bus(kind: str, channel: str) -> None:
    settings = BusSettings(kind, channel)
    one, other = open_link(settings), open_link(settings)
    one.send(0x123, b"\x01")
    assert other.receive(WAIT_NS) == Frame(0x123, b"\x01", 0, False)
    assert one.receive(20_000_000) is None, "own frames came back"
    one.close()
    other.close()


@pytest.mark.usefixtures("configured")
def test_an_adapter_finds_its_own_options_in_can_conf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(can.interfaces.BACKENDS, "adapter", (__name__, "Adapter"))
    monkeypatch.setattr(can.util, "VALID_INTERFACES", can.util.VALID_INTERFACES | {"adapter"})
    link: Any = open_link(BusSettings("adapter", "usb0", 500_000))
    assert link._bus.options == {
        "channel": "usb0",
        "bitrate": 500_000,
        "fd": False,
        "receive_own_messages": False,
        "can_filters": None,
        "serial": 4711,
    }


def test_link_errors_are_oserrors_told_apart() -> None:
    assert issubclass(LinkDown, OSError) and issubclass(QueueFull, OSError)
    assert not issubclass(QueueFull, LinkDown)


def _text_until(fd: int, wanted: bytes, seconds: float) -> bytes:
    end, text = time.monotonic() + seconds, b""
    while wanted not in text and (left := end - time.monotonic()) > 0:
        if select.select([fd], [], [], left)[0]:
            text += os.read(fd, 65536)
    return text


def test_can_viewer_shows_the_frames(channel: str) -> None:
    main, terminal = pty.openpty()
    env = {**os.environ, "TERM": "xterm", "LINES": "30", "COLUMNS": "120"}
    command = [sys.executable, "-m", "can.viewer", "-i", "hil-local", "-c", channel]
    with subprocess.Popen(
        command, stdin=terminal, stdout=terminal, stderr=terminal, env=env, cwd=ROOT
    ) as viewer:
        link = open_link(BusSettings("hil-local", channel))
        try:
            text, end = b"", time.monotonic() + 30
            while b"0x2A7" not in text and time.monotonic() < end:
                link.send(0x2A7, bytes.fromhex("DEADBEEF"))
                text += _text_until(main, b"0x2A7", 0.3)
            text += _text_until(main, b"EF", 1.0)
            assert b"0x2A7" in text and b"DE AD BE EF" in text, text[-400:]
        finally:
            viewer.terminate()
            viewer.wait(10)
            link.close()
            os.close(main)
            os.close(terminal)


def _can_unshare() -> bool:
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return False
    return subprocess.run(["unshare", "-rn", "true"], capture_output=True, check=False).returncode == 0


needs_namespaces = pytest.mark.skipif(not _can_unshare(), reason="needs unshare, ip and user namespaces")


def in_namespace(setup: str, program: str) -> subprocess.CompletedProcess[str]:
    """Run a Python program in a network namespace of its own, after shell commands."""
    script = f'{setup}\nexec "$0" -c "$1"'
    return subprocess.run(
        ["unshare", "-rn", "sh", "-ec", script, sys.executable, program],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=ROOT,
    )


EXCHANGE = """
from drivers.bus import BusSettings, open_link
one, other = (open_link(BusSettings("hil-local", "ns")) for _ in range(2))
one.send(0x123, b"ok")
print(other.receive(2_000_000_000).data.decode())
one.close(), other.close()
"""


@needs_namespaces
def test_loopback_alone_is_enough() -> None:
    done = in_namespace("ip link set lo up", EXCHANGE)
    assert (done.stdout.strip(), done.stderr) == ("ok", "")


@needs_namespaces
def test_loopback_down_is_said() -> None:
    done = in_namespace(":", EXCHANGE)
    assert done.returncode != 0 and "ip link set lo up" in done.stderr.splitlines()[-1]


SNIFF = """
import socket, time
from drivers.bus import BusSettings, open_link
from drivers.local import address_of
sniffers = []
for name in ("veth0", "veth1", "lo"):
    sniffer = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
    sniffer.bind((name, 0)); sniffer.setblocking(False); sniffers.append(sniffer)
one, other = (open_link(BusSettings("hil-local", "ns")) for _ in range(2))
group, port = address_of("ns")
for number in range(20):
    one.send(number, b"HILFRAME")
got = sum(other.receive(1_000_000_000) is not None for _ in range(20))
joined = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
membership = socket.inet_aton(group) + socket.inet_aton("10.9.8.1")
joined.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("10.9.8.1"))
stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
stranger.sendto(bytes(16), (group, port))
intruded = other.receive(100_000_000) is not None
time.sleep(0.1)
counts = []
for sniffer in sniffers:
    count = strange = 0
    while True:
        try: packet = sniffer.recv(2048)
        except BlockingIOError: break
        count += b"HILFRAME" in packet
        strange += port.to_bytes(2, "big") in packet and b"HILFRAME" not in packet
    counts += [count, strange]
print(got, intruded, *counts)
"""


@needs_namespaces
def test_nothing_leaves_the_machine_and_nothing_comes_in() -> None:
    setup = """ip link set lo up
ip link add veth0 type veth peer name veth1
ip addr add 10.9.8.1/24 dev veth0; ip link set veth0 up; ip link set veth1 up
ip route add default via 10.9.8.2 dev veth0"""
    done = in_namespace(setup, SNIFF)
    assert done.returncode == 0, done.stderr
    got, intruded, veth0, strange0, veth1, strange1, lo, _ = done.stdout.split()
    assert (got, veth0, veth1) == ("20", "0", "0")
    assert int(lo) >= 20, "the sniffer must see what is there"
    assert int(strange0) >= 1 and int(strange1) >= 1, "the stranger's datagram did go out on the wire"
    assert intruded == "False"


@pytest.mark.parametrize("flag", [ERR_FLAG, RTR_FLAG, ERR_FLAG | EFF_FLAG, RTR_FLAG | EFF_FLAG])
@pytest.mark.parametrize("interface", ["hil-local", "virtual"])
def test_no_link_sends_what_is_no_data_frame(channel: str, interface: str, flag: int) -> None:
    """Error class 0x80 without its flag would be SYNC."""
    link = open_link(BusSettings(interface, channel))
    with can.Bus(interface=interface, channel=channel) as other:
        with pytest.raises(LinkError, match="only data frames are sent"):
            link.send(flag | 0x80, bytes(8))
        link.send(0x80, b"\x01")
        heard = other.recv(2.0)
        assert heard is not None and bytes(heard.data) == b"\x01", "the first that went out"
    link.close()


def test_remote_and_error_frames_through_any_adapter(channel: str) -> None:
    """A remote frame has the length that it asks for, an error frame its class and nothing else."""
    link = open_link(BusSettings("virtual", channel))
    with can.Bus(interface="virtual", channel=channel) as other:
        other.send(can.Message(arbitration_id=0x181, is_extended_id=False, is_remote_frame=True, dlc=5))
        other.send(can.Message(arbitration_id=4, is_error_frame=True, data=bytes(8)))
        assert link.receive(WAIT_NS) == Frame(0x181, bytes(5), RTR_FLAG, False)
        assert link.receive(WAIT_NS) == Frame(4, bytes(8), ERR_FLAG, False)
    link.close()
