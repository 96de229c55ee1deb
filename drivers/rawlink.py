"""A link as raw frames in a buffer, whatever is below: a socket's own bytes, or frames laid out here."""

from __future__ import annotations

from typing import Protocol

from drivers.bus import Link, SocketLink, unpack_frame
from drivers.local import FD, FD_FDF, pack_frame


class RawLink(Protocol):
    """Frames in SocketCAN's layout, from and to buffers that the caller owns."""

    def receive_into(self, buffer: memoryview, timeout_ns: int) -> int:
        """Read the next frame; return its size, 0 after ``timeout_ns`` (0: at once). Raises LinkError."""

    def send_raw(self, raw: memoryview) -> None:
        """Send a frame that is laid out. Raises LinkDown, QueueFull or LinkError."""


class Packed:
    """Any link as a raw one."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def receive_into(self, buffer: memoryview, timeout_ns: int) -> int:
        """The next frame, laid out."""
        frame = self._link.receive(timeout_ns)
        if frame is None:
            return 0
        raw = pack_frame(frame.can_id | frame.flags, frame.data, frame.fd)
        buffer[: len(raw)] = raw
        return len(raw)

    def send_raw(self, raw: memoryview) -> None:
        """The frame, taken apart."""
        frame = unpack_frame(bytes(raw))
        assert frame is not None  # noqa: S101 - the client lays out whole frames
        self._link.send(frame.can_id | frame.flags, frame.data, len(raw) == FD.size and raw[5] & FD_FDF != 0)


def raw_link(link: Link, fd: bool) -> RawLink:
    """The link itself where it has a socket that carries the frames to send (``fd``: CAN FD)."""
    return link if isinstance(link, SocketLink) and link.carries(fd) else Packed(link)
