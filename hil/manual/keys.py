"""The keys of the configuration files, one by one, as the schema has them."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from hil.errors import HilError
from hil.manual.schema import FILES, NODES, Schema, schema_of

BEFORE: Final = {"run": "", "plant": "plant:", "faults": "faults:", "campaign": "campaign:"}
"""What stands before a key that is of another file than the run's, as in a campaign's plan."""


NAMES: Final = {"string": "text", "boolean": "true or false", "object": "table"}


@dataclass(frozen=True, slots=True)
class Key:
    """One key; None for what it has not. ``above`` is a bound that is not included."""

    key: str
    kind: str | None
    type: str
    unit: str | None
    least: float | None
    above: float | None
    most: float | None
    default: Any
    required: bool
    doc: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)

    @property
    def range(self) -> str:
        """Least and most, both included unless it says so; empty for none."""
        if self.above is not None and (self.least is None or self.above >= self.least):
            return f"above {short(self.above)}" + (f", up to {short(self.most)}" if self.most else "")
        if self.least is None or self.most is None:
            return f"from {short(self.least)}" if self.least is not None else ""
        return f"{short(self.least)} to {short(self.most)}"

    @property
    def facts(self) -> str:
        """Type, range with unit, default, in a line."""
        span = " ".join(part for part in (self.range, self.unit) if part)
        given = "needed" if self.required else f"default {written(self.default)}"
        return ", ".join(part for part in (self.type, span, given) if part)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a file; of several ``kind`` one, ``many`` for an array of tables."""

    file: str
    key: str
    kind: str | None
    many: bool
    doc: str
    keys: list[Key] = field(default_factory=list)

    @property
    def name(self) -> str:
        """As it stands in a file; empty for what stands above all tables."""
        path = self.key.rpartition(":")[2]
        return path and (f"[[{path}]]" if self.many else f"[{path}]")


def short(value: float) -> str:
    """A bound as one writes it: 1e9, 0.001, 2147483647."""
    return str(value) if isinstance(value, int) else f"{value:g}".replace("e+0", "e").replace("e-0", "e-")


def written(value: Any) -> str:
    """A default as TOML writes it; none where leaving a key out means something of its own."""
    return "none" if value is None else json.dumps(value)


def tables() -> list[Table]:
    """All tables of all files, each before those in it."""
    return [table for file in FILES for table in _tables(file)]


def _tables(file: str) -> Iterator[Table]:
    schema = schema_of(file)
    yield from _walk(schema, schema, file, BEFORE[file], False)


def _walk(schema: Schema, node: Schema, file: str, key: str, many: bool) -> Iterator[Table]:
    """The table ``node`` that is called ``key``, and those in it."""
    kind = node["properties"].get("kind", {}).get("const")
    table = Table(file, key.rstrip("."), kind, many, node.get("description", ""))
    inner, needed = [], (*node.get("required", ()), *node.get("then", {}).get("required", ()))
    for name, given in node["properties"].items():
        one = _key(name, given, name in needed, table)
        members, is_list = _members(schema, given)
        if members:
            inner += [_walk(schema, member, file, f"{key}{name}.", is_list) for member in members]
        if not members or {"type": "string"} in given.get("anyOf", ()):
            table.keys.append(one)
    yield table
    for walk in inner:
        yield from walk


def _members(schema: Schema, given: Schema) -> tuple[list[Schema], bool]:
    """The tables that a key may be, and whether it is an array of them."""
    if "$ref" in given:
        return [schema["$defs"][given["$ref"].rpartition("/")[2]]], False
    if given.get("type") == "array":
        return _members(schema, given.get("items", {}))[0], True
    if "properties" in given:
        return [given], False
    several = (*given.get("oneOf", ()), *given.get("anyOf", ()))
    found = [_members(schema, one) for one in several if NODES not in one]
    out: list[Schema] = []
    for members, _ in found:
        out += [member for member in members if member not in out]
    return out, any(is_list for _, is_list in found)


def _key(name: str, given: Schema, required: bool, table: Table) -> Key:
    before = table.key + ("" if not table.key or table.key.endswith(":") else ".")
    if name == "kind" and table.kind:
        doc = "Tells the kinds apart" + ("." if required else "; this one may be left out.")
        given = {"default": table.kind, "description": doc}
    least, above, most = _bounds(given.get("items", given) if given.get("type") == "array" else given)
    return Key(
        key=before + name,
        kind=table.kind,
        type=f'"{table.kind}"' if name == "kind" and table.kind else _type(given),
        unit=given.get("x-unit"),
        least=least,
        above=above,
        most=most,
        default=given.get("default"),
        required=required,
        doc=given.get("description", ""),
    )


def _type(given: Schema) -> str:
    """What a key takes, in a word or two."""
    if "enum" in given:
        return " or ".join(json.dumps(value) for value in given["enum"])
    if several := given.get("anyOf") or given.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(one) for one in several))
    kind = str(given.get("type", "object"))
    return f"list of {_type(given.get('items', {}))}" if kind == "array" else NAMES.get(kind, kind)


def _bounds(given: Schema) -> tuple[float | None, float | None, float | None]:
    """Least, what it must be above, most; of whole numbers the largest that is allowed."""
    most, below = given.get("maximum"), given.get("exclusiveMaximum")
    most = below - 1 if below is not None and given.get("type") == "integer" else most
    return given.get("minimum"), given.get("exclusiveMinimum"), most


def found(wanted: str) -> list[Key]:
    """The keys that ``wanted`` names: a key, a table, or the end of keys. Raises HilError for none.

    ``load.0.torque_n_m``, as ``--set`` takes it, is ``load.torque_n_m``.
    """
    asked = ".".join(part for part in wanted.strip().strip("[].").split(".") if not part.isdecimal())
    keys = [key for table in tables() for key in table.keys]
    hits = [key for key in keys if key.key == asked]
    hits = hits or [key for key in keys if key.key.startswith((f"{asked}.", f"{asked.rstrip(':')}:"))]
    hits = hits or [key for key in keys if f".{key.key.rpartition(':')[2]}.".find(f".{asked}.") >= 0]
    if not asked or not hits:
        raise HilError(f"{wanted}: no such key{_near(asked, keys)}; hil config explain lists all tables")
    return hits


def _near(asked: str, keys: list[Key]) -> str:
    ends = {key.key.rpartition(".")[2].rpartition(":")[2]: key.key for key in keys}
    close = difflib.get_close_matches(asked, [key.key for key in keys], n=1)
    close = close or [ends[end] for end in difflib.get_close_matches(asked.rpartition(".")[2], ends, n=1)]
    return f"; did you mean {close[0]!r}?" if close else ""
