"""SYNC by the kernel's own timer: a job of SocketCAN's Broadcast Manager, and an ear that hears it stamped.

The job sends SYNC with its counter, one frame after the other, until it is deleted or its socket is closed:
it dies with its process. Three things are not as one may think. It starts its timer anew after each expiry,
so that its period is its interval and what the kernel took (3 us): :class:`Steering` keeps it on the grid.
It goes on by itself when an interface that was down comes up: the client deletes it once the bus was down.
And it goes on while its process stands still: the drive's watchdog and the guardian are for that.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
from typing import Final

import numpy as np

from drivers.errors import LinkError
from drivers.local import CLASSIC, EFF_FLAG
from drivers.posix import (
    CONTROL_AT,
    CONTROL_BYTES,
    EAR_FD,
    EAR_WORDS,
    FRAME_AT,
    FRAME_BYTES,
    IOV_AT,
    MESSAGE_AT,
    PERIOD,
    STAMP,
    SYNC_COUNTS,
    SYNCED,
)

_HEAD: Final = struct.Struct("@3I4q2I")
"""struct bcm_msg_head: opcode, flags, count, two intervals of s and us, identifier, number of frames."""
TX_SETUP, TX_DELETE = 1, 2
SETTIMER, STARTTIMER = 1, 2
SO_TIMESTAMPNS: Final = 35
_CAN_INV_FILTER: Final = 0x20000000
STEER_EVERY: Final = 64
"""Periods between two looks at the phase."""
_ROOM: Final = 0.1
"""Share of the period by which the interval may differ from it."""


class Steering:
    """Whole microseconds that keep a timer which starts anew after each expiry on a grid of ``period_ns``."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns, self.interval_us = period_ns, period_ns // 1000
        self._k = self._stamp_ns = 0

    def steer(self, k: int, stamp_ns: int, due_ns: int) -> int:
        """The interval [us] from period k on, which was stamped at ``stamp_ns`` and due at ``due_ns``.

        What the mean period has over the interval is what the kernel takes; the phase is worked off until the
        next look.
        """
        periods = k - self._k
        if self._stamp_ns and periods > 0:
            over_ns = (stamp_ns - self._stamp_ns) / periods - 1000 * self.interval_us
            wanted = (self._period_ns - over_ns - (stamp_ns - due_ns) / STEER_EVERY) / 1000
            whole = self._period_ns / 1000
            self.interval_us = round(min(max(wanted, (1 - _ROOM) * whole), (1 + _ROOM) * whole))
        self._k, self._stamp_ns = k, stamp_ns
        return self.interval_us


def _refusal(channel: str, error: OSError) -> LinkError:
    return LinkError(
        error.errno or errno.EIO,
        f'SYNC by the kernel on {channel}: {error.strerror}; modprobe can_bcm, or set bus.sync = "loop"',
    )


