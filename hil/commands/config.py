"""``hil config``: what a key means, and the schema that editors take."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hil.commands.common import Commands, print_json

if TYPE_CHECKING:
    from hil.manual.keys import Key

FILES = ("run", "plant", "faults", "campaign")


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add("config", cmd_config, "Explain config keys, or print the files' JSON schema.")
    command.add_argument("what", choices=("explain", "schema"))
    command.add_argument(
        "key",
        nargs="?",
        metavar="KEY",
        help="of explain: a key, a table or the end of keys, as loop.rate_hz, limits, delay_ms, "
        "plant:load (default: all tables); of schema: run, plant, faults or campaign (default: run)",
    )


def cmd_config(args: argparse.Namespace) -> int:
    """Explain or print."""
    return _schema(args.key or "run") if args.what == "schema" else _explain(args.key, args.json)


def _schema(file: str) -> int:
    from hil.errors import HilError
    from hil.manual.schema import schema_of

    if file not in FILES:
        raise HilError(f"{file}: no kind of file; there are {', '.join(FILES)}")
    print(json.dumps(schema_of(file), indent=2))  # noqa: T201
    return 0


def _explain(wanted: str | None, as_json: bool) -> int:
    from hil.manual.keys import found, tables

    if wanted is None:
        rows = [{"table": t.key, "kind": t.kind, "keys": len(t.keys), "doc": t.doc} for t in tables()]
        lines = [f"{row['table'] or 'run:'}{_of(row['kind'])}: {row['doc']}" for row in rows]
        lines.append("hil config explain TABLE, or KEY, says more.")
    else:
        keys = found(wanted)
        rows = [key.as_dict() for key in keys]
        lines = list(_told(keys))
    if as_json:
        print_json({"tables" if wanted is None else "keys": rows})
    else:
        print("\n".join(lines))  # noqa: T201
    return 0


def _told(keys: list[Key]) -> Iterator[str]:
    """Two lines a key; kinds for which it is the same share them."""
    same: dict[tuple[str, str, str], list[str]] = {}
    for key in keys:
        same.setdefault((key.key, key.facts, key.doc), []).append(key.kind or "")
    for (name, facts, doc), kinds in same.items():
        yield f"{name}{_of(', '.join(filter(None, kinds)))}: {facts}\n    {doc}"


def _of(kind: object) -> str:
    return f" (kind {kind})" if kind else ""
