"""The drive client's receive path under drawn frames, near-valid ones among them.

What a tick holds afterwards is all of one valid feedback frame that came, or what it held before: never a
mix, never a part of one that was damaged. Frames are judged by the plain decoder, one by one. Both ways in
are taken: frames taken apart, and frames as a socket hands them out.
"""

from __future__ import annotations

import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.bus import Frame, SocketLink, unpack_frame
from drivers.client import DriveClient
from drivers.codec import Database, Message
from drivers.errors import DecodeError, LinkDown
from drivers.local import EFF_FLAG, ERR_FLAG, RTR_FLAG, pack_frame
from hil.signals import RxFlag, new_ticks
from tests.fuzz.draw import Draw

DBC = Path(__file__).resolve().parents[2] / "configs" / "drives" / "hil_pmsm.dbc"
DATABASE = Database(DBC)
FEEDBACK, STATUS = DATABASE.message("FEEDBACK"), DATABASE.message("STATUS")
MEASURED = {
    "w": "Speed",
    "i_q": "CurrentQ",
    "i_d": "CurrentD",
    "echo": "Echo",
    "drive_state": "State",
    "limited": "Limited",
}
SLOW = {
    "v_dc": "DcLinkVoltage",
    "temperature_motor": "TemperatureMotor",
    "temperature_inverter": "TemperatureInverter",
}
IDENTIFIERS = (0x181, 0x181, 0x181, 0x281, 0x081, 0x080, 0x201, 0x301, 0x701, 0x481, 0x000, 0x7FF)


class PlainLink:
    """A bus of frames that wait in a list."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []

    def put(self, frames: list[bytes]) -> None:
        self.waiting += frames

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None: ...

    def receive(self, timeout_ns: int) -> Frame | None:
        while self.waiting:
            frame = unpack_frame(self.waiting.pop(0))
            if frame is not None:
                return frame
        return None

    def discard(self) -> int:
        return 0

    def close(self) -> None: ...


class RawLink(SocketLink):
    """A socket's end; the frames that come are put in at the other, and what is sent leads nowhere."""

    def __init__(self) -> None:
        self._far, receiving = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._drain, sending = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._drain.setblocking(False)
        super().__init__(None, receiving, sending)

    def put(self, frames: list[bytes]) -> None:
        with suppress(BlockingIOError):
            while self._drain.recv(128):
                pass
        for raw in frames:
            self._far.send(raw)

    def close(self) -> None:
        for one in (self._far, self._drain, self.receiving, self.sending):
            one.close()


def take(data: bytes) -> None:
    """Hand out the input's frames to a client of either kind, some at a time; check after each receive."""
    draw = Draw(data)
    link: Any = (PlainLink, RawLink)[draw.below(2)]()
    try:
        exchange(draw, link)
    finally:
        link.close()


def exchange(draw: Draw, link: Any) -> None:
    client, ticks = DriveClient(link, DATABASE), new_ticks()
    client.prepare(ticks[0])
    while draw.rest():
        raw = [drawn_frame(draw) for _ in range(draw.below(6))]
        link.put(raw)
        before, tick = held(ticks, MEASURED), ticks[0]
        slow = held(ticks, SLOW)
        tick["rx_flags"] = 0
        late = draw.one_in(8)
        if late:
            with suppress(LinkDown):
                client.sync(tick)
        client.receive(tick, 0)
        flags = int(tick["rx_flags"])
        allowed = [values_of(frame, FEEDBACK, MEASURED) for frame in raw]
        check(held(ticks, MEASURED), before, [] if late else allowed, bool(flags & RxFlag.FRESH), raw)
        came = [values_of(frame, STATUS, SLOW) for frame in raw]
        check(held(ticks, SLOW), slow, came, bool(flags & RxFlag.STATUS), raw)


def held(ticks: Any, fields: dict[str, str]) -> bytes:
    return b"".join(ticks[name].tobytes() for name in fields)


def values_of(raw: bytes, message: Message, fields: dict[str, str]) -> bytes | None:
    """The bytes that a tick would hold after this frame; None when it is damaged, or another's."""
    frame = unpack_frame(raw)
    if frame is None or frame.can_id | frame.flags != message.send_id:
        return None
    try:
        values = message.decode(frame.data)
    except DecodeError:
        return None
    ticks = new_ticks()
    for name, signal in fields.items():
        ticks[name] = values[signal]
    return held(ticks, fields)


def check(now: bytes, before: bytes, allowed: list[bytes | None], fresh: bool, raw: list[bytes]) -> None:
    """``now`` is all of one allowed frame when something fresh came, else what it was before."""
    good = [values for values in allowed if values is not None]
    shown = [frame.hex() for frame in raw]
    assert now in good if fresh else now == before, f"fresh {fresh}: a tick of no frame that came: {shown}"


def drawn_frame(draw: Draw) -> bytes:
    """A frame as a socket hands it out: good, damaged, of other lengths and kinds, or no frame at all."""
    can_id = draw.pick(IDENTIFIERS)
    message = STATUS if can_id == 0x281 else FEEDBACK
    data = bytearray(draw.bytes(8))
    if not draw.one_in(4):
        message.protect(data)
    if draw.one_in(6):
        data[draw.below(8)] ^= 1 << draw.below(8)
    if draw.one_in(6):
        del data[draw.below(9) :]
    if draw.one_in(8):
        can_id |= draw.pick((EFF_FLAG, RTR_FLAG, ERR_FLAG))
    raw = bytearray(pack_frame(can_id, bytes(data), draw.one_in(8)))
    if draw.one_in(12):
        raw[draw.below(len(raw))] = draw.below(256)
    if draw.one_in(12):
        del raw[draw.below(len(raw)) :]
    return bytes(raw)
