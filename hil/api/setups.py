"""Configurations for scripts: loaded from a file with other settings, or built from tables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from hil.errors import HilError
from hil.faults.matrix import inline
from hil.runtime.setup import Overrides, Setup, load_setup

Settings = Mapping[str, Any] | Iterable[str]
"""``{"loop.duration_s": 2.0}`` or ``["loop.duration_s=2.0"]``, as ``--set`` takes them."""
File = str | os.PathLike[str]
BUILT: Final = "# made by hil.build: "


def texts(settings: Settings) -> tuple[str, ...]:
    """Settings as ``table.key=value``."""
    if isinstance(settings, Mapping):
        return tuple(f"{key}={inline(value)}" for key, value in settings.items())
    return tuple(settings)


def overrides(settings: Settings) -> Overrides:
    """Settings as the commands take them."""
    return Overrides(settings=texts(settings))


def load(config: File, settings: Settings = ()) -> Setup:
    """A run's configuration with all that belongs to it: loaded, checked and designed; nothing is opened.

    ``config`` is the path of the file, ``settings`` are other values of its keys. Of the result are public:
    ``config`` (typed, frozen tables: ``config.loop.rate_hz``), ``path`` and ``warnings``.

    Raises ``hil.ConfigError`` that names every mistake, and other ``hil.HilError``.
    """
    return load_setup(Path(config), overrides(settings))


def build(tables: Mapping[str, Any], path: File) -> Setup:
    """A configuration from tables, ``{"loop": {"rate_hz": 1000}, ...}``, written to ``path`` and loaded.

    Paths in the tables are relative to that file. It is what ``hil emulate`` and a log need, and is written
    over only where ``build`` made it. Raises ``hil.HilError`` for a file of another origin.
    """
    file = Path(path)
    if file.exists() and not file.read_text(encoding="utf-8", errors="replace").startswith(BUILT):
        raise HilError(f"{file}: exists and was not made by hil.build; name another file")
    plain = [f"{key} = {inline(value)}" for key, value in tables.items() if not isinstance(value, Mapping)]
    for name, table in tables.items():
        if isinstance(table, Mapping):
            plain += [f"\n[{name}]", *(f"{key} = {inline(value)}" for key, value in table.items())]
    file.write_text("\n".join([f"{BUILT}edit what calls it, not this", *plain, ""]), encoding="utf-8")
    return load(file)


def setup_of(config: Setup | File, settings: Settings = ()) -> Setup:
    """A configuration as it is given: loaded, or still a path. Settings on a loaded one are refused."""
    if not isinstance(config, Setup):
        return load(config, settings)
    if texts(settings):
        raise HilError("settings: the configuration is loaded; give them to hil.load")
    return config
