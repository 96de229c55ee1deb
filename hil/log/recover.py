"""`hil recover`: what a damaged log still holds, as a complete log, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.log.errors import LogError
from hil.log.mcapfile import RunFile
from hil.log.reader import Log, read_blocks
from hil.signals import new_ticks


@dataclass(frozen=True, slots=True)
class Recovery:
    """What came over. ``damage`` is None when the log was complete already."""

    path: Path
    ticks: int
    frames: int
    events: int
    last_t_ns: int | None
    damage: str | None

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "log": str(self.path),
            "ticks": self.ticks,
            "frames": self.frames,
            "events": self.events,
            "last_t_ns": self.last_t_ns,
            "damage": self.damage,
        }


def recover(path: Path, out: Path) -> Recovery:
    """Rewrite ``path`` as the new file ``out``. Raises LogError when either can't be."""
    log = Log(path, new_ticks(0))
    held = sum(len(block.records) for block in read_blocks(log))  # metadata are known once it is read
    if log.damage is not None and not held and not log.event_count:
        raise LogError(f"{path}: holds no tick, frame or event that can be read ({log.damage})")
    try:
        with _begin(log, out) as file:
            return _copy(log, file, out)
    except OSError as error:
        if isinstance(error, LogError):
            raise
        raise LogError(f"{out}: can't be written ({error.strerror})") from error


def _begin(log: Log, out: Path) -> RunFile:
    run = log.metadata.get("run", {})
    header = {"metadata": run, "attachments": log.attachments, "nodes": list(log.nodes[1:])}
    header["more"] = {name: log.metadata[name] for name in _of_nodes(log) if name in log.metadata}
    file = RunFile(out, header, absent=log.absent)
    if "part" in log.metadata:
        file.add_metadata("part", log.metadata["part"])
    file.add_metadata("recovered", {"from": log.path.name, "damage": log.damage or "none"})
    return file


def _of_nodes(log: Log) -> tuple[str, ...]:
    """What the metadata of a run with several nodes are called."""
    return ("nodes", *(f"run of {node}" for node in log.nodes[1:])) if log.nodes else ()


def _copy(log: Log, file: RunFile, out: Path) -> Recovery:
    """Copy block by block: memory stays bounded."""
    for kind, records in read_blocks(Log(log.path, new_ticks(0))):
        if kind == "ticks":
            file.add_ticks(records)
        else:
            file.add_frames(records)
    for node in log.nodes[1:]:
        for kind, records in read_blocks(Log(log.path, new_ticks(0), node=node)):
            if kind == "ticks":
                file.add_ticks(records, node)
    for event in log.events:
        file.add_event(event["t_ns"], event["k"], event["kind"], event["text"])
    recovery = Recovery(out, file.ticks, file.frames, len(log.events), log.last_t_ns, log.damage)
    file.finish(log.result or {"ended": "not known, recovered from a damaged log"})
    return recovery
