"""TOML files: read with a bound on their size, and keys of them set from the command line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from hil.errors import ConfigError

MAX_CONFIG_BYTES = 1 << 20
# tomllib keeps every prefix of a dotted key: one of 100,000 parts would take 40 GB
_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){16}""")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 1 MiB. Raises ConfigError with the file's name and the line."""
    try:
        with path.open("rb") as stream:  # a device has no size, and no end
            raw = stream.read(MAX_CONFIG_BYTES + 1)
        if len(raw) > MAX_CONFIG_BYTES:
            raise ConfigError(str(path), [f"larger than {MAX_CONFIG_BYTES} bytes; this is no configuration"])
        text = raw.decode()
    except OSError as error:
        raise ConfigError(str(path), [f"can't be read: {error.strerror or error}"]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [f"is not TOML: {error}"]) from error
    if _DEEP_KEY.search(text):
        raise ConfigError(str(path), ["holds a key of more than 16 parts; this is no configuration"])
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # not TOML, or a number of too many digits
        raise ConfigError(str(path), [f"is not TOML: {error}"]) from error


def override(data: dict[str, Any], setting: str, base: Path) -> None:
    """Set one ``table.key=value``; a value that is not TOML is taken as a string.

    A table that is given as the path of a file is read first, so that one key of it can be changed.
    """
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise ConfigError("--set", [f"{setting!r} is not of the form table.key=value"])
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    put(data, key.strip(), value, base)


def put(data: dict[str, Any], key: str, value: Any, base: Path, where: str = "--set") -> None:
    """Set the key ``table.key``, of an array of tables ``table.0.key``, to ``value``. Raises ConfigError.

    A table that is given as the path of a file, relative to ``base``, is read first.
    """
    *tables, last = key.split(".")
    place: Any = data
    for name in tables:
        place = _table_of(place, name, base)
        if not isinstance(place, dict | list):
            raise ConfigError(where, [f"{key}: {name} is not a table"])
    if isinstance(place, dict):
        place[last] = value
        return
    place[_row(place, last, key, where)] = value


def _table_of(place: Any, name: str, base: Path) -> Any:
    """What ``name`` leads to, a new table where there is none; None where it leads nowhere."""
    if isinstance(place, list):
        return place[int(name)] if name.isdecimal() and int(name) < len(place) else None
    if isinstance(place.get(name), str) and place[name].endswith(".toml"):
        place[name] = read_toml(base / place[name])
    return place.setdefault(name, {})


def _row(rows: list[Any], name: str, key: str, where: str) -> int:
    if not name.isdecimal() or int(name) >= len(rows):
        raise ConfigError(where, [f"{key}: there are entries 0 to {len(rows) - 1}, and no {name}"])
    return int(name)
