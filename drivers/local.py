"""`hil-local`: a CAN bus between processes of one machine, registered with python-can as a plugin.

Frames travel as SocketCAN's can_frame / canfd_frame in UDP multicast datagrams that are sent from and joined
on the loopback interface alone, with TTL 0: no frame leaves the machine, and no network is needed. The
channel's name picks the multicast group, so that buses of different names do not meet.
"""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import select
import socket
import struct
import time
import zlib
from collections.abc import Collection
from typing import Any

import can

LOOPBACK = "127.0.0.1"
FIRST_PORT, PORTS = 16384, 16384  # below the ports that the kernel hands out by itself
CLASSIC = struct.Struct("=IB3x8s")
FD = struct.Struct("=IBB2x64s")
EFF_FLAG, RTR_FLAG, ERR_FLAG = 0x80000000, 0x40000000, 0x20000000
FD_BRS, FD_ESI, FD_FDF = 0x01, 0x02, 0x04
_SO_ATTACH_FILTER = 26
_IP_MULTICAST_ALL = 49


def address_of(channel: str) -> tuple[str, int]:
    """Multicast group and UDP port of a channel: 32 bits of its name's hash, so that buses do not meet.

    The group is in the organisation-local range 239.192.0.0/14; a channel that is itself a multicast
    address is taken as the group.
    """
    digest = zlib.crc32(channel.encode())
    group = f"239.{192 + (digest & 3)}.{digest >> 2 & 255}.{digest >> 10 & 255}"
    with contextlib.suppress(ValueError):
        group = str(ipaddress.IPv4Address(channel)) if ipaddress.IPv4Address(channel).is_multicast else group
    return group, FIRST_PORT + (digest >> 18) % PORTS


def pack_frame(can_id: int, data: bytes, fd: bool = False) -> bytes:
    """SocketCAN layout of a data frame; identifiers over 11 bits get the extended flag by the caller."""
    check_length(data, fd)
    if fd:
        return FD.pack(can_id, len(data), FD_FDF | FD_BRS, data)
    return CLASSIC.pack(can_id, len(data), data)


def check_length(data: bytes, fd: bool) -> None:
    """Raise ValueError for what no frame can hold; packing would cut it off without a word."""
    if len(data) > (64 if fd else 8):
        raise ValueError(f"{len(data)} bytes do not fit a {'CAN FD' if fd else 'classic CAN'} frame")


def keep_out(sock: socket.socket, port: int | None, ids: Collection[int] = (), only: bool = False) -> None:
    """Let the kernel drop frames before the socket: a classic BPF program.

    ``port``: UDP source port whose datagrams are dropped, None where the socket has no UDP. ``ids``:
    identifiers, with flags, whose frames are dropped, or with ``only`` all others; error frames come through.
    """
    drop, accept = (0x06, 0, 0, 0), (0x06, 0, 0, 0xFFFFFFFF)
    sources = [] if port is None else [(0x28, 0, 0, 0), (0x15, 0, 1, port), drop]
    frame_at = 0 if port is None else 8
    known = [(0x15, 0, 1, _as_loaded(can_id)) for can_id in sorted(ids)]
    sort = [line for test in known for line in (test, accept if only else drop)]
    head = [(0x20, 0, 0, frame_at), (0x45, 0, 1, _as_loaded(ERR_FLAG)), accept] if ids else []
    lines = [*sources, *head, *sort, drop if only else accept]
    buffer = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in lines))
    program = struct.pack("HL", len(lines), ctypes.addressof(buffer))
    sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)


def hear_only(receiving: socket.socket, ids: Collection[int]) -> None:
    """Let a raw CAN socket hear these identifiers, with flags, and errors.

    The kernel finds who hears an identifier before it makes a copy of the frame: what is not heard costs its
    sender nothing, where a program of :func:`keep_out` costs a copy.
    """
    known = [(can_id, EFF_FLAG | RTR_FLAG | (0x1FFFFFFF if can_id & EFF_FLAG else 0x7FF)) for can_id in ids]
    receiving.setsockopt(
        socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"".join(struct.pack("=II", *one) for one in known)
    )


def _as_loaded(can_id: int) -> int:
    """An identifier as the program sees it: a frame has it in the processor's order, a load is big endian."""
    return int.from_bytes(struct.pack("=I", can_id), "big")


