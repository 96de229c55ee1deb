"""What may be written where: no result takes the place of a measurement, or of anything not of its kind."""

from __future__ import annotations

import os
from pathlib import Path

from hil.errors import HilError

MCAP_MAGIC = b"\x89MCAP0\r\n"


def output_file(path: Path, *endings: str, config: Path | None = None) -> Path:
    """A file to be written in the end, refused before the work when it can't be. Raises HilError.

    Its name must end in one of ``endings``, and what is there already must be no log, and not the ``config``
    that the work is for: a mistyped line must not write over a measurement.
    """
    if path.is_dir():
        raise HilError(f"{path}: is a folder; name another file")
    if path.suffix.lower() not in endings:
        raise HilError(f"{path}: must end in {' or '.join(endings)}; name another file")
    if not path.parent.is_dir():
        raise HilError(f"{path.parent}: no such folder; make it, or name another file")
    if path.exists() and not path.is_file():
        raise HilError(f"{path}: is no plain file; name another")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise HilError(f"{path}: can't be written; name another file")
    if path.exists() and _holds_log(path):
        raise HilError(f"{path}: holds a log; name another file")
    if config is not None and path.resolve() == config.resolve():
        raise HilError(f"{path}: is the configuration itself; name another file")
    return path


def output_log(path: Path) -> Path:
    """A log to be written anew. Raises HilError for another ending, and for a file that is there."""
    if path.suffix.lower() != ".mcap":
        raise HilError(f"{path}: must end in .mcap; name another file")
    if path.exists():
        raise HilError(f"{path}: exists already; name another file")
    return path


def _holds_log(path: Path) -> bool:
    """True for an MCAP file, whatever its name."""
    with path.open("rb") as stream:
        return stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC


def output_folder(path: Path, *names: str) -> Path:
    """A folder for results, made with the rights that this user gives new ones. Raises HilError.

    ``names``: files that will be written in it, each held to what :func:`output_file` asks.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HilError(f"{path}: can't be made: {error.strerror}; name another folder") from error
    if not os.access(path, os.W_OK):
        raise HilError(f"{path}: can't be written into; name another folder")
    for name in names:
        output_file(path / name, Path(name).suffix)
    return path
