"""JSON schemas of the four kinds of configuration files, for editors and for all else that is said of keys.

The models that read the files are the one source: pydantic gives types, ranges and defaults, the docstring
below a field its line, the end of its name its unit (:mod:`hil.manual.units`). Docstrings are read from the
source when somebody asks, and not while a run starts.
"""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final

from pydantic import BaseModel, TypeAdapter

import firmware_model.config
import hil.config.table
from drivers.mapping import NO_KEYS, DriveMap
from firmware_model.config import PlantConfig
from hil.campaign.plan import CovarianceTable, PlanTable
from hil.config.mistakes import models_in
from hil.config.nodes import MOST, NAME, OWN
from hil.config.tables import RunConfig
from hil.faults.matrix import Expect, Matrix
from hil.manual.units import unit_of

FILES: Final[dict[str, type[BaseModel]]] = {
    "run": RunConfig,
    "plant": PlantConfig,
    "faults": Matrix,
    "campaign": PlanTable,
}
"""Kinds of files: what is run, the emulated drive, the rows of ``hil faults``, a campaign's plan."""
INCLUDED: Final = (hil.config.table.included, firmware_model.config.included)
"""What lets a table be the path of a file that holds it."""
USUAL: Final = ("ftdob", "cascade")
"""Kinds that a table may leave out."""
NODES: Final = "x-nodes"
"""Marks what says a table's keys once more, for a list of nodes."""
Schema = dict[str, Any]


@functools.cache
def schema_of(file: str) -> Schema:
    """JSON schema (2020-12) of a kind of file; ``x-unit`` beside a number is its unit."""
    model = FILES[file]
    schema = model.model_json_schema()
    known = {one.__name__: one for one in reached(model)}
    for name, table in (*schema.get("$defs", {}).items(), (model.__name__, schema)):
        _describe(table, known[name])
    _open(schema, file)
    about = " ".join((model.__doc__ or "").split())
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"hil {file}: {about}"}
    return head | {key: value for key, value in schema.items() if key not in head}


