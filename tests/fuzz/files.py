"""Everything that reads a file of a stranger: taken, or refused with one of the project's own errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drivers.codec import Database
from drivers.errors import DriverError
from firmware_model.config import PlantConfig
from hil.config.tables import RunConfig, load_toml
from hil.errors import HilError
from hil.exchange.recording import Recording
from hil.faults.matrix import Matrix
from hil.log.info import info
from hil.log.reader import open_log
from hil.log.recover import recover

MOST_TICKS = 100_000
Take = Callable[[bytes], None]


def reads(path: Path, read: Callable[[Path], object]) -> Take:
    """A target that writes its input to ``path`` and reads that."""

    def take(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read(path)
        except (HilError, DriverError) as refused:
            assert str(refused), "a refusal says why"

    return take


def read_log(path: Path) -> None:
    """Read, list and recover one log."""
    log = open_log(path)
    assert len(log.ticks) < MOST_TICKS
    info(path)
    out = path.with_suffix(".out")
    out.unlink(missing_ok=True)
    recover(path, out)


def read_recording(path: Path) -> None:
    """A recording of another tool, as far as it can be read."""
    found = Recording(path, partial=True)
    assert sum(1 for _ in found.frames()) == found.count


def read_config(path: Path) -> None:
    load_toml(path, RunConfig)


def read_plant(path: Path) -> None:
    """A plant with its script of faults."""
    load_toml(path, PlantConfig)


def read_matrix(path: Path) -> None:
    load_toml(path, Matrix)


def read_database(path: Path) -> None:
    """A DBC file; whatever it holds must encode and decode its own frames."""
    for message in Database(path).messages.values():
        message.decode(message.encode({}))
