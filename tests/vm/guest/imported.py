"""What the packages of a run consist of: runs on the host and prints, as JSON, what the image is made of.

`modules` in the order of their import and the `files` that they came from; none is of the tree.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from pathlib import Path
from types import ModuleType

from tests.vm.guest import ABSENT

ROOT = Path(__file__).resolve().parents[3]
LOADER = ("/lib64/ld-linux-x86-64.so.2", "/etc/ld.so.cache")


def is_ours(path: Path) -> bool:
    """Of the tree, and not of a virtual environment in it."""
    return path.is_relative_to(ROOT) and not path.is_relative_to(sys.prefix)


def is_package(name: str, module: ModuleType) -> bool:
    """Whether an import by that name gives this module again, from outside the tree."""
    spec = getattr(module, "__spec__", None)
    if spec is None or spec.name != name:
        return False
    return not (spec.origin and is_ours(Path(spec.origin))) and not name.startswith("__editable__")


def mapped() -> set[str]:
    """Files of the shared libraries, and the symbolic links beside them that they are found by."""
    lines = (line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text().splitlines())
    files = {words[5] for words in lines if len(words) == 6 and words[5].startswith("/")}
    folders = {Path(file).parent for file in files}
    links = (
        link for folder in folders if folder.is_dir() for link in folder.glob("*.so*") if link.is_symlink()
    )
    return files | {str(link) for link in links if str(link.resolve()) in files}


def installed() -> set[str]:
    """What Python looks at when it starts, and how plugins are found."""
    folders = (Path(folder) for folder in sys.path if folder.startswith(sys.prefix))
    started = {str(file) for folder in folders for file in folder.glob("*.pth")}
    described = {
        str(distribution.locate_file(file))
        for distribution in importlib.metadata.distributions()
        for file in distribution.files or ()
        if file.name in ("METADATA", "entry_points.txt")
    }
    return {sys.executable, str(Path(sys.prefix) / "pyvenv.cfg"), *LOADER, *started, *described}


def main() -> None:
    opened: set[str] = set()

    def look(event: str, args: tuple[object, ...]) -> None:
        if event == "open" and isinstance(args[0], str):
            opened.add(args[0])

    sys.addaudithook(look)
    sys.modules.update(dict.fromkeys(ABSENT))  # type: ignore[arg-type]
    from tests.vm.guest.process import warm_up

    warm_up()
    loaded = {name: module for name, module in sys.modules.items() if module}
    places = ("__file__", "__cached__")
    files = {getattr(module, place, None) or "" for module in loaded.values() for place in places}
    files |= {file for file in opened if file.startswith((sys.prefix, sys.base_prefix))}
    files |= mapped() | installed()
    modules = [name for name, module in loaded.items() if is_package(name, module)]
    kept = sorted(file for file in files if Path(file).is_file() and not is_ours(Path(file)))
    print(json.dumps({"absent": ABSENT, "modules": modules, "files": kept}))


if __name__ == "__main__":
    main()
