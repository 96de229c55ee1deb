"""The link of each client of several drives on one bus: each gets the frames that are its drive's.

A frame of nobody's goes to the first client, which notes what is foreign; an error frame goes to all. On
sockets of SocketCAN's frames each client has its own, and the kernel sorts; else a :class:`Hub` sorts.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from drivers.binding import Binding
from drivers.bus import Frame, Link, SocketLink
from drivers.local import ERR_FLAG

READ_MOST: Final = 4096
"""Frames that one read takes off the bus for others: a flood can't hold it longer."""


def heard_ids(binding: Binding) -> set[int]:
    """Identifiers, with flags, of all that a drive sends and of what only its own controller may send."""
    own = [bound.message for bound in (*binding.incoming, *binding.outgoing)]
    return {m.send_id for m in (*own, binding.heartbeat, binding.emergency) if m is not None}


def links_of(opened: Callable[[], Link], bindings: Sequence[Binding]) -> list[Link]:
    """A link of one client each, over what ``opened`` opens. Raises LinkError, with none left open."""
    links = [opened()]
    if not isinstance(links[0], SocketLink):
        return list(Hub(links[0], bindings).ports)
    try:
        others: set[int] = set().union(*map(heard_ids, bindings[1:]))
        links[0].hear(others, only=False)
        for binding in bindings[1:]:
            links.append(link := opened())
            assert isinstance(link, SocketLink)  # noqa: S101 - of the same bus as the first
            link.hear(heard_ids(binding))
            link.discard()  # what came before it heard its own alone
    except BaseException:
        for link in links:
            link.close()
        raise
    return links


class Hub:
    """``ports`` are links of one client each, over one ``link``; closing the first closes that."""

    def __init__(self, link: Link, bindings: Sequence[Binding]) -> None:
        self._link = link
        self._owner = {can_id: i for i, binding in enumerate(bindings) for can_id in heard_ids(binding)}
        self._queues: list[deque[Frame]] = [deque(maxlen=READ_MOST) for _ in bindings]
        self.ports = [Port(self, i) for i in range(len(bindings))]

    def send(self, can_id: int, data: bytes, fd: bool) -> None:
        """Send a data frame."""
        self._link.send(can_id, data, fd)

    def receive(self, port: int, timeout_ns: int) -> Frame | None:
        """The next frame of a port, or None after ``timeout_ns``."""
        queue = self._queues[port]
        end_ns = time.monotonic_ns() + timeout_ns if timeout_ns else 0
        for _ in range(READ_MOST):
            if queue:
                return queue.popleft()
            left_ns = max(end_ns - time.monotonic_ns(), 0) if timeout_ns else 0
            frame = self._link.receive(left_ns)
            if frame is None:
                return None
            self._sort(frame)
        return None

    def _sort(self, frame: Frame) -> None:
        """Put a frame where it belongs."""
        if frame.flags & ERR_FLAG:
            for queue in self._queues:
                queue.append(frame)
        else:
            self._queues[self._owner.get(frame.can_id | frame.flags, 0)].append(frame)

    def discard(self) -> int:
        """Throw away everything received and not read, of all ports."""
        count = self._link.discard() + sum(map(len, self._queues))
        for queue in self._queues:
            queue.clear()
        return count

    def close(self) -> None:
        """Close the bus."""
        self._link.close()


class Port:
    """A :class:`drivers.bus.Link` of one client."""

    def __init__(self, hub: Hub, number: int) -> None:
        self._hub, self._number = hub, number

    def send(self, can_id: int, data: bytes, fd: bool = False) -> None:
        """Send a data frame."""
        self._hub.send(can_id, data, fd)

    def receive(self, timeout_ns: int) -> Frame | None:
        """Return the next frame of this client's, or None."""
        return self._hub.receive(self._number, timeout_ns)

    def discard(self) -> int:
        """Throw away what was received, of all clients."""
        return self._hub.discard()

    def close(self) -> None:
        """Close the bus, with the first port."""
        if self._number == 0:
            self._hub.close()
