"""Which files are parts of one run: by what each says of itself, not by its name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from hil.log.errors import DamagedError
from hil.log.scan import Raw, parse, raw_records
from hil.log.split import PART
from hil.log.summary import later


def part_of(path: Path) -> tuple[str, int] | None:
    """Run and number that a file gives itself; None for a whole run's, and for what can't be read.

    No message is read.
    """
    try:
        for raw in _named(path):
            record = parse(raw.opcode, raw.content) if raw.opcode == Opcode.METADATA else None
            if isinstance(record, Metadata) and record.name == PART:
                return record.metadata["run"], int(record.metadata["number"])
    except (DamagedError, OSError, KeyError, ValueError):
        return None
    return None


def _named(path: Path) -> Iterator[Raw]:
    """The records before the first message, then metadata and attachments behind it."""
    for raw in raw_records(path):
        if raw.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            yield from later(path, raw.offset)
            return
        yield raw


def grouped(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """The files run by run: parts of one run together and in order, where its first-named part stands."""
    groups: dict[str, list[tuple[int, Path]]] = {}
    for place, path in enumerate(paths):
        run, number = part_of(path) or (f"alone {place}", 0)
        groups.setdefault(run, []).append((number, path))
    return [tuple(path for _, path in sorted(group)) for group in groups.values()]
