"""A link: raw frames over any python-can interface, with its own non-blocking reads where there is a socket.

python-can opens the bus. Where it has a socket of SocketCAN's frame layout (socketcan, hil-local) the link
reads and writes that socket itself; any other interface goes through ``Bus.recv`` and ``Bus.send``.
"""

from __future__ import annotations

import errno
import select
import socket
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn, Protocol

import can
import numpy as np

from drivers.errors import LinkDown, LinkError, QueueFull
from drivers.local import (
    CLASSIC,
    EFF_FLAG,
    ERR_FLAG,
    FD,
    RTR_FLAG,
    LocalBus,
    check_length,
    hear_only,
    keep_out,
    pack_frame,
)

_DOWN = {errno.ENETDOWN, errno.ENETUNREACH, errno.ENODEV, errno.ENXIO, errno.EBADF}
_FULL = {errno.ENOBUFS, errno.EAGAIN}
_FLAGS = EFF_FLAG | RTR_FLAG | ERR_FLAG
DISCARD_MOST = 100_000
PLAIN = ("socketcan", "hil-local", "virtual")
"""Interfaces that are all there is to be said of them."""
RECEIVE_BYTES = 128
"""More than a frame: a datagram that is none is seen to be longer."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """The bus in python-can's terms."""

    interface: str
    channel: str
    bitrate: int = 1_000_000
    data_bitrate: int | None = None
    fd: bool = False


class Frame(NamedTuple):
    """One received frame; ``flags`` are SocketCAN's EFF, RTR and ERR bits."""

    can_id: int
    data: bytes
    flags: int
    fd: bool


class Link(Protocol):
    """What the drive client and the emulator need of a bus."""

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame. Raises LinkDown, QueueFull or LinkError; LinkError for what is no data frame."""

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None after ``timeout_ns`` (0: at once). Raises LinkError."""

    def discard(self) -> int:
        """Throw away everything received and not read; return how many frames."""

    def close(self) -> None:
        """Close the bus."""


def raise_link_error(error: OSError, action: str) -> NoReturn:
    """Raise what an OSError of the bus means."""
    code = error.errno or 0
    if code in _DOWN:
        raise LinkDown(code, f"can't {action}: the CAN interface is down or gone; bring it up") from error
    if code in _FULL:
        raise QueueFull(code, f"can't {action}: the transmit queue is full; is the bus connected?") from error
    raise LinkError(code, f"can't {action}: {error}") from error


class SocketLink:
    """A link over sockets of SocketCAN's frame layout. ``fd``: the bus was opened for CAN FD."""

    def __init__(
        self, bus: can.BusABC | None, receiving: socket.socket, sending: socket.socket, fd: bool = True
    ) -> None:
        self._bus, self.receiving, self.sending, self._fd = bus, receiving, sending, fd
        receiving.setblocking(False)
        self._fds = [receiving.fileno()]
        self.fds = np.array([receiving.fileno(), sending.fileno(), 0, 0], np.int32)
        """Receiving and sending descriptor for :mod:`drivers.posix`, and room for its poll."""
        poll = select.poll()
        poll.register(receiving, select.POLLIN)
        self._poll = poll.poll
        self._recv_into, self._write = receiving.recv_into, sending.send
        self._own = memoryview(bytearray(RECEIVE_BYTES))

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        check_data_frame(can_id)
        if fd and not self._fd:
            raise LinkError(
                errno.EINVAL, "can't send a CAN FD frame: the bus is opened without fd; set bus.fd, or --fd"
            )
        try:
            self._write(pack_frame(can_id, data, fd))
        except OSError as error:
            raise_link_error(error, "send")

    def hear(self, ids: Collection[int], only: bool = True) -> None:
        """Receive frames of these identifiers, with flags, alone; without ``only`` all but those.

        Of none: of a link that only sends, which then costs those who send nothing either.
        """
        if only and self.receiving.family == socket.AF_CAN:
            hear_only(self.receiving, ids)
            return
        udp = self.receiving.family == socket.AF_INET
        keep_out(self.receiving, self.sending.getsockname()[1] if udp else None, ids, only)

    def carries(self, fd: bool) -> bool:
        """True when a frame of this kind can be sent."""
        return self._fd or not fd

    def send_raw(self, raw: memoryview) -> None:
        """Send a frame that is laid out already; the caller answers for it."""
        try:
            self._write(raw)
        except OSError as error:
            raise_link_error(error, "send")

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None."""
        size = self.receive_into(self._own, timeout_ns)
        return unpack_frame(bytes(self._own[:size])) if size else None

    def receive_into(self, buffer: memoryview, timeout_ns: int) -> int:
        """Read what the socket has next; return its size, 0 for nothing.

        With no time to wait, poll tells without an exception.
        """
        try:
            if timeout_ns > 0:
                if not select.select(self._fds, [], [], timeout_ns * 1e-9)[0]:
                    return 0
            elif not self._poll(0):
                return 0
            return self._recv_into(buffer)
        except BlockingIOError:
            return 0
        except ValueError:  # the descriptor of a closed link
            raise_link_error(OSError(errno.EBADF, "closed"), "receive")
        except OSError as error:
            raise_link_error(error, "receive")

    def discard(self) -> int:
        """Throw away what is queued."""
        return _discard(self)

    def close(self) -> None:
        """Close the bus."""
        self._fds, self._poll = [-1], _closed  # their number may be another file's by the next call
        self.fds[:] = -1
        if self._bus is not None:
            self._bus.shutdown()


def _closed(timeout: float | None = None, /) -> list[tuple[int, int]]:
    raise ValueError("closed")


def check_data_frame(can_id: int) -> None:
    """Raise LinkError for an identifier with the bit of an error or a remote frame: neither is a data frame.

    Sent without that bit it would be one, of another meaning: error class 0x80 reads as SYNC.
    """
    if can_id & (RTR_FLAG | ERR_FLAG):
        kind = "an error frame" if can_id & ERR_FLAG else "a remote frame"
        raise LinkError(errno.EINVAL, f"can't send {can_id:08X}: it is {kind}; only data frames are sent")


def _discard(link: Link) -> int:
    """Read until nothing is there; a flood can't hold the caller longer than the bound."""
    count = 0
    while count < DISCARD_MOST and link.receive(0) is not None:
        count += 1
    return count