def _loopback_index() -> int:
    return socket.if_nametoindex("lo")


def open_sockets(channel: str, own: bool) -> tuple[socket.socket, socket.socket]:
    """Return (receiving, sending) sockets of a channel. Raises OSError when loopback is down."""
    group, port = address_of(channel)
    membership = struct.pack("=4s4si", socket.inet_aton(group), socket.inet_aton(LOOPBACK), _loopback_index())
    receiving = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    sending = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiving.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiving.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        receiving.bind((group, port))
        receiving.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiving.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, membership)
        sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        sending.bind((LOOPBACK, 0))
        sending.connect((group, port))
        if not own:
            keep_out(receiving, sending.getsockname()[1])
    except OSError:
        receiving.close()
        sending.close()
        raise
    return receiving, sending


class LocalBus(can.BusABC):
    """python-can interface `hil-local`.

    ``channel`` is any name; ``bitrate`` and ``data_bitrate`` are accepted and have no effect, as on vcan.
    """

    def __init__(
        self,
        channel: str | None = "demo",
        fd: bool = True,
        receive_own_messages: bool = False,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        **kwargs: Any,  # python-can hands its own options (can_filters, ...) through to BusABC
    ) -> None:
        self._channel = str(channel or "demo")
        self.fd = fd
        try:
            self.receiving, self.sending = open_sockets(self._channel, receive_own_messages)
        except OSError as error:
            raise can.CanInitializationError(
                f"hil-local: loopback can't be used ({error}); bring it up: ip link set lo up"
            ) from error
        self.channel_info = (
            f"hil-local channel {self._channel} ({':'.join(map(str, address_of(self._channel)))} on lo)"
        )
        super().__init__(self._channel, **kwargs)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message. Raises CanOperationError."""
        if msg.is_fd and not self.fd:
            raise can.CanOperationError(
                "hil-local: can't send a CAN FD frame: the bus is opened with fd=False"
            )
        can_id = msg.arbitration_id
        can_id |= EFF_FLAG if msg.is_extended_id else 0
        can_id |= RTR_FLAG if msg.is_remote_frame else 0
        can_id |= ERR_FLAG if msg.is_error_frame else 0
        if msg.is_fd:
            flags = FD_FDF | (FD_BRS if msg.bitrate_switch else 0)
            raw = FD.pack(
                can_id, msg.dlc, flags | (FD_ESI if msg.error_state_indicator else 0), bytes(msg.data)
            )
        else:
            raw = CLASSIC.pack(can_id, msg.dlc, bytes(msg.data))
        try:
            self.sending.send(raw)
        except OSError as error:
            raise can.CanOperationError(f"hil-local: can't send: {error}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            if not select.select([self.receiving], [], [], timeout)[0]:
                return None, False
            raw = self.receiving.recv(128)
        except BlockingIOError:
            return None, False
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"hil-local: can't receive: {error}") from error
        return self._message(raw), False

    def _message(self, raw: bytes) -> can.Message | None:
        """A python-can message from SocketCAN's layout; None for a datagram that is none."""
        if len(raw) not in (CLASSIC.size, FD.size):
            return None
        fd = len(raw) == FD.size
        if fd and not self.fd:
            return None
        can_id, length, flags, data = FD.unpack(raw) if fd else (*CLASSIC.unpack(raw)[:2], 0, raw[8:])
        if length > (64 if fd else 8):
            return None
        remote = bool(can_id & RTR_FLAG)
        return can.Message(
            timestamp=time.time(),
            arbitration_id=can_id & (0x1FFFFFFF if can_id & EFF_FLAG else 0x7FF),
            is_extended_id=bool(can_id & EFF_FLAG),
            is_remote_frame=remote,
            is_error_frame=bool(can_id & ERR_FLAG),
            is_fd=fd,
            bitrate_switch=bool(flags & FD_BRS),
            error_state_indicator=bool(flags & FD_ESI),
            dlc=length,
            data=None if remote else data[:length],
            channel=self._channel,
            is_rx=True,
        )

    def fileno(self) -> int:
        """File descriptor of the receiving socket."""
        return self.receiving.fileno()

    def shutdown(self) -> None:
        """Close both sockets."""
        super().shutdown()
        self.receiving.close()
        self.sending.close()
