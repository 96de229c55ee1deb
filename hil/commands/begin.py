"""``hil init`` and ``hil completion``: what one needs once, at the beginning."""

from __future__ import annotations

import argparse
import re
import tomllib
from pathlib import Path

from hil.commands.common import Commands, print_json, say

SCHEMA = re.compile(r"#:schema \S*?([\w.]+\.schema\.json)")
KINDS = ("demo", "vcan0", "can0", "inverter", "paper")


def register(commands: Commands) -> None:
    """Add what this module offers."""
    command = commands.add(
        "init", cmd_init, "Copy a configuration with its motor, plant and DBC into a folder to start from."
    )
    command.add_argument("folder", type=Path, metavar="DIR", help="new or empty folder")
    command.add_argument("--like", choices=KINDS, default="demo", help="which one to copy (default: demo)")
    command = commands.add("completion", cmd_completion, "Print a shell's completion script for hil.")
    command.add_argument("shell", choices=("bash", "zsh", "tcsh"), help='bash: eval "$(hil completion bash)"')
    command.set_defaults(parser=commands.parser)


def wanted(config: Path) -> list[Path]:
    """A configuration and the files that it names, and they name in turn."""
    found, waiting = [], [config]
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.append(path)
        if path.suffix == ".toml":
            waiting += [path.parent / name for name in named(tomllib.loads(path.read_text(encoding="utf-8")))]
    return found


def named(table: object) -> list[str]:
    """The files that a table names."""
    if isinstance(table, dict):
        return [name for value in table.values() for name in named(value)]
    is_file = isinstance(table, str) and table.endswith((".toml", ".dbc"))
    return [str(table)] if is_file else []


def cmd_init(args: argparse.Namespace) -> int:
    """Copy; nothing that is there is touched."""
    from hil.config.shipped import find_shipped
    from hil.errors import HilError

    folder: Path = args.folder
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise HilError(f"{folder}: is not an empty folder; name a new one")
    source = find_shipped(f"{args.like}.toml")
    made: dict[Path, str] = {}
    files = {(folder / path.resolve().relative_to(source.resolve().parent)): path for path in wanted(source)}
    try:
        for to, path in files.items():
            to.parent.mkdir(parents=True, exist_ok=True)
            text = path.read_text(encoding="utf-8").replace('folder = "../logs"', 'folder = "logs"')
            if path.suffix == ".toml":
                text = _with_schema(text, to, folder, made)
            to.write_text(text, encoding="utf-8")
        for to, text in made.items():
            to.write_text(text, encoding="utf-8")
    except OSError as error:
        raise HilError(f"{folder}: can't be written ({error.strerror}); name another folder") from error
    config = folder / f"{args.like}.toml"
    if args.json:
        print_json({"config": str(config), "files": sorted(map(str, [*files, *made]))})
    else:
        say("\n".join(f"hil: {to}" for to in sorted([*files, *made])))
        say(f"hil: next: hil demo {config}, or hil emulate {config} and hil run {config}")
    return 0


def _with_schema(text: str, to: Path, folder: Path, made: dict[Path, str]) -> str:
    """A file's text whose ``#:schema`` names the schema in ``folder``, which is noted in ``made``."""
    from hil.manual.page import schema_text

    if not (named := SCHEMA.match(text)):
        return text
    schema = folder / named[1]
    made[schema] = schema_text(named[1])
    up = "../" * len(to.parent.relative_to(folder).parts)
    return f"#:schema {up}{named[1]}" + text[named.end() :]


def cmd_completion(args: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    print(shtab.complete(args.parser, shell=args.shell))  # noqa: T201
    return 0