def reached(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """A model and all that its fields lead to."""
    yield model
    for field in model.model_fields.values():
        for inner in models_in(field.annotation):
            yield from reached(inner)


def docs_of(model: type[Any]) -> dict[str, str]:
    """The docstring below each field of a class, those of its bases first; empty without source."""
    found: dict[str, str] = {}
    for one in reversed(model.__mro__):
        if one not in BaseModel.__mro__:
            found |= _written_in(one.__module__).get(one.__name__, {})
    return found


@functools.cache
def _written_in(module: str) -> dict[str, dict[str, str]]:
    """The docstrings below the fields of each class of a module. What is made at run time has none there."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return {}
    return {node.name: _below(node.body) for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def _below(body: list[ast.stmt]) -> dict[str, str]:
    return {
        ast.unparse(field.target): " ".join(ast.literal_eval(below.value).split())
        for field, below in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr)
    }


def _describe(table: Schema, model: type[BaseModel]) -> None:
    """Put description and unit beside each key of a table."""
    docs = docs_of(model)
    for name, field in model.model_fields.items():
        key = _given(table["properties"][field.alias or name])
        table["properties"][field.alias or name] = key
        text = docs.get(name) or key.get("description") or _of_table(field.annotation)
        unit = key.get("x-unit") or unit_of(name)
        key |= {"description": sentence(text), **({"x-unit": unit} if unit and _counts(key) else {})}
        if any(getattr(one, "func", None) in INCLUDED for one in field.metadata):
            table["properties"][name] = {"anyOf": [{"type": "string"}, key], "description": sentence(text)}
    kind = table["properties"].get("kind", {})
    if "const" in kind and kind.get("default") not in (None, *USUAL):  # else a key of that name
        table["required"] = sorted({*table.get("required", ()), "kind"})
    table["description"] = sentence((model.__doc__ or "").split("\n\n")[0])


def _given(key: Schema) -> Schema:
    """A key as a file can have it: TOML has no null, and the default of a table is that of its keys."""
    out = {name: value for name, value in key.items() if name not in ("title", "anyOf")}
    kinds = [one for one in key.get("anyOf", ()) if one.get("type") != "null"]
    out |= kinds[0] if len(kinds) == 1 else {"anyOf": kinds} if kinds else {}
    if out.get("default") is None or isinstance(out["default"], dict):
        out.pop("default", None)
    return out


def _of_table(annotation: Any) -> str:
    """What a table says of itself, for a key that is a table of one kind."""
    models = models_in(annotation)
    return (models[0].__doc__ or "").split("\n\n")[0] if len(models) == 1 else ""


def sentence(text: str) -> str:
    """A text as one line with a full stop; its first word begins large unless it is a symbol or a name."""
    line = " ".join(text.split())
    first = line.partition(" ")[0].rstrip(",:;")
    large = line[:1].upper() if first.isalpha() and len(first) > 1 else line[:1]
    return line and (large + line[1:].rstrip(".") + ".").replace("``", "")


def _counts(key: Schema) -> bool:
    """True for a number, a list of numbers, or one of them that may be left out."""
    kinds = [key, key.get("items", {}), *key.get("anyOf", ())]
    kinds += [one["items"] for one in kinds if isinstance(one.get("items"), dict)]
    return any(one.get("type") in ("number", "integer") for one in kinds)


def _open(schema: Schema, file: str) -> None:
    """Tables that are checked elsewhere: the map of a drive, a campaign's axes, expectations of rows."""
    if file == "run":
        signals = schema["$defs"]["DriveTable"]["properties"]["signals"]
        signals |= _map_schema() | {"description": signals["description"]}
        expect = schema["$defs"]["FaultsTable"]["properties"]["expect"]
        expect["additionalProperties"] = _table(Expect)
        _open_nodes(schema)
    if file == "faults":
        schema["$defs"]["Row"]["properties"]["fault"]["items"] = {"type": "object", "required": ["kind"]}
    if file == "campaign":
        group = _table(CovarianceTable)
        covariance = schema["properties"]["covariance"]
        covariance |= {"anyOf": [group, {"type": "array", "items": group}]}


def _open_nodes(schema: Schema) -> None:
    """``[[drive]]``: a list of nodes, each with the tables that else stand at the top."""
    drive, given = schema["$defs"]["DriveTable"], schema["properties"]
    name = {"type": "string", "pattern": f"^{NAME.pattern}$", "description": "What the node is called."}
    node = {
        "type": "object",
        "description": "A node of several on one bus (docs/two-nodes.md).",
        "properties": {"name": name} | drive["properties"] | {own: given[own] for own in OWN},
        "required": ["name", "dbc"],
        "additionalProperties": False,
    }
    nodes = {"type": "array", "items": node, "minItems": MOST, "maxItems": MOST, NODES: True}
    given["drive"] = {"anyOf": [given["drive"], nodes]}
    needed = [key for key in schema["required"] if key != "drive"]
    schema["required"] = ["drive"]
    schema["if"] = {"properties": {"drive": {"type": "object"}}}
    schema["then"] = {"required": needed}


def _table(model: type[BaseModel]) -> Schema:
    table = model.model_json_schema()
    _describe(table, model)
    return table


def _map_schema() -> Schema:
    """``[drive.signals]``: the fields of the map that a config gives."""
    table = TypeAdapter(DriveMap).json_schema()
    for name in NO_KEYS:  # said elsewhere
        del table["properties"][name]
    table.pop("$defs", None)
    for name in ("start", "stop"):
        table["properties"][name]["items"] = {"type": "object", "required": ["message"]}
    for name, text in docs_of(DriveMap).items():
        if name in table["properties"]:
            table["properties"][name] |= {"description": sentence(text)}
            table["properties"][name].pop("title", None)
    for name in ("constants", "units"):  # TOML reads A.B = 1 as a table in a table
        values = table["properties"][name]["additionalProperties"]
        nested = {"type": "object", "additionalProperties": values}
        table["properties"][name]["additionalProperties"] = {"anyOf": [values, nested]}
    return table | {"additionalProperties": False, "description": "Which signal plays which part."}
