"""SDO transfers with one CANopen node over a link: the `canopen` library's protocol without its threads.

A request waits for its answer on the link itself, so that what comes uninvited is seen: a second answer to
one request is a second node of the same number.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from drivers.bus import Link
from drivers.errors import NodeError

ANSWER_S: Final = 0.5
"""So long a node may take to answer."""
STORE_S: Final = 10.0
"""The same for a save into non-volatile memory, which erases pages first."""
DOUBLE_S: Final = 0.05
"""So long after the first answer a second node of the same number is listened for."""
BEATS_S: Final = 1.2
"""So long heartbeats of other nodes are listened for when the asked one is silent."""
REQUEST, RESPONSE, HEARTBEAT, NMT, EMERGENCY = 0x600, 0x580, 0x700, 0x000, 0x080
_TELL_A_NODE: Final = (0x700, 0x580, 0x180, 0x280, 0x380, 0x480, 0x080)
_NOT_THERE: Final = (0x06020000, 0x06090011)
logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what it would print is raised here


def named(index: int, sub: int = 0) -> str:
    """An object as people write it: 6041h, 1A00h:1."""
    return f"{index:04X}h" + (f":{sub:X}" if sub else "")


def abort_text(error: SdoAbortedError) -> str:
    """An abort code with CiA 301's words."""
    return f"abort 0x{error.code:08X}, {SdoAbortedError.CODES.get(error.code, 'a code of the maker')}"


class Sdo:
    """Objects of one node, as bytes or whole numbers. ``where``: the bus, for messages.

    Every method raises NodeError for a node that is silent, refuses or is there twice, LinkError for a bus
    that is down.
    """

    def __init__(self, link: Link, node_id: int, where: str, answer_s: float = ANSWER_S) -> None:
        self.node_id, self._where = node_id, where
        self._client = _Client(link, node_id, answer_s)

    def read(self, index: int, sub: int = 0) -> bytes:
        """The bytes of an object."""
        try:
            data: bytes = self._client.upload(index, sub)
        except SdoAbortedError as error:
            raise self._refused("read", index, sub, error) from error
        except SdoCommunicationError as error:
            raise self._silent(index, sub, error) from error
        return data

    def read_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        """An object that is a whole number."""
        return int.from_bytes(self.read(index, sub), "little", signed=signed)

    def optional_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
        """The same, None for an object that the node does not have."""
        try:
            return self.read_int(index, sub, signed=signed)
        except NodeError as error:
            cause = error.__cause__
            if isinstance(cause, SdoAbortedError) and cause.code in _NOT_THERE:
                return None
            raise

    def write(self, index: int, sub: int, value: int, size: int, answer_s: float | None = None) -> None:
        """Write a whole number of ``size`` bytes; a negative one in two's complement."""
        before = self._client.answer_s
        self._client.answer_s = answer_s or before
        try:
            self._client.download(index, sub, (value % (1 << 8 * size)).to_bytes(size, "little"))
        except SdoAbortedError as error:
            raise self._refused(f"set to {shown(value)}", index, sub, error) from error
        except SdoCommunicationError as error:
            raise self._silent(index, sub, error) from error
        finally:
            self._client.answer_s = before

    def alone(self) -> None:
        """Ask for the device type and listen on: two nodes of one number both answer."""
        self.read(0x1000)
        if self._client.uninvited(DOUBLE_S):
            raise NodeError(
                f"{self._where}: two nodes answer as node {self.node_id}; give one of them another number "
                "(its switches, or LSS) before anything is sent to either"
            )

    def _refused(self, what: str, index: int, sub: int, error: SdoAbortedError) -> NodeError:
        return NodeError(
            f"node {self.node_id} on {self._where}: {named(index, sub)} can't be {what}: {abort_text(error)}"
        )

    def _silent(self, index: int, sub: int, error: SdoCommunicationError) -> NodeError:
        odd = "" if isinstance(error, _Silence) else f" ({error})"
        others = sorted(self._client.nodes_heard(BEATS_S) - {self.node_id})
        heard = f"heard on this bus: node {', '.join(map(str, others))}" if others else "no other node heard"
        return NodeError(
            f"node {self.node_id} does not answer on {self._where}: {named(index, sub)} asked by SDO, "
            f"{self._client.answer_s:g} s{odd}; {heard}; is it powered, are drive.node_id and bitrate right?"
        )


def shown(value: int) -> str:
    """A value in a message: small ones as they are, others in hex."""
    return str(value) if abs(value) < 1000 else f"0x{value:X}"


class _Silence(SdoCommunicationError):  # type: ignore[misc]  # nor is its type
    """Nothing came."""


class _Client(SdoClient):  # type: ignore[misc]  # its types are not read
    """The library's client over a link: its own way to wait for an answer."""

    def __init__(self, link: Link, node_id: int, answer_s: float) -> None:
        super().__init__(REQUEST + node_id, RESPONSE + node_id, ObjectDictionary())
        self._link, self.answer_s = link, answer_s
        self.network: Any = self

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """What the library asks of a network."""
        self._link.send(can_id, bytes(data))

    def request_response(self, sdo_request: bytes) -> bytes:
        """One request, one answer; what came before it belongs to no request. Raises as the library does."""
        self._link.discard()
        self.send_request(sdo_request)
        response: bytes = self.read_response()
        return response

    def read_response(self) -> bytes:
        """The next frame of the node's SDO channel."""
        end = time.monotonic_ns() + round(self.answer_s * 1e9)
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None and frame.can_id | frame.flags == self.tx_cobid and len(frame.data) == 8:
                if frame.data[0] == 0x80:
                    raise SdoAbortedError(int.from_bytes(frame.data[4:8], "little"))
                return frame.data
        raise _Silence("No SDO response received")

    def uninvited(self, seconds: float) -> bool:
        """True when an answer comes that nobody asked for."""
        end = time.monotonic_ns() + round(seconds * 1e9)
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None and frame.can_id | frame.flags == self.tx_cobid:
                return True
        return False

    def nodes_heard(self, seconds: float) -> set[int]:
        """Numbers of the nodes that send anything that names them."""
        heard: set[int] = set()
        end = time.monotonic_ns() + round(seconds * 1e9)
        while (left := end - time.monotonic_ns()) > 0:
            frame = self._link.receive(left)
            if frame is not None and not frame.flags and frame.can_id & 0x780 in _TELL_A_NODE:
                heard |= {frame.can_id & 0x7F}
        return heard - {0}
