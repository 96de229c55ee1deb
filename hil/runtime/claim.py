"""One sender of an identifier a bus: names in the kernel that a process holds while it lives.

The names are abstract UNIX sockets: of the same network namespace as the bus itself, seen by all users, gone
with the process that holds them, whatever ends it. Who is not on this machine is heard by listening alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import socket
import struct
from collections.abc import Iterable, Iterator

from hil.errors import HilError

PRIVATE = ("virtual",)
"""Buses of one process, which no other one can be on."""


class ClaimedError(HilError, RuntimeError):
    """Another process sends that on this bus already."""


@contextlib.contextmanager
def claimed(interface: str, channel: str, names: Iterable[str]) -> Iterator[None]:
    """Hold ``names`` on a bus while the block runs. Raises ClaimedError, with the process that holds one."""
    with contextlib.ExitStack() as held:
        for name in () if interface in PRIVATE else sorted(set(names)):
            held.enter_context(_hold(f"{interface}:{channel}", name))
        yield


def _hold(bus: str, name: str) -> socket.socket:
    address = "\0hil-drive/" + hashlib.sha256(f"{bus} {name}".encode()).hexdigest()
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        holder.bind(address)
        holder.listen()
    except OSError as error:
        holder.close()
        raise ClaimedError(
            f"{_who(address)} sends {name} on {bus} already: stop that, or take another bus.channel"
        ) from error
    return holder


def _who(address: str) -> str:
    """The process that holds an address, by the kernel's word."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking, contextlib.suppress(OSError):
        asking.setblocking(False)
        asking.connect(address)
        raw = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        if pid := struct.unpack("3i", raw)[0]:
            return f"process {pid}"
    return "another process"
