"""The chunks of a file decompressed by a thread of its own, a few ahead of the one that is read."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Chunk

from hil.log.errors import DamagedError
from hil.log.scan import Raw, chunk_content, parse

DEPTH: Final = 4
"""Chunks that are held besides the one that is read: of this program's logs 0.5 MB each."""


def content_of(raw: Raw) -> bytes:
    """What a chunk holds. Raises DamagedError."""
    record = parse(raw.opcode, raw.content)
    assert isinstance(record, Chunk)  # noqa: S101 - only chunks come here
    return chunk_content(record)


def ahead(records: Iterable[Raw]) -> Iterator[tuple[Raw, Future[bytes] | None]]:
    """The records in their order, with what each chunk holds: its result, or DamagedError."""
    held: deque[tuple[Raw, Future[bytes] | None]] = deque()
    broken: DamagedError | None = None
    with ThreadPoolExecutor(1, "hil-log") as pool:
        source = iter(records)
        while True:
            try:
                raw = next(source, None)
            except DamagedError as error:  # what came before it goes first
                raw, broken = None, error
            if raw is None:
                break
            held.append((raw, pool.submit(content_of, raw) if raw.opcode == Opcode.CHUNK else None))
            if len(held) > DEPTH:
                yield held.popleft()
        while held:
            yield held.popleft()
    if broken is not None:
        raise broken