class KernelSync:
    """SYNC with a counter from 1 to 240 every period: the Broadcast Manager's ``job``, and an ``ear`` for it.

    ``words`` are what :func:`drivers.posix.hear` works on; the client that is given this hands them on.
    """

    def __init__(
        self, job: socket.socket, ear: socket.socket, send_id: int, counted: bool, period_ns: int
    ) -> None:
        self.send_id, self._steering = send_id, Steering(period_ns)
        counts = range(1, SYNC_COUNTS + 1) if counted else range(1)
        self._frames = b"".join(CLASSIC.pack(send_id, counted, bytes((count,))) for count in counts)
        self._job, self._ear = job, ear
        self._going = False
        self._lay_out(period_ns)

    def _lay_out(self, period_ns: int) -> None:
        """The message header of recvmsg with all that it points to, in one row of words."""
        words = self.words = np.zeros(EAR_WORDS, np.int64)
        at = words.ctypes.data
        words[EAR_FD], words[PERIOD] = self._ear.fileno(), period_ns
        words[MESSAGE_AT + 2], words[MESSAGE_AT + 3] = at + 8 * IOV_AT, 1
        words[MESSAGE_AT + 4], words[MESSAGE_AT + 5] = at + 8 * CONTROL_AT, CONTROL_BYTES
        words[IOV_AT], words[IOV_AT + 1] = at + 8 * FRAME_AT, FRAME_BYTES

    def start(self) -> None:
        """Send the first SYNC now, the next a period later, and so on. Raises LinkError.

        What the ear has heard before is others', who were listened for.
        """
        with contextlib.suppress(BlockingIOError):
            while self._ear.recv(FRAME_BYTES, socket.MSG_DONTWAIT):
                pass
        try:
            self._setup(SETTIMER | STARTTIMER)
        except OSError as error:
            raise LinkError(error.errno or errno.EIO, f"can't send SYNC: {error.strerror}") from error
        self._going = True

    def _setup(self, flags: int) -> None:
        interval, count = divmod(self._steering.interval_us, 1_000_000), len(self._frames) // CLASSIC.size
        head = _HEAD.pack(TX_SETUP, flags, 0, 0, 0, *interval, self.send_id, count)
        self._job.send(head + self._frames)

    def taken(self) -> tuple[int, int]:
        """How many SYNCs were heard since the last look, and when the newest was [ns]."""
        count, self.words[SYNCED] = int(self.words[SYNCED]), 0
        return count, int(self.words[STAMP])

    def steer(self, k: int, due_ns: int) -> None:
        """Keep period k on its grid; it was due at ``due_ns``. The counter goes on."""
        before = self._steering.interval_us
        if self._going and self._steering.steer(k, int(self.words[STAMP]), due_ns) != before:
            with contextlib.suppress(OSError):  # the loop sees a bus that is gone by itself
                self._setup(SETTIMER)

    def stop(self) -> None:
        """No SYNC leaves after this returns; never raises. It does not start again."""
        if self._going:
            self._going = False
            with contextlib.suppress(OSError):
                self._job.send(_HEAD.pack(TX_DELETE, 0, 0, 0, 0, 0, 0, self.send_id, 0))
            self._job.close()  # what is not deleted now dies with its socket

    def close(self) -> None:
        """Stop, and hear nothing more."""
        self.stop()
        self._job.close()
        self.words[EAR_FD] = -1
        self._ear.close()


def kernel_sync(channel: str, send_id: int, counted: bool, period_ns: int) -> KernelSync:
    """SYNC on a SocketCAN interface; nothing is sent yet. Raises LinkError."""
    job = _open(channel, socket.SOCK_DGRAM, socket.CAN_BCM)
    ear = _open(channel, socket.SOCK_RAW, socket.CAN_RAW, only=send_id)
    return KernelSync(job, ear, send_id, counted, period_ns)


def all_but(receiving: socket.socket, can_id: int) -> None:
    """Let a raw CAN socket hear everything but one identifier."""
    if receiving.family != socket.AF_CAN:
        return
    only = struct.pack("=II", can_id | _CAN_INV_FILTER, _mask(can_id))
    receiving.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, only)


def _open(channel: str, kind: int, protocol: int, only: int | None = None) -> socket.socket:
    """A CAN socket of the interface, with stamps and but one identifier for ``only``. Raises LinkError."""
    try:
        sock = socket.socket(socket.AF_CAN, kind, protocol)
    except OSError as error:
        raise _refusal(channel, error) from error
    try:
        if only is None:
            sock.connect((channel,))
        else:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", only, _mask(only)))
            sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            sock.bind((channel,))
    except OSError as error:
        sock.close()
        raise _refusal(channel, error) from error
    return sock


def _mask(can_id: int) -> int:
    """All bits of an identifier and the one that says which kind it is."""
    return EFF_FLAG | (0x1FFFFFFF if can_id & EFF_FLAG else 0x7FF)
