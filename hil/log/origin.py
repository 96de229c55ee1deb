"""Who writes: version and commit of the running code, as they stand in a log, and the log's format."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from hil.log.layouts import FORMAT

PACKAGE = Path(__file__).resolve().parents[1]
CODE = ("hil", "drivers", "firmware_model")


def package_version(name: str) -> str:
    """Version of an installed package."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=PACKAGE, capture_output=True, text=True, timeout=5, check=True)
    return done.stdout.strip()


@cache
def commit() -> str:
    """The commit that this code is of, "+changes" when it was changed since; "installed wheel" out of git.

    A wheel may be installed inside somebody else's repository: its commit says nothing of this code.
    """
    try:
        if Path(_git("rev-parse", "--show-toplevel")).resolve() != PACKAGE.parent:
            return "installed wheel"
        changed = _git("status", "--porcelain", "--", *(str(PACKAGE.parent / name) for name in CODE))
        return _git("rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return "installed wheel"


def origin() -> dict[str, str]:
    """What every log says of its writer."""
    return {
        "format": str(FORMAT),
        "commit": commit(),
        "version hil-drive": package_version("hil-drive"),
    }


def is_own(run: Mapping[str, str]) -> bool:
    """True when the metadata ``run`` of a log is of this very code, as far as can be told."""
    return all(run.get(name) == text for name, text in origin().items())