def unpack_frame(raw: bytes) -> Frame | None:
    """A frame from SocketCAN's layout; anything else on the socket is no frame."""
    if len(raw) == CLASSIC.size:
        can_id, length, data = CLASSIC.unpack(raw)
        fd, top = False, 8
    elif len(raw) == FD.size:
        can_id, length, _, data = FD.unpack(raw)
        fd, top = True, 64
    else:
        return None
    if length > top:
        return None
    # the named tuple's own constructor is a Python function and costs twice as much
    return tuple.__new__(Frame, (can_id & 0x1FFFFFFF, data[:length], can_id & _FLAGS, fd))


class GenericLink:
    """A link through python-can's own recv and send, for interfaces without a socket."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        check_data_frame(can_id)
        check_length(data, fd)
        message = can.Message(
            arbitration_id=can_id & 0x1FFFFFFF,
            is_extended_id=bool(can_id & EFF_FLAG),
            data=data,
            is_fd=fd,
            bitrate_switch=fd,
        )
        try:
            self._bus.send(message)
        except can.CanError as error:
            raise LinkError(errno.EIO, f"can't send: {error}") from error

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame, or None."""
        try:
            message = self._bus.recv(max(0, timeout_ns) * 1e-9)
        except can.CanError as error:
            raise LinkError(errno.EIO, f"can't receive: {error}") from error
        if message is None:
            return None
        flags = (EFF_FLAG if message.is_extended_id else 0) | (RTR_FLAG if message.is_remote_frame else 0)
        flags = ERR_FLAG if message.is_error_frame else flags
        data = bytes(min(message.dlc, 8)) if message.is_remote_frame else bytes(message.data)
        return Frame(message.arbitration_id, data, flags, message.is_fd)

    def discard(self) -> int:
        """Throw away what is queued."""
        return _discard(self)

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()


def open_link(settings: BusSettings) -> Link:
    """Open a bus. Raises LinkError with python-can's own words when it can't be opened.

    python-can's own configuration (can.conf, CAN_INTERFACE and the like) never says which bus it is, and
    adds to a plain bus nothing at all; an adapter finds its own options there (a serial number).
    """
    options: dict[str, Any] = {"fd": settings.fd}
    adapter = settings.interface not in PLAIN
    if adapter:
        options |= {"bitrate": settings.bitrate, "receive_own_messages": False, "can_filters": None}
        if settings.data_bitrate:
            options["data_bitrate"] = settings.data_bitrate
    if settings.interface == "virtual":
        options = {}
    try:
        bus = can.Bus(settings.channel, settings.interface, ignore_config=not adapter, **options)
    except (can.CanError, OSError, ValueError, ImportError) as error:
        remedy = f"is {settings.channel!r} up? ip link set {settings.channel} up"
        if settings.interface != "socketcan":
            remedy = "see python-can's documentation of this interface"
        raise LinkError(
            errno.ENODEV, f"can't open bus {settings.interface}:{settings.channel}: {error}; {remedy}"
        ) from error
    if isinstance(bus, LocalBus):
        return SocketLink(bus, bus.receiving, bus.sending, settings.fd)
    if settings.interface == "socketcan":
        return SocketLink(bus, bus.socket, bus.socket, settings.fd)  # type: ignore[attr-defined]
    return GenericLink(bus)
