"""Two nodes on one bus: a configuration whose ``[[drive]]`` is a list, taken apart into one for each node.

What belongs to a node stands in its entry (``drive.motor``, ``drive.limits``, ...); a table that all share
may stand at the top, and an entry's own replaces it. Loop, bus, guardian, log and rights are the run's. So
each node is a whole :class:`hil.config.tables.RunConfig`, checked and designed like any other, and commands
for one drive take one node of such a file by ``--set node=NAME``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from hil.errors import ConfigError

OWN: Final = (
    "motor", "controller", "observer", "limits", "feedback", "reference", "stop", "setpoint", "criteria",
    "emulator", "canopen", "faults",
)  # fmt: skip
"""Tables that an entry may have."""
MOST: Final = 2
NAME: Final = re.compile(r"[a-z][a-z0-9_-]{0,30}")
CHOICE: Final = "node"
"""The key by which a command for one drive takes one of several."""


def several(data: Mapping[str, Any]) -> bool:
    """True where the drive is a list."""
    return isinstance(data.get("drive"), list)


def taken_apart(data: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """What each node's configuration is, by its name, in the file's order. Raises ConfigError."""
    entries = data["drive"]
    problems = _mistakes(entries)
    if problems:
        raise ConfigError(where, problems)
    shared = {name: table for name, table in data.items() if name not in ("drive", CHOICE)}
    out: dict[str, dict[str, Any]] = {}
    for entry in entries:
        own = {name: entry[name] for name in OWN if name in entry}
        drive = {name: value for name, value in entry.items() if name not in (*OWN, "name")}
        out[entry["name"]] = {**shared, **own, "drive": drive}
    return out


def _mistakes(entries: Any) -> list[str]:
    """What is wrong with the list itself."""
    if len(entries) != MOST or not all(isinstance(entry, Mapping) for entry in entries):
        return [
            f"drive: a list of {MOST} tables [[drive]], not of {len(entries)}; one drive alone is [drive]"
        ]
    problems = []
    for index, entry in enumerate(entries):
        name = entry.get("name")
        if not isinstance(name, str) or not NAME.fullmatch(name):
            given = "missing" if name is None else f"{name!r:.40} is no name"
            problems.append(f"drive.{index}.name: {given}; take small letters and digits, as load")
    if not problems and entries[0]["name"] == entries[1]["name"]:
        problems.append(f"drive.1.name: {entries[1]['name']!r} is the first node's too; give each its own")
    return problems


def chosen(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The configuration of one drive: of several the one that ``node`` names. Raises ConfigError."""
    if not several(data):
        return data
    nodes, name = taken_apart(data, where), data.get(CHOICE)
    if name in nodes:
        return nodes[name]
    names = " or ".join(f"--set node={known}" for known in nodes)
    if name is None:
        raise ConfigError(where, [f"drive: is a list of nodes, and this takes one: {names}"])
    raise ConfigError(where, [f"node: there is no {name!r:.40}; take {names}"])
