"""``docs/reference-config.md`` from the keys.

    python -m hil.manual.page docs

writes it and the four schemas beside it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Final

from hil.manual.keys import Key, Table, tables, written
from hil.manual.schema import FILES, schema_of

HEAD: Final = """# Every key of every file

Made from the tables that read the files by `make reference`; a test holds them together. `hil config explain
KEY` says the same in the terminal. A key that is needed has no default; "none" is a key whose absence means
what its line says. Ranges are those that are refused at once; what a motor or a bus can't do is refused when
all is known.

Editors that know [taplo](https://taplo.tamasfe.dev) (VS Code: Even Better TOML) complete and check keys by
the schema that the first line of a file names:

```toml
#:schema config.schema.json
```

`hil init DIR` puts the schemas beside the files; `hil config schema [run|plant|faults|campaign]` prints one.
"""
TITLES: Final = {
    "run": "A run: `hil run CONFIG`",
    "plant": "The emulated drive: `[emulator] plant = FILE`",
    "faults": "Faults: `hil faults FILE`",
    "campaign": "A campaign: `hil campaign PLAN`",
}


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for file, group in groupby(tables(), key=lambda table: table.file):
        parts += [f"## {TITLES[file]}\n", *_sections(list(group))]
    return "\n".join(parts)


def _sections(found: list[Table]) -> Iterator[str]:
    """A section a table; those that have the same keys, as the observers of two channels, share one."""
    same: dict[str, list[Table]] = {}
    for table in found:
        same.setdefault("\n".join([table.kind or "", table.doc, *map(_row, table.keys)]), []).append(table)
    for alike in same.values():
        first = alike[0]
        named = dict.fromkeys(f"`{table.name}`" for table in alike if table.name)
        names = ", ".join(named) or "Above all tables"
        yield f"### {names}" + (f', `kind = "{first.kind}"`' if first.kind else "") + f"\n\n{first.doc}\n"
        if first.keys:
            yield "| key | type | range | default | |\n|---|---|---|---|---|"
            yield "\n".join(map(_row, first.keys)) + "\n"


def _row(key: Key) -> str:
    """A row of the table of keys."""
    span = " ".join(part for part in (key.range, key.unit) if part)
    default = "needed" if key.required else "none" if key.default is None else f"`{written(key.default)}`"
    name = key.key.rpartition(":")[2].rpartition(".")[2]
    return " | ".join([f"| `{name}`", key.type, span, default, _safe(key.doc) + " |"])


def _safe(text: str) -> str:
    return text.replace("|", "\\|").replace("*", "\\*")


SCHEMAS: Final = {f"{'config' if file == 'run' else file}.schema.json": file for file in FILES}
"""The kind of file for each schema's name."""


def schema_text(name: str) -> str:
    """What stands in the file of that name."""
    return json.dumps(schema_of(SCHEMAS[name]), indent=1) + "\n"


def files() -> dict[str, str]:
    """What is made, by name: the page and the schemas."""
    return {"reference-config.md": page()} | {name: schema_text(name) for name in SCHEMAS}


if __name__ == "__main__":
    for name, text in files().items():
        (Path(sys.argv[1]) / name).write_text(text, encoding="utf-8")
