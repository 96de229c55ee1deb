"""The configurations that come with the package: in the source tree, or where a wheel puts them."""

from __future__ import annotations

import sysconfig
from pathlib import Path
from typing import Final

from hil.errors import HilError

SOURCE_TREE: Final = Path(__file__).resolve().parents[2] / "configs"
INSTALLED: Final = Path(sysconfig.get_path("data")) / "share" / "hil-drive" / "configs"
"""Where ``[tool.setuptools.data-files]`` of pyproject.toml puts them."""


def find_config(name: str) -> Path:
    """A shipped configuration: in the working directory's configs/, else the package's. Raises HilError."""
    for folder in (Path("configs"), SOURCE_TREE, INSTALLED):
        if (folder / name).is_file():
            return folder / name
    raise HilError(f"configs/{name}: not found; run from the project's folder or pass a configuration")


def find_shipped(name: str) -> Path:
    """A configuration as it was shipped, whatever the working directory holds. Raises HilError."""
    for folder in (SOURCE_TREE, INSTALLED):
        if (folder / name).is_file():
            return folder / name
    raise HilError(f"{name}: is not in the installation; install hil-drive anew")


def log_base(config: Path) -> Path:
    """Folder that a config's ``log.folder`` is relative to: its own; an installed one's is ./configs."""
    return Path.cwd() / "configs" if config.is_relative_to(INSTALLED) else config.parent
