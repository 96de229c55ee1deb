"""Frames that are laid out before they are needed, and how a row of them is sent whatever comes of each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Final

import numpy as np
import numpy.typing as npt

from drivers.codec import Message
from drivers.errors import QueueFull
from drivers.local import CLASSIC, FD
from drivers.tables import laid_out

STOP_PAUSE_S: Final = 0.002


class Outgoing:
    """One message to send: its frame in a buffer."""

    def __init__(self, message: Message, index: int) -> None:
        self.message, self.index = message, index
        self.raw = laid_out(message.send_id, message.length, message.fd)
        self.view = self.raw.data[: FD.size if message.fd else CLASSIC.size]

    def lay(self, raw: npt.NDArray[np.uint8]) -> None:
        """Take a buffer that is laid out, its frame first."""
        self.raw, self.view = raw, raw.data[: len(self.view)]


def try_all(sends: Iterable[Callable[[], None]]) -> None:
    """Call each, whatever the others raise; once the queue is full wait a little and leave the rest."""
    for send in sends:
        try:
            send()
        except QueueFull:
            time.sleep(STOP_PAUSE_S)
            return
        except Exception:  # noqa: BLE001, S112 - whatever it is, the next frame must be tried
            continue
