"""``hil export``: one log in another format, block by block, whole under its name or not there at all."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

import numpy as np

from hil.exchange.recordings import Asc, Blf, Candump, Mf4Recording
from hil.exchange.tables import CsvTable, MatTable, Mf4Table, ParquetTable
from hil.log.errors import LogError
from hil.log.info import info_of
from hil.log.reader import Log, Source, new_log, read_blocks
from hil.log.schema import Records

SLAB: Final = 1 << 16
"""Records that are gathered before they are written: row groups of Parquet, 25 MB of memory."""


class Sink(Protocol):
    """A file in the making."""

    def add(self, records: Records, /) -> None:
        """Append ticks or frames."""

    def close(self, *, whole: bool) -> None:
        """Finish the file; one that is not whole goes, so it need only be let go of."""


Open = Callable[[Path, Log], Sink]
FRAMES_OF: Final[dict[str, Open]] = {".mf4": Mf4Recording}
"""Endings that may stand for the frames, too, when these are asked for."""
FORMATS: Final[dict[str, tuple[Literal["ticks", "frames"], Open]]] = {
    ".parquet": ("ticks", ParquetTable),
    ".csv": ("ticks", CsvTable),
    ".mat": ("ticks", MatTable),
    ".mf4": ("ticks", Mf4Table),
    ".log": ("frames", lambda path, log: Candump(path, log, "can0")),
    ".asc": ("frames", Asc),
    ".blf": ("frames", Blf),
}


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written."""

    written: str
    holds: str
    records: int
    bytes: int
    damage: str | None

    def as_dict(self) -> dict[str, Any]:
        """As a plain dict."""
        return asdict(self)


@contextlib.contextmanager
def replacing(out: Path, *, force: bool) -> Iterator[Path]:
    """A path beside ``out`` to write to; it takes the name of ``out`` when the block ends well, else it goes.

    Raises LogError when ``out`` exists and may not be replaced, or can't be written.
    """
    if out.exists() and not force:
        raise LogError(f"{out}: exists already; --force replaces it")
    part = out.with_name(f".{out.name}.part{out.suffix}")
    try:
        part.unlink(missing_ok=True)  # of one that was killed
        yield part
        part.replace(out)
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{out}: can't be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def _names(source: Source) -> tuple[str, ...]:
    """The nodes of a run with several."""
    return tuple(info_of((source,) if isinstance(source, Path) else source).nodes)


def outputs(source: Source, out: Path, node: str = "") -> dict[str, Path]:
    """Each node's file: the first's is ``out``, another one's has its name before the ending.

    Of a run of one drive, and for frames, which are the bus's, there is one; of a ``node`` just its own.
    """
    nodes = () if node else _names(source)
    if not nodes or FORMATS.get(out.suffix.lower(), ("frames",))[0] == "frames":
        return {node: out}
    return {nodes[0]: out} | {name: out.with_name(f"{out.stem}.{name}{out.suffix}") for name in nodes[1:]}


def export_nodes(
    source: Source, out: Path, *, frames: bool = False, force: bool = False, node: str = ""
) -> dict[str, Exported]:
    """:func:`export` of each node, or of ``node``, by its name; nothing is written where one can't be."""
    files = {node: out} if frames else outputs(source, out, node)
    for path in files.values():
        if path.exists() and not force:
            raise LogError(f"{path}: exists already; --force replaces it")
    return {name: export(source, path, frames=frames, force=force, node=name) for name, path in files.items()}


def export(
    source: Source, out: Path, *, frames: bool = False, force: bool = False, node: str = ""
) -> Exported:
    """Write the log ``source`` as ``out``; the ending names the format. Raises LogError.

    ``frames``: the frames, where the ending can stand for them and for ticks. ``node``: of a run with several
    nodes the one whose ticks these are; empty: the first.
    """
    kind = out.suffix.lower()
    if kind not in FORMATS:
        raise LogError(f"{out}: the ending must be one of {' '.join(sorted(FORMATS))}")
    holds, opened = ("frames", FRAMES_OF[kind]) if frames and kind in FRAMES_OF else FORMATS[kind]
    if frames and holds != "frames":
        raise LogError(f"{out}: {kind} holds ticks; frames go to .log .asc .blf .mf4")
    if node and holds == "frames":
        raise LogError(f"{out}: the frames are those of all nodes; leave out --node {node}")
    log = new_log(source, "" if node in _names(source)[:1] else node)
    with replacing(out, force=force) as part:
        count = _stream(log, part, holds, opened)
    return Exported(str(out), holds, count, out.stat().st_size, log.damage)


def _stream(log: Log, part: Path, holds: str, opened: Open) -> int:
    """Slabs of the log into a sink. The sink is opened with the first, when the metadata are known."""
    slabs = _slabs(log, holds)
    first = next(slabs, None)
    if first is None:
        raise LogError(f"{log.path}: holds no {holds}")
    sink, count, whole = opened(part, log), 0, False
    try:
        for slab in itertools.chain([first], slabs):
            sink.add(slab)
            count += len(slab)
        whole = True
    finally:
        sink.close(whole=whole)
    return count


def _slabs(log: Log, kind: str) -> Iterator[Records]:
    """Records of one kind, gathered from blocks to about SLAB."""
    held: list[Records] = []
    for block in read_blocks(log):
        if block.kind == kind and len(block.records):
            held.append(block.records)
            if sum(map(len, held)) >= SLAB:
                yield _joined(held)
                held = []
    if held:
        yield _joined(held)


def _joined(held: list[Records]) -> Records:
    """Copied as whole records: field by field takes ten times as long."""
    dtype = held[0].dtype
    whole = np.dtype(f"V{dtype.itemsize}")
    return np.concatenate([np.ascontiguousarray(one).view(whole) for one in held]).view(dtype)
