"""What a log says of its run: where it lies, and the facts in its header."""

from __future__ import annotations

import json
import math
import platform
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hil.config.shipped import log_base
from hil.config.toml import read_toml
from hil.errors import ConfigError
from hil.log.origin import origin, package_version
from hil.log.split import part_path
from hil.runtime.progress import say
from hil.runtime.setup import Setup


def log_path(setup: Setup, kind: str) -> Path:
    """Where the run's log goes: the configured name, or config name, kind and UTC time."""
    log = setup.config.log
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    name = log.name or f"{setup.path.stem}-{kind}-{stamp}"
    path = (log_base(setup.path) / log.folder / f"{name}.mcap").resolve()
    return path if log.split_s is None and log.split_mb is None else part_path(path, 0)


def plant_of(path: Path) -> dict[str, str]:
    """The plant's file as an attachment: with a motor and no bus, and nothing else that the path may lead to.

    Whether it holds mistakes is for the emulated drive to say: a run does not load the plant's model.
    """
    try:
        if not path.is_file():
            raise ConfigError(str(path), ["no such file"])
        data = read_toml(path)
        if "motor" not in data or "bus" in data:
            raise ConfigError(str(path), ["is no plant, which has a motor and no bus"])
        return {"plant.toml": path.read_text(encoding="utf-8")}
    except (ConfigError, OSError, ValueError) as error:
        say(f"no plant is kept in the log: {str(error).splitlines()[0]}")
        return {}


def header_of(setup: Setup, kind: str, clock: str) -> dict[str, Any]:
    """Metadata and attachments that make a log self-contained."""
    packages = ("numpy", "scipy", "numba", "python-can", "mcap")
    attachments = {
        "config.toml": setup.path.read_text(encoding="utf-8"),
        "config.json": setup.config.model_dump_json(),
        "controller.json": setup.machine.to_json(),
        "drive.dbc": setup.database.text,
    }
    if setup.config.emulator is not None:
        attachments |= plant_of(setup.path.parent / setup.config.emulator.plant)
    return {
        "metadata": {
            "kind": kind,
            "clock": clock,
            "started": datetime.now(UTC).isoformat(),
            "python": sys.version.split()[0],
            "machine": platform.machine(),
            "kernel": platform.release(),
            "wire": json.dumps(
                {
                    "u_lsb": setup.wire.u_lsb,
                    "T_L_lsb": setup.wire.T_L_lsb,
                    "counter_modulus": setup.wire.counter_modulus,
                    "x_lsb": setup.wire.x_lsb,
                    "u_top": setup.wire.u_top,
                    **({"T_L_top": setup.wire.T_L_top} if math.isfinite(setup.wire.T_L_top) else {}),
                    "slow": [asdict(message) for message in setup.wire.slow],
                    "measured": setup.wire.measured,
                    **({"theta_span": setup.wire.theta_span} if setup.wire.theta_span else {}),
                }
            ),
            **origin(),
            **{f"version {name}": package_version(name) for name in packages},
        },
        "attachments": attachments,
        "compression": setup.config.log.compression,
        "split": {"s": setup.config.log.split_s, "mb": setup.config.log.split_mb},
    }
