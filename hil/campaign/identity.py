"""What must be the same on every worker and from one session of a campaign to the next, for the same bits."""

from __future__ import annotations

import hashlib
import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

Identity = dict[str, str]
LIBRARIES: Final = ("hil-drive", "numpy", "scipy", "numba", "llvmlite")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


@lru_cache(maxsize=1)
def source() -> str:
    """A digest of the packages' source, of which two states may have one version."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[2]
    for package in ("hil", "drivers", "firmware_model"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@lru_cache(maxsize=1)
def identity() -> Identity:
    """Versions, source and architecture of this process."""
    found = {name: _version(name) for name in LIBRARIES}
    return found | {"source": source(), "python": platform.python_version(), "machine": platform.machine()}


def differences(wanted: Identity, found: Identity) -> str:
    """What differs, in words; empty for nothing."""
    names = [name for name in wanted if wanted[name] != found.get(name)]
    return ", ".join(f"{name} {found.get(name, 'unknown')} and not {wanted[name]}" for name in names)
