"""Each node's configuration of a file with several (:mod:`hil.config.nodes`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hil.config.nodes import CHOICE, several, taken_apart
from hil.config.tables import RunConfig, validate
from hil.config.toml import override, read_toml


def load_nodes(path: Path, overrides: Iterable[str] = ()) -> dict[str, RunConfig] | None:
    """Each node's configuration by its name; None for a file of one drive, or one node of it chosen.

    Raises ConfigError, an entry's mistakes with the node's name.
    """
    data = read_toml(path)
    for text in overrides:
        override(data, text, path.parent)
    if not several(data) or CHOICE in data:
        return None
    nodes = taken_apart(data, str(path))
    return {
        name: validate(node, RunConfig, f"{path}: node {name}", path.parent) for name, node in nodes.items()
    }
