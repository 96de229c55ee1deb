"""Goes through a log in a process of its own, some blocks ahead of the one that uses them: on two cores.

Reading is numpy on blocks of a thousand ticks, which waits for the interpreter's lock: threads gain nothing,
a second process does. Its blocks lie in memory that both share, so many as there are slots, and when either
process ends, so does the other's work.
"""

from __future__ import annotations

import contextlib
import io
import mmap
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator
from typing import Any, Final, NoReturn, TypeVar

import numpy as np

from hil.log.errors import LogError
from hil.log.reader import Block, Log
from hil.log.schema import Records

WORTH_BYTES: Final = 8 << 20
"""A smaller log is read by the time that a process takes to start."""
SLOTS: Final = 4
SLOT_BYTES: Final = 1 << 20
"""A block of ours takes 0.43 MB; a larger one goes through the pipe."""
_NEWS: Final = ("damage", "bytes_lost", "tick_count", "event_count", "last_t_ns", "absent", "unknown")

T = TypeVar("T")
Through = Callable[[Log], Generator[Block, None, T]]
"""Goes through a log: yields its blocks, returns what it found."""


def ahead(log: Log, through: Through[T]) -> Generator[Block, None, T]:
    """Yield and return what ``through(log)`` does, from another process where that pays.

    ``log`` gathers metadata, events and damage on the way as it does without. Raises what ``through`` raises,
    and LogError when its process died.
    """
    if not _pays(log):
        return (yield from through(log))
    return (yield from forked(log, through))


def _pays(log: Log) -> bool:
    """A long log, a second core, and no thread whose locks a forked process would find taken for ever."""
    size = sum(path.stat().st_size for path in log.parts or (log.path,))
    return size >= WORTH_BYTES and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1


def forked(log: Log, through: Through[T]) -> Generator[Block, None, T]:
    """:func:`ahead`, in another process in any case."""
    with mmap.mmap(-1, SLOTS * SLOT_BYTES) as shared:
        (heard, said), (freed, free) = os.pipe(), os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(heard)
            os.close(free)
            _Sender(log, shared, said, freed).send_all(through)
        os.close(said)
        os.close(freed)
        try:
            with os.fdopen(heard, "rb") as news, os.fdopen(free, "wb", buffering=0) as done:
                found: T = yield from _received(log, shared, news, done)
                return found
        finally:
            os.waitpid(pid, 0)  # the pipes are closed: it ends with its next block


def _received(
    log: Log, shared: mmap.mmap, news: io.BufferedReader, done: io.FileIO
) -> Generator[Block, None, Any]:
    slot, layouts = 0, dict[str, np.dtype[Any]]()
    while True:
        try:
            what, state, found, count = pickle.load(news)
        except (EOFError, pickle.UnpicklingError) as error:
            raise LogError(f"{log.path}: the process that reads it was killed; is memory short?") from error
        for name, value in state.items():
            setattr(log, name, log.events + value if name == "events" else value)
        if what == "raised":
            raise found
        if what == "returned":
            return found
        if not isinstance(found, np.ndarray):
            layout = layouts[what] = layouts[what] if found is None else found
            size = count * layout.itemsize
            found = np.frombuffer(shared, np.uint8, size, slot * SLOT_BYTES).copy().view(layout)
            slot = (slot + 1) % SLOTS
            with contextlib.suppress(BrokenPipeError):  # it has sent all that there was
                done.write(b"x")
        yield Block(what, found)


class _Sender:
    """The forked process: sends all that there is, and leaves without a word."""

    def __init__(self, log: Log, shared: mmap.mmap, said: int, freed: int) -> None:
        self._log, self._shared, self._freed = log, shared, freed
        self._said = os.fdopen(said, "wb")
        self._sent = 0
        self._events = len(log.events)
        self._texts: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
        self._layouts: dict[str, np.dtype[Any]] = {}
        """Layout of the last block of each kind: to send it takes longer than the block."""

    def send_all(self, through: Through[Any]) -> NoReturn:
        """Send the blocks, then what was returned or raised."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process ends, and its pipes with it
        try:
            passing = through(self._log)
            while True:
                self._send_block(next(passing))
        except StopIteration as end:
            self._send("returned", end.value)
        except (BrokenPipeError, EOFError):
            pass  # nobody wants to know
        except Exception as error:  # noqa: BLE001 - raised where somebody hears of it
            self._send("raised", error)
        finally:
            os._exit(0)

    def _send_block(self, block: Block) -> None:
        records: Records = block.records
        if records.nbytes > SLOT_BYTES:
            self._send(block.kind, records)
            return
        if self._sent >= SLOTS and not os.read(self._freed, 1):
            raise EOFError
        at = self._sent % SLOTS * SLOT_BYTES
        self._shared[at : at + records.nbytes] = np.ascontiguousarray(records).view(np.uint8).data
        self._sent += 1
        known = self._layouts.get(block.kind) == records.dtype
        self._layouts[block.kind] = records.dtype
        self._send(block.kind, None if known else records.dtype, len(records))

    def _send(self, what: str, found: Any, count: int = 0) -> None:
        with contextlib.suppress(BrokenPipeError):
            pickle.dump((what, self._news(), found, count), self._said)
            self._said.flush()

    def _news(self) -> dict[str, Any]:
        """What is new in the log since the last block."""
        log = self._log
        out: dict[str, Any] = {name: getattr(log, name) for name in _NEWS}
        if len(log.events) > self._events:
            out["events"], self._events = log.events[self._events :], len(log.events)
        texts = (log.metadata, log.attachments)
        if texts != self._texts:
            self._texts = (dict(log.metadata), dict(log.attachments))
            out["metadata"], out["attachments"] = self._texts
        return out
